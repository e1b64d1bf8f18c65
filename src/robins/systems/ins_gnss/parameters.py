"""Parameters of INS/GNSS, of a replayed log and of a simulated drive, with units."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import pydantic

from robins.scenario import Parameters, Positive, Quantity, default
from robins.systems import quantities as q
from robins.systems.parts import (
    Departure,
    Leg,
    LogPartition,
    Names,
    refuse_too_long,
    refuse_unsettled,
)
from robins.systems.study import Scenario


class InsGnssImu(Parameters):
    """The inertial sensors as modelled by the filter, and their mounting.

    The biases are random walks with the stated initial sigma, or first-order Gauss-Markov if a
    correlation time is given.
    """

    gyro_noise: q.AngleWalks
    accel_noise: q.AccelWalks
    gyro_bias: q.RateSizes
    accel_bias: q.AccelSizes
    gyro_bias_walk: q.RateWalkSizes
    accel_bias_walk: q.AccelRateWalkSizes
    gyro_bias_time: q.Duration | None = None
    accel_bias_time: q.Duration | None = None
    scale_states: bool = False
    gyro_scale: Annotated[q.Three, Quantity("scale factor", least="0 ppm")] = default("1000 ppm")
    accel_scale: Annotated[q.Three, Quantity("scale factor", least="0 ppm")] = default("1000 ppm")
    orientation: q.Angles = default("0 deg")  # roll, pitch, yaw of the mounting


class Gnss(Parameters):
    """The receiver, its antenna, and corrections to its stated sigmas."""

    lever_arm: q.Arm = default("0 m")  # IMU to antenna, body
    latency: Annotated[float, Quantity("time", least="-10 s", most="10 s")] = default("0 s")
    use_velocity: bool = True
    # window of the mean velocity: many receivers state that since the last fix; 0 s: the velocity
    # at the fix; not given: estimated by `robust`, 0 for the others
    velocity_window: q.Time | None = None
    # by RTKLIB quality: 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP
    sigma_factor: dict[str, Positive] = pydantic.Field(default_factory=dict)
    least_sigma: Annotated[float, Quantity("length", least="0 m")] = default("0 m")
    least_velocity_sigma: q.SpeedSize = default("0 m/s")
    # `robust`: share of the variance of positions that is correlated from fix to fix; not given: a
    # replay estimates it from the scatter of the fixes, a live filter assumes 0
    lasting_share: Annotated[float, pydantic.Field(ge=0.0, lt=1.0)] | None = None
    lasting_time: q.Duration = default("100 s")


class InsGnssStart(Parameters):
    """Uncertainty of the start, and the source of the heading."""

    tilt: q.Spread = default("2 deg")
    heading: q.Spread = default("20 deg")
    velocity: q.Speed = default("0.2 m/s")
    position: q.Length = default("0.1 m")
    # heading of the body at the first sample; not given: the course, once above `course_speed`
    known_heading: q.Angle | None = None
    course_speed: q.Speed = default("1 m/s")


class Aids(Parameters):
    """Constraints on the motion, used as measurements."""

    zero_velocity: bool = True
    standstill_velocity: q.Speed = default("0.01 m/s")
    standstill_rate: q.AngleRate = default("0.05 deg/s")
    # limits, at rest, of the standard deviation of samples over the window
    window: q.Duration = default("0.5 s")
    quiet_accel: q.Acceleration = default("0.15 m/s^2")
    quiet_rate: q.AngleRate = default("0.5 deg/s")
    # a fix proves motion if it is faster than this and than four of its sigmas
    moving_speed: q.Speed = default("0.2 m/s")
    non_holonomic: bool = False
    axle: q.Arm = default("0 m")  # IMU to rear axle, body
    road_velocity: Annotated[tuple[float, float], Quantity("speed", above="0 m/s")] = default(
        "0.1 m/s"
    )

    @property
    def quiet(self) -> tuple[float, float, float]:
        """Window [s], rate [rad/s] and force [m/s^2] of `robins.ins.rest.standstill`."""
        return self.window, self.quiet_rate, self.quiet_accel


class Outages(Parameters):
    """Times at which the GNSS is withheld, to measure the drift of the inertial solution."""

    length: q.Duration
    first: q.Time  # after the first fix
    gap: q.Duration  # between two outages
    last: q.Time  # no outage begins this shortly before the last fix

    def mask(self, time_s: np.ndarray, first_s: float, last_s: float) -> np.ndarray:
        """Mask (N,), true in an outage; none begins within `last` of the last fix.

        The first and the last fix are at `first_s` and `last_s`.
        """
        period = self.length + self.gap
        since = time_s - (first_s + self.first)
        begin = np.floor(since / period) * period
        inside = (since >= 0.0) & (since - begin < self.length)
        return inside & (first_s + self.first + begin < last_s - self.last)


class InsGnssUpdate(LogPartition):
    """Steps of the filter."""

    longest_gap: q.Duration = default("1 s")
    # gate probability of the filters other than `robust`; 0: no gate
    gate: Annotated[float, pydantic.Field(ge=0.0, lt=1.0)] = 0.9999
    # `robust`: mean duration of a fault of positions
    patience: q.Duration = default("10 s")


class UnknownImu(InsGnssImu):
    """Default for an unknown unit: a consumer-grade MEMS."""

    gyro_noise: q.AngleWalks = default("0.01 deg/s/sqrt(Hz)")
    accel_noise: q.AccelWalks = default("200 ug/sqrt(Hz)")
    gyro_bias: q.RateSizes = default("0.5 deg/s")
    accel_bias: q.AccelSizes = default("20 mg")
    gyro_bias_walk: q.RateWalkSizes = default("0.002 deg/s/sqrt(s)")
    accel_bias_walk: q.AccelRateWalkSizes = default("20 ug/sqrt(s)")


class UnknownReceiver(Gnss):
    """Default for an unknown receiver."""

    # of every fix, instead of those in the log; north, east, down, or one for all
    sigma: Annotated[q.Three, Quantity("length", above="0 m")] | None = None
    velocity_sigma: Annotated[q.Three, Quantity("speed", above="0 m/s")] | None = None
    sigma_factor: dict[str, Positive] = pydantic.Field(default_factory=lambda: {"2": 3.0, "5": 3.0})


class UnknownStart(InsGnssStart):
    """Default for an unknown start."""

    tilt: q.Spread = default("3 deg")


class InsGnssReplay(Parameters):
    """Parameters of a recorded log that its files do not contain; each part is optional."""

    system: Literal["ins-gnss"] = "ins-gnss"
    title: str = "INS/GNSS replay, consumer MEMS"
    imu: UnknownImu = pydantic.Field(default_factory=UnknownImu)
    gnss: UnknownReceiver = pydantic.Field(default_factory=UnknownReceiver)
    start: UnknownStart = pydantic.Field(default_factory=UnknownStart)
    aids: Aids = pydantic.Field(default_factory=Aids)
    update: InsGnssUpdate = pydantic.Field(default_factory=InsGnssUpdate)
    outages: Outages | None = None
    filters: Names = ("robust", "robust+rts")
    every_sample: bool = False  # write positions and attitudes at every inertial sample as well

    def withheld(self, time_s: np.ndarray, fix_s: np.ndarray) -> np.ndarray:
        """Mask (N,) of the times in an outage, for a log with fixes at the times `fix_s` (M,)."""
        if self.outages is None:
            return np.zeros(len(time_s), dtype=bool)
        return self.outages.mask(time_s, fix_s[0], fix_s[-1])


class SimulatedReceiver(Gnss):
    """A simulated receiver; it states its true sigmas."""

    rate: Annotated[float, Quantity("frequency", above="0 Hz", most="1 kHz")] = default("1 Hz")
    sigma: Annotated[q.Three, Quantity("length", above="0 m")]
    velocity_sigma: Annotated[q.Three, Quantity("speed", above="0 m/s")]


class InsGnssAssumptions(Parameters):
    """Ratios of assumed to true values in the filters; 1 is right, anything else is a test."""

    q_factor: Positive = 1.0  # of the process noise covariance
    r_factor: Positive = 1.0  # of the fixes' covariance


class Drive(Scenario):
    """A simulated drive; sensor errors are drawn with the sigmas that the filters assume."""

    system: str = "ins-gnss"
    study: str = "drive"
    title: str = "INS/GNSS drive"
    imu_rate: q.Frequency = default("100 Hz")
    place: Departure
    legs: Annotated[tuple[Leg, ...], pydantic.Field(min_length=1)]
    imu: InsGnssImu
    gnss: SimulatedReceiver
    start: InsGnssStart = pydantic.Field(default_factory=InsGnssStart)
    aids: Aids = pydantic.Field(default_factory=lambda: Aids(zero_velocity=False))
    update: InsGnssUpdate = pydantic.Field(default_factory=InsGnssUpdate)
    outages: Outages | None = None
    believed: InsGnssAssumptions = pydantic.Field(default_factory=InsGnssAssumptions)
    # figures pooled over time omit the time before, when heading errors are large
    settle: q.Time = default("0 s")
    filters: Names = ("ekf",)

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> Drive:
        lasts = sum(leg.lasts_s for leg in self.legs)
        refuse_too_long("imu_rate", lasts, self.imu_rate)
        refuse_too_long("gnss.rate", lasts, self.gnss.rate)
        refuse_too_long("update.longest_block", lasts, 1.0 / self.update.longest_block)
        refuse_unsettled("settle", self.settle, lasts)
        return self
