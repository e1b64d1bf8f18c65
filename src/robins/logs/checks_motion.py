"""Checks of IMU and GNSS together: clocks, gyros, accelerometers, lever arm, forward axis.

All are estimated, each with its sigma (`motion_models`). A unit, an order of axes or a leap second
is named only if it agrees with the estimate within three sigmas; else the number is stated.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import GnssTable, ImuTable
from robins.logs.findings import Finding
from robins.logs.gnss_motion import track_of
from robins.logs.motion import MotionIntegrals, power_of, signed_permutations
from robins.logs.motion_fit import FORCE, LEVER, OFFSET, RATE, SCALE, MotionFit
from robins.logs.motion_models import ModelChoice, judge
from robins.logs.quiet import (
    error,
    finding,
    name_of,
    note,
    signal_of,
    warning,
)

_DEG = np.pi / 180
SCALES = {
    _DEG: ("deg/s", "multiply by pi/180"),
    _DEG / 3600: ("deg/h", "multiply by pi/180/3600"),
    1 / _DEG: ("rad/s converted to radians once more", "take the conversion out"),
}
_UNITS = (
    SCALES
    | {
        _DEG / 1e3: ("mdeg/s", "multiply by pi/180/1000"),
        1e-3: ("mrad/s", "divide by 1000"),
        np.pi / 30: ("revolutions per minute", "multiply by pi/30"),
        2 * np.pi: ("revolutions per second", "multiply by 2 pi"),
    }
    | {
        _DEG / k: (f"counts of 1/{k:g} deg/s", f"multiply by pi/180/{k:g}")
        for k in (131.0, 65.5, 32.8, 16.4)
    }
)
_STEPS = {
    1.0: "That is a leap second",
    18.0: "That is the leap seconds between UTC and GPS time",
    37.0: "That is the leap seconds between UTC and atomic time",
    19.0: "That is the seconds between GPS time and atomic time",
    86400.0: "That is a day",
    604800.0: "That is a week",
} | {3600.0 * k: f"That is {k} h: a time zone" for k in range(1, 13)}
_SIGMAS, _NAMED = 5.0, 3.0  # sigmas for a finding, and for a named cause
_OFFSET_S, _DRIFT_S = 0.05, 0.1  # smaller ones are acceptable
_OFF, _SURE = 0.1, 0.15  # relative errors that are reported, and largest sigma of an observed axis
_TURNED_DEG, _FORWARD_DEG, _LEVER_M = 5.0, 10.0, 0.5
_STEP_S = 5.0  # no buffer delays a fix by more
_LEAST_S, _LEAST_SCALE = 0.01, 0.01  # least sigmas of a clock and of a gyro scale
_WELL, _CHI = 0.05, 3.0  # unexplained share for naming causes, or in stated noise
_GOOD = 0.5  # largest unexplained share of consistent data


def check_motion(imu: ImuTable, gnss: GnssTable) -> Iterator[Finding]:
    """Findings from the common motion of IMU and GNSS; none if there is too little motion."""
    signal, track = signal_of(imu), track_of(gnss)
    if signal is None or track is None:
        return
    verdict = judge(imu, gnss, signal, track)
    left = np.inf if verdict is None else verdict.fit.left(verdict.views)
    if verdict is None or not np.isfinite(left) or _hidden(verdict, left):
        yield note(imu, "motion_not_checked", 0)(
            "gyro unit, axes and time offset could not be checked against GNSS: there are no "
            "15 s of common data with enough acceleration for these fixes. Drive a figure of eight "
            "to have them checked."
        )
        return
    found = estimates(verdict)
    both = "forces" in verdict.free and bool({"gyros", "scale"} & {*verdict.free})
    if verdict.rival or both or (verdict.free and not explained(verdict)) or left > _GOOD:
        yield from _unclear(imu, gnss, verdict, left, found)
        return
    before = verdict.nothing.left(verdict.views)
    share = f"(then {left:.0%} of the change of velocity is left unexplained, now {_all(before)})"
    wrong = []
    if {"gyros", "scale"} & {*verdict.free}:
        of_gyros = list(_gyros(imu, verdict, found, signal.step_s, share))
        wrong += of_gyros or _turned(imu, found, share)
    if "forces" in verdict.free:
        wrong += _forces(imu, found, share)
    yield from wrong
    if "clock" in verdict.free:
        yield from _clock(imu, gnss, verdict, found, share)
    if not wrong:
        yield from _lever(gnss, found)
        yield from _forward(imu, gnss, found)


def _hidden(verdict: ModelChoice, left: float) -> bool:
    """True if the motion hardly stands out of the noise of the fixes, and no fault does."""
    return not (verdict.free or verdict.rival) and left > _GOOD and explained(verdict)


def estimates(verdict: ModelChoice) -> dict[str, tuple[float, float]]:
    """Value and sigma of each estimate, by name.

    "gyros" and "gyro x" are correction factors of the gyros, "accel x" likewise, "gyros turned" the
    angle between the triads [deg]. "offset" [s] and "rate" [s/s] are corrections to the stamps of
    fixes, in the middle of the log; "step" is the largest step of the offset. "lever x" [m] is in
    the axes of the IMU, and "forward" the direction of travel from x to y [deg].
    """
    state, sigma = verdict.fit.state, verdict.fit.sigma
    levers = verdict.fit if "clock" in verdict.free else verdict.clocked
    P = _nearest(state.M_g)
    relative = np.maximum(sigma[SCALE].reshape(3, 3), _LEAST_SCALE)
    factors, own = np.abs(np.diag(state.M_g @ P.T)), np.diag(relative)
    weight = own**-2 / np.sum(own**-2)
    common = float(np.exp(np.sum(weight * np.log(factors))))
    out = {"gyros": (common, common * float(np.sum(own**-2) ** -0.5))}
    unit = state.M_g @ P.T / common
    skewed = 0.5 * (unit - unit.T)[[2, 0, 1], [1, 2, 0]]
    turned = (relative + relative.T)[[2, 0, 1], [1, 2, 0]] * 0.5
    angle = max(float(np.linalg.norm(skewed)), 1e-9)
    out["gyros turned"] = (
        np.rad2deg(np.arcsin(min(angle, 1.0))),
        float(np.rad2deg(np.linalg.norm(skewed * turned) / angle)),
    )
    of_force = np.maximum(sigma[FORCE][[0, 3, 5]], _LEAST_SCALE)
    for k, axis in enumerate("xyz"):
        out[f"gyro {axis}"] = factors[k], factors[k] * own[k]
        factor = verdict.factor * abs(state.M_a[k, k])
        out[f"accel {axis}"] = factor, factor * of_force[k]
        # a clock offset and an antenna ahead are not separable at constant speed
        arm = levers.state.lever[k]
        out[f"lever {axis}"] = arm, float(np.hypot(levers.sigma[LEVER][k], _LEAST_SCALE * arm))
    out["rate"] = state.rate, sigma[RATE]
    offset, of_offset = state.offset, np.maximum(sigma[OFFSET:], _LEAST_S)
    out["offset"] = offset[0], of_offset[0]
    if len(offset) > 1:
        k = int(np.argmax(np.abs(np.diff(offset))))
        out["step"] = offset[k + 1] - offset[k], float(np.hypot(*of_offset[k : k + 2]))
    forward = travel(verdict)
    if forward is not None:
        out["forward"] = forward
    return {name: (float(value), float(s)) for name, (value, s) in out.items()}


def explained(verdict: ModelChoice) -> bool:
    """True if hardly more than noise is unexplained, so that causes can be named."""
    views = verdict.views
    noise = views.noise**2 / float(np.mean(power_of(views)))
    return verdict.fit.left(views) < max(_WELL, _CHI * noise)


def in_body(verdict: ModelChoice) -> np.ndarray:
    """Velocities (k, 3) [m/s] above 0.5 m/s, in the axes of the IMU.

    None, (0, 3), if the azimuth of the axes is not observed: in a steady turn small biases turn it.
    """
    views, one = verdict.views, verdict.fit
    if one.azimuth > _SURE:
        return np.zeros((0, 3))
    seen = np.zeros(len(views.v), bool)
    seen[views.node] = np.isfinite(one.squares)
    C = one.R[views.node_of] @ one.turned
    v_b = np.einsum("kji,kj->ki", C, views.v)
    return v_b[seen & (np.linalg.norm(views.v, axis=-1) > 0.5)]


def travel(verdict: ModelChoice) -> tuple[float, float] | None:
    """Direction of travel from x to y [deg] and its sigma; None if undetermined."""
    v_b = in_body(verdict)
    if len(v_b) <= 20:
        return None
    ahead = (v_b[:, 0] + 1j * v_b[:, 1]) / np.hypot(v_b[:, 0], v_b[:, 1])
    mean = np.mean(ahead)
    if np.abs(mean) < 0.85:
        return None
    parts = np.array_split(np.angle(ahead / mean), min(len(verdict.views.start_s), 8))
    each = np.array([np.mean(part) for part in parts])
    spread = float(np.std(each))  # of crab and slip, which last: more parts do not average them
    sigma = np.hypot(max(spread, 0.005), verdict.fit.azimuth)
    return float(np.rad2deg(np.angle(mean))), float(np.rad2deg(sigma))


def _nearest(M: np.ndarray) -> np.ndarray:
    """The signed permutation nearest to a matrix."""
    maps = signed_permutations()
    rows = M / np.linalg.norm(M, axis=1, keepdims=True)
    return maps[int(np.argmax(np.sum(maps * rows, axis=(1, 2))))]


def _unclear(
    imu: ImuTable, gnss: GnssTable, verdict: ModelChoice, left: float, found: dict
) -> Iterator[Finding]:
    """Findings if the motion is explained by two causes equally well, or by none."""
    before = verdict.nothing.left(verdict.views)
    if before < _GOOD:
        return
    if verdict.rival:
        (shift, s), (factor, of_factor) = found["offset"], found["gyros"]
        tried = {
            "clock": f"a shift of {shift:+.2f} +- {s:.2f} s",
            "scale": f"a factor of {factor:.3g} +- {of_factor:.2g} of the gyros",
            "gyros": "another gyro unit, exchanged or reversed axes",
            "forces": "other accelerometers",
        }
        rest = (
            f" as it is; {tried[verdict.free[0]]} and {tried[verdict.rival]} explain them about "
            "equally. Drive more turns and stops to tell which."
        )
    elif explained(verdict):
        rest = (
            f" as it is ({_all(before)} of their change is left); only other gyros together with "
            "other accelerometers do. Compare units and axes of both triads with the data sheet."
        )
    else:
        rest = (
            f" ({_all(left)} of their change is left), and neither another gyro unit, exchanged or "
            "reversed axes, nor a shift of the clock explains it. Are the files of one recording, "
            "and is the IMU fixed to the vehicle?"
        )
    moved = "velocities" if gnss.v_n is not None else "motion by the positions"
    yield warning(imu, "motion_disagrees", left)(
        f"the IMU does not explain the {moved} of {name_of(gnss)}{rest}"
    )


def _all(share: float) -> str:
    return "all" if share > 0.95 else f"{share:.0%}"


def _gyros(
    imu: ImuTable, verdict: ModelChoice, found: dict, step_s: float, share: str
) -> Iterator[Finding]:
    """Findings about order, signs and scales in the matrix of the gyros."""
    P, state = _nearest(verdict.fit.state.M_g), verdict.fit.state
    mirrored = bool(np.linalg.det(state.M_a) < 0.0)
    value, sigma = found["gyros"]
    each = [found[f"gyro {axis}"] for axis in "xyz"]
    left = verdict.fit.left(verdict.views)
    if mirrored or not np.array_equal(P, np.eye(3)):
        changed = np.any(np.eye(3) != P, axis=1) | mirrored
        if all(s < _SURE * v for (v, s), own in zip(each, changed, strict=True) if own):
            code, cause = _meaning(P, mirrored)
            yield error(imu, code, left)(
                "gyros and accelerometers together do not explain the GNSS velocities, with other "
                f"axes they do {share}. {cause}."
            )
        else:
            yield warning(imu, "motion_disagrees", left)(
                f"the gyros explain the velocities only with other axes {share}, but it turned too "
                "little about each axis to tell which."
            )
    alike = all(abs(np.log(v / value)) < max(_NAMED * s / v, _OFF) for v, s in each)
    if alike and abs(np.log(value)) > max(_OFF, _SIGMAS * sigma / value):
        shown = (
            "turns by the gyros fit those of the GNSS velocity only if the rates are multiplied by "
            f"{value:.4g} +- {sigma:.2g} {share}"
        )
        yield unit_finding(imu, value, sigma, step_s, shown)
    elif not alike:
        for axis, (v, s) in zip("xyz", each, strict=True):
            if abs(v - 1.0) > max(_OFF, _SIGMAS * s) and s < _SURE * v:
                yield error(imu, "gyro_scale", v)(
                    f"the gyro about {axis} reads {1 / v:.3g} +- {s / v**2:.2g} times what the "
                    f"course turns {share}. Multiply it by {v:.4g}, or check its scale factor."
                )


def _turned(imu: ImuTable, found: dict, share: str) -> Iterator[Finding]:
    """Report a small angle between the axes of the two triads."""
    angle, sigma = found["gyros turned"]
    if angle > max(_TURNED_DEG, _SIGMAS * sigma):
        yield error(imu, "gyro_axes", angle)(
            f"the gyros are turned by {angle:.1f} +- {sigma:.1f} deg against the accelerometers "
            f"{share}. Both triads must be given along the same axes."
        )


def _named(value: float, sigma: float, names: dict[float, tuple[str, str]]) -> tuple | None:
    """The unique name within three sigmas; None if there is none, or more than one."""
    near = [k for k in names if abs(np.log(value / k)) < max(_NAMED * sigma / value, 0.03)]
    return names[near[0]] if len(near) == 1 else None


def unit_finding(imu: ImuTable, value: float, sigma: float, step_s: float, shown: str) -> Finding:
    """Finding about a common factor of all gyros, named if it is that of a usual unit."""
    names = _UNITS | {
        step_s: ("rates where increments are expected", f"multiply by {step_s:g} s"),
        1 / step_s: ("increments where rates are expected", f"divide by {step_s:g} s"),
    }
    name = _named(value, sigma, names)
    if name is None:
        return error(imu, "gyro_unit", value)(
            f"{shown}: the gyros read {1 / value:.3g} times what they should. No usual unit is "
            "that; check the scale factor."
        )
    return error(imu, "gyro_unit", value)(
        f"{shown}. The gyro columns are probably {name[0]}: {name[1]}."
    )


def _forces(imu: ImuTable, found: dict, share: str) -> list[Finding]:
    """Findings about the scales of the accelerometers."""
    return [
        warning(imu, "force_scale", v)(
            f"the accelerometer along {axis} reads {1 / v:.3g} +- {s / v**2:.2g} times the "
            f"specific force of the course and gravity {share}. Check its scale factor."
        )
        for axis, (v, s) in ((axis, found[f"accel {axis}"]) for axis in "xyz")
        if abs(v - 1.0) > max(_OFF, _SIGMAS * s) and s < _SURE * v
    ]


def _steps(one: MotionFit, views: MotionIntegrals) -> list[tuple[float, float, float]]:
    """Steps of the clock of fixes that count: size and sigma [s], and when [s]."""
    sigma, out = np.maximum(one.sigma[OFFSET:], _LEAST_S), []
    for k, size in enumerate(np.diff(one.state.offset)):
        s = float(np.hypot(sigma[k], sigma[k + 1]))
        if abs(size) > max(_OFFSET_S, _SIGMAS * s):
            out.append((float(size), s, float(views.start_s[np.argmax(one.state.part == k + 1)])))
    return out


def _drifts(one: MotionFit, views: MotionIntegrals) -> bool:
    """True if the rate of the clock of fixes counts."""
    rate, span = abs(one.state.rate), float(views.end_s[-1] - views.begin_s[0])
    return bool(rate > _SIGMAS * one.sigma[RATE] and rate * span > _DRIFT_S)


def _clock(
    imu: ImuTable, gnss: GnssTable, verdict: ModelChoice, found: dict, share: str
) -> Iterator[Finding]:
    """Findings about the clocks: steps, rate, offset."""
    views, other = verdict.views, verdict.other
    steps, drifts = _steps(verdict.fit, views), _drifts(verdict.fit, views)
    rate, s = found["rate"]
    if other is not None and (
        (drifts and _steps(other, views)) or (steps and _drifts(other, views))
    ):
        stepped, drifting = (other, verdict.fit) if drifts else (verdict.fit, other)
        size, _, when = max(_steps(stepped, views), key=lambda step: abs(step[0]))
        yield warning(gnss, "motion_disagrees", size)(
            f"the motion fits {name_of(imu)} only with other stamps {share}; a step of {size:+.2f} "
            f"s from about {when:.0f} s on and a drift of {1e3 * drifting.state.rate:+.3g} ms in a "
            "second explain it about equally. Drive more turns and stops to tell which."
        )
        return
    for size, of_step, when in steps:
        yield error(gnss, "time_jump", size)(
            f"the motion fits {name_of(imu)} only if {size:+.2f} +- {of_step:.2f} s is added to "
            f"all stamps from about {when:.0f} s after the start of {name_of(imu)} on {share}. "
            f"{_step_named(size, of_step) or 'A clock was set there'}; take the step off."
        )
    if drifts:
        yield error(gnss, "clock_rate", rate)(
            f"its clock and that of {name_of(imu)} drift apart by {1e3 * rate:+.3g} +- "
            f"{1e3 * s:.2g} ms in a second {share}. Stamp both by one clock, or stretch the stamps "
            "of one of them."
        )
        return
    offset, s = found["offset"]
    if abs(offset) > max(_OFFSET_S, _SIGMAS * s):
        yield _offset(imu, gnss, offset, s, share)


def small_offset(verdict: ModelChoice) -> float | None:
    """Correction [s] to the stamps of fixes, if it is certain and small; else None."""
    offset, sigma = estimates(verdict)["offset"]
    sound = "clock" in verdict.free and not verdict.rival and explained(verdict)
    sound &= len(verdict.fit.state.offset) == 1
    certain = max(_OFFSET_S, _SIGMAS * sigma) < abs(offset) <= _STEP_S
    return offset if sound and certain else None


def _step_named(size: float, sigma: float) -> str:
    near = [k for k in _STEPS if abs(abs(size) - k) < max(_NAMED * sigma, 0.1)]
    return _STEPS[near[0]] if len(near) == 1 else ""


def _offset(imu: ImuTable, gnss: GnssTable, offset: float, sigma: float, share: str) -> Finding:
    if abs(offset) <= _STEP_S:
        return finding("error" if abs(offset) > 1.0 else "warning", gnss, "time_offset", offset)(
            f"the motion fits {name_of(imu)} best if {offset:+.2f} +- {sigma:.2f} s is added to "
            "the stamps of this file. A buffer or a filter delays one of them; give the run that "
            "time offset, or have `robins doctor --write unit.toml` write it."
        )
    cause = _step_named(offset, sigma) or "The clocks were never set together"
    code = "leap_seconds" if "leap seconds" in cause else "time_offset"
    return error(gnss, code, offset)(
        f"the motion fits {name_of(imu)} only if {offset:+.2f} +- {sigma:.2f} s is added to the "
        f"stamps of this file {share}. {cause}; shift one of the files."
    )


def _lever(gnss: GnssTable, found: dict) -> Iterator[Finding]:
    """Note an antenna far from the IMU."""
    each = {axis: found[f"lever {axis}"] for axis in "xyz"}
    if any(abs(v) > max(_LEVER_M, _SIGMAS * s) for v, s in each.values()):
        words = ", ".join(f"{axis} {v:+.2f} +- {s:.2f} m" for axis, (v, s) in each.items())
        yield note(gnss, "lever_arm", float(np.linalg.norm([v for v, _ in each.values()])))(
            f"the antenna is away from the IMU: {words} along its axes. Measure the lever arm and "
            "give it to the run."
        )


def _forward(imu: ImuTable, gnss: GnssTable, found: dict) -> Iterator[Finding]:
    """Warn of a vehicle that does not travel along its forward axis."""
    angle, sigma = found.get("forward", (np.nan, np.nan))
    ahead = 0.0 if imu.body == "FRD" else 90.0
    off = (angle - ahead + 180.0) % 360.0 - 180.0
    if abs(off) > max(_FORWARD_DEG, _SIGMAS * sigma):
        yield warning(imu, "forward_axis", off)(
            f"by the velocities of {name_of(gnss)} the vehicle travels {angle:+.0f} +- {sigma:.1f} "
            f"deg from x towards y of the IMU, not along {'x' if imu.body == 'FRD' else 'y'}. "
            f"The sensor is turned in the vehicle: give its mounting, {abs(off):.0f} deg more "
            "about the vertical, else a heading begun from the velocity is wrong by as much."
        )


def _meaning(S: np.ndarray, mirrored: bool) -> tuple[str, str]:
    """Code and cause of a gyro map S, with the specific force reflected or not.

    If the accelerometer triad is a reflection M of the true one, rates, which are pseudovectors,
    fit after the map S = -M. Both triads reflected alike need S = -1.
    """
    if mirrored and np.array_equal(S, -np.eye(3)):
        return "left_handed", (
            "Both triads are left-handed: two axes are exchanged or one is reversed, alike in "
            "gyros and accelerometers. Check the axes against the data sheet's picture"
        )
    if mirrored and np.array_equal(S, np.eye(3)):
        return "accel_reversed", (
            "The accelerometers have the opposite sign: the log holds gravity, or minus the "
            "specific force. Turn the signs of all three"
        )
    if mirrored:
        return "accel_axes", (
            "The accelerometer axes do not belong to those of the gyros: take them as "
            f"{words_of(-S.T, 'accel')}. Columns were exchanged or a sign lost"
        )
    if np.array_equal(S, -np.eye(3)):
        return "gyro_reversed", (
            "The gyros have the opposite sense of rotation: turn the signs of all three"
        )
    return "gyro_axes", (
        "The gyro axes do not belong to those of the accelerometers: take them as "
        f"{words_of(S, 'gyro')}. Columns were exchanged or a sign lost"
    )


def words_of(S: np.ndarray, sensor: str) -> str:
    """Signed permutation in words, as columns: (gyro_y, -gyro_x, gyro_z)."""
    parts = []
    for row in S:
        j = int(np.argmax(np.abs(row)))
        parts.append(f"{'-' if row[j] < 0 else ''}{sensor}_{'xyz'[j]}")
    return f"({', '.join(parts)})"
