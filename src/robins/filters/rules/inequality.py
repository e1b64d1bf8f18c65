"""Bounds on the state throughout a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import jax.numpy as jnp
import numpy as np

from robins.errors import require
from robins.filters import trees
from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import finite_numbers, one_of
from robins.filters.limits.constrain import Function, as_sensor
from robins.filters.limits.interval import clip, truncate
from robins.filters.linearise import Transition
from robins.filters.model import Given
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import Numbers, is_known, kind, number, value

Method = Literal["active-set", "truncation"]


@value
class Inequality(Rule):
    """Rule of `inequality`: low <= g(x) <= high after each update."""

    g: Function
    low: Numbers  # (c,)
    high: Numbers  # (c,)
    method: Method = kind()

    name = "inequality"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        sensor, _ = as_sensor(belief.mean, self.g, None, None)
        count = len(self.low)
        if sensor.dim != count:
            raise ValueError(f"inequality has {count} bounds for {sensor.dim} components of g")
        return jnp.zeros((), bool)  # True if this step has been truncated

    def process(self, memory: Memory, transition: Transition):
        return jnp.zeros((), bool), transition

    def after(self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        if self.method == "active-set":
            kept = clip(posterior, self.g, self.low, self.high)
            belief = kept.belief
        else:
            kept = truncate(posterior, self.g, self.low, self.high)
            skip = memory & ~jnp.any(info.used)
            belief = trees.select(skip, posterior, kept.belief)
            memory = jnp.ones((), bool)
        notes = {"outside": jnp.sum(kept.outside), "infeasible": kept.infeasible}
        info = info.contradicted_where(kept.infeasible).noted("inequality", **notes)
        return memory, belief, info


def inequality(
    g: Function,
    lower: Given | None = None,
    upper: Given | None = None,
    method: Method = "active-set",
) -> Rule:
    """Keep ``lower <= g(x) <= upper`` after each update (Simon 2010, secs. 2.5 and 2.6).

    "active-set" moves a mean that is outside to the nearest state inside, in the metric P^-1 (Gupta
    & Hauser 2007), and keeps P. A projection on a convex set, in its own metric, never increases
    the distance to a true state inside, so P stays consistent; treated as an equality, an active
    bound would leave no variance across it. "truncation" takes mean and covariance of the density
    inside the bounds (Simon & Simon 2010): its errors are smaller while the bound is active. But it
    reuses the bound as information: if the state hardly moves between steps, the mean is pushed
    away from the bound, and P becomes too small.

    Truncation acts at the first sensor of each step and at each used measurement; clipping always.
    Notes: ``inequality.outside``, the number of bounds that the mean violated;
    ``inequality.infeasible``, true if no state satisfies them all (the belief is then unchanged) or
    an exactly known component violates its bound: the update is then `Code.CONTRADICTED`. Infinite
    bounds are the Kalman filter.

    Args:
        g: (c, n) matrix D, or a function of the state with values in an array, linearised about
            the mean.
        lower: (c,) lower bounds; None or -inf for none.
        upper: (c,) upper bounds; None or inf for none.
        method: "active-set" or "truncation".

    Raises:
        ValueError: there is no bound, one is NaN, lower exceeds upper, a row of D is zero, the
            method is unknown; at `init`, D does not fit the state.
    """
    one_of("inequality method", method, Method)
    low, high = _bounds(lower, upper)
    D = g if callable(g) or not is_known(g) else _rows(g, len(low))
    return Inequality(D, low, high, method)


def _bounds(lower: Given | None, upper: Given | None) -> tuple[Numbers, Numbers]:
    require(lower is not None or upper is not None, "inequality wants lower or upper bounds")
    real = "inequality bounds must be numbers"
    shape = number(real, lower if upper is None else upper).shape
    low = np.full(shape, -np.inf) if lower is None else number(real, lower)
    high = np.full(shape, np.inf) if upper is None else number(real, upper)
    if low.ndim != 1 or low.shape != high.shape or low.size == 0:
        raise ValueError(
            f"inequality bounds must be (c,) and alike, got lower {low.shape}, upper {high.shape}"
        )
    if not is_known((low, high)):
        return low, high
    if np.any(np.isnan(low) | np.isnan(high)):
        raise ValueError("inequality bounds hold NaN: use -inf and inf where there are none")
    if np.any(low > high) or np.any(low == np.inf) or np.any(high == -np.inf):
        raise ValueError(f"inequality lower must not exceed upper, got {low} and {high}")
    return low, high


def _rows(g: Given, count: int) -> np.ndarray:
    D = finite_numbers("inequality D", g)
    if D.ndim != 2 or len(D) != count:
        raise ValueError(f"inequality D must be ({count}, n), a row for each bound, got {D.shape}")
    for row in np.flatnonzero(~np.any(D != 0.0, axis=1)):
        raise ValueError(f"inequality: row {row} of D is zero and bounds nothing")
    return D
