"""Parameters that systems share, and what a scenario may ask for at most."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Annotated, NamedTuple

import numpy as np
import pydantic
from jaxtyping import ArrayLike

from robins.ins.increments import Increments
from robins.scenario import Parameters, Quantity

NED, FRD = ("north", "east", "down"), ("forward", "right", "down")
ENU, RFU = ("east", "north", "up"), ("right", "forward", "up")
Three = tuple[float, float, float]

MOST_RUNS = 1_000_000
MOST_SAMPLES = 10_000_000  # of one run: a day at 100 Hz; six axes of them are half a gigabyte

Runs = Annotated[int, pydantic.Field(ge=1, le=MOST_RUNS)]
"""Monte Carlo runs."""

Names = Annotated[tuple[str, ...], pydantic.Field(min_length=1)]
"""Filters by name, one at least."""


class Place(Parameters):
    """Where a vehicle begins; a study adds its height."""

    latitude: Annotated[float, Quantity("angle", least="-89 deg", most="89 deg")]
    longitude: Annotated[float, Quantity("angle", least="-180 deg", most="180 deg")]


def refuse_too_long(rate: str, lasts_s: float, rate_hz: float) -> None:
    """Raise a ValueError where the samples of a run would not fit into memory.

    Args:
        rate: the parameter that says how often.
        lasts_s: duration of a run.
        rate_hz: samples a second.
    """
    if (samples := lasts_s * rate_hz) > MOST_SAMPLES:
        raise ValueError(
            f"{rate}: at {rate_hz:g} Hz a run of {lasts_s:g} s has {samples:.3g} samples, of which "
            f"{MOST_SAMPLES:.0e} fit at most: lower the rate or shorten the run"
        )


def refuse_unsettled(name: str, from_s: float, lasts_s: float) -> None:
    """Raise a ValueError where figures would begin to count after the end of the run.

    Args:
        name: the parameter that says from when.
        from_s: what it says.
        lasts_s: duration of a run.
    """
    if from_s > 0.0 and from_s >= lasts_s:
        raise ValueError(
            f"{name} = {from_s:g} s leaves nothing to count of a run of {lasts_s:g} s: it must be "
            "before the end"
        )


class Block(NamedTuple):
    """Input of one step of a motion that is mechanised from inertial samples."""

    increments: Increments  # dt (K,), theta (K, 3), dv (K, 3)
    noise_scale: ArrayLike  # () multiplies the process noise factor: 1, more across an IMU gap


LARGEST_RAD = np.radians(5.0)  # of an error that a linear model may take


def warn_of_large_angles(reached_rad: Mapping[str, float]) -> None:
    """Warn of errors beyond 5 deg, for which linear models do not hold.

    Args:
        reached_rad: by parameter the size [rad] that its error may reach.
    """
    large = {name: size for name, size in reached_rad.items() if size > LARGEST_RAD}
    if large:
        told = ", ".join(f"{name} may reach {np.degrees(x):.1f} deg" for name, x in large.items())
        warnings.warn(
            f"{told}: the filters' model is linear in these angles and good below 5 deg; expect "
            "biased estimates",
            stacklevel=4,
        )
