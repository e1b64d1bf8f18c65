"""Mounting of the IMU: sensor axes to forward-right-down, and lever arm of the antenna.

Also conversion of trajectories to local metres, east, north, up about an origin, and back, without
drift.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from robins import rotation
from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable, Trajectory
from robins.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.ins.frames import to_ned_frd
from robins.logs.findings import LogError

T = TypeVar("T")

# Exchanges east-north-up and north-east-down; its own inverse.
SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class LocalPath(NamedTuple):
    """Path in the axes east, north, up of one origin."""

    time_ns: np.ndarray  # (n,)
    r_l: np.ndarray  # (n, 3) m
    v_l: np.ndarray  # (n, 3) m/s
    q_lb: np.ndarray  # (n, 4) scalar first, body to local


class Origin(NamedTuple):
    """Origin of the local axes on the Earth."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    @classmethod
    def of(cls, trajectory: Trajectory) -> Origin:
        """The first point of a trajectory.

        Raises:
            LogError: it has no points.
        """
        if not len(trajectory):
            name = trajectory.source or "trajectory"
            raise LogError(name, "the trajectory has no points", "give an origin")
        lat, lon = (float(np.rad2deg(a[0])) for a in (trajectory.lat_rad, trajectory.lon_rad))
        return cls(lat, lon, float(trajectory.alt_m[0]))

    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        """C_el and the Earth-fixed position of the origin."""
        at = np.deg2rad(self.lat_deg), np.deg2rad(self.lon_deg), self.alt_m
        lat, lon, alt = map(np.asarray, at)
        return dcm_en(lat, lon) @ SWAP, ecef_from_geodetic(lat, lon, alt)


def to_local(trajectory: Trajectory, origin: Origin) -> LocalPath:
    """Trajectory in the axes of the origin, with the curvature of the Earth."""
    C_el, r0_e = origin._axes()
    r_e = ecef_from_geodetic(trajectory.lat_rad, trajectory.lon_rad, trajectory.alt_m)
    C_ln = C_el.T @ _axes_at(trajectory.lat_rad, trajectory.lon_rad, trajectory.nav)
    return LocalPath(
        trajectory.time_ns,
        (r_e - r0_e) @ C_el,
        np.einsum("nij,nj->ni", C_ln, trajectory.v_n),
        _compose(C_ln, trajectory.q_nb),
    )


def from_local(path: LocalPath, origin: Origin, source: str = "") -> Trajectory:
    """Trajectory in east, north, up at each of its places; body axes are unchanged."""
    C_el, r0_e = origin._axes()
    with np.errstate(invalid="ignore"):  # infinite coordinates become NaN, for `clean` to count
        r_e = r0_e + path.r_l @ C_el.T
    try:
        lat, lon, alt = geodetic_from_ecef(r_e)
    except ValueError as error:
        raise LogError(source or "path", str(error), "look at the unit of the path") from error
    C_nl = np.swapaxes(_axes_at(lat, lon, "ENU"), -1, -2) @ C_el
    with np.errstate(invalid="ignore"):
        v_n = np.einsum("nij,nj->ni", C_nl, path.v_l)
    q_nb = _compose(C_nl, path.q_lb)
    return Trajectory(path.time_ns, lat, lon, alt, v_n, q_nb, "ENU", source=source)


def _axes_at(lat_rad: np.ndarray, lon_rad: np.ndarray, nav: str) -> np.ndarray:
    """C_en (n, 3, 3) of the navigation axes at each place."""
    C_en = dcm_en(lat_rad, lon_rad)
    return C_en @ SWAP if nav == "ENU" else C_en


def _compose(C: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Quaternions of the product of matrices C and the rotations of q."""
    return rotation.multiply(rotation.from_dcm(C), np.asarray(q, float))


OnBoard = TypeVar("OnBoard", bound=ImuTable | MagTable | AttitudeTable)


@dataclass(frozen=True)
class Mounting:
    """Orientation of the sensor and lever arm of the GNSS antenna.

    The angles are roll, pitch, yaw (Z-Y-X) of the vehicle's forward-right-down axes relative to
    the sensor axes. GNSS_IMU calls them `imu_misalign`; for its walk they are 180, 0, -90 deg: a
    sensor whose x points left, y backward and z up.
    """

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    lever_arm_b_m: tuple[float, float, float] | None = None
    """From the IMU to the antenna, forward, right, down [m]; None: left to the user of the log."""

    def dcm_bs(self) -> np.ndarray:
        """(3, 3) C_bs: maps sensor axes to body axes; exact where the angles are right angles.

        Raises:
            ValueError: an angle is not finite.
        """
        C_bs = rotation.to_dcm(rotation.from_euler(*self._angles())).T
        # Rotations by right angles only permute axes, so rounding of 1e-16 must not mix them.
        whole = np.round(C_bs)
        return np.where(np.abs(C_bs - whole) < 1e-15, whole, C_bs) + 0.0

    def _angles(self) -> np.ndarray:
        angles = np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])
        if not np.all(np.isfinite(angles)):
            raise ValueError(f"the angles of {self} must be finite")
        return angles

    def turn(self, table: OnBoard) -> OnBoard:
        """Rotate samples, field or attitude to body axes, forward-right-down.

        An attitude sensor to navigation becomes body to navigation: q_nb = q_ns q_sb. Data in
        right-forward-up are first converted to forward-right-down.
        """
        if table.body != "FRD":
            table = _relabelled(table)
        if isinstance(table, AttitudeTable):
            if not any((self.roll_deg, self.pitch_deg, self.yaw_deg)):
                return dataclasses.replace(table, body="FRD")
            q_sb = rotation.from_euler(*self._angles())
            q_nb = rotation.multiply(table.q_nb, q_sb)
            return dataclasses.replace(table, q_nb=q_nb, body="FRD")
        C_bs = self.dcm_bs()
        if isinstance(table, MagTable):
            return dataclasses.replace(table, field_t=_turned(C_bs, table.field_t), body="FRD")
        gyro, accel = (_turned(C_bs, v) for v in (table.gyro, table.accel))
        return dataclasses.replace(table, gyro=gyro, accel=accel, body="FRD")


def turned(opened: T, mounting: Mounting | None) -> T:
    """Table or dataset with all data in sensor axes rotated to body axes.

    Fixes and paths are unchanged, and so is everything without a mounting. A dataset gets the lever
    arm.

    Raises:
        LogError: a dataset without GNSS is given a lever arm, or one that is not finite.
    """
    if mounting is None:
        return opened
    if isinstance(opened, Dataset):
        on_board = {k: turned(getattr(opened, k), mounting) for k in ("imu", "mag", "attitude")}
        extra = {"lever_arm_b_m": _lever_arm(opened, mounting), "mounted": True}
        return dataclasses.replace(opened, **on_board, **extra)
    if isinstance(opened, ImuTable | MagTable | AttitudeTable):
        return mounting.turn(opened)
    return opened


def _lever_arm(dataset: Dataset, mounting: Mounting) -> tuple[float, float, float] | None:
    arm = mounting.lever_arm_b_m
    if arm is None:
        return dataset.lever_arm_b_m
    if dataset.gnss is None:
        cause = "has no GNSS fixes, but is given a lever arm to their antenna"
        remedy = "give the log of the receiver too, or omit the lever arm"
        raise LogError(dataset.name, cause, remedy)
    if not np.all(np.isfinite(arm)):
        raise LogError(dataset.name, f"is given a lever arm of {arm} m", "give finite numbers")
    return arm


def _relabelled(table: OnBoard) -> OnBoard:
    """Table in forward-right-down; the navigation axes of an attitude are unchanged."""
    if isinstance(table, AttitudeTable) and table.nav == "ENU":
        return dataclasses.replace(to_ned_frd(dataclasses.replace(table, nav="NED")), nav="ENU")
    return to_ned_frd(table)


def _turned(C_bs: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """C_bs @ v by rows. Zero entries are skipped, so NaN on one axis does not spread to another."""
    out = np.zeros_like(vectors)
    for i, j in zip(*np.nonzero(C_bs), strict=True):
        out[:, i] += C_bs[i, j] * vectors[:, j]
    return out
