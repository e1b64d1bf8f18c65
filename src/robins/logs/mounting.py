"""How the IMU sits in the vehicle: sensor axes into forward-right-down, and the antenna's place."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable
from robins.ins.frames import to_ned_frd
from robins.logs.findings import LogError

OnBoard = TypeVar("OnBoard", bound=ImuTable | MagTable | AttitudeTable)


@dataclass(frozen=True)
class Mounting:
    """Orientation of the sensor and lever arm of the GNSS antenna.

    The angles are roll, pitch, yaw (Z-Y-X) of the vehicle's forward-right-down axes as seen from
    the sensor's axes. GNSS_IMU calls them `imu_misalign`; for its walk they are 180, 0, -90 deg: a
    sensor whose x points left, y backward and z up.
    """

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    lever_arm_b_m: tuple[float, float, float] | None = None
    """From the IMU to the antenna, forward, right, down; None leaves it to who uses the log."""

    def dcm_bs(self) -> np.ndarray:
        """(3, 3) C_bs: maps sensor axes to body axes; exact where the angles are right angles.

        Raises:
            ValueError: an angle is not finite.
        """
        C_bs = np.asarray(rotation.to_dcm(rotation.from_euler(*self._angles()))).T
        # Turns by right angles only exchange axes, so a rounding of 1e-16 must not mix them.
        whole = np.round(C_bs)
        return np.where(np.abs(C_bs - whole) < 1e-15, whole, C_bs) + 0.0

    def _angles(self) -> np.ndarray:
        angles = np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])
        if not np.all(np.isfinite(angles)):
            raise ValueError(f"the angles of {self} must be finite")
        return angles

    def turn(self, table: OnBoard) -> OnBoard:
        """The same samples, field or attitude along body axes, forward-right-down.

        An attitude sensor to navigation becomes body to navigation: q_nb = q_ns q_sb. What lies
        along right-forward-up is first named forward-right-down.
        """
        if table.body != "FRD":
            table = _relabelled(table)
        if isinstance(table, AttitudeTable):
            if not any((self.roll_deg, self.pitch_deg, self.yaw_deg)):
                return dataclasses.replace(table, body="FRD")
            q_sb = rotation.from_euler(*self._angles())
            q_nb = np.asarray(rotation.multiply(jnp.asarray(table.q_nb), q_sb))
            return dataclasses.replace(table, q_nb=q_nb, body="FRD")
        C_bs = self.dcm_bs()
        if isinstance(table, MagTable):
            return dataclasses.replace(table, field_t=_turned(C_bs, table.field_t), body="FRD")
        gyro, accel = (_turned(C_bs, v) for v in (table.gyro, table.accel))
        return dataclasses.replace(table, gyro=gyro, accel=accel, body="FRD")


def turned(opened: Any, mounting: Mounting | None) -> Any:
    """A table or dataset with all that lies along sensor axes turned to the body's.

    Fixes and paths stay as they are, and so does everything where there is no mounting. A dataset
    takes the lever arm along.

    Raises:
        LogError: a dataset without GNSS is given a lever arm, or one that is not finite.
    """
    if mounting is None:
        return opened
    if isinstance(opened, Dataset):
        on_board = {k: turned(getattr(opened, k), mounting) for k in ("imu", "mag", "attitude")}
        return dataclasses.replace(opened, **on_board, lever_arm_b_m=_lever_arm(opened, mounting))
    if isinstance(opened, ImuTable | MagTable | AttitudeTable):
        return mounting.turn(opened)
    return opened


def _lever_arm(dataset: Dataset, mounting: Mounting) -> tuple[float, float, float] | None:
    arm = mounting.lever_arm_b_m
    if arm is None:
        return dataset.lever_arm_b_m
    if dataset.gnss is None:
        cause = "has no GNSS fixes, but is given a lever arm to their antenna"
        mend = "give the log of the receiver too, or omit the lever arm"
        raise LogError(dataset.name, cause, mend)
    if not np.all(np.isfinite(arm)):
        raise LogError(dataset.name, f"is given a lever arm of {arm} m", "give finite numbers")
    return arm


def _relabelled(table: OnBoard) -> OnBoard:
    """In forward-right-down, the navigation axes of an attitude as they are."""
    if isinstance(table, AttitudeTable) and table.nav == "ENU":
        return dataclasses.replace(to_ned_frd(dataclasses.replace(table, nav="NED")), nav="ENU")
    return to_ned_frd(table)


def _turned(C_bs: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """C_bs @ v by rows. A zero entry takes no part, so NaN on one axis does not reach another."""
    out = np.zeros_like(vectors)
    for i, j in zip(*np.nonzero(C_bs), strict=True):
        out[:, i] += C_bs[i, j] * vectors[:, j]
    return out
