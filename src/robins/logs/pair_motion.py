"""Common motion of a master INS and the IMU to be aligned to it, for the doctor.

The rotation and velocity change between records of the master are also measured by the IMU. On a
healthy vehicle their differences are small and linear, so they are fitted and removed: a bias of
each triad, a mounting error, the delay of the records, the lever arm. The residual is noise and
flexure, unless the records are not as labelled. All in NumPy, NED/FRD.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.dataset import ImuTable, Trajectory
from robins.ins.plausible import G
from robins.logs.motion import at, integral
from robins.logs.ordering import increasing
from robins.logs.quiet import signal_of
from robins.rotation import conjugate, multiply, normalise, skew, to_dcm, to_rotvec

_WINDOW_S = 0.5  # longest window, in which the body hardly turns
_LONGEST_S = 2.0
_HALF_S = 0.05  # half width of the mean of gyro rates
LAGS_S = np.arange(-10, 11) * 0.1


class SharedMotion(NamedTuple):
    """Records of the master about half a second apart, and the IMU's integrals; w windows."""

    time_s: np.ndarray  # (w + 1,) of the records, since the first sample
    inside: np.ndarray  # (w,) bool, short windows within the time of the samples
    q: np.ndarray  # (w + 1, 4) attitudes q_nb
    v_n: np.ndarray  # (w + 1, 3) m/s, NaN where missing
    sample_s: np.ndarray  # (n,)
    angle: np.ndarray  # (n, 3) rad, integral of the gyros
    pushed: np.ndarray  # (n, 3) m/s, integral of the accelerometers

    @property
    def length_s(self) -> np.ndarray:
        """Durations (k,) [s] of the windows inside."""
        return np.diff(self.time_s)[self.inside]


def shared_motion(imu: ImuTable, master: Trajectory) -> SharedMotion | None:
    """Records and integrals on the clock of the IMU; None with fewer than ten windows."""
    signal = signal_of(imu)
    known = np.flatnonzero(np.isfinite(master.q_nb).all(axis=1))
    known = known[increasing(master.time_ns[known])]
    if signal is None or len(known) < 2:
        return None
    time_s = (master.time_ns[known] - int(imu.time_ns[signal.rows[0]])) * 1e-9
    first = np.concatenate([[True], np.diff(np.floor(time_s / _WINDOW_S)) > 0])
    known, time_s = known[first], time_s[first]
    inside = (time_s[:-1] > 0.0) & (time_s[1:] < signal.time_s[-1])
    inside &= np.diff(time_s) < _LONGEST_S
    if np.count_nonzero(inside) < 10:
        return None
    q = normalise(master.q_nb[known])
    angle, pushed = (integral(signal.time_s, a, imu.kind) for a in (signal.gyro, signal.accel))
    return SharedMotion(time_s, inside, q, master.v_n[known], signal.time_s, angle, pushed)


def turned_by_gyros(shared: SharedMotion, lag_s: float = 0.0) -> np.ndarray:
    """Rotation (k, 3) [rad] of the IMU in each window, shifted earlier by `lag_s`."""
    return np.diff(at(shared.time_s - lag_s, shared.sample_s, shared.angle), axis=0)[shared.inside]


def turned(q: np.ndarray, shared: SharedMotion) -> np.ndarray:
    """Rotation (k, 3) [rad] of attitudes (w + 1, 4) at the records in each window."""
    return to_rotvec(multiply(conjugate(q[:-1]), q[1:]))[shared.inside]


class TurningFit(NamedTuple):
    """Fit of the rotation of attitudes to that of the gyros."""

    share: float  # unexplained share of the rotation
    late_s: float  # age of attitudes at their stamps
    sigma_s: float


def fit_turning(
    q: np.ndarray, shared: SharedMotion, gyro_map: np.ndarray | None = None
) -> TurningFit:
    """Fit bias, mounting error and delay by Gauss-Newton, from the best of coarse delays.

    Args:
        q: (w + 1, 4) attitudes at the records, in the convention to test.
        shared: the motion.
        gyro_map: (3, 3) applied to the gyros.
    """
    of_master = turned(q, shared)
    C = np.eye(3) if gyro_map is None else gyro_map

    def by_gyros(lag_s: float) -> np.ndarray:
        return turned_by_gyros(shared, lag_s) @ C.T

    coarse = [by_gyros(lag_s) - of_master for lag_s in LAGS_S]
    late_s = float(LAGS_S[np.argmin([np.sum((d - d.mean(axis=0)) ** 2) for d in coarse])])
    bias = shared.length_s[:, None, None] * np.eye(3)
    step_s = 0.02
    spread = np.sum((of_master - of_master.mean(axis=0)) ** 2)
    fit = TurningFit(np.inf, late_s, np.inf)
    for _ in range(4):
        early, here, late = (by_gyros(fit.late_s + k * step_s) for k in (-1, 0, 1))
        slope = (late - early) / (2.0 * step_s)
        design = np.concatenate([bias, skew(here), slope[:, :, None]], axis=-1).reshape(-1, 7)
        left, found, sigma = _least_squares((of_master - here).ravel(), design)
        late_s = np.clip(fit.late_s + np.clip(found[6], -0.1, 0.1), LAGS_S[0], LAGS_S[-1])
        fit = TurningFit(float(left @ left / spread), float(late_s), float(sigma[6]))
    return fit


def _pushes(v_n: np.ndarray, shared: SharedMotion) -> tuple[np.ndarray, ...] | None:
    """Windows with velocities at both ends; None if there are fewer than ten.

    Returns:
        at: (k,) their indices.
        length_s: (k,) s.
        C: (k, 3, 3) from body to navigation axes in their middle.
        gained: (k, 3) m/s along navigation axes, by the master.
        pushed: (k, 3) m/s along body axes, by the IMU.
    """
    gained = np.diff(v_n, axis=0)
    at_ = np.flatnonzero(shared.inside & np.isfinite(gained).all(axis=1))
    if len(at_) < 10:
        return None
    before, after = shared.q[:-1], shared.q[1:]
    far = np.sum(before * after, axis=-1, keepdims=True) < 0.0
    middle = normalise(before + np.where(far, -after, after))
    pushed = np.diff(at(shared.time_s, shared.sample_s, shared.pushed), axis=0)
    length_s = np.diff(shared.time_s)
    return at_, length_s[at_], to_dcm(middle)[at_], gained[at_], pushed[at_]


def forces_of(shared: SharedMotion) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean specific force (k, 3) along the body in each window: by the master, by the IMU."""
    p = _pushes(shared.v_n, shared)
    if p is None:
        return None
    _, length_s, C, gained, pushed = p
    f_n = gained / length_s[:, None] - [0.0, 0.0, G]
    return np.einsum("kji,kj->ki", C, f_n), pushed / length_s[:, None]


def fit_velocity(v_n: np.ndarray, shared: SharedMotion) -> np.ndarray | None:
    """Fit bias, mounting error and lever arm; residual squares (3,) along north, east, down.

    Args:
        v_n: (w + 1, 3) velocities at the records, in the convention to test.
        shared: the motion.

    Returns:
        Sums of squares [m^2/s^2]; None if fewer than ten windows have velocities.
    """
    p = _pushes(v_n, shared)
    if p is None:
        return None
    at_, length_s, C, gained, pushed = p
    along = length_s[:, None, None]
    missing = gained - np.einsum("kij,kj->ki", C, pushed) - along[:, 0] * [0, 0, G]
    early, late = (at(shared.time_s + k * _HALF_S, shared.sample_s, shared.angle) for k in (-1, 1))
    swing = np.diff(to_dcm(shared.q) @ skew((late - early) / (2.0 * _HALF_S)), axis=0)[at_]
    design = np.concatenate([C * along, np.eye(3) * along, C @ skew(pushed), swing], axis=-1)
    left, _, _ = _least_squares(missing.ravel(), design.reshape(-1, 12))
    return np.sum(left.reshape(-1, 3) ** 2, axis=0)


def _least_squares(y: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals, parameters and their standard deviations; unobservable parameters are zero."""
    scale = np.linalg.norm(A, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    A = A / scale
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-10, hermitian=True)
    found = inverse @ (A.T @ y)
    left = y - A @ found
    variance = left @ left / max(len(y) - A.shape[1], 1)
    return left, found / scale, np.sqrt(variance * np.diag(inverse)) / scale
