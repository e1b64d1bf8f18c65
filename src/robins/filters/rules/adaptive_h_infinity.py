"""Adapt the bound of an H-infinity filter to the size of the innovations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Code, Number, StepInfo
from robins.filters.observation import Observation
from robins.filters.rule import Rule
from robins.filters.rules import _inflation
from robins.filters.rules._inflation import GivenWeight, Weight, local_bound
from robins.filters.values import Numbers, is_known, kind, number, value

NAME = "adaptive_h_infinity"
SHARE = 0.95  # greatest lambda_max(L P L') / xi^2 of a compensated P
LARGEST = 1e200  # limit of a NIS, so that sums stay finite


class AdaptiveMemory(NamedTuple):
    """Memory of `adaptive_h_infinity`."""

    nis: Array  # (window,) NIS of the last steps, summed over sensors; a ring
    dof: Array  # (window,) components used in them
    at: Array  # () index of this step in the ring
    inverse: Array  # () 1 / xi of the last step; 0 before the first


@value
class AdaptiveHInfinity(Rule):
    """Rule of `adaptive_h_infinity`: P becomes (P^-1 - xi^-2 L'L)^-1 before a prediction."""

    weight: Weight
    zeta: Numbers
    floor: Numbers
    ceiling: Numbers
    window: int = kind()
    compensate_first: bool = kind()

    name = NAME

    def weighted(self, belief: Belief) -> Array:
        """(q, n) L S."""
        return _inflation.weighted_factor(self.weight, belief, NAME)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> AdaptiveMemory:
        self.weighted(belief)  # checks the shape of the weight
        ring = jnp.zeros(self.window)
        return AdaptiveMemory(ring, ring, jnp.zeros((), int), jnp.zeros(()))

    def chosen(self, memory: AdaptiveMemory) -> tuple[Array, Array]:
        """Ratio q of the window, and alpha from it."""
        dof = jnp.sum(memory.dof)
        q = jnp.where(dof > 0.0, jnp.sum(memory.nis) / jnp.maximum(dof, 1.0), 1.0)
        alpha = 1.0 + 1.0 / (self.zeta * jnp.maximum(q - 1.0, 1e-6))
        return q, jnp.clip(alpha, self.floor, self.ceiling)

    def compensated(self, memory: AdaptiveMemory, factor: Array, weighted: Array):
        """Factor for which the last xi is feasible, and () bool: it had to be reduced."""
        needed = memory.inverse * local_bound(weighted) >= 1.0
        shrunk, _ = _inflation.deflated(factor, memory.inverse * weighted, SHARE)
        return jnp.where(needed, shrunk, factor), needed

    def after(self, memory: AdaptiveMemory, posterior: Belief, info: StepInfo, o: Observation):
        here = memory.at
        memory = memory._replace(
            nis=memory.nis.at[here].add(jnp.minimum(info.nis, LARGEST)),
            dof=memory.dof.at[here].add(info.dof.astype(float)),
        )
        weighted = self.weighted(posterior)
        bound = local_bound(weighted)
        q, alpha = self.chosen(memory)
        notes = {"q": q, "alpha": alpha, "xi": jnp.sqrt(alpha) * bound, "bound": bound}
        if self.compensate_first:
            factor, acted = self.compensated(memory, posterior.factor, weighted)
            left = local_bound(self.weighted(posterior._replace(factor=factor)))
            notes |= {"xi": jnp.sqrt(alpha) * left, "compensated": acted & (memory.dof[here] > 0.0)}
        return memory, posterior, info.noted(NAME, **notes)

    def settle(self, memory: AdaptiveMemory, belief: Belief):
        counts = memory.dof[memory.at] > 0.0
        weighted = self.weighted(belief)
        factor, shrunk = belief.factor, jnp.array(False)
        if self.compensate_first:
            factor, shrunk = self.compensated(memory, factor, weighted)
            weighted = self.weighted(belief._replace(factor=factor))
        alpha, bound = self.chosen(memory)[1], local_bound(weighted)
        xi = jnp.sqrt(alpha) * bound
        inverse = jnp.where(xi > 0.0, 1.0 / jnp.where(xi > 0.0, xi, 1.0), 0.0)
        wide, exists = _inflation.inflated(factor, inverse * weighted)
        acts = counts & exists & (shrunk | (inverse > 0.0))
        code = jnp.where(counts & ~exists, int(Code.INFEASIBLE), int(Code.DONE))
        new = belief._replace(factor=jnp.where(acts, wide, belief.factor))
        # clear the entry of the next step in the ring
        following = jnp.where(counts, (memory.at + 1) % self.window, memory.at)
        memory = AdaptiveMemory(
            nis=memory.nis.at[following].multiply(jnp.where(counts, 0.0, 1.0)),
            dof=memory.dof.at[following].multiply(jnp.where(counts, 0.0, 1.0)),
            at=following,
            inverse=jnp.where(counts, inverse, memory.inverse),
        )
        return memory, new, code


def adaptive_h_infinity(
    weight: GivenWeight,
    zeta: Number = 1.0,
    window: int = 10,
    floor: Number = 1.05,
    ceiling: Number = 1e6,
    compensate_first: bool = False,
) -> Rule:
    """H-infinity filter with its own bound at each step: a *reconstruction*.

    It follows the adaptive-compensation H-infinity filter of a patent on transfer alignment
    (Southeast University) whose formulas (6) to (24) are lost; the formulas here are derived from
    its text and were not checked against the source:

        q      NIS over its degrees of freedom, over the last ``window`` steps with a measurement
        alpha  1 + 1 / (zeta max(q - 1, 1e-6)), kept between ``floor`` and ``ceiling``
        xi^2   alpha lambda_max(L P L')
        P      becomes (P^-1 - xi^-2 L'L)^-1 before the next prediction, as in `h_infinity`

    so it exists by construction, is nearly the Kalman filter while innovations are as expected
    (q = 1 if the model is right), and raises the gain when they are larger: correctly if the motion
    is wrong, wrongly if the measurement is, which it cannot distinguish. With weights L / xi_k in
    step k, the bound of `h_infinity` holds for gamma = 1.

    Notes, after each sensor (those of the last one are for the step): ``adaptive_h_infinity.q``,
    ``.alpha``, ``.xi`` and ``.bound``, sqrt(lambda_max(L P L')), in units of L x; ``.compensated``
    with ``compensate_first``. Derivatives treat the local bound as constant.
    ``floor = ceiling = inf`` is the Kalman filter.

    Args:
        weight: L as in `h_infinity`.
        zeta: sensitivity of the gain to large innovations, positive; 0.01 to 1 hardly differ.
        window: number of steps over which q is computed, at least 1.
        floor: least alpha, above 1; with 1.05 variances grow up to 21 times.
        ceiling: largest alpha, at least the floor.
        compensate_first: if the xi of the step before is infeasible for P, reduce P as in the
            patent (``policy="compensate"`` of `h_infinity`, to 0.95 xi^2) before the new xi is
            chosen. The smaller P has no justification in the data.

    Raises:
        TypeError: the weight is not of real numbers.
        ValueError: an argument is out of its range, or the weight not finite or of a wrong shape.
    """
    require(window >= 1, "window must be at least one step", window)
    if is_known((floor, ceiling)) and not np.all((floor > 1.0) & (floor <= ceiling)):
        raise ValueError(f"1 < floor <= ceiling is wanted, got floor {floor}, ceiling {ceiling}")
    return AdaptiveHInfinity(
        weight=_inflation.as_weight(weight, NAME),
        zeta=number("zeta must be positive", zeta, lambda z: z > 0.0),
        floor=number("floor must be a real number", floor),
        ceiling=number("ceiling must be a real number", ceiling),
        window=window,
        compensate_first=compensate_first,
    )
