"""The doctor on IMU and GNSS together: gyro unit, axes, handedness, forward, time offset.

And on an IMU alone that was turned about, by gravity standing still. That is weaker, for the
sensor's own acceleration disturbs it and a reflection of both triads looks like gyros of the
opposite sense; used where GNSS cannot judge.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import GnssTable, ImuTable
from robins.logs.findings import Finding
from robins.logs.gnss_motion import Track, lateness, lowest, track_of, velocity_of
from robins.logs.motion import (
    GRAVITY,
    Fit,
    Pair,
    at_the_spot,
    pair_of,
    signed_permutations,
    travel_in_body,
    unexplained,
    unexplained_but_for_biases,
)
from robins.logs.quiet import (
    Signal,
    error,
    finding,
    name_of,
    note,
    signal_of,
    usual_force,
    warning,
    windows_of,
)

_WELL = 0.05  # share left unexplained by data about which there is no question
_GOOD = 0.5  # most that data which fit may leave
_BETTER = 0.4  # a hypothesis must leave this share of what the data as they are leave
_TURNED_WRONG, _TURNED_RIGHT, _TURNED_BETTER = 0.1, 0.1, 0.2  # likewise of gravity alone
_OFFSET_S = 0.05
_SMALL_LAG_S = 5.0
SCALES = {
    np.pi / 180: ("deg/s", "multiply by pi/180"),
    np.pi / 180 / 3600: ("deg/h", "multiply by pi/180/3600"),
    180 / np.pi: ("rad/s converted to radians once more", "take the conversion out"),
}


def check_motion(imu: ImuTable, gnss: GnssTable) -> Iterator[Finding]:
    """Findings about IMU and GNSS as views of one motion; none if there is too little of it."""
    signal, track = signal_of(imu), track_of(gnss)
    if signal is None or track is None:
        return
    pair = pair_in_time(imu, gnss, signal, track)
    if pair is None:
        yield note(imu, "motion_not_checked", 0)(
            "gyro unit, axes and time offset could not be checked against GNSS: there are no "
            "30 s of common data with enough acceleration for these fixes. Drive a figure of eight "
            "to have them checked."
        )
        return
    as_is = float(np.mean(unexplained(pair, np.eye(3)[None]).proper))
    if as_is > _WELL:  # a large bias must not look like a wrong axis
        as_is = min(as_is, float(np.mean(unexplained_but_for_biases(pair, np.zeros(1)))))
    wrong = _diagnosis(imu, gnss, signal, pair, as_is) if as_is > _WELL else None
    if wrong is not None:
        yield wrong
    else:
        yield from _small_offset(imu, gnss, pair)
        yield from _forward(imu, gnss, pair)


def pair_in_time(
    imu: ImuTable, gnss: GnssTable, signal: Signal, track: Track, late_s: float | None = None
) -> Pair | None:
    """Both on one time, specific force scaled to gravity, velocities without their delay.

    Args:
        imu: the table of the signal.
        gnss: the table of the track.
        signal: usable samples.
        track: complete fixes.
        late_s: how much older velocities are than their stamps; by default as the positions say.
    """
    windows = windows_of(signal)
    size = usual_force(windows)
    if not size > 0.0:
        return None
    # Half a minute of a cheap gyro's bias tilts gravity by more than the vehicle accelerates.
    bias = (
        np.median(windows.gyro[windows.at_rest], axis=0) if windows.at_rest.any() else np.zeros(3)
    )
    accel, gyro = signal.accel * (GRAVITY / size), signal.gyro - bias
    scaled = signal._replace(accel=accel, gyro=gyro)
    v_n, noise = velocity_of(track)
    start = int(imu.time_ns[signal.rows[0]]) - int(gnss.time_ns[0])
    late_s = lateness(track) if late_s is None else late_s
    when = track.time_s - start * 1e-9 - (late_s or 0.0)
    return pair_of(scaled, when, v_n, noise)


def small_offset(pair: Pair) -> float | None:
    """What is to be added to the stamps of GNSS for the motion to fit best [s]; None if it fits."""
    lags = np.arange(-_SMALL_LAG_S, _SMALL_LAG_S + 0.05, 0.1)
    left = _mean(unexplained(pair, np.eye(3)[None], lags))[0]
    lags = lags[np.nanargmin(left)] + np.arange(-2, 3) * 0.1
    each = [lowest(lags, left) for left in unexplained_but_for_biases(pair, lags)]
    clear = np.array([lag for lag in each if lag is not None])
    if len(clear) < max(1, len(each) // 2):
        return None
    lag = float(np.median(clear))
    return lag if abs(lag) > max(_OFFSET_S, 2.0 * float(clear.std())) else None


def _small_offset(imu: ImuTable, gnss: GnssTable, pair: Pair) -> Iterator[Finding]:
    lag = small_offset(pair)
    if lag is not None:
        yield finding("error" if abs(lag) > 1.0 else "warning", gnss, "time_offset", lag)(
            f"the motion fits {name_of(imu)} best if {lag:+.2f} s is added to the stamps of this "
            "file. A buffer or a filter delays one of them; give the run that time offset, or have "
            "`robins doctor --write unit.toml` write it."
        )


def _forward(imu: ImuTable, gnss: GnssTable, pair: Pair) -> Iterator[Finding]:
    """Whether the vehicle travels along its forward axis."""
    v_b = travel_in_body(pair)
    x, y = v_b[:, :2].T
    mean = np.mean((x + 1j * y) / np.hypot(x, y)) if len(v_b) > 20 else 0.0
    forward = 0.0 if imu.body == "FRD" else 90.0
    angle = float(np.rad2deg(np.angle(mean)))
    off = (angle - forward + 180.0) % 360.0 - 180.0
    if np.abs(mean) > 0.85 and abs(off) > 30.0:
        yield warning(imu, "forward_axis", off)(
            f"by the velocities of {name_of(gnss)} the vehicle travels {angle:+.0f} deg from x "
            f"towards y of the IMU, not along {'x' if imu.body == 'FRD' else 'y'}. The sensor is "
            f"turned in the vehicle: give its mounting, {abs(off):.0f} deg more about the "
            "vertical, else a heading begun from the velocity is wrong by as much."
        )


def _diagnosis(
    imu: ImuTable, gnss: GnssTable, signal: Signal, pair: Pair, as_is: float
) -> Finding | None:
    """The hypothesis that explains the motion much better, or that none does what none should."""
    scales = [*SCALES, signal.step_s, 1.0 / signal.step_s]
    lags = np.arange(-120, 121) * 0.25
    tried = {
        "scale": unexplained(pair, np.array(scales)[:, None, None] * np.eye(3)),
        "axes": unexplained(pair, signed_permutations()),
        "lag": unexplained(pair, np.eye(3)[None], lags),
    }
    left = {name: _least(_mean(fit)) for name, fit in tried.items()}
    left["lag"] = _least(_mean(tried["lag"])[0])  # a reflection has no delay
    left["scale"] = _least(_mean(tried["scale"])[0])
    best = min(left, key=lambda name: left[name])
    if left[best] > min(_GOOD, _BETTER * as_is):
        if as_is < _GOOD:
            return None
        return warning(imu, "motion_disagrees", as_is)(
            f"the IMU does not explain the velocities of {name_of(gnss)} ({_all(as_is)} of their "
            "change is left), and neither another gyro unit, exchanged or reversed axes, nor a "
            "shift of up to 30 s mends it. Are the files of one recording, and is the IMU fixed to "
            "the vehicle?"
        )
    share = (
        f"(then {left[best]:.0%} of the change of velocity is left unexplained, now {_all(as_is)})"
    )
    if best == "lag":
        late = _late(imu, gnss, lags, tried["lag"], share)
        return late if abs(float(late.value)) > _SMALL_LAG_S else None
    if best == "scale":
        return _unit(imu, scales[int(np.nanargmin(_mean(tried["scale"])[0]))], signal.step_s, share)
    return _axes(imu, tried["axes"], share)


def _least(left: np.ndarray) -> float:
    finite = left[np.isfinite(left)]
    return float(finite.min()) if len(finite) else np.inf


def _all(share: float) -> str:
    return "all" if share > 0.95 else f"{share:.0%}"


def _mean(fit: Fit) -> np.ndarray:
    """(2, hypotheses): by rotation and by reflection, over all stretches that were recorded.

    A hypothesis judged by less than half of them is left out (NaN).
    """
    few = np.mean(np.isfinite(fit.proper), axis=0) < 0.5
    both = np.stack([fit.proper, fit.mirrored])
    total, count = np.nansum(both, axis=1), np.sum(np.isfinite(both), axis=1)
    return np.where(few, np.nan, total / np.maximum(count, 1))


def _late(imu: ImuTable, gnss: GnssTable, lags: np.ndarray, fit: Fit, share: str) -> Finding:
    left = _mean(fit)[0]
    k = int(np.nanargmin(left))
    near = slice(max(k - 1, 0), k + 2)
    lag = lowest(lags[near], left[near]) or float(lags[k])
    leap = abs(abs(lag) - 18.0) < 0.5
    cause = (
        "That is the leap seconds between UTC and GPS time"
        if leap
        else "The clocks were never set together"
    )
    return error(gnss, "leap_seconds" if leap else "time_offset", lag)(
        f"the motion fits {name_of(imu)} only if {lag:+.2f} s is added to the stamps of this file "
        f"{share}. {cause}; shift one of the files."
    )


def _unit(imu: ImuTable, scale: float, step_s: float, share: str) -> Finding:
    if scale in SCALES:
        unit, mend = SCALES[scale]
    elif scale == step_s:
        unit, mend = "rates where increments are expected", f"multiply by {step_s:g} s"
    else:
        unit, mend = "increments where rates are expected", f"divide by {step_s:g} s"
    return error(imu, "gyro_unit", scale)(
        f"turns by the gyros fit those of the GNSS velocity only if the rates are multiplied by "
        f"{scale:.4g} {share}. The gyro columns are probably {unit}: {mend}."
    )


def _axes(imu: ImuTable, fit: Fit, share: str) -> Finding:
    left = _mean(fit)
    mirrored, k = np.unravel_index(int(np.nanargmin(left)), left.shape)
    code, cause = _meaning(signed_permutations()[k], bool(mirrored))
    return error(imu, code, _least(left))(
        "gyros and accelerometers together do not explain the GNSS velocities, with other axes "
        f"they do {share}. {cause}."
    )


def _meaning(S: np.ndarray, mirrored: bool) -> tuple[str, str]:
    """Code and cause, if the gyro needs the map S, and the specific force a reflection or not.

    An accelerometer triad that is a reflection M of the true one makes axes in which rates are
    pseudovectors: they fit after the map S = -M. Both triads reflected alike need S = -1.
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
    """A signed permutation as columns: (gyro_y, -gyro_x, gyro_z)."""
    parts = []
    for row in S:
        j = int(np.argmax(np.abs(row)))
        parts.append(f"{'-' if row[j] < 0 else ''}{sensor}_{'xyz'[j]}")
    return f"({', '.join(parts)})"


def check_turning(imu: ImuTable) -> Iterator[Finding]:
    """Findings about gyros that do not turn gravity as the accelerometers see it turn."""
    signal = signal_of(imu)
    if signal is None:
        return
    size = usual_force(windows_of(signal))
    if not size > 0.0:
        return
    pair = at_the_spot(signal._replace(accel=signal.accel * (GRAVITY / size)))
    if pair is None:
        return
    as_is = float(np.mean(unexplained(pair, np.eye(3)[None]).proper))
    if not as_is > _TURNED_WRONG:
        return
    scales = np.array([*SCALES, 0.0])  # the last: as if it had not turned at all
    maps = np.concatenate([signed_permutations(), scales[:, None, None] * np.eye(3)])
    left = np.mean(unexplained(pair, maps).proper, axis=0)
    k = int(np.argmin(left))
    # A vehicle that only accelerates needs no turns to be explained, and tells nothing about them.
    if left[k] > min(_TURNED_RIGHT, _TURNED_BETTER * as_is, 0.5 * left[-1]):
        return
    if k >= 48:
        unit, mend = SCALES[float(scales[k - 48])]
        code, cause = "gyro_unit", f"The gyro columns are probably {unit}: {mend}"
    elif np.array_equal(maps[k], -np.eye(3)):
        code, cause = (
            "left_handed",
            "The gyros have the opposite sense of rotation, or both triads are left-handed: two "
            "axes exchanged or one reversed, alike in both",
        )
    else:
        code, cause = (
            "gyro_axes",
            f"The gyros fit as {words_of(maps[k], 'gyro')}; or the accelerometers' columns were "
            "exchanged or reversed accordingly",
        )
    yield error(imu, code, float(left[k]))(
        "turned about, the gyros do not turn gravity as the accelerometers see it turn "
        f"({as_is:.0%} of it is left over, with other gyro columns {left[k]:.0%}). {cause}."
    )
