"""Hold the state to a constraint that is always true."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from robins.errors import require
from robins.filters import trees
from robins.filters.belief import Belief, Code, Number, StepInfo
from robins.filters.checks import finite_numbers
from robins.filters.chi_square import limits, within
from robins.filters.limits.constrain import (
    ITERATIONS,
    Function,
    Numbers,
    Weight,
    as_sensor,
    check_rows,
    check_weight,
    constrain,
)
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule, hooks


def equality(
    g: Function,
    d: Any = None,
    weight: Weight = "covariance",
    noise: Numbers | None = None,
    hard: bool = False,
    gate: Number | None = None,
    iterations: int = ITERATIONS,
) -> Rule:
    """Hold the state to ``g(x) = d`` after each update (Simon & Chia 2002; `constrain`).

        G = V D' (D V D')^-1,   x* = x - G (g(x) - d),   P* = (I - G D) P (I - G D)' + G R_d G'

    with V = P or W^-1. A constraint without noise holds after each sensor's update, and nothing is
    uncertain across it any more, so that no trace of P grows (W = P^-1: no variance at all). Wants
    ``form="sqrt"`` where other sensors follow: P is singular. A noisy one is information: it is
    used once a step, by the first sensor, and as a measurement would be, K = P D' (D P D' +
    R_d)^-1. Errors of it that last from step to step are not white, and want a state of their own.

    It also holds where the sensor's measurement is missing. What comes with data (air data, a map
    that is read) is a sensor, not a rule.

    Notes: ``equality.residual``, the greatest entry of d - g(x) before; ``equality.nis``, all of
    them squared by D P D' + R_d; ``equality.refused``. A constraint that contradicts what is known
    exactly makes the update `Code.CONTRADICTED`, one that the gate refuses ``PARTLY_MISSING``.
    Infinite noise is the Kalman filter.

    Args:
        g: (c, n) matrix D or a function of the state, as in `constrain`.
        d: what it equals; zero if left out.
        weight: "covariance", "identity" or an (n, n) matrix W.
        noise: (c,) standard deviations or a (c, k) factor of R_d; exact if left out.
        hard: put the mean on a noisy constraint, as other weights always do.
        gate: probability below which a residual is chance: beyond that chi-square quantile the
            constraint is refused. None: never.
        iterations: how often a function is linearised.

    Raises:
        ValueError: rows of D depend on each other or contradict (the rank and the row are named),
            numbers are not finite, a parameter is not of its range; and by `init`, D, noise or
            weight do not fit the state.
    """
    if gate is not None and not 0.0 < gate < 1.0:
        raise ValueError(f"equality gate must lie between 0 and 1, or be None, got {gate}")
    require(iterations >= 1, "equality iterations must be at least 1", iterations)
    for name, value in (("d", d), ("noise", noise)):
        for leaf in jax.tree_util.tree_leaves(value):
            finite_numbers(f"equality {name}", leaf)
    check_weight("equality", weight)
    if not callable(g):
        _check_rows(g, d, noise)
    once = noise is not None

    def init(belief: Belief, dims):
        sensor, _ = as_sensor(belief.mean, g, d, noise)
        n = belief.factor.shape[0]
        check_weight("equality", weight, n)
        require(not sensor.dim > n, f"equality has {sensor.dim} components, the state only {n}")
        return jnp.zeros((), bool)  # whether this step has used a noisy constraint

    def process(used, transition: Transition):
        return jnp.zeros((), bool), transition

    def after(used, posterior: Belief, info: StepInfo, o: Observation):
        held = constrain(posterior, g, d, weight, noise, hard, iterations)
        refused = jnp.zeros((), bool)
        if gate is not None:
            refused = held.nis > within(limits(gate), held.residual)[held.dof]
        skip = refused | used
        belief = trees.select(skip, posterior, held.belief)
        worst = jnp.max(jnp.abs(held.residual))
        info = info.noted("equality", residual=worst, nis=held.nis, refused=refused)
        info = info.contradicted_where(~skip & jnp.isinf(held.nis))
        partly = refused & (info.code == int(Code.DONE))
        code = jnp.where(partly, int(Code.PARTLY_MISSING), info.code)
        return used | once, belief, info._replace(code=code)

    return hooks(init=init, process=process, after=after, name="equality")


def _check_rows(g: Numbers, d: Any, noise: Numbers | None) -> None:
    D = finite_numbers("equality D", g)
    if D.ndim != 2 or D.shape[0] == 0:
        raise ValueError(f"equality D must be (c, n), a row for each constraint, got {D.shape}")
    value = np.zeros(len(D)) if d is None else np.asarray(d, float)
    if value.shape != (len(D),):
        raise ValueError(f"equality d is {value.shape}: ({len(D)},), one for each row of D")
    exact = np.ones(len(D), bool)
    if noise is not None:
        root = np.asarray(noise, float)
        if root.shape[0] == len(D):  # other shapes are refused where they are used
            exact = ~np.any(root.reshape(len(D), -1) != 0.0, axis=1)
    try:
        check_rows(D, value, exact)
    except ValueError as error:
        raise ValueError(f"equality: {error}") from None
