"""Parameters that systems share, and the limits of a scenario."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, PyTree

from robins.filters import Motion
from robins.filters.belief import Number
from robins.filters.values import Numbers
from robins.ins.increments import Increments
from robins.scenario import Parameters, Quantity, Span, default
from robins.sim import _given
from robins.sim._given import Listed
from robins.sim.commands import Manoeuvre, accelerate, climb, stop, straight, turn
from robins.systems import quantities as q

NED, FRD = ("north", "east", "down"), ("forward", "right", "down")
ENU, RFU = ("east", "north", "up"), ("right", "forward", "up")

MOST_RUNS = 1_000_000
MOST_SAMPLES = 10_000_000  # of one run: a day at 100 Hz; six axes of them are half a gigabyte

Runs = Annotated[int, pydantic.Field(ge=1, le=MOST_RUNS)]
"""Monte Carlo runs."""

RunNumber = Annotated[int, pydantic.Field(ge=0, le=MOST_RUNS)]
"""Number of a run, from 0; or how many."""

HowMany = Annotated[RunNumber, pydantic.BeforeValidator(lambda x: MOST_RUNS if x == "all" else x)]
"""Number of runs, or "all"."""

Names = Annotated[tuple[str, ...], pydantic.Field(min_length=1)]
"""Filters by name, one at least."""


class StartPlace(Parameters):
    """Position of a vehicle at the start; a study adds its height."""

    latitude: Annotated[float, Quantity("angle", least="-89 deg", most="89 deg")]
    longitude: Annotated[float, Quantity("angle", least="-180 deg", most="180 deg")]


def refuse_too_long(rate: str, lasts_s: float, rate_hz: float) -> None:
    """Raise a ValueError, which names a rate, where a run has more samples than fit into memory."""
    if (samples := lasts_s * rate_hz) > MOST_SAMPLES:
        raise ValueError(
            f"{rate}: at {rate_hz:g} Hz a run of {lasts_s:g} s has {samples:.3g} samples, of which "
            f"{MOST_SAMPLES:.0e} fit at most: lower the rate or shorten the run"
        )


def refuse_unsettled(name: str, from_s: float, lasts_s: float) -> None:
    """Raise a ValueError, which names a time, where figures would count from after a run's end."""
    if from_s > 0.0 and from_s >= lasts_s:
        raise ValueError(
            f"{name} = {from_s:g} s leaves nothing to count of a run of {lasts_s:g} s: it must be "
            "before the end"
        )


def outside(spans: Sequence[Span], time_s: np.ndarray) -> np.ndarray:
    """Mask of the times (N,) in none of some spans, (N,) bool."""
    return ~np.any([np.zeros(len(time_s), bool), *(span.holds(time_s) for span in spans)], axis=0)


def during(spans: Sequence[Span | None], time_s: np.ndarray) -> np.ndarray:
    """(N,) bool, true of the times (N,) that lie in one of some spans."""
    return ~outside([span for span in spans if span is not None], time_s)


def as_array(numbers: PyTree) -> Numbers:
    """Numbers of parameters as an array: NumPy's, which can be checked; JAX's if one is traced."""
    return (np if _given.known(numbers) else jnp).asarray(numbers, float)


def any_there(numbers: Sequence[Number]) -> bool:
    """True if one of some sizes is not zero, or may not be, for it is traced."""
    return not _given.known(numbers) or any(numbers)


Draw = Literal["normal", "plus-sigma", "random-sign"]
"""Draw of errors of a stated size: with it as sigma, as stated, or with random signs."""


def signed(key: Array, size: Listed, draw: Draw) -> Array:
    """Errors of a stated size, of any shape."""
    sigma = jnp.asarray(size, float)
    normal = jax.random.normal(key, sigma.shape)
    if draw == "plus-sigma":
        return sigma
    return sigma * (jnp.where(normal < 0.0, -1.0, 1.0) if draw == "random-sign" else normal)


class LogPartition(Parameters):
    """Partition of a recorded log into steps of a filter."""

    longest_block: q.Duration = default("0.25 s")
    # a gap of the inertial samples beyond this ends a piece, and the next is aligned again
    longest_gap: q.Duration = default("0.5 s")
    # process noise factor across one that is bridged
    gap_noise: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 30.0


class Departure(StartPlace):
    """Position, height and heading of a vehicle at the start."""

    height: Annotated[float, Quantity("length", least="-1 km", most="100 km")] = default("0 m")
    heading: q.Angle = default("0 deg")


class Leg(Parameters):
    """One command of a motion over ground; which quantities it takes depends on what it does."""

    do: Literal["stop", "straight", "accelerate", "turn", "climb"]
    seconds: q.Duration | None = None
    speed: q.SpeedSize | None = None  # at the end
    # positive to the right
    angle: Annotated[float, Quantity("angle", least="-36000 deg", most="36000 deg")] | None = None
    rate: q.AngleRate | None = None
    # gained
    height: Annotated[float, Quantity("length", least="-100 km", most="100 km")] | None = None

    @property
    def lasts_s(self) -> float:
        """Duration as of `robins.sim.commands`; 0 for a leg that has none."""
        if self.seconds is not None or self.angle is None or self.rate is None:
            return self.seconds or 0.0
        hold = abs(self.angle) / self.rate
        return hold + min(hold, 1.0)  # a turn takes a second to ease in and out

    def command(self) -> Manoeuvre:
        """The leg as a command of `robins.sim.commands`.

        Raises:
            ValueError: it lacks a quantity it needs, or has one it does not take.
        """
        make, needed = _COMMANDS[self.do]
        given = {name for name in Leg.model_fields if getattr(self, name) is not None} - {"do"}
        if wrong := sorted(given ^ set(needed)):
            what = "needs" if wrong[0] in needed else "does not take"
            raise ValueError(f"legs: '{self.do}' {what} '{wrong[0]}'; it takes {', '.join(needed)}")
        return make(*(getattr(self, name) for name in needed))


# parameters of each leg, in the order its command takes them
_COMMANDS: dict[str, tuple[Callable[..., Manoeuvre], tuple[str, ...]]] = {
    "stop": (stop, ("seconds",)),
    "straight": (straight, ("seconds",)),
    "accelerate": (accelerate, ("speed", "seconds")),
    "turn": (turn, ("angle", "rate")),
    "climb": (climb, ("height", "seconds")),
}


class ImuBlock(NamedTuple):
    """Input of one step of a motion that is mechanised from inertial samples."""

    increments: Increments  # dt (K,), theta (K, 3), dv (K, 3)
    noise_scale: ArrayLike  # () multiplies the process noise factor: 1, more across an IMU gap


def noise_of_linear(linear: Callable[..., tuple], x: PyTree, u: PyTree) -> Array:
    """The noise of a step, the third that the linear form of its motion gives."""
    return linear(x, u)[2]


def moved_by(step: Callable[..., PyTree], linear: Callable[..., tuple], *given: PyTree) -> Motion:
    """A motion by its step and its linear form, which take `given` before state and input."""
    slope = Partial(linear, *given)
    return Motion(Partial(step, *given), Partial(noise_of_linear, slope), slope)


LARGEST_RAD = np.radians(5.0)  # of an error that a linear model may take


def warn_of_large_angles(reached_rad: Mapping[str, float]) -> None:
    """Warn of errors [rad], by parameter, beyond 5 deg, for which linear models do not hold."""
    large = {name: size for name, size in reached_rad.items() if size > LARGEST_RAD}
    if large:
        listed = ", ".join(f"{name} may reach {np.degrees(x):.1f} deg" for name, x in large.items())
        warnings.warn(
            f"{listed}: the filters' model is linear in these angles and good below 5 deg; expect "
            "biased estimates",
            stacklevel=4,
        )
