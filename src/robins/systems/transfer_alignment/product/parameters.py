"""Parameters of a master and a slave on one vehicle, of the study "product", and of a recording.

A scenario class takes those of the pair by inheriting `PairParameters` as well as `Scenario`.
Vectors along the body are forward, right, down; along the Earth north, east, down.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import pydantic

from robins.filters.values import Numbers
from robins.scenario import Dof, Parameters, Positive, Quantity, Share, Span, default
from robins.sim.flexure import Flexure
from robins.systems import quantities as q
from robins.systems.parts import (
    Departure,
    Draw,
    Leg,
    LogPartition,
    Names,
    as_array,
    refuse_too_long,
    refuse_unsettled,
)
from robins.systems.study import Scenario


class BankLeg(Parameters):
    """Bank angle, right wing down positive, and duration of the leg."""

    bank: Annotated[float, Quantity("angle", above="-85 deg", below="85 deg")]
    seconds: q.Duration


class Sway(Parameters):
    """Sinusoidal oscillation of an angle."""

    amplitude: q.AngleSize
    period: q.Duration
    phase: q.Angle = default("0 deg")


class Heave(Sway):
    """Sinusoidal oscillation of height."""

    amplitude: Annotated[float, Quantity("length", least="0 m", most="1 km")]


class Aircraft(Departure):
    """Level flight at constant speed through commanded banks; see `robins.sim.manoeuvres.fly`."""

    kind: Literal["aircraft"]
    speed: q.Speed
    pitch: Annotated[float, Quantity("angle", least="-80 deg", most="80 deg")] = default("0 deg")
    roll_time: q.Duration = default("2 s")
    legs: Annotated[tuple[BankLeg, ...], pydantic.Field(min_length=1)]

    @property
    def lasts_s(self) -> float:
        """Duration [s]."""
        return sum(leg.seconds for leg in self.legs)


class Ship(Departure):
    """A straight course in the sea; without any sway the sea of `MODERATE_SEA`."""

    kind: Literal["ship"]
    speed: q.SpeedSize = default("0 m/s")
    seconds: q.Duration
    roll: tuple[Sway, ...] | None = None
    pitch: tuple[Sway, ...] | None = None
    yaw: tuple[Sway, ...] | None = None
    heave: tuple[Heave, ...] | None = None

    @property
    def lasts_s(self) -> float:
        """Duration [s]."""
        return self.seconds


class GroundVehicle(Departure):
    """A ground vehicle that drives legs, on a road that may be rough."""

    kind: Literal["vehicle"]
    speed: q.SpeedSize = default("0 m/s")  # initial speed
    legs: Annotated[tuple[Leg, ...], pydantic.Field(min_length=1)]
    roll: tuple[Sway, ...] = ()
    pitch: tuple[Sway, ...] = ()

    @property
    def lasts_s(self) -> float:
        """Duration [s]."""
        return sum(leg.lasts_s for leg in self.legs)


class PairSlave(Parameters):
    """The inertial unit to be aligned; constants are drawn in each run, with these sigmas.

    Its errors after compensation are those of a patent of Southeast University, (6) and (7),

        eps   = eps_const + eps_slow + eps_fast - eps_calibrated        gyros
        nabla = nabla_const + nabla_fast - nabla_calibrated             accelerometers

    with fast for white noise and slow for a first-order Gauss-Markov process in its steady state. A
    calibration determines the constant with an error of the stated sigma, c = const + error, so
    const - c = -error remains; where none is stated there was no calibration, c = 0.
    """

    rate: q.Frequency = default("50 Hz")
    gyro_noise: q.AngleWalkSizes  # fast
    accel_noise: q.AccelWalkSizes
    gyro_bias: q.RateSizes  # constant
    accel_bias: q.AccelSizes
    gyro_slow: q.RateSizes = default("0 deg/h")
    gyro_slow_time: q.Durations = default("300 s")  # correlation time of the slow part
    gyro_calibration: q.RateSizes | None = None
    accel_calibration: q.AccelSizes | None = None

    @property
    def gyro_left(self) -> Numbers:
        """(3,) sigma of the residual constant drift after calibration [rad/s]."""
        calibrated = self.gyro_calibration
        return as_array(self.gyro_bias if calibrated is None else calibrated)

    @property
    def accel_left(self) -> Numbers:
        """(3,) sigma of the residual constant bias after calibration [m/s^2]."""
        calibrated = self.accel_calibration
        return as_array(self.accel_bias if calibrated is None else calibrated)

    @property
    def gyro_sigma(self) -> np.ndarray:
        """(3,) sigma of constant and slow drift at any one time [rad/s]."""
        return np.hypot(self.gyro_left, self.gyro_slow)

    @property
    def gyro_walk(self) -> np.ndarray:
        """(3,) random walk [rad/s/sqrt(s)] equivalent to the slow drift over short times."""
        return np.asarray(self.gyro_slow) * np.sqrt(2.0 / np.asarray(self.gyro_slow_time))


class PairMaster(Parameters):
    """The records of the master; one at each epoch of the filters."""

    rate: q.Frequency = default("10 Hz")
    # one sigma about north, east, down; includes flutter of the structure
    attitude_noise: q.AngleSizes
    velocity_noise: q.SpeedSizes
    position_noise: q.LengthSizes = default("0 m")
    delay: q.Time = default("0 s")  # a record stamped t describes t - delay


class PairMounting(Parameters):
    """Mounting of the slave: ``C_ms = C(nominal) exp(error x)``, the error in slave axes."""

    nominal: q.Angles = default("0 deg")  # roll, pitch, yaw of the slave
    error: q.Angles = default("0 deg")  # the same in every run
    sigma: q.AngleSizes = default("0 deg")  # drawn in each run, in addition


class Structure(Parameters):
    """Flexure between master and slave, in master axes: roll, pitch, heading."""

    sigma: q.AngleSizes = default("0 deg")
    time: q.Durations = default("1 s")
    damping: Positive = 1.0
    # degrees of freedom of the Student-t noise that drives it; without, normal
    tail_dof: Dof | None = None
    bending: q.Angles = default("0 deg")  # per g of load factor above 1

    @property
    def flexure(self) -> Flexure:
        """Convert to the `Flexure` of simulator and filters."""
        sigma, time, bending = (as_array(x) for x in (self.sigma, self.time, self.bending))
        return Flexure(sigma, time, self.damping, self.tail_dof, bending)


class PairDisturbance(Parameters):
    """Disturbances unknown to the filters, unless a scenario states otherwise."""

    # records of the master with attitude and velocity noise that many times as large
    outlier_share: Share = 0.0
    outlier_factor: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 10.0
    # degrees of freedom of Student-t noise of the master, of the stated sigmas; without, normal
    tail_dof: Dof | None = None
    gyro_noise_factor: Annotated[float, pydantic.Field(ge=0.0, le=1e6)] = 1.0  # in the window
    gyro_noise_window: Span | None = None
    drift_step: Annotated[q.Three, Quantity("angle rate")] = default("0 deg/h")  # slave axes
    drift_step_time: q.Time | None = None
    dropouts: tuple[Span, ...] = ()  # no records of the master


class PairStart(Parameters):
    """One sigma of the initial errors of the slave's navigation, north, east, down.

    They are drawn from normal distributions, or all +1 sigma, or 1 sigma with random signs.
    """

    attitude: q.AngleSizes
    velocity: q.SpeedSizes = default("0 m/s")
    position: q.LengthSizes = default("0 m")
    draw: Draw = "normal"


class PairParameters(Parameters):
    """A master, a slave, the structure between them, and their motion."""

    manoeuvre: Annotated[Aircraft | Ship | GroundVehicle, pydantic.Field(discriminator="kind")]
    slave: PairSlave
    master: PairMaster
    start: PairStart
    mounting: PairMounting = pydantic.Field(default_factory=PairMounting)
    lever_arm: q.Arm = default("0 m")  # master to slave, master axes
    flexure: Structure = pydantic.Field(default_factory=Structure)
    disturbance: PairDisturbance = pydantic.Field(default_factory=PairDisturbance)

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> PairParameters:
        if self.manoeuvre is not None:  # a recorded pair brings its own
            lasts = self.manoeuvre.lasts_s
            refuse_too_long("slave.rate", lasts, self.slave.rate)
            refuse_too_long("master.rate", lasts, self.master.rate)
            refuse_unsettled("settle", getattr(self, "settle", 0.0), lasts)
        return self


class PairAssumptions(Parameters):
    """Assumptions of the filters; left out: the stated noise, start and mounting are true."""

    mounting: q.AngleSizes = default("0.3 deg")  # one sigma of the mounting error
    # flexure modelled by states; tails and bending are not modelled
    flexure: Structure | None = None
    gyro_bias_walk: q.RateWalkSizes = default("0 deg/h/sqrt(h)")
    accel_bias_walk: q.AccelRateWalkSizes = default("0 mg/sqrt(h)")
    position: bool = False  # match positions too


class Product(Scenario, PairParameters):
    """A pair to be aligned by filters of the product model."""

    system: str = "transfer-alignment"
    study: str = "product"
    title: str = "Transfer alignment, closed loop"
    filters: Names = ("kf", "product")
    believed: PairAssumptions = pydantic.Field(default_factory=PairAssumptions)
    # metrics are pooled from here on, when the manoeuvre has made the states observable
    settle: q.Time = default("0 s")


class PairReplay(Product):
    """Assumptions on a recorded pair; the log brings its own motion."""

    manoeuvre: (  # pyright: ignore[reportIncompatibleVariableOverride]
        Annotated[Aircraft | Ship | GroundVehicle, pydantic.Field(discriminator="kind")] | None
    ) = None
    recording: LogPartition = pydantic.Field(default_factory=LogPartition)
    filters: Names = ("product",)
