"""Recorded log on one clock, in the vehicle's axes, with the sigmas that a filter assumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robins import rotation
from robins.dataset import Dataset, GnssTable
from robins.ins.frames import to_ned_frd, turned
from robins.ins.increments import Increments, from_imu, own_intervals
from robins.systems.ins_gnss.parameters import InsGnssReplay, UnknownReceiver

TYRES = 0.02  # relative sigma of the wheel speed due to tyres, pressure, slip


class WheelSpeed(NamedTuple):
    """Forward speed measured by the wheels."""

    time_s: np.ndarray  # (W,)
    speed: np.ndarray  # (W,) m/s
    sigma: np.ndarray  # (W,) m/s, including `TYRES`


class Log(NamedTuple):
    """A log or a piece of it, NED/FRD, with times [s] since the first IMU sample."""

    increments: Increments  # dt (N,), theta (N, 3), dv (N, 3)
    time_s: np.ndarray  # (N,) end of each increment
    gnss: GnssTable  # M fixes, of the whole log
    gnss_s: np.ndarray  # (M,)
    sigma_m: np.ndarray  # (M, 3) assumed by the filter
    v_n: np.ndarray | None  # (M, 3) m/s, None if velocities are not used
    sigma_v: np.ndarray | None
    withheld: np.ndarray  # (M,) bool
    field_s: np.ndarray | None = None  # (K,) times of a magnetometer, if there is one
    field_b: np.ndarray | None = None  # (K, 3) T, body axes
    wheels: WheelSpeed | None = None
    first: int = 0  # number of increments of the record before these


def as_rates(dataset: Dataset) -> Dataset:
    """Log with rates instead of increments, forward-right-down and north-east-down."""
    imu = to_ned_frd(dataset.imu)
    if imu.kind == "increment":
        dt = own_intervals(np.diff(imu.time_ns) * 1e-9, imu.gyro, imu.accel)[:, None]
        imu = replace(imu, gyro=imu.gyro / dt, accel=imu.accel / dt, kind="rate")
    gnss = None if dataset.gnss is None else to_ned_frd(dataset.gnss)
    return replace(dataset, imu=imu, gnss=gnss)


def in_body_axes(dataset: Dataset, orientation: Sequence[float]) -> Dataset:
    """Log with samples rotated into the vehicle's axes; unchanged if loaded with a mounting.

    Args:
        dataset: a log.
        orientation: roll, pitch, yaw [rad] of forward-right-down relative to the sensor axes.
    """
    if dataset.mounted or not any(orientation):
        return dataset
    C_bs = axes_of(orientation)
    imu = to_ned_frd(dataset.imu)
    imu = replace(imu, gyro=turned(C_bs, imu.gyro), accel=turned(C_bs, imu.accel))
    mag = dataset.mag
    if mag is not None:
        mag = to_ned_frd(mag)
        mag = replace(mag, field_t=turned(C_bs, mag.field_t))
    return replace(dataset, imu=imu, mag=mag, mounted=True)


def axes_of(orientation: Sequence[float]) -> np.ndarray:
    """Matrix (3, 3) from sensor axes to forward-right-down; orientation as in `in_body_axes`."""
    C_bs = np.asarray(rotation.to_dcm(rotation.from_euler(*np.asarray(orientation)))).T
    whole = np.round(C_bs)  # rotations by right angles are exact
    return np.where(np.abs(C_bs - whole) < 1e-15, whole, C_bs) + 0.0


def believed_sigmas(
    gnss: GnssTable, parameters: UnknownReceiver
) -> tuple[np.ndarray, np.ndarray | None]:
    """Sigmas (M, 3) [m] and (M, 3) [m/s] that the filter assumes; None for unused velocities.

    Args:
        gnss: with sigmas; factors by quality apply only to those that the receiver states, not to
            those marked as assumed, which already depend on the kind of fix.
        parameters: of the receiver; sigmas given here replace those of the log, and factors by
            quality apply to them.
    """
    g, factor = parameters, np.ones(len(gnss))
    if gnss.quality is not None:
        for quality, value in g.sigma_factor.items():
            factor[gnss.quality == int(quality)] = value

    def of(
        sigma: np.ndarray, assumed: np.ndarray | None, own: tuple[float, ...] | None, least: float
    ) -> np.ndarray:
        if own is not None:
            sigma, assumed = np.tile(own, (len(sigma), 1)), None
        stated = True if assumed is None else ~assumed
        return np.maximum(np.where(stated, sigma * factor[:, None], sigma), least)

    sigma_v = gnss.sigma_v if g.use_velocity else None
    if sigma_v is not None:
        sigma_v = of(sigma_v, gnss.assumed_v, g.velocity_sigma, g.least_velocity_sigma)
    return of(gnss.sigma_m, gnss.assumed_m, g.sigma, g.least_sigma), sigma_v


def on_one_clock(dataset: Dataset, parameters: InsGnssReplay) -> Log:
    """Tables of a log on the IMU's clock, with the sigmas that the filter assumes.

    Raises:
        ValueError: there is no GNSS, or no fix lies within the IMU's time.
    """
    if dataset.gnss is None or len(dataset.gnss) == 0:
        raise ValueError(
            "a replay of INS/GNSS needs GNSS fixes; this log has none: give their file too, or "
            "--system marg for the attitude alone"
        )
    gnss, g = to_ned_frd(dataset.gnss), parameters.gnss
    increments, end_ns = from_imu(dataset.imu)
    origin = int(dataset.imu.time_ns[0])
    time_s, gnss_s = (end_ns - origin) * 1e-9, (gnss.time_ns - origin) * 1e-9
    if not np.any((gnss_s > 0.0) & (gnss_s <= time_s[-1])):
        raise ValueError(
            f"no GNSS fix lies within the IMU log: the IMU spans 0 to {time_s[-1]:.1f} s, the "
            f"fixes {gnss_s[0]:.1f} to {gnss_s[-1]:.1f} s; do both use the same time scale?"
        )
    sigma_m, sigma_v = believed_sigmas(gnss, g)
    return Log(
        Increments(*(np.asarray(a, dtype=float) for a in increments[:3])),
        time_s,
        gnss,
        gnss_s,
        sigma_m,
        gnss.v_n if sigma_v is not None else None,
        sigma_v,
        parameters.withheld(gnss_s, gnss_s),
        *_field(dataset, origin),
        _wheels(dataset, origin),
    )


def _wheels(dataset: Dataset, origin_ns: int) -> WheelSpeed | None:
    """Complete rows of the odometry, ordered by time; None without odometry."""
    rows = dataset.odometry
    if rows is None:
        return None
    order = np.argsort(rows.time_ns, kind="stable")
    order = order[np.isfinite(rows.speed_mps[order]) & (rows.sigma_speed[order] > 0.0)]
    speed = rows.speed_mps[order]
    sigma = np.hypot(rows.sigma_speed[order], TYRES * speed)
    return WheelSpeed((rows.time_ns[order] - origin_ns) * 1e-9, speed, sigma)


def _field(dataset: Dataset, origin_ns: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Times (K,) [s] and complete readings (K, 3) [T] of the magnetometer; None without one."""
    if dataset.mag is None:
        return None, None
    mag = to_ned_frd(dataset.mag)
    whole = np.all(np.isfinite(mag.field_t), axis=1)
    return (mag.time_ns[whole] - origin_ns) * 1e-9, mag.field_t[whole]


def with_lever_arm(
    parameters: InsGnssReplay, arm: tuple[float, float, float] | None
) -> InsGnssReplay:
    """Parameters with the lever arm that the log was loaded with, if any.

    Raises:
        ValueError: the parameters have a different one.
    """
    other = parameters.gnss.lever_arm
    if arm is None:
        return parameters
    if any(other) and not np.allclose(arm, other, rtol=0.0, atol=1e-6):
        raise ValueError(
            f"the log was loaded with a lever arm of {arm} m, and gnss.lever_arm is {other} m; "
            "give one of the two"
        )
    gnss = parameters.gnss.model_copy(update={"lever_arm": arm})
    return parameters.model_copy(update={"gnss": gnss})
