"""Parameters of an airship in the wind, with units.

Vectors along the body are forward, right, down; along the Earth north, east, down. Directions are
those towards which something goes, clockwise from north.
"""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from robins.scenario import Parameters, Quantity, Share, Span, default
from robins.systems import quantities as q
from robins.systems.parts import Draw, Names, Runs, StartPlace, refuse_too_long
from robins.systems.study import Scenario


class Position(StartPlace):
    """Position at the start of the flight."""

    height: Annotated[float, Quantity("length", least="0 m", most="100 km")]


class AirshipBody(Parameters):
    """Motion of the airship: velocity through the air, and time constant of the drift."""

    air_speed: q.SpeedSize = default("10 m/s")
    course: q.Angle = default("90 deg")
    response: q.Duration = default("20 s")
    # amplitudes of roll, pitch and heading, and the periods of their sines
    sway_calm: q.AngleSizes = default("0.3 deg")
    sway_gust: q.AngleSizes = default("2.3 deg")
    sway_period: q.Durations = default("60 s")


class Gusts(Parameters):
    """Gusts drawn at fixed intervals, each held until the next."""

    speed: Annotated[tuple[float, float], Quantity("speed", least="0 m/s")]
    spread: q.AngleSize = default("45 deg")
    every: q.Duration = default("10 s")


class Turbulence(Parameters):
    """Continuous turbulence with a spectrum of its own; lengths along and across the wind."""

    spectrum: Literal["dryden", "von-karman"]
    sigma: Annotated[tuple[float, float], Quantity("speed", least="0 m/s")]
    length: Annotated[tuple[float, float], Quantity("length", above="0 m")] = default("533 m")
    step: q.Duration = default("0.1 s")


class Wind(Parameters):
    """Steady wind, plus gusts or turbulence within `span`."""

    constant: q.SpeedSize = default("10 m/s")
    towards: q.Angle = default("90 deg")
    span: Span = Span(begin=200.0, end=800.0)
    gusts: Gusts | None = None
    turbulence: Turbulence | None = None

    @property
    def gusty(self) -> bool:
        """True if there are gusts or turbulence."""
        return self.gusts is not None or self.turbulence is not None

    @pydantic.model_validator(mode="after")
    def _check_steps(self) -> Wind:
        if self.gusts is not None and self.turbulence is not None:
            steps = self.gusts.every / self.turbulence.step
            if abs(steps - round(steps)) > 1e-9 or round(steps) < 1:
                raise ValueError(
                    f"gusts.every, {self.gusts.every:g} s, must be a multiple of turbulence.step"
                )
        return self


class AirshipImu(Parameters):
    """The inertial unit; biases are constant in a run."""

    rate: q.Frequency = default("100 Hz")
    gyro_bias: q.RateSizes = default("0.1 deg/h")
    gyro_noise: q.AngleWalkSizes = default("0.01 deg/sqrt(h)")
    accel_bias: q.AccelSizes = default("1 mg")
    accel_noise: q.AccelWalkSizes = default("4.903325e-3 m/s/sqrt(s)")
    draw: Draw = "random-sign"  # of the biases
    unsensed: Share = 0.0  # share of the acceleration by gusts that the accelerometers do not sense


class InstrumentRate(Parameters):
    """Parameters of every instrument but the inertial unit: rate and outages."""

    rate: q.Frequency = default("1 Hz")
    lost: tuple[Span, ...] = ()


class Sar(InstrumentRate):
    """Horizontal position and heading from a radar image matched with a map."""

    position: q.Length = default("25 m")  # each axis
    heading: q.Spread = default("1 deg")
    outlier_share: Share = 0.0
    outlier_factor: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 5.0


class Barometer(InstrumentRate):
    """Height from static pressure."""

    height: q.Length = default("20 m")


class AirshipStar(InstrumentRate):
    """Pitch, roll and heading from stars, once an epoch or several times."""

    rate: q.Frequency = default("2 Hz")
    attitude: q.Spread = default("20 arcsec")


class AirData(InstrumentRate):
    """Velocity through the air, and the assumed wind, both with errors."""

    noise: q.Speed = default("0.3 m/s")  # each axis
    wind_error: q.Speed = default("0.3 m/s")
    wind_time: q.Duration = default("50 s")


class AirshipStart(Parameters):
    """Uncertainty at the start, in north, east, down; one standard deviation."""

    attitude: q.AngleSizes
    velocity: q.SpeedSizes = default("0.1 m/s")
    position: q.LengthSizes
    draw: Draw = "plus-sigma"


class BelievedNoise(Parameters):
    """Noise of the inertial unit assumed by filters of nine states, for want of bias states.

    The product assumes the noise of the inertial unit, times `accel_noise_factor` where the hull
    bends or the unit sits off the centre.
    """

    gyro_noise: q.AngleWalkSize = default("0.01 deg/sqrt(h)")
    accel_noise: q.AccelWalk = default("0.07 m/s/sqrt(s)")
    accel_noise_factor: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 1.0


COMPARED = ("ekf", "aekf", "ukf", "raukf", "cukf-wind-states", "cukf-robust", "product")
"""Filters that a scenario compares by default."""


class Airship(Scenario):
    """An airship in the wind, navigated by SINS, stars, radar, barometer and air data."""

    system: str = "airship"
    title: str = "Airship in the wind"
    runs: Runs = 20
    filters: Names = COMPARED
    claims: tuple[str, ...] | None = ()  # ids of those the scenario checks
    duration: q.Duration = default("1000 s")
    epoch: q.Duration = default("1 s")  # step of the filters
    counted: Span = Span(begin=200.0, end=800.0)  # span over which metrics are pooled
    place: Position
    hull: AirshipBody = pydantic.Field(default_factory=AirshipBody)
    wind: Wind = pydantic.Field(default_factory=Wind)
    imu: AirshipImu = pydantic.Field(default_factory=AirshipImu)
    sar: Sar = pydantic.Field(default_factory=Sar)
    barometer: Barometer = pydantic.Field(default_factory=Barometer)
    star: AirshipStar = pydantic.Field(default_factory=AirshipStar)
    air_data: AirData = pydantic.Field(default_factory=AirData)
    start: AirshipStart
    believed: BelievedNoise = pydantic.Field(default_factory=BelievedNoise)

    @pydantic.model_validator(mode="after")
    def _check_rates(self) -> Airship:
        """Check that all measurement times fall on epochs or on even parts of one, and that all of
        it fits.
        """
        refuse_too_long("imu.rate", self.duration, self.imu.rate)
        if self.wind.turbulence is not None:
            refuse_too_long("wind.turbulence.step", self.duration, 1.0 / self.wind.turbulence.step)
        for name, among in (("imu", self.star.rate), ("star", 1.0 / self.epoch)):
            ratio = getattr(self, name).rate / among
            if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
                of = "star.rate" if name == "imu" else "that of the epochs"
                raise ValueError(f"{name}.rate must be a multiple of {of}, {among:g} Hz")
        others = (name for name, of in self if isinstance(of, InstrumentRate) and name != "star")
        for name in others:  # read at the end of an epoch
            ratio = 1.0 / (self.epoch * getattr(self, name).rate)
            if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
                raise ValueError(
                    f"{name}.rate must divide that of the epochs, {1.0 / self.epoch:g} Hz: it is "
                    "read at the end of one"
                )
        if self.counted.end > self.duration:
            raise ValueError(
                f"counted.end is {self.counted.end:g} s, after the end of the run at "
                f"{self.duration:g} s"
            )
        return self
