"""Parameters of a spinning rocket in free flight, with units.

Two studies share the flight, the body, the gyro and the disturbances of the magnetometer: in
"magnetic-attitude" the magnetometer reports three angles, as in the paper; in "field-vector" it
reports the field, and the gyro drives the motion.
"""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from robins.scenario import Parameters, Quantity, Span, default
from robins.systems import quantities as q
from robins.systems.parts import Names, refuse_too_long, refuse_unsettled
from robins.systems.study import Scenario


class Launch(Parameters):
    """Place, time and velocity at the start of free flight, relative to inertial space."""

    latitude: Annotated[float, Quantity("angle", least="-90 deg", most="90 deg")]
    longitude: Annotated[float, Quantity("angle", least="-180 deg", most="180 deg")]
    height: Annotated[float, Quantity("length", least="-1 km", most="100 km")] = default("0 m")
    speed: q.Speed
    elevation: Annotated[float, Quantity("angle", above="0 deg", most="90 deg")]
    azimuth: q.Angle = default("0 deg")
    year: Annotated[float, pydantic.Field(ge=2020.0, lt=2030.0)] = 2026.0


class RocketBody(Parameters):
    """A body symmetric about its x axis, that spins and cones; white torque over inertia."""

    spin: q.AngleRate
    cone: Annotated[float, Quantity("angle", least="0 deg", below="80 deg")]  # half angle
    elevation: Annotated[float, Quantity("angle", least="-90 deg", most="90 deg")]  # of momentum
    azimuth: q.Angle
    e1: Annotated[float, pydantic.Field(ge=-1.0, lt=1.0)]  # 1 - Ix/It
    # times 1/e2 in which the spin decays, and 1/e3 in which the rates across do; none: never
    spin_decay: q.Duration | None = None
    cone_decay: q.Duration | None = None
    torque: q.RateWalkSize


class RocketGyro(Parameters):
    """A MEMS triad: constant, slow and white errors; sigma of the white one is of a sample."""

    white: q.AngleRate
    bias: q.RateSize = default("5 deg/h")
    drift: q.RateSize = default("5 deg/h")
    drift_time: q.Duration = default("300 s")
    scale_factor: Annotated[float, Quantity("ratio", least="0")] = default("0 ppm")
    # white noise of the integrated attitude, where the gyro reads that
    attitude_noise: q.Spread = default("0.5 deg")
    lost: tuple[Span, ...] = ()


class MagneticDisturbance(Parameters):
    """Recurring disturbance of the magnetometer by an angle, each for a limited time."""

    angle: q.Spread
    every: q.Duration = default("30 s")
    length: q.Duration = default("1 s")

    @pydantic.model_validator(mode="after")
    def _check_pauses(self) -> MagneticDisturbance:
        if self.length >= self.every:
            raise ValueError(
                f"length ({self.length:g} s) must be below every ({self.every:g} s), or the "
                "magnetometer is never right"
            )
        return self


class RocketMagnetometer(Parameters):
    """White noise and disturbances, as angles.

    In "field-vector" hard iron is the residual after calibration, and an axis saturates at full
    scale.
    """

    noise: q.Spread = default("1 deg")
    hard_iron: Annotated[q.Three, Quantity("magnetic field")] = default("0 uT")
    full_scale: q.FieldStrength | None = None
    disturbance: MagneticDisturbance | None = None
    lost: tuple[Span, ...] = ()


class RocketStart(Parameters):
    """Start of the estimate: its error, and its assumed sigma."""

    attitude_error: q.Angles = default("0 deg")
    attitude: q.Spread = default("2 deg")
    rate: q.AngleRate = default("1 deg/s")


class RocketFlight(Scenario):
    """Parameters that the two studies share."""

    system: str = "rocket"
    claims: tuple[str, ...] | None = ()  # the paper's hold only where a scenario states them
    duration: q.Duration = default("600 s")
    step: q.Duration = default("0.1 s")
    counted_from: q.Time = default("30 s")
    quiet_after: q.Time = default("10 s")
    launch: Launch
    body: RocketBody
    gyro: RocketGyro
    magnetometer: RocketMagnetometer = pydantic.Field(default_factory=RocketMagnetometer)
    start: RocketStart = pydantic.Field(default_factory=RocketStart)

    @pydantic.model_validator(mode="after")
    def _check_length(self) -> RocketFlight:
        refuse_unsettled("counted_from", self.counted_from, self.duration)
        refuse_too_long("step", self.duration, 1.0 / self.step)
        if self.duration < 2.0 * self.step:
            raise ValueError(
                f"duration ({self.duration:g} s) must hold two steps of {self.step:g} s at least"
            )
        burst = self.magnetometer.disturbance
        if burst is not None and burst.length < self.step * (1.0 - 1e-9):
            raise ValueError(
                f"magnetometer.disturbance.length ({burst.length:g} s) is shorter than a step of "
                f"{self.step:g} s: it would miss every sample"
            )
        return self


class RocketAssumptions(Parameters):
    """Motion assumed by the filters: the paper's equation with an error of some per cent."""

    error: Annotated[float, Quantity("ratio")] = default("0 %")  # of the coefficients
    wrong: Literal["rates", "all"] = "all"  # only e1, e2, e3, or the kinematic rows too
    attitude_noise: q.AngleWalk = default("3.16227766e-5 rad/sqrt(s)")
    rate_noise: Annotated[float, Quantity("rate random walk", above="0 deg/s/sqrt(s)")] = default(
        "0.02 deg/s/sqrt(s)"
    )


class MagneticAttitude(RocketFlight):
    """Test-bed A: attitude angles "measured" by the magnetometer, the formulation of the paper."""

    study: str = "magnetic-attitude"
    title: str = "Rocket, magnetic attitude"
    filters: Names = (
        *("gyro", "magnetic-raw", "magnetometer", "ukf", "federated-scalar-ukf"),
        *("federated-vector-stukf", "federated-root", "huber", "gate", "discriminator"),
    )
    gyro_reads: Literal["rate", "attitude"] = "rate"
    believed: RocketAssumptions = pydantic.Field(default_factory=RocketAssumptions)


class FieldVector(RocketFlight):
    """Test-bed B: attitude on SO(3), driven by the gyro, corrected by the measured field."""

    study: str = "field-vector"
    title: str = "Rocket, field vector"
    filters: Names = (
        *("gyro", "magnetometer", "usque", "huber", "gate", "discriminator"),
        *("strong-tracking", "gate-scale-factor"),
    )
    scale_factor_sigma: Annotated[float, Quantity("ratio", above="0")] = default("1000 ppm")
