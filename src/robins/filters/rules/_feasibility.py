"""Whether an H-infinity filter existed all along a run, and the error that says it did not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg
from robins.errors import RobinsError
from robins.filters.audit import Again
from robins.filters.rules._inflation import inflated, local_bound


class Infeasible(RobinsError, ValueError):
    """No H-infinity filter exists for the gamma asked for.

    Attributes:
        step: row of the measurements after which the bound broke, from 0; in a stream, predictions
            before it less one.
        time_s: time of that step [s], or None where times are not known.
        gamma: asked for.
        local_bound: sqrt(lambda_max(L P L')) there, which gamma must exceed.
        gamma_min: least gamma for all of the run, or None where it cannot be run again.
    """

    def __init__(
        self,
        step: int,
        time_s: float | None,
        gamma: float,
        local_bound: float,
        gamma_min: float | None,
    ):
        self.step, self.time_s, self.gamma = step, time_s, gamma
        self.local_bound, self.gamma_min = local_bound, gamma_min
        when = "" if time_s is None else f" (t = {time_s:g} s)"
        whole = "" if gamma_min is None else f"; the whole run needs gamma = {gamma_min:.6g}"
        super().__init__(
            f"no H-infinity filter with gamma = {gamma:.6g} exists at step {step}{when}: the local "
            f"bound sqrt(lambda_max(L P L')) is {local_bound:.6g} there{whole}",
            fix="give a larger gamma, or policy='raise_gamma' or 'compensate'; gamma has the units "
            "of L x over those of whitened noise, so look at the units of weight, R and P0 too",
        )


class HInfinityMemory(NamedTuple):
    """What `h_infinity` remembers from step to step."""

    inverse: Array  # () 1 / gamma: 0 is the Kalman filter, and finite
    steps: Array  # () predictions so far
    fresh: Array  # () bool, no sensor has been asked since the prediction
    measured: Array  # () bool, something was used since the prediction
    predicted: Any  # mean as predicted; () where the estimate does not need it
    weighted: Array  # (q, n) L S that the last step is judged by
    events: Array  # () steps in which the policy acted
    first: Array  # () the first of them
    weighted_first: Array  # (q, n) L S there


def first_infeasible(final: HInfinityMemory, whole: bool = True) -> tuple[int, Array] | None:
    """Step, and L S there, where a run of policy "raise" first had no filter; None if it had.

    Args:
        final: memory that the run ended with.
        whole: judge the last step too, from which nothing has been predicted.
    """
    if int(final.events) > 0:
        return int(final.first), final.weighted_first
    n = final.weighted.shape[1]
    exists = inflated(linalg.identity(n), final.inverse * final.weighted)[1]
    if whole and bool(final.measured) and not bool(exists):
        return int(final.steps) - 1, final.weighted
    return None


def anew(memory: HInfinityMemory, gamma: Any) -> HInfinityMemory:
    """The same memory with another gamma and no events."""
    inverse = 1.0 / jnp.asarray(gamma, float)
    return memory._replace(inverse=inverse, events=jnp.zeros((), int), first=jnp.array(-1))


class Demanding(HInfinityMemory):
    """The same under policy "raise"."""

    def audit(self, start: HInfinityMemory, again: Again | None, time: Any) -> None:
        """What it has to report (`robins.filters.audit`).

        One sample at a time, a step is judged when the next prediction closes it: until then more
        sensors may come.

        Raises:
            Infeasible: the filter did not exist at some step.
        """
        broken = first_infeasible(self, whole=again is not None)
        if broken is None:
            return
        step, weighted = broken
        gamma, least = 1.0 / float(self.inverse), None
        if again is not None:
            step -= int(start.steps)

            def exists(one: float) -> bool:
                return first_infeasible(again(anew(start, one))) is None

            least = least_gamma(exists, gamma)
        times = () if time is None else np.asarray(time)
        time_s = float(times[step]) if 0 <= step < len(times) else None
        raise Infeasible(step, time_s, gamma, float(local_bound(weighted)), least)


def least_gamma(exists: Callable[[float], bool], lower: float, rtol: float = 1e-4) -> float:
    """Least feasible gamma above a lower bound: doubled until it exists, then bisected.

    Feasibility is monotone in gamma. The number returned exists, and is at most rtol too large.

    Raises:
        ValueError: nothing up to 2^100 times the lower bound exists.
    """
    low, high = lower, 2.0 * lower
    while not exists(high):
        low, high = high, 2.0 * high
        if high > 2.0**100 * lower:
            raise ValueError(f"no gamma up to {high:.3g} exists: the Kalman filter must fail too")
    while high > low * (1.0 + rtol):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if exists(middle) else (middle, high)
    return high
