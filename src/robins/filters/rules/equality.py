"""Equality constraint on the state throughout a run."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from robins.errors import require
from robins.filters import trees
from robins.filters.belief import Belief, Code, Number, StepInfo
from robins.filters.chi_square import limits, within
from robins.filters.limits.constrain import (
    ITERATIONS,
    Function,
    Weight,
    as_sensor,
    as_weight,
    check_rows,
    check_size,
    constrain,
)
from robins.filters.linearise import Transition
from robins.filters.model import Data, Given
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import (
    Numbers,
    finite_leaf,
    is_known,
    is_probability,
    kind,
    number,
    value,
)


@value
class Equality(Rule):
    """Rule of `equality`: x - G (g(x) - d), G = V D' (D V D')^-1."""

    g: Function
    d: Data  # of the form of g(x); None is zero
    weight: Weight
    noise: Numbers | None
    limit: Numbers | None  # (MOST + 1,) limit of the NIS by components; None: no gate
    hard: bool = kind()
    iterations: int = kind()

    name = "equality"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        sensor, _ = as_sensor(belief.mean, self.g, self.d, self.noise)
        n = belief.factor.shape[0]
        check_size("equality", self.weight, n)
        require(not sensor.dim > n, f"equality has {sensor.dim} components, the state only {n}")
        return jnp.zeros((), bool)  # True if this step has used a noisy constraint

    def process(self, memory: Memory, transition: Transition):
        return jnp.zeros((), bool), transition

    def after(self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        held = constrain(
            posterior, self.g, self.d, self.weight, self.noise, self.hard, self.iterations
        )
        refused = jnp.zeros((), bool)
        if self.limit is not None:
            refused = held.nis > within(self.limit, held.residual)[held.dof]
        skip = refused | memory
        belief = trees.select(skip, posterior, held.belief)
        worst = jnp.max(jnp.abs(held.residual))
        info = info.noted("equality", residual=worst, nis=held.nis, refused=refused)
        info = info.contradicted_where(~skip & jnp.isinf(held.nis))
        partly = refused & (info.code == int(Code.DONE))
        code = jnp.where(partly, int(Code.PARTLY_MISSING), info.code)
        return memory | (self.noise is not None), belief, info._replace(code=code)


def equality(
    g: Function,
    d: Data = None,
    weight: Weight = "covariance",
    noise: Given | None = None,
    hard: bool = False,
    gate: Number | None = None,
    iterations: int = ITERATIONS,
) -> Rule:
    """Constrain the state to ``g(x) = d`` after each update (Simon & Chia 2002; `constrain`).

        G = V D' (D V D')^-1,   x* = x - G (g(x) - d),   P* = (I - G D) P (I - G D)' + G R_d G'

    with V = P or W^-1. A constraint without noise is applied after each sensor's update, even if
    its measurement is missing, and leaves no variance across it, so that no trace of P grows (with
    W = P^-1, no variance at all). P is then singular: if other sensors follow, use
    ``form="sqrt"``. A noisy constraint is information: it is used once per step, at the first
    sensor, as a measurement, K = P D' (D P D' + R_d)^-1. If its errors are not white, model them as
    a state. A constraint that comes with data (air data, a map) is a sensor, not a rule.

    Notes: ``equality.residual``, the greatest entry of |d - g(x)| before; ``equality.nis``, the
    squared residual normalised by D P D' + R_d; ``equality.refused``. A constraint that contradicts
    exact knowledge makes the update `Code.CONTRADICTED`, one that the gate refuses
    ``PARTLY_MISSING``. Infinite noise is the Kalman filter.

    Args:
        g: (c, n) matrix D or a function of the state, as in `constrain`.
        d: value of g(x); zero by default.
        weight: "covariance", "identity" or an (n, n) matrix W.
        noise: (c,) standard deviations or a (c, k) factor of R_d; None: exact.
        hard: put the mean on a noisy constraint, as other weights always do.
        gate: probability of the chi-square quantile beyond which the constraint is refused; None:
            never.
        iterations: number of linearisations of a function.

    Raises:
        ValueError: rows of D are dependent or contradict each other, numbers are not finite, or an
            argument is out of its range; at `init`, D, noise or weight do not fit the state.
    """
    if gate is not None:
        gate = number("equality gate must lie between 0 and 1, or be None", gate, is_probability)
    require(iterations >= 1, "equality iterations must be at least 1", iterations)
    d = jax.tree_util.tree_map(
        lambda leaf: finite_leaf("equality d", leaf), d, is_leaf=lambda x: isinstance(x, list)
    )
    root = None if noise is None else finite_leaf("equality noise", noise)
    metric = as_weight("equality", weight)
    D = g if callable(g) else _rows(finite_leaf("equality D", g), d, root)
    limit = None if gate is None else limits(gate)
    return Equality(D, d, metric, root, limit, hard, iterations)


def _rows(D: Numbers, d: Data, noise: Numbers | None) -> Numbers:
    """D, checked unless it, d or the noise is traced."""
    if not is_known((D, d, noise)):
        return D
    if D.ndim != 2 or D.shape[0] == 0:
        raise ValueError(f"equality D must be (c, n), a row for each constraint, got {D.shape}")
    value = np.zeros(len(D)) if d is None else np.asarray(d, float)
    if value.shape != (len(D),):
        raise ValueError(f"equality d is {value.shape}: ({len(D)},), one for each row of D")
    exact = np.ones(len(D), bool)
    if noise is not None and noise.shape[0] == len(D):  # other shapes are refused by `init`
        exact = ~np.any(noise.reshape(len(D), -1) != 0.0, axis=1)
    check_rows("equality", np.asarray(D), value, exact)
    return D
