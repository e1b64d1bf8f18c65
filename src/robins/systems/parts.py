"""Parameters shared by several systems, and the limits of a scenario."""

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

from robins.earth import Geodetic
from robins.filters import Motion, Sensor
from robins.filters.belief import Number
from robins.filters.values import Numbers
from robins.ins.increments import Increments
from robins.scenario import Parameters, Quantity, Span, default
from robins.sim import _arguments
from robins.sim._arguments import Listed
from robins.sim.commands import (
    Manoeuvre,
    accelerate,
    climb,
    from_commands,
    stop,
    straight,
    turn,
)
from robins.sim.trajectory import MotionProfile
from robins.systems import quantities as q

NED, FRD = ("north", "east", "down"), ("forward", "right", "down")
ENU, RFU = ("east", "north", "up"), ("right", "forward", "up")

MOST_RUNS = 1_000_000
MOST_SAMPLES = 10_000_000  # of one run: 28 h at 100 Hz; six axes take half a gigabyte

Runs = Annotated[int, pydantic.Field(ge=1, le=MOST_RUNS)]
"""Monte Carlo runs."""

RunNumber = Annotated[int, pydantic.Field(ge=0, le=MOST_RUNS)]
"""Number of a run, from 0, or a number of runs."""

HowMany = Annotated[RunNumber, pydantic.BeforeValidator(lambda x: MOST_RUNS if x == "all" else x)]
"""Number of runs, or "all"."""

Names = Annotated[tuple[str, ...], pydantic.Field(min_length=1)]
"""Names of filters, at least one."""


NoiseOf = ArrayLike | Callable[..., Array]
"""Standard deviations or factor of a noise, or a function of state and data that gives them."""


class StartPlace(Parameters):
    """Position of a vehicle at the start; a study adds its height."""

    latitude: Annotated[float, Quantity("angle", least="-89 deg", most="89 deg")]
    longitude: Annotated[float, Quantity("angle", least="-180 deg", most="180 deg")]


def refuse_too_long(rate: str, lasts_s: float, rate_hz: float) -> None:
    """Raise a ValueError naming `rate` if a run has more samples than `MOST_SAMPLES`."""
    if (samples := lasts_s * rate_hz) > MOST_SAMPLES:
        raise ValueError(
            f"{rate}: at {rate_hz:g} Hz a run of {lasts_s:g} s has {samples:.3g} samples, of which "
            f"{MOST_SAMPLES:.0e} fit at most: lower the rate or shorten the run"
        )


def refuse_unsettled(name: str, from_s: float, lasts_s: float) -> None:
    """Raise a ValueError naming the parameter if the settling time reaches the end of the run."""
    if from_s > 0.0 and from_s >= lasts_s:
        raise ValueError(
            f"{name} = {from_s:g} s leaves nothing to count of a run of {lasts_s:g} s: it must be "
            "before the end"
        )


def outside(spans: Sequence[Span], time_s: np.ndarray) -> np.ndarray:
    """Mask (N,) of the times (N,) that lie in none of the spans."""
    return ~np.any([np.zeros(len(time_s), bool), *(span.holds(time_s) for span in spans)], axis=0)


def during(spans: Sequence[Span | None], time_s: np.ndarray) -> np.ndarray:
    """Mask (N,) of the times (N,) that lie in any of the spans; None for no spans."""
    return ~outside([span for span in spans if span is not None], time_s)


def as_array(numbers: PyTree) -> Numbers:
    """Numbers of parameters as a NumPy array, which can be checked, or a JAX array if traced."""
    return (np if _arguments.known(numbers) else jnp).asarray(numbers, float)


def may_be_nonzero(numbers: Sequence[Number]) -> bool:
    """True if any size is nonzero, or is traced and so may be nonzero."""
    return not _arguments.known(numbers) or any(numbers)


Draw = Literal["normal", "plus-sigma", "random-sign"]
"""Draw of errors of a stated size: normal with that sigma, exactly plus it, or of random sign."""


def signed(key: Array, size: Listed, draw: Draw) -> Array:
    """Errors of a stated size, drawn according to `draw`; shape of `size`."""
    sigma = jnp.asarray(size, float)
    normal = jax.random.normal(key, sigma.shape)
    if draw == "plus-sigma":
        return sigma
    return sigma * (jnp.where(normal < 0.0, -1.0, 1.0) if draw == "random-sign" else normal)


class LogPartition(Parameters):
    """Partition of a recorded log into steps of a filter."""

    longest_block: q.Duration = default("0.25 s")
    # a longer gap in the inertial samples ends a piece, and the next is aligned again
    longest_gap: q.Duration = default("0.5 s")
    # factor on the process noise across a shorter gap, which is bridged
    gap_noise: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 30.0


class Departure(StartPlace):
    """Position, height and heading of a vehicle at the start."""

    height: Annotated[float, Quantity("length", least="-1 km", most="100 km")] = default("0 m")
    heading: q.Angle = default("0 deg")


class Leg(Parameters):
    """One command of a motion over ground, with the quantities that its kind `do` requires."""

    do: Literal["stop", "straight", "accelerate", "turn", "climb"]
    seconds: q.Duration | None = None
    speed: q.SpeedSize | None = None  # reached at the end
    # positive to the right
    angle: Annotated[float, Quantity("angle", least="-36000 deg", most="36000 deg")] | None = None
    rate: q.AngleRate | None = None
    # height gained
    height: Annotated[float, Quantity("length", least="-100 km", most="100 km")] | None = None

    @property
    def lasts_s(self) -> float:
        """Duration, as in `robins.sim.commands`; 0 if the leg states none."""
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


def motion_of(place: Departure, legs: Sequence[Leg], speed: float = 0.0) -> MotionProfile:
    """The motion that legs describe, from rest or from a speed [m/s].

    Raises:
        ValueError: a leg is not complete.
    """
    start = Geodetic(place.latitude, place.longitude, place.height)
    return from_commands(start, [leg.command() for leg in legs], place.heading, speed)


# parameters of each leg, in the order its command takes them
_COMMANDS: dict[str, tuple[Callable[..., Manoeuvre], tuple[str, ...]]] = {
    "stop": (stop, ("seconds",)),
    "straight": (straight, ("seconds",)),
    "accelerate": (accelerate, ("speed", "seconds")),
    "turn": (turn, ("angle", "rate")),
    "climb": (climb, ("height", "seconds")),
}


class ImuBlock(NamedTuple):
    """Input of one step of a strapdown mechanisation."""

    increments: Increments  # dt (K,), theta (K, 3), dv (K, 3)
    noise_scale: ArrayLike  # () multiplier of the process noise factor: 1, larger across an IMU gap


def _first(linear: Callable[..., tuple], x: PyTree, u: PyTree) -> PyTree:
    return linear(x, u)[0]


def _third(linear: Callable[..., tuple], x: PyTree, u: PyTree) -> Array:
    return linear(x, u)[2]


def moved_by(
    step: Callable[..., PyTree] | None, linear: Callable[..., tuple], *given: PyTree
) -> Motion:
    """Motion with this step and linear form, both called with `given` before state and input.

    The process noise is that of the linear form, and so is the step if it is None.
    """
    slope = Partial(linear, *given)
    moved = Partial(_first, slope) if step is None else Partial(step, *given)
    return Motion(moved, Partial(_third, slope), slope)


def seen_by(linear: Callable[..., tuple], noise: NoiseOf, dim: int, name: str) -> Sensor:
    """Sensor whose reading is the first output of its linear form."""
    slope = Partial(linear)
    return Sensor(Partial(_first, slope), noise, dim, name, slope)


LARGEST_RAD = np.radians(5.0)  # largest error for which a linear model holds


def warn_of_large_angles(reached_rad: Mapping[str, float]) -> None:
    """Warn of errors [rad], by parameter, above 5 deg, where linear models no longer hold."""
    large = {name: size for name, size in reached_rad.items() if size > LARGEST_RAD}
    if large:
        listed = ", ".join(f"{name} may reach {np.degrees(x):.1f} deg" for name, x in large.items())
        warnings.warn(
            f"{listed}: the filters' model is linear in these angles and good below 5 deg; expect "
            "biased estimates",
            stacklevel=4,
        )
