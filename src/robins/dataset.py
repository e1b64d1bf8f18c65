"""Input of a run: tables of samples, fixes or a master INS, and any known truth.  Readers of real
logs and simulators both produce a `Dataset`; nothing downstream depends on which. The tables are
NumPy, float64, time in integer nanoseconds, SI and radians, and each states its frames. They are
plain records: the *doctor* (`robins.logs.doctor`) judges them, the systems use them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

NavFrame = Literal["NED", "ENU"]
BodyFrame = Literal["FRD", "RFU"]
Severity = Literal["error", "warning", "note"]


class _Rows:
    time_ns: np.ndarray

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True)
class ImuTable(_Rows):
    """Inertial samples.

    kind "increment": row k is the integral over (time[k-1], time[k]], or, where samples before it
    are missing, over its own sampling interval up to time[k]; gyro [rad], accel [m/s].
    kind "rate": row k is the value at time[k]; gyro [rad/s], accel (specific force) [m/s^2].
    """

    time_ns: np.ndarray  # (N,) int64
    gyro: np.ndarray  # (N, 3) body axes
    accel: np.ndarray  # (N, 3) body axes
    kind: Literal["rate", "increment"]
    body: BodyFrame = "FRD"
    source: str = ""  # file or scenario the rows came from
    rows: np.ndarray | None = None  # (N,) line number of each row in its source, for messages


@dataclass(frozen=True)
class GnssTable(_Rows):
    """Position and velocity fixes of a GNSS antenna; NaN where a component is missing.

    Velocities and sigmas are given along ``nav``; for ENU the components are east, north, up.
    ``assumed_m`` and ``assumed_v`` mark sigmas that the log does not state; without, it states all.
    """

    time_ns: np.ndarray  # (M,) int64
    lat_rad: np.ndarray  # (M,)
    lon_rad: np.ndarray  # (M,)
    alt_m: np.ndarray  # (M,) above the WGS-84 ellipsoid
    sigma_m: np.ndarray  # (M, 3) one-sigma position along nav axes
    v_n: np.ndarray | None = None  # (M, 3) m/s
    sigma_v: np.ndarray | None = None  # (M, 3) m/s
    quality: np.ndarray | None = None  # (M,) int; RTKLIB: 1 fix, 2 float, 5 single
    nav: NavFrame = "NED"
    source: str = ""
    rows: np.ndarray | None = None
    assumed_m: np.ndarray | None = None  # (M, 3) bool
    assumed_v: np.ndarray | None = None  # (M, 3) bool


@dataclass(frozen=True)
class Trajectory(_Rows):
    """A path: position, velocity and attitude over time (the truth, or what a system reported).

    As the report of a master INS it may have NaN where a component is missing, and turn rates.
    """

    time_ns: np.ndarray  # (K,) int64
    lat_rad: np.ndarray
    lon_rad: np.ndarray
    alt_m: np.ndarray
    v_n: np.ndarray  # (K, 3) m/s
    q_nb: np.ndarray  # (K, 4) scalar first, body to nav
    nav: NavFrame = "NED"
    body: BodyFrame = "FRD"
    source: str = ""
    omega_ib_b: np.ndarray | None = None  # (K, 3) rad/s turn rate against inertial space, body axes
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class MagTable(_Rows):
    """Magnetic field as a three-axis magnetometer reads it; NaN where a component is missing."""

    time_ns: np.ndarray  # (N,) int64
    field_t: np.ndarray  # (N, 3) tesla, body axes, as recorded: hard and soft iron are in it
    body: BodyFrame = "FRD"
    source: str = ""
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class AttitudeTable(_Rows):
    """Attitude over time, without a place on Earth, as motion capture gives it."""

    time_ns: np.ndarray  # (K,) int64
    q_nb: np.ndarray  # (K, 4) scalar first, body to nav; NaN rows where there was no fix
    nav: NavFrame = "NED"
    body: BodyFrame = "FRD"
    moving: np.ndarray | None = None  # (K,) bool, phases that count where an author marked them
    source: str = ""
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class Finding:
    """One remark on a log.

    An *error* means a run on these data would be wrong or meaningless, a *warning* that it will be
    worse than it could be or that samples were refused, a *note* is information.
    """

    severity: Severity
    code: str  # for programs: "gravity_unit", "time_gap", ...
    file: str
    where: str  # "line 12", "lines 12-40", "time 3.250 s", "" for the whole file
    value: float | int | str
    sentence: str  # for people; complete without the other fields

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


@dataclass(frozen=True)
class Dataset:
    """Everything a run starts from."""

    name: str
    imu: ImuTable
    gnss: GnssTable | None = None
    truth: Trajectory | None = None
    master: Trajectory | None = None  # INS of the vehicle, to align the IMU to
    mag: MagTable | None = None
    attitude: AttitudeTable | None = None  # true attitude, where nothing else is known
    odometry: OdometryTable | None = None  # speed of the wheels
    counts: dict[str, int] = field(default_factory=dict)  # refused samples by reason
    findings: list[Finding] = field(default_factory=list)  # of the readers: what they left out
    time_unit_known: tuple[str, ...] = ()  # files that state the unit of their stamps
    imu_gaps: list[tuple[int, int]] = field(default_factory=list)  # (start_ns, end_ns), by `clean`
    master_delay_s: float = 0.0  # latency of the master: age of its records at their stamps
    # from the IMU to the GNSS antenna, forward, right, down; None where it is not given
    lever_arm_b_m: tuple[float, float, float] | None = None
    mounted: bool = False  # the sensor's axes were turned to the vehicle's when it was loaded


@dataclass(frozen=True)
class RangeTable(_Rows):
    """Pseudoranges of a GNSS receiver, one per row; rows of one epoch are adjacent.

    Corrected for the atmosphere and the satellite clocks. A satellite's position is that at the
    time of transmission, Earth-fixed at that time, so the model must apply the Sagnac correction.
    """

    time_ns: np.ndarray  # (N,) int64, never decreasing
    range_m: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,)
    satellite_e: np.ndarray  # (N, 3) m
    satellite: np.ndarray  # (N,) int, one number for each satellite of any system
    system: np.ndarray  # (N,) int
    elevation_rad: np.ndarray  # (N,)
    cn0_dbhz: np.ndarray  # (N,)
    source: str = ""
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class OdometryTable(_Rows):
    """Speed of the wheels and rate of a yaw gyro."""

    time_ns: np.ndarray  # (M,) int64
    speed_mps: np.ndarray  # (M,) forward
    yaw_rate: np.ndarray  # (M,) rad/s, positive to the right; NaN where there is none
    sigma_speed: np.ndarray  # (M,) m/s noise of a row
    sigma_yaw: np.ndarray  # (M,) rad/s
    source: str = ""
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class PlaceTable(_Rows):
    """True positions, Earth-fixed."""

    time_ns: np.ndarray  # (K,) int64
    r_e: np.ndarray  # (K, 3) m
    source: str = ""
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class RangeLog:
    """Input of a run on pseudoranges and odometry."""

    name: str
    ranges: RangeTable
    odometry: OdometryTable
    truth: PlaceTable | None = None
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
