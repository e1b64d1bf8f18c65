"""Parameters of tight GNSS, of a replayed log and of a simulated city, with units.

The assumptions of the filters come from physics and published figures, not from a log: the
oscillator is the temperature-compensated crystal of Brown & Hwang (2012, table 9.3), wheels and yaw
gyro are those of a car, delays follow from the width of streets.
"""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from robins.scenario import Parameters, Positive, Quantity, default
from robins.systems import quantities as q
from robins.systems.parts import Departure, Leg, Names, refuse_too_long
from robins.systems.study import Scenario

Decibels = Annotated[float, pydantic.Field(ge=0.0, le=70.0)]


class ReceiverClock(Parameters):
    """The receiver's oscillator, by the coefficients h0 [s] and h_-2 [Hz] of its Allan variance."""

    h0: Positive = 2e-19
    h2: Positive = 2e-20
    drift: q.Speed = default("300 m/s")  # sigma at the start: 1 ppm
    system_bias: q.Length = default("10 m")  # sigma of a system's clock relative to the first


class GnssWheels(Parameters):
    """Odometer and yaw gyro; the log states the white noise of each sample."""

    scale: Annotated[float, Quantity("ratio", above="0 ppm")] = default("2 %")
    yaw_bias: q.AngleRate = default("0.2 deg/s")
    # change of height along the road, a random walk over distance: sigma after 1 m
    rise: q.Length = default("0.1 m")
    # distance after which the heading is known and |c| = 1 is measured
    aligned_after: q.Length = default("100 m")


class Delays(Parameters):
    """Delays of diffracted or reflected signals, one state per satellite.

    A signal reflected by a wall at the distance a from the receiver arrives late by 2 a cos(e), e
    being the elevation (Hsu 2018). The distance to the walls is exponential with the mean
    `reflector`; the probability that a signal is blocked falls from one to zero between two C/N0.
    """

    reflector: q.Length = default("20 m")
    blocked_dbhz: Decibels = 25.0
    clear_dbhz: Decibels = 45.0
    multipath: q.Length = default("3 m")  # sigma of the delay of a signal in direct sight
    # correlation distance of a delay, and correlation time, which matters at rest
    distance: q.Length = default("30 m")
    time: q.Duration = default("100 s")

    @pydantic.model_validator(mode="after")
    def _check_order(self) -> Delays:
        if not self.blocked_dbhz < self.clear_dbhz:
            raise ValueError("blocked_dbhz must be less than clear_dbhz")
        return self


class RobustWeights(Parameters):
    """Constants of the robust weights by satellite; defaults as usual in the literature."""

    huber: Positive = 1.345
    dof: Positive = 5.0
    switch: Positive = 1.0


class GnssAssumptions(Parameters):
    """Assumptions of every filter."""

    clock: ReceiverClock = pydantic.Field(default_factory=ReceiverClock)
    wheels: GnssWheels = pydantic.Field(default_factory=GnssWheels)
    delays: Delays = pydantic.Field(default_factory=Delays)
    weights: RobustWeights = pydantic.Field(default_factory=RobustWeights)


class GnssReplay(GnssAssumptions):
    """Parameters of a recorded log that its file does not contain."""

    system: Literal["gnss"] = "gnss"
    title: str = "Tight GNSS replay"
    # the smoother states sigmas that are too small (docs/systems/gnss.md)
    filters: Names = ("delays",)


class Satellites(Parameters):
    """The sky over the city: systems alternate, azimuths spread by the golden angle."""

    count: Annotated[int, pydantic.Field(ge=6, le=64)] = 16
    lowest: Annotated[float, Quantity("angle", least="5 deg", most="60 deg")] = default("12 deg")
    noise: q.Length = default("3 m")  # white noise at 45 dBHz


class StreetWalls(Parameters):
    """Walls on both sides, in blocks whose height and distance are drawn for each block."""

    block: q.Length = default("40 m")
    gap: Annotated[float, pydantic.Field(ge=0.0, le=1.0)] = 0.25  # share of blocks without a wall
    least_height: q.Length = default("8 m")
    mean_height: q.Length = default("20 m")
    nearest: q.Length = default("8 m")  # wall to mid-street, log-uniform up to `farthest`
    farthest: q.Length = default("40 m")
    loss_db: Positive = 12.0  # of a reflected signal


class City(Scenario, GnssAssumptions):
    """A simulated drive through streets whose walls block and reflect signals."""

    system: str = "gnss"
    study: str = "city"
    title: str = "Drive through a city"
    rate: Annotated[float, Quantity("frequency", above="0 Hz", most="100 Hz")] = default("5 Hz")
    place: Departure
    legs: Annotated[tuple[Leg, ...], pydantic.Field(min_length=1)]
    satellites: Satellites = pydantic.Field(default_factory=Satellites)
    streets: StreetWalls = pydantic.Field(default_factory=StreetWalls)
    speed_noise: q.Speed = default("0.05 m/s")
    yaw_noise: q.AngleRate = default("0.1 deg/s")
    settle: q.Time = default("0 s")
    filters: Names = ("ls", "ekf", "huber", "student-t", "switchable", "delays")

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> City:
        lasts = sum(leg.lasts_s for leg in self.legs)
        refuse_too_long("rate", lasts, self.rate)
        if self.settle >= lasts:
            raise ValueError(f"settle: the drive lasts {lasts:g} s; let it begin to count before")
        return self
