"""The doctor on a master INS and the IMU to be aligned to it, as views of one motion.

Both sit on one vehicle, so they turn together, whatever flexes between them. The IMU must be given
along the master's axes, as nearly as its mounting is known.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from robins.dataset import GnssTable, ImuTable, Trajectory
from robins.ins.frames import to_ned_frd
from robins.logs.checks_imu import UNITS, G
from robins.logs.checks_motion import SCALES, words_of
from robins.logs.checks_velocity import check_velocity
from robins.logs.findings import Finding
from robins.logs.motion import signed_permutations
from robins.logs.ordering import increasing
from robins.logs.quiet import Signal, finding, name_of, signal_of

_WINDOW_S = 0.5  # at most of which a change of attitude is compared with the gyros
_LONGEST_S = 2.0
_LEAST_RATE = np.deg2rad(0.5)  # rad/s RMS; below it noise of the attitudes is all there is
_WELL, _BETTER = 0.3, 0.1  # shares of the turning left unexplained
_WRONG, _RIGHT = 0.1, 0.03  # shares of the specific force left unexplained
# What an IMU alone is judged by, at rest or nearly so; a master tells more, in any motion.
BY_REST = frozenset(
    (
        *("gravity_unit", "gravity_unknown", "gravity_bias", "gravity_not_seen"),
        *("gravity_missing", "z_axis_reversed", "not_level"),
        *("rates_as_increments", "increments_as_rates"),
    )
)
_LAGS_S = np.arange(-50, 51) * 0.02
_LATE_S = 0.03


def check_master(imu: ImuTable, master: Trajectory) -> Iterator[Finding]:
    """Findings about what is missing, velocities against positions, and the IMU against both."""
    if not len(master):
        return
    imu, master = to_ned_frd(imu), to_ned_frd(master)
    yield from _missing(master)
    yield from check_velocity(_as_fixes(master))
    yield from _turning(imu, master)
    yield from _force(imu, master)


def _as_fixes(master: Trajectory) -> GnssTable:
    rough = np.ones((len(master), 3))
    return GnssTable(
        time_ns=master.time_ns,
        lat_rad=master.lat_rad,
        lon_rad=master.lon_rad,
        alt_m=master.alt_m,
        sigma_m=rough,
        v_n=master.v_n,
        sigma_v=rough,
        source=master.source,
        rows=master.rows,
    )


def _missing(master: Trajectory) -> Iterator[Finding]:
    position = np.stack([master.lat_rad, master.lon_rad, master.alt_m], -1)
    for name, values in (
        ("position", position),
        ("velocity", master.v_n),
        ("attitude", master.q_nb),
    ):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            k = int(np.argmax(bad))
            yield finding(
                master,
                "error" if bad.all() else "warning",
                "master_missing",
                int(bad.sum()),
                f"the {name} is not whole here, nor in {bad.sum()} of {len(master)} records. The "
                "rest of those records is used.",
                k,
            )


def _turning(imu: ImuTable, master: Trajectory) -> Iterator[Finding]:
    turns = _turns(imu, master)
    if turns is None:
        yield finding(
            imu,
            "note",
            "turning_not_checked",
            0,
            f"gyro unit, axes and time offset could not be checked against {name_of(master)}: the "
            "vehicle hardly turns while both were recorded.",
        )
        return
    of_master, of_gyros = turns
    at = int(np.flatnonzero(_LAGS_S == 0.0)[0])
    as_is = _left(of_master, of_gyros[at])
    lags = np.array([_left(of_master, turn) for turn in of_gyros])
    best = int(np.argmin(lags))
    if as_is > _WELL and lags[best] > _BETTER:
        yield _diagnosis(imu, master, of_master, of_gyros[at], as_is)
    elif 0 < best < len(lags) - 1 and np.isfinite(lags[best - 1 : best + 2]).all():
        below, here, above = lags[best - 1 : best + 2]
        curve = below - 2.0 * here + above
        late = _LAGS_S[best] + (0.5 * (below - above) / curve * 0.02 if curve > 0.0 else 0.0)
        if abs(late) > _LATE_S:
            yield finding(
                master,
                "warning" if as_is > _WELL else "note",
                "master_late",
                float(late),
                f"its attitudes are {abs(late):.2f} s {'older' if late > 0 else 'younger'} than "
                f"their stamps, judged by the gyros of {name_of(imu)}. State that as its delay.",
            )


def _turns(imu: ImuTable, master: Trajectory) -> tuple[np.ndarray, list[np.ndarray]] | None:
    """How far the master turned in each window (w, 3) [rad], and what the gyros say, by lag.

    Means are taken out, so a bias of the gyros takes no part. None where there is too little.
    """
    signal = signal_of(imu)
    known = np.flatnonzero(np.isfinite(master.q_nb).all(axis=1))
    known = known[increasing(master.time_ns[known])]
    if signal is None or len(known) < 2:
        return None
    start = int(imu.time_ns[signal.rows[0]])
    time = (master.time_ns[known] - start) * 1e-9
    first = np.concatenate([[True], np.diff(np.floor(time / _WINDOW_S)) > 0])
    known, time = known[first], time[first]
    inside = (time[:-1] > _LAGS_S[-1]) & (time[1:] < signal.time_s[-1] - _LAGS_S[-1])
    inside &= np.diff(time) < _LONGEST_S
    if np.count_nonzero(inside) < 10:
        return None
    q = Rotation.from_quat(master.q_nb[known], scalar_first=True)
    of_master = (q[:-1].inv() * q[1:]).as_rotvec()[inside]
    angle = _integral(imu, signal, signal.gyro)

    def by_gyros(lag: float) -> np.ndarray:
        at = [np.interp(time - lag, signal.time_s, a) for a in angle.T]
        turned = np.diff(np.stack(at, -1), axis=0)[inside]
        return turned - turned.mean(axis=0)

    of_master = of_master - of_master.mean(axis=0)
    length = float(np.median(np.diff(time)[inside]))
    if np.sqrt(np.mean(np.sum(of_master**2, axis=1))) < _LEAST_RATE * length:
        return None
    return of_master, [by_gyros(lag) for lag in _LAGS_S]


def _integral(imu: ImuTable, signal: Signal, values: np.ndarray) -> np.ndarray:
    """(n, 3) integral of rates up to each sample, from the first; those of increments are means."""
    steps = np.diff(signal.time_s, prepend=signal.time_s[0])[:, None]
    before = np.concatenate([values[:1], values[:-1]])
    return np.cumsum(
        steps * (values if imu.kind == "increment" else 0.5 * (before + values)), axis=0
    )


def _left(of_master: np.ndarray, of_gyros: np.ndarray) -> float:
    """Share of the master's turning that the gyros do not explain."""
    return float(np.sum((of_master - of_gyros) ** 2) / np.sum(of_master**2))


def _diagnosis(
    imu: ImuTable, master: Trajectory, of_master: np.ndarray, of_gyros: np.ndarray, as_is: float
) -> Finding:
    """Another unit or other axes of the gyros, if one of them explains the turning."""
    maps = signed_permutations()
    scales = np.array([*SCALES, *(1.0 / s for s in SCALES)])
    tried = np.concatenate([maps, scales[:, None, None] * np.eye(3)])
    left = np.array([_left(of_master, of_gyros @ m.T) for m in tried])
    k = int(np.argmin(left))
    shown = (
        f"the gyros do not turn as the attitudes of {name_of(master)} do ({as_is:.0%} of the "
        f"turning is left over"
    )
    if left[k] > _BETTER:
        return finding(
            imu,
            "error",
            "turning_disagrees",
            as_is,
            f"{shown}), whatever unit, axis or shift of a second is tried. The files are of "
            "different recordings or clocks, or the nominal mounting is another.",
        )
    if k < len(maps):
        code = "gyro_axes"
        cause = f"They fit as {words_of(maps[k], 'gyro')}: correct the nominal mounting or the axes"
    else:
        code = "gyro_unit"
        scale = float(tried[k][0, 0])
        unit, mend = SCALES.get(scale, ("of the attitudes in another unit", "check both files"))
        cause = f"They are probably {unit}: {mend}"
    return finding(
        imu, "error", code, float(left[k]), f"{shown}, with other gyros {left[k]:.0%}). {cause}."
    )


def _force(imu: ImuTable, master: Trajectory) -> Iterator[Finding]:
    """Accelerometers against what the master's velocities and attitudes ask for."""
    signal = signal_of(imu)
    known = np.flatnonzero(
        np.isfinite(master.q_nb).all(axis=1) & np.isfinite(master.v_n).all(axis=1)
    )
    known = known[increasing(master.time_ns[known])]
    forces = None if signal is None or len(known) < 2 else _forces(imu, master, signal, known)
    if signal is None or forces is None:
        yield finding(
            imu,
            "note",
            "force_not_checked",
            0,
            f"the accelerometers could not be checked against {name_of(master)}: too few seconds "
            "of both.",
        )
        return
    wanted, measured = forces
    as_is = _left(wanted, measured)
    if as_is < _WRONG:
        return
    maps = signed_permutations()
    units = [(G / value, "gravity_unit", *words) for value, words in UNITS.items()]
    if imu.kind == "increment":  # before cm/s^2, which look the same at 100 Hz
        mend = (signal.step_s, "rates_as_increments", "rates", "name a format of rates")
    else:
        mend = (1.0 / signal.step_s, "increments_as_rates", "increments", "name a format of those")
    units.insert(0, mend)
    tried = np.concatenate([maps, [factor * np.eye(3) for factor, *_ in units]])
    left = np.array([_left(wanted, measured @ m.T) for m in tried])
    k = int(np.argmax(left < np.min(left) + 1e-3))
    if left[k] > _RIGHT:
        code, cause = (
            "force_disagrees",
            (
                "No usual unit or order of the axes makes them fit: another recording, a nominal "
                "mounting that is another, or gravity taken off"
            ),
        )
    elif k >= len(maps):
        _, code, unit, mend = units[k - len(maps)]
        cause = f"They are probably {unit}: {mend}"
    elif np.array_equal(maps[k], -np.eye(3)):
        code, cause = "accel_reversed", "They have the opposite sign: turn all three"
    else:
        code = "accel_axes"
        fit = words_of(maps[k], "accel")
        cause = f"They fit as {fit}: correct the nominal mounting or the axes"
    yield finding(
        imu,
        "error",
        code,
        float(left[k]),
        f"the accelerometers do not feel what the velocities and attitudes of {name_of(master)} "
        f"ask for ({as_is:.0%} of the specific force is left over). {cause}.",
    )


def _forces(
    imu: ImuTable, master: Trajectory, signal: Signal, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean specific force (w, 3) along the body in each window: by the master, by the IMU."""
    time = (master.time_ns[known] - int(imu.time_ns[signal.rows[0]])) * 1e-9
    first = np.concatenate([[True], np.diff(np.floor(time / _WINDOW_S)) > 0])
    known, time = known[first], time[first]
    length = np.diff(time)
    inside = (time[:-1] > 0.0) & (time[1:] < signal.time_s[-1]) & (length < _LONGEST_S)
    if np.count_nonzero(inside) < 10:
        return None
    q = Rotation.from_quat(master.q_nb[known], scalar_first=True)
    middle = q[:-1] * Rotation.from_rotvec(0.5 * (q[:-1].inv() * q[1:]).as_rotvec())
    f_n = np.diff(master.v_n[known], axis=0) / length[:, None] - [0.0, 0.0, G]
    gained = _integral(imu, signal, signal.accel)
    at = np.stack([np.interp(time, signal.time_s, a) for a in gained.T], -1)
    return middle.inv().apply(f_n)[inside], (np.diff(at, axis=0) / length[:, None])[inside]
