"""Parameters of a small satellite controlled by its estimate, with units."""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from robins.scenario import Entry, Parameters, Positive, Quantity, Span, default
from robins.systems import quantities as q
from robins.systems.parts import refuse_too_long, refuse_unsettled
from robins.systems.study import Scenario

_TILTED = (3.0**-0.5, 3.0**-0.5, 3.0**-0.5)


class OrbitParameters(Parameters):
    """Circular orbit, and the model of the magnetic field along it."""

    altitude: Annotated[float, Quantity("length", least="100 km")] = default("500 km")
    inclination: q.AngleSize = default("97.4 deg")
    node: q.Angle = default("0 deg")
    latitude_argument: q.Angle = default("0 deg")
    field: Literal["dipole", "wmm"] = "dipole"
    year: Annotated[float, pydantic.Field(ge=2020.0, lt=2030.0)] = 2025.0


class Craft(Parameters):
    """Inertia and disturbances; products are the elements xy, xz, yz of the matrix."""

    moments: Annotated[q.Three, Quantity("moment of inertia", above="0 kg m^2")] = default(
        "1.9 kg m^2", "2.1 kg m^2", "2.4 kg m^2"
    )
    products: Annotated[q.Three, Quantity("moment of inertia")] = default(
        "0.02 kg m^2", "-0.03 kg m^2", "0.01 kg m^2"
    )
    dipole: Annotated[q.Three, Quantity("magnetic moment")] = default(
        "0.05 A m^2", "-0.03 A m^2", "0.04 A m^2"
    )
    # amplitude of a torque on each axis at orbital period, phases 120 deg apart
    disturbance: Annotated[float, Quantity("torque", least="0 N m")] = default("1 uN m")


class ReactionWheels(Parameters):
    """Reaction wheels, numbered from 0; those in ``lost`` give no torque, and control knows."""

    axes: tuple[tuple[Entry, Entry, Entry], ...] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
        _TILTED,
    )
    torque: Annotated[float, Quantity("torque", above="0 N m")] = default("5 mN m")
    momentum: Annotated[float, Quantity("angular momentum", above="0 N m s")] = default("0.1 N m s")
    start: Annotated[float, Quantity("angular momentum")] = default("0 N m s")  # each of them
    lost: tuple[Annotated[int, pydantic.Field(ge=0, le=99)], ...] = ()
    lost_at: q.Time = default("0 s")
    loss_known: bool = True  # from the start; torques are then allocated to the others

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> ReactionWheels:
        for i, axis in enumerate(self.axes):
            if sum(x * x for x in axis) == 0.0:
                raise ValueError(f"axes: wheel {i} has none: give a vector other than zero")
        if beyond := [i for i in self.lost if i >= len(self.axes)]:
            raise ValueError(f"lost: there is no wheel {beyond[0]}, only 0 to {len(self.axes) - 1}")
        if abs(self.start) > self.momentum:
            raise ValueError(
                f"start ({self.start:g} N m s) is beyond what a wheel holds, "
                f"{self.momentum:g} N m s"
            )
        return self


class Control(Parameters):
    """Attitude control by wheels, their unloading by magnetorquers."""

    frequency: q.AngleRate = default("0.12 rad/s")
    damping: Positive = 0.9
    dipole: Annotated[float, Quantity("magnetic moment", least="0 A m^2")] = default("5 A m^2")
    unloading: Annotated[float, Quantity("inverse time", least="0 1/s")] = default("0.002 1/s")


class Slew(Parameters):
    """Sinusoidal turns about the body axes on top of the reference, growing from rest."""

    angle: Annotated[q.Three, Quantity("angle", most="90 deg")]
    period: q.Durations
    grows: q.Time = default("100 s")


class SatelliteGyro(Parameters):
    """A gyro triad whose noise has several sources; each is drawn in each run."""

    random_walk: q.AngleWalk = default("1.2 arcsec/sqrt(s)")
    rate_walk: q.RateWalkSize = default("0.005 arcsec/s/sqrt(s)")
    markov: q.RateSize = default("0.3 arcsec/s")
    markov_time: q.Duration = default("300 s")
    bias: q.RateSize = default("3 arcsec/s")
    ramp: Annotated[float, Quantity("angular acceleration", least="0 rad/s^2")] = default(
        "9.6962736e-10 rad/s^2"  # 2e-4 arcsec/s^2
    )
    scale_factor: Annotated[float, Quantity("ratio", least="0")] = default("0 ppm")  # one sigma
    misalignment: q.AngleSize = default("0 arcsec")  # one sigma
    quantum: q.AngleSize = default("0.05 arcsec")


class StarFault(Span):
    """Fault of the star sensor, from begin (included) to end (excluded).

    "stuck": its last report repeated; "turned": an attitude rotated about its boresight; "sign": in
    every other second the same attitude with the opposite sign, which is not a fault of the sensor;
    "short": a quaternion whose length is not one.
    """

    kind: Literal["stuck", "turned", "sign", "short"]
    angle: q.Spread = default("10 deg")


class Camera(Parameters):
    """The star sensor as a camera that tracks stars about the directions predicted by the filter.

    Its attitude comes from their directions by QUEST, with a covariance of each frame; the noise of
    the star sensor is then used for the design of gains.
    """

    catalogue: Literal["synthetic", "hipparcos"] = "synthetic"
    field: Annotated[float, Quantity("angle", above="1 deg", most="60 deg")] = default("20 deg")
    magnitude: Annotated[float, pydantic.Field(ge=3.0, le=6.5)] = 5.5
    noise: q.Spread = default("20 arcsec")  # of a star
    missed: Annotated[float, Quantity("ratio", least="0", below="1")] = default("0 %")
    false_stars: Annotated[int, pydantic.Field(ge=0, le=20)] = 0
    tolerance: q.Spread = default("0.1 deg")  # of a match


class StarSensor(Parameters):
    """A star sensor, its boresight z; the low-frequency error is a sine of drawn phase."""

    period: q.Duration = default("0.5 s")
    noise: Annotated[q.Three, Quantity("angle", above="0 deg")] = default(
        "10 arcsec", "10 arcsec", "40 arcsec"
    )
    low_frequency: q.AngleSize = default("0 arcsec")
    low_frequency_period: q.Duration = default("600 s")
    lost: tuple[Span, ...] = ()
    faults: tuple[StarFault, ...] = ()
    camera: Camera | None = None


class SatelliteAssumptions(Parameters):
    """Assumptions of filters; ``drift`` is the random walk of the gyro's rate, with Markov drift.

    Left out, it is the equivalent of the true one.
    """

    drift: Annotated[float, Quantity("rate random walk", above="0 rad/s/sqrt(s)")] | None = None
    attitude: q.Spread = default("60 arcsec")
    bias: q.AngleRate = default("3 arcsec/s")


class AttitudeLoop(Scenario, Parameters):
    """A satellite in closed loop."""

    system: str = "satellite"
    study: str = "attitude-loop"
    title: str = "Satellite attitude"
    claims: tuple[str, ...] | None = ()
    duration: q.Duration = default("1500 s")
    step: q.Duration = default("0.1 s")
    counted_from: q.Time = default("500 s")
    points: Literal["nadir", "inertial"] = "nadir"
    slew: Slew | None = None
    orbit: OrbitParameters = pydantic.Field(default_factory=OrbitParameters)
    craft: Craft = pydantic.Field(default_factory=Craft)
    wheels: ReactionWheels = pydantic.Field(default_factory=ReactionWheels)
    control: Control = pydantic.Field(default_factory=Control)
    gyro: SatelliteGyro = pydantic.Field(default_factory=SatelliteGyro)
    star: StarSensor = pydantic.Field(default_factory=StarSensor)
    believed: SatelliteAssumptions = pydantic.Field(default_factory=SatelliteAssumptions)

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> AttitudeLoop:
        refuse_unsettled("counted_from", self.counted_from, self.duration)
        refuse_too_long("step", self.duration, 1.0 / self.step)
        ratio = self.star.period / self.step
        if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-6:
            raise ValueError(
                f"star.period ({self.star.period:g} s) must be a multiple of step "
                f"({self.step:g} s): a frame comes with a sample of the gyro"
            )
        return self
