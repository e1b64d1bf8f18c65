"""Parameters of INS/GNSS, of a replayed log and of a simulated drive, with units."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import pydantic

from robins.scenario import Parameters, Positive, Quantity, default
from robins.systems.parts import (
    Departure,
    Duration,
    Leg,
    Names,
    Speed,
    Spread,
    Three,
    refuse_too_long,
    refuse_unsettled,
)
from robins.systems.study import Scenario


class Imu(Parameters):
    """The inertial sensors as the filter models them, and how they are mounted.

    The biases are random walks that begin with the stated spread, or first-order Gauss-Markov
    where a correlation time is given.
    """

    gyro_noise: Annotated[Three, Quantity("angle random walk", above="0 deg/sqrt(h)")]
    accel_noise: Annotated[Three, Quantity("velocity random walk", above="0 m/s/sqrt(h)")]
    gyro_bias: Annotated[Three, Quantity("angle rate", least="0 deg/h")]
    accel_bias: Annotated[Three, Quantity("acceleration", least="0 mg")]
    gyro_bias_walk: Annotated[Three, Quantity("rate random walk", least="0 deg/h/sqrt(h)")]
    accel_bias_walk: Annotated[Three, Quantity("acceleration random walk", least="0 mg/sqrt(h)")]
    gyro_bias_time: Duration | None = None
    accel_bias_time: Duration | None = None
    scale_states: bool = False
    gyro_scale: Annotated[Three, Quantity("scale factor", least="0 ppm")] = default("1000 ppm")
    accel_scale: Annotated[Three, Quantity("scale factor", least="0 ppm")] = default("1000 ppm")
    orientation: Annotated[Three, Quantity("angle")] = default("0 deg")  # roll, pitch, yaw of mount


class Gnss(Parameters):
    """The receiver, its antenna and how far its stated sigmas are believed."""

    # IMU to antenna, body
    lever_arm: Annotated[Three, Quantity("length", least="-1 km", most="1 km")] = default("0 m")
    latency: Annotated[float, Quantity("time", least="-10 s", most="10 s")] = default("0 s")
    use_velocity: bool = True
    # many receivers state the mean velocity since the last fix; 0 s: the velocity at the fix; not
    # given: `robust` finds out, the others take it for 0
    velocity_window: Annotated[float, Quantity("time", least="0 s")] | None = None
    # by RTKLIB quality: 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP
    sigma_factor: dict[str, Positive] = pydantic.Field(default_factory=dict)
    least_sigma: Annotated[float, Quantity("length", least="0 m")] = default("0 m")
    least_velocity_sigma: Annotated[float, Quantity("speed", least="0 m/s")] = default("0 m/s")


class Start(Parameters):
    """How well the start is known, and how the heading is found."""

    tilt: Spread = default("2 deg")
    heading: Spread = default("20 deg")
    velocity: Speed = default("0.2 m/s")
    position: Annotated[float, Quantity("length", above="0 m")] = default("0.1 m")
    # heading of the body at the start; without it, the course once above the speed
    known_heading: Annotated[float, Quantity("angle")] | None = None
    course_speed: Speed = default("1 m/s")


class Aids(Parameters):
    """Knowledge about the motion, used as measurements."""

    zero_velocity: bool = True
    standstill_velocity: Speed = default("0.01 m/s")
    standstill_rate: Annotated[float, Quantity("angle rate", above="0 deg/s")] = default(
        "0.05 deg/s"
    )
    # at rest: spread of the samples over the window stays below these
    window: Duration = default("0.5 s")
    quiet_accel: Annotated[float, Quantity("acceleration", above="0 m/s^2")] = default("0.15 m/s^2")
    quiet_rate: Annotated[float, Quantity("angle rate", above="0 deg/s")] = default("0.5 deg/s")
    # a fix that is faster, and by four of its sigmas faster than nothing, says that it moves
    moving_speed: Speed = default("0.2 m/s")
    non_holonomic: bool = False
    # IMU to rear axle, body
    axle: Annotated[Three, Quantity("length", least="-1 km", most="1 km")] = default("0 m")
    road_velocity: Annotated[tuple[float, float], Quantity("speed", above="0 m/s")] = default(
        "0.1 m/s"
    )

    @property
    def quiet(self) -> tuple[float, float, float]:
        """Window [s], rate [rad/s] and force [m/s^2] of `robins.ins.rest.standstill`."""
        return self.window, self.quiet_rate, self.quiet_accel


class Outages(Parameters):
    """Times at which the GNSS is withheld, to see how long the inertial solution holds."""

    length: Duration
    first: Annotated[float, Quantity("time", least="0 s")]  # after the first fix
    gap: Duration  # between two outages
    last: Annotated[float, Quantity("time", least="0 s")]  # before the last fix none begins

    def mask(self, time_s: np.ndarray, first_s: float, last_s: float) -> np.ndarray:
        """Which times lie in an outage (N,) bool; outages repeat until none may begin any more.

        Args:
            time_s: (N,) times to judge.
            first_s: time of the first fix.
            last_s: time of the last fix.
        """
        period = self.length + self.gap
        since = time_s - (first_s + self.first)
        begin = np.floor(since / period) * period
        inside = (since >= 0.0) & (since - begin < self.length)
        return inside & (first_s + self.first + begin < last_s - self.last)


class Update(Parameters):
    """How the filter steps."""

    longest_block: Duration = default("0.25 s")
    # of the other filters than `robust`; 0: no gate
    gate: Annotated[float, pydantic.Field(ge=0.0, lt=1.0)] = 0.9999
    # `robust` follows positions that stay away for longer than this
    patience: Duration = default("10 s")
    # an IMU gap longer than this is declared instead of bridged
    longest_gap: Duration = default("1 s")
    # process noise factor across one
    gap_noise: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 30.0


class Unit(Imu):
    """A unit of which nothing is told: a consumer-grade MEMS."""

    gyro_noise: Annotated[Three, Quantity("angle random walk", above="0 deg/sqrt(h)")] = default(
        "0.01 deg/s/sqrt(Hz)"
    )
    accel_noise: Annotated[Three, Quantity("velocity random walk", above="0 m/s/sqrt(h)")] = (
        default("200 ug/sqrt(Hz)")
    )
    gyro_bias: Annotated[Three, Quantity("angle rate", least="0 deg/h")] = default("0.5 deg/s")
    accel_bias: Annotated[Three, Quantity("acceleration", least="0 mg")] = default("20 mg")
    gyro_bias_walk: Annotated[Three, Quantity("rate random walk", least="0 deg/h/sqrt(h)")] = (
        default("0.002 deg/s/sqrt(s)")
    )
    accel_bias_walk: Annotated[
        Three, Quantity("acceleration random walk", least="0 mg/sqrt(h)")
    ] = default("20 ug/sqrt(s)")


class Rover(Gnss):
    """A receiver of which nothing is told."""

    sigma_factor: dict[str, Positive] = pydantic.Field(default_factory=lambda: {"2": 3.0, "5": 3.0})


class FirstLook(Start):
    """A start of which nothing is told."""

    tilt: Spread = default("3 deg")


class Replay(Parameters):
    """A recorded log: what cannot be read from the files themselves; each part may be left out."""

    system: Literal["ins-gnss"] = "ins-gnss"
    title: str = "INS/GNSS replay, consumer MEMS"
    imu: Unit = pydantic.Field(default_factory=Unit)
    gnss: Rover = pydantic.Field(default_factory=Rover)
    start: FirstLook = pydantic.Field(default_factory=FirstLook)
    aids: Aids = pydantic.Field(default_factory=Aids)
    update: Update = pydantic.Field(default_factory=Update)
    outages: Outages | None = None
    filters: Names = ("robust", "robust+rts")

    def withheld(self, time_s: np.ndarray, fix_s: np.ndarray) -> np.ndarray:
        """Which times (N,) lie in an outage, of a log with fixes at some times (M,)."""
        if self.outages is None:
            return np.zeros(len(time_s), dtype=bool)
        return self.outages.mask(time_s, fix_s[0], fix_s[-1])


class Receiver(Gnss):
    """A simulated receiver; its sigmas are true, and what it states."""

    rate: Annotated[float, Quantity("frequency", above="0 Hz", most="1 kHz")] = default("1 Hz")
    sigma: Annotated[Three, Quantity("length", above="0 m")]
    velocity_sigma: Annotated[Three, Quantity("speed", above="0 m/s")]


class Believed(Parameters):
    """What the filters believe, over what is true; 1 is right, and anything else a test."""

    q_factor: Positive = 1.0  # of the process noise covariance
    r_factor: Positive = 1.0  # of the fixes' covariance


class Drive(Scenario):
    """A simulated drive; sensor errors are drawn from what the filter is told of them."""

    system: str = "ins-gnss"
    study: str = "drive"
    title: str = "INS/GNSS drive"
    imu_rate: Annotated[float, Quantity("frequency", above="0 Hz", most="100 kHz")] = default(
        "100 Hz"
    )
    place: Departure
    legs: Annotated[tuple[Leg, ...], pydantic.Field(min_length=1)]
    imu: Imu
    gnss: Receiver
    start: Start = pydantic.Field(default_factory=Start)
    aids: Aids = pydantic.Field(default_factory=lambda: Aids(zero_velocity=False))
    update: Update = pydantic.Field(default_factory=Update)
    outages: Outages | None = None
    believed: Believed = pydantic.Field(default_factory=Believed)
    # figures pooled over time leave out what comes before, while heading errors are large
    settle: Annotated[float, Quantity("time", least="0 s")] = default("0 s")
    filters: Names = ("ekf",)

    @pydantic.model_validator(mode="after")
    def _fits(self) -> Drive:
        lasts = sum(leg.lasts_s for leg in self.legs)
        refuse_too_long("imu_rate", lasts, self.imu_rate)
        refuse_too_long("gnss.rate", lasts, self.gnss.rate)
        refuse_too_long("update.longest_block", lasts, 1.0 / self.update.longest_block)
        refuse_unsettled("settle", self.settle, lasts)
        return self
