"""Equivalent weights in three zones: full weight, reduced weight, none."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Memory, Rule
from robins.filters.rules._robust import widened
from robins.filters.values import Numbers, is_known, number, value


@value
class Igg3(Rule):
    """Rule of `igg3`: R_ij / sqrt(w_i w_j), weights in three zones of |r_i| / sqrt(S_ii)."""

    k0: Numbers  # ()
    k1: Numbers  # ()
    floor: Numbers  # ()
    patience: Numbers | None  # () measurements in a row

    name = "igg3"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        return {name: jnp.zeros((), int) for name in dims}  # measurements in a row without weight

    def before(self, memory: Memory, prior: Belief, o: Observation):
        seen = normalised(o)
        deviation = jnp.sqrt(jnp.sum(seen.factor**2, axis=1))
        t = jnp.abs(jnp.where(seen.used, o.residual, 0.0)) / deviation
        weight = self.weights(t)
        measured = jnp.any(seen.used)
        hopeless = measured & jnp.all(~seen.used | (weight <= self.floor))
        earlier, recovered = memory[o.sensor], jnp.zeros((), bool)
        if self.patience is not None:
            recovered = hopeless & (earlier.astype(float) >= self.patience)
            far = t > self.k0
            beyond = jnp.where(far, t, self.k1)
            a = jnp.max(jnp.where(far, 1.0 / self.k0**2 - 1.0 / beyond**2, 0.0))
            root = jnp.sqrt(jnp.where(recovered, a, 1.0)) * o.residual[:, None]
            prior = widened(recovered, prior, o, seen.used, root)
        weight = jnp.where(recovered, 1.0, weight)
        count = jnp.where(hopeless & ~recovered, earlier + 1, 0)
        count = jnp.where(measured, count, earlier)
        heavier = o.noise / jnp.sqrt(jnp.where(weight > 0.0, weight, 1.0))[:, None]
        o = o.raised(heavier, o.accepted & (weight > 0.0))
        o = o.noted("igg3", weight=jnp.min(weight), recovered=recovered)
        return {**memory, o.sensor: count}, prior, o

    def weights(self, t: Array) -> Array:
        """(m,) weights of innovations in units of their standard deviations."""
        far = t > self.k0
        beyond = jnp.where(far, t, self.k1)
        share = jnp.maximum(self.k1 - beyond, 0.0) * (1.0 / (self.k1 - self.k0))
        weight = jnp.where(far, jnp.maximum(self.k0 / beyond * share**2, self.floor), 1.0)
        return jnp.where((t >= self.k1) & (self.floor * t > self.k0), 0.0, weight)


def igg3(
    k0: Number = 1.5, k1: Number = 4.0, floor: Number = 1e-4, patience: int | None = 10
) -> Rule:
    r"""IGG-III equivalent weights, component by component (Yang, Song & Xu 2002).

        t_i = |r_i| / sqrt(S_ii)
        w_i = 1                                      t_i <= k0
              (k0 / t_i) ((k1 - t_i) / (k1 - k0))^2  k0 < t_i < k1, at least the floor
              floor                                  beyond k1
        R_ij becomes R_ij / sqrt(w_i w_j)

    With a floor of zero a component beyond k1 is refused; otherwise one beyond k0 / floor, which
    even at the floor would cause a larger correction than any of full weight.

    After ``patience`` measurements of a sensor in a row without a component above the floor, as in
    a diverged filter, the next such measurement is used with full weight, and the prior covariance
    is first widened along the innovation until no t_i exceeds k0, by
    `robins.filters.rules._robust.widened` with

        D = a r r',   a = max_i (1 / k0^2 - 1 / t_i^2)

    Notes: ``igg3.weight``, the least of the measurement, and ``igg3.recovered``. The Kalman filter
    is the limit of k0 above every t_i.

    Args:
        k0: end of full weight, in standard deviations of the innovation, positive.
        k1: start of the floor, finite.
        floor: least weight, in [0, 1).
        patience: measurements in a row with no weight above the floor before one is used; None
            never recovers.

    Raises:
        ValueError: an argument is out of its range, or not k0 < k1.
    """
    if is_known((k0, k1)):
        low, high = np.asarray(k0, float), np.asarray(k1, float)
        rising = np.all((low > 0.0) & (low < high) & (high < np.inf))
        require(rising, f"igg3 needs 0 < k0 < k1 < inf, got k0 = {k0}, k1 = {k1}")
    negative = "igg3 patience must not be negative"
    return Igg3(
        k0=number("igg3 k0 must be a number", k0),
        k1=number("igg3 k1 must be a number", k1),
        floor=number("igg3 floor must lie in [0, 1)", floor, lambda x: (x >= 0.0) & (x < 1.0)),
        patience=None if patience is None else number(negative, patience, lambda p: p >= 0.0),
    )
