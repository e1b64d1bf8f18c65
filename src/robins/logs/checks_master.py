"""Checks of a master INS against the IMU to be aligned to it, which share one motion.

Both are on one vehicle, so they rotate together but for flexure. The IMU must be given in the
master's axes, as far as its mounting is known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robins.dataset import GnssTable, ImuTable, Trajectory
from robins.ins.frames import to_ned_frd
from robins.ins.plausible import FORCE_UNITS, G
from robins.logs.checks_gnss import check_velocity
from robins.logs.checks_motion import SCALES, words_of
from robins.logs.findings import Finding
from robins.logs.motion import signed_permutations
from robins.logs.pair_motion import (
    SharedMotion,
    TurningFit,
    fit_turning,
    fit_velocity,
    forces_of,
    shared_motion,
    turned,
    turned_by_gyros,
)
from robins.logs.quiet import error, finding, name_of, note, usual_step_s
from robins.logs.tables import place_of
from robins.rotation import conjugate, from_euler, to_euler

_LEAST_RATE = np.deg2rad(0.5)  # rad/s RMS; less is noise of the attitudes
_WELL, _BETTER = 0.3, 0.1  # unexplained shares of the rotation
_WRONG, _RIGHT = 0.1, 0.03  # unexplained shares of the specific force
_HALVED = 0.5  # ratio by which the right convention reduces the residual
_THIRD = 1.0 / 3.0  # likewise for velocities, whose fit has more parameters
_CLEAR = 1.6  # times the scatter: steps of five such sigmas are significant among thousands
_LATE_S, _TOO_LATE_S = 0.01, 0.02
_SIGMAS = 5.0
_CONVENTIONS = {  # signs of roll, pitch, heading; what to do
    "heading": ((1, 1, -1), "counted counterclockwise: count it clockwise from north"),
    "pitch": ((1, -1, 1), "positive with the nose down: turn its sign"),
    "roll": ((-1, 1, 1), "positive with the right wing up: turn its sign"),
}


def check_master(imu: ImuTable, master: Trajectory, delay_s: float = 0.0) -> Iterator[Finding]:
    """Findings about missing data, velocities against positions, and the IMU against both.

    Args:
        imu: in the axes of the master.
        master: records of the master.
        delay_s: stated age of the records at their stamps [s].
    """
    if not len(master):
        return
    imu, master = to_ned_frd(imu), to_ned_frd(master)
    master = replace(master, time_ns=master.time_ns - round(delay_s * 1e9))
    yield from _missing(master)
    of_velocity = list(check_velocity(_as_fixes(master)))
    yield from of_velocity
    shared = shared_motion(imu, master)
    of_turning = list(_turning(imu, master, shared, delay_s))
    yield from of_turning
    if any(f.code == "attitude_sign" for f in of_turning):
        return  # with wrong attitudes no force fits
    yield from _force(imu, master, shared)
    others = {f.code for f in of_velocity + of_turning if f.severity == "error"}
    if shared is not None and not others - {"master_late"}:
        yield from _velocity_sign(imu, master, shared)


def _as_fixes(master: Trajectory) -> GnssTable:
    """Records as fixes, with the scatter of positions, from second differences, as sigma."""
    north_m, east_m = 6.4e6 * master.lat_rad, 6.4e6 * np.cos(master.lat_rad) * master.lon_rad
    bends = np.abs(np.diff(np.stack([north_m, east_m, master.alt_m], -1), 2, axis=0))
    bends = bends[np.isfinite(bends).all(axis=1)]
    scatter = np.median(bends, axis=0) / 0.6745 / np.sqrt(6.0) if len(bends) else np.ones(3)
    sigma_m = np.tile(np.maximum(_CLEAR * scatter, 1.0), (len(master), 1))
    sigma_v = np.ones((len(master), 3))
    place = (master.lat_rad, master.lon_rad, master.alt_m)
    fixes = GnssTable(master.time_ns, *place, sigma_m, master.v_n, sigma_v)
    return replace(fixes, source=master.source, rows=master.rows)


def _missing(master: Trajectory) -> Iterator[Finding]:
    for name, values in (
        ("position", place_of(master)),
        ("velocity", master.v_n),
        ("attitude", master.q_nb),
    ):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            severity, k = "error" if bad.all() else "warning", int(np.argmax(bad))
            yield finding(severity, master, "master_missing", int(bad.sum()), k)(
                f"the {name} is not whole here, nor in {bad.sum()} of {len(master)} records. The "
                "rest of those records is used."
            )


def _turning(
    imu: ImuTable, master: Trajectory, shared: SharedMotion | None, delay_s: float
) -> Iterator[Finding]:
    of_master = np.zeros((1, 3)) if shared is None else turned(shared.q, shared)
    of_master = of_master - of_master.mean(axis=0)
    length = 1.0 if shared is None else float(np.median(shared.length_s))
    if shared is None or np.sqrt(np.mean(np.sum(of_master**2, axis=1))) < _LEAST_RATE * length:
        yield note(imu, "turning_not_checked", 0)(
            f"gyro unit, axes and time offset could not be checked against {name_of(master)}: the "
            "vehicle hardly turns while both were recorded."
        )
        return
    of_gyros = turned_by_gyros(shared)
    as_is, unfitted = fit_turning(shared.q, shared), _left(of_master, of_gyros - of_gyros.mean(0))
    shown = (
        f"the gyros do not turn as the attitudes of {name_of(master)} do ({unfitted:.0%} of the "
        "turning is left over"
    )
    causes = [_other_attitudes(imu, master, shared, as_is)]
    if as_is.share > _BETTER:
        causes.append(_other_gyros(imu, shared, as_is, shown))
    found = min((t for t in causes if t is not None), key=lambda t: float(t.value), default=None)
    if found is not None:
        yield found
    elif as_is.share > _WELL:
        yield error(imu, "turning_disagrees", as_is.share)(
            f"{shown}), whatever unit, axis or shift of a second is tried. The files are of "
            "different recordings or clocks, or the nominal mounting is another."
        )
    elif abs(as_is.late_s) > max(_LATE_S, _SIGMAS * as_is.sigma_s):
        yield _late(imu, master, as_is, delay_s)


def _left(of_master: np.ndarray, of_gyros: np.ndarray) -> float:
    """Share of the master's rotation that the gyros do not explain."""
    return float(np.sum((of_master - of_gyros) ** 2) / np.sum(of_master**2))


def _other_attitudes(
    imu: ImuTable, master: Trajectory, shared: SharedMotion, as_is: TurningFit
) -> Finding | None:
    """Finding of another convention of the attitudes, if one explains the rotation."""
    angles = to_euler(shared.q)
    tried = {
        f"with {name} reversed": (
            from_euler(*(s * a for s, a in zip(signs, angles, strict=True))),
            f"{name.capitalize()} is probably {remedy}",
        )
        for name, (signs, remedy) in _CONVENTIONS.items()
    }
    tried["the other way round"] = (
        conjugate(shared.q),
        "They probably turn navigation to body axes: give their conjugates",
    )
    fits = {words: fit_turning(q, shared) for words, (q, _) in tried.items()}
    words = min(fits, key=lambda w: fits[w].share)
    if not fits[words].share < min(_BETTER, _HALVED * as_is.share):
        return None
    return error(master, "attitude_sign", fits[words].share)(
        f"its attitudes turn as the gyros of {name_of(imu)} do only {words}: that leaves "
        f"{fits[words].share:.2%} of the turning over, as they stand {as_is.share:.2%}. "
        f"{tried[words][1]}."
    )


def _other_gyros(
    imu: ImuTable, shared: SharedMotion, as_is: TurningFit, shown: str
) -> Finding | None:
    """Finding of another unit or other axes of the gyros, if one explains the rotation."""
    maps = signed_permutations()
    scales = np.array([*SCALES, *(1.0 / s for s in SCALES)])
    tried = np.concatenate([maps, scales[:, None, None] * np.eye(3)])
    left = np.array([fit_turning(shared.q, shared, m).share for m in tried])
    k = int(np.argmin(left))
    if not left[k] < min(_BETTER, _HALVED * as_is.share):
        return None
    if k < len(maps):
        code = "gyro_axes"
        cause = f"They fit as {words_of(maps[k], 'gyro')}: correct the nominal mounting or the axes"
    else:
        code = "gyro_unit"
        scale = float(tried[k][0, 0])
        unit, remedy = SCALES.get(scale, ("of the attitudes in another unit", "check both files"))
        cause = f"They are probably {unit}: {remedy}"
    return error(imu, code, float(left[k]))(f"{shown}, with other gyros {left[k]:.0%}). {cause}.")


def _late(imu: ImuTable, master: Trajectory, fit: TurningFit, delay_s: float) -> Finding:
    total_s = fit.late_s + delay_s
    stamps_text = f"the stated delay of {delay_s:g} s makes them" if delay_s else "their stamps"
    remedy = (
        f'State that: master.delay = "{total_s:.3f} s"'
        if total_s >= 0.0
        else f"Add {-total_s:.3f} s to their stamps, and state no delay"
    )
    severity = "error" if abs(fit.late_s) > _TOO_LATE_S else "warning"
    return finding(severity, master, "master_late", fit.late_s)(
        f"its attitudes are {1e3 * abs(fit.late_s):.0f} ms (one sigma {1e3 * fit.sigma_s:.1f} ms) "
        f"{'older' if fit.late_s > 0 else 'younger'} than {stamps_text}, judged by the gyros of "
        f"{name_of(imu)}. {remedy}."
    )


def _velocity_sign(imu: ImuTable, master: Trajectory, shared: SharedMotion) -> Iterator[Finding]:
    """Check the signs of velocities: their changes must match the accelerometers."""
    as_is = fit_velocity(shared.v_n, shared)
    if as_is is None:
        return
    for k, (name, other) in enumerate((("north", "south"), ("east", "west"), ("down", "up"))):
        left = fit_velocity(shared.v_n * np.where(np.arange(3) == k, -1.0, 1.0), shared)
        if left is not None and left[k] < _THIRD * as_is[k]:
            yield error(master, "velocity_sign", name)(
                f"its velocity {name} changes against what the accelerometers of {name_of(imu)} "
                f"feel; with its sign turned {left[k] / as_is[k]:.1%} of the squares are left. "
                f"It is probably positive {other}: turn its sign."
            )


def _force(imu: ImuTable, master: Trajectory, shared: SharedMotion | None) -> Iterator[Finding]:
    """Check the accelerometers against the master's velocities and attitudes."""
    forces = None if shared is None else forces_of(shared)
    if forces is None:
        yield note(imu, "force_not_checked", 0)(
            f"the accelerometers could not be checked against {name_of(master)}: too few seconds "
            "of both."
        )
        return
    wanted, measured = forces
    as_is = _left(wanted, measured)
    if as_is < _WRONG:
        return
    maps = signed_permutations()
    units = [(G / value, "gravity_unit", *words) for value, words in FORCE_UNITS.items()]
    step_s = usual_step_s(imu.time_ns)
    if imu.kind == "increment":  # first, as cm/s^2 looks the same at 100 Hz
        remedy = (step_s, "rates_as_increments", "rates", "name a format of rates")
    else:
        remedy = (1.0 / step_s, "increments_as_rates", "increments", "name a format of those")
    units.insert(0, remedy)
    tried = np.concatenate([maps, [factor * np.eye(3) for factor, *_ in units]])
    left = np.array([_left(wanted, measured @ m.T) for m in tried])
    k = int(np.argmax(left < np.min(left) + 1e-3))
    if left[k] > _RIGHT:
        code = "force_disagrees"
        cause = (
            "No usual unit or order of the axes makes them fit: another recording, a nominal "
            "mounting that is another, or gravity taken off"
        )
    elif k >= len(maps):
        _, code, unit, remedy = units[k - len(maps)]
        cause = f"They are probably {unit}: {remedy}"
    elif np.array_equal(maps[k], -np.eye(3)):
        code, cause = "accel_reversed", "They have the opposite sign: turn all three"
    else:
        code = "accel_axes"
        fit = words_of(maps[k], "accel")
        cause = f"They fit as {fit}: correct the nominal mounting or the axes"
    yield error(imu, code, float(left[k]))(
        f"the accelerometers do not feel what the velocities and attitudes of {name_of(master)} "
        f"ask for ({as_is:.0%} of the specific force is left over). {cause}."
    )
