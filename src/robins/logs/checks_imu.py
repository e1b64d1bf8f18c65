"""Checks of an IMU by itself: units from gravity, rates against increments, upward axis.

Also of each of its columns: missing, stuck, saturated, coarse.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable
from robins.ins.plausible import (
    BIASED,
    EARTH_RATE,
    FASTEST,
    FORCE_UNITS,
    REST_RATE,
    G,
    is_near,
    rate_across,
)
from robins.logs.findings import Finding, Value
from robins.logs.quiet import (
    ImuSignal,
    Windows,
    error,
    finding,
    longest_run,
    note,
    signal_of,
    usual_step_s,
    warning,
    windows_of,
)

_LIVELY = 5.0  # times gravity: vehicles exceed it for moments only
_GRAVITY = (9.7, 9.9)  # m/s^2, range of inhabited places


def check_imu(imu: ImuTable, in_vehicle: bool = True) -> Iterator[Finding]:
    """All findings about the IMU's units and axes that need no other sensor.

    Args:
        imu: the table.
        in_vehicle: the axes are those of a vehicle, so gravity must be along z.
    """
    signal = signal_of(imu)
    if signal is None:
        yield error(imu, "no_samples", len(imu))(
            "fewer than ten samples have all six numbers; units and axes cannot be judged."
        )
        return
    windows = windows_of(signal)
    of_force = list(_gravity(imu, signal, windows))
    yield from of_force
    if not any(f.code == "gravity_missing" for f in of_force):  # otherwise there is no direction
        yield from _up(imu, windows) if in_vehicle else _free(imu, windows)
    if not any(f.code in ("rates_as_increments", "increments_as_rates") for f in of_force):
        yield from _rates(imu, signal, windows)


def _gravity(imu: ImuTable, signal: ImuSignal, windows: Windows) -> Iterator[Finding]:
    size = np.linalg.norm(windows.accel[windows.calm], axis=-1)
    measured = float(np.median(size))
    row = int(signal.rows[windows.first[np.flatnonzero(windows.calm)[0]]])
    where = "at rest" if windows.at_rest.any() else "at its calmest (it never rests)"
    if _GRAVITY[0] <= measured <= _GRAVITY[1]:
        return
    if abs(measured / G - 1.0) < BIASED:
        yield note(imu, "gravity_bias", measured, row)(
            f"{where} the specific force is {measured:.3f} m/s^2, gravity is 9.76 to 9.83. The "
            f"unit is right; the accelerometers are off by {measured - 9.8:+.2f} m/s^2 "
            f"({(measured - 9.8) / G * 1e3:+.0f} mg), usual for cheap sensors. Begin the filter "
            "with a bias sigma of at least that."
        )
        return
    causes = list(_causes(imu, signal.step_s, measured))
    shown = f"{where} the specific force is {measured:.4g} m/s^2 where gravity is 9.8"
    if causes:
        yield error(imu, causes[0][0], measured, row)(
            f"{shown}. {' Or '.join(f'{cause}.' for _, cause in causes)}"
        )
    elif measured < 0.5:
        yield error(imu, "gravity_missing", measured, row)(
            f"{shown}. Gravity was taken off: these are 'linear accelerations' of a phone or of "
            "another filter. Log the raw accelerometers; gravity cannot be put back."
        )
    elif size.min() < G * (1.0 + BIASED) and size.max() > G * (1.0 - BIASED):
        return  # in turns or climbs, specific force differs from gravity in the right unit too
    elif windows.at_rest.any():
        yield error(imu, "gravity_unknown", measured, row)(
            f"{shown}, and no usual unit makes it that. A scale factor is missing (counts of the "
            "converter?), or the columns are in another order."
        )
    else:
        yield warning(imu, "gravity_not_seen", measured, row)(
            f"{shown}, and the log has no second at rest. Unless the vehicle really accelerated "
            "like that all the time, a unit or a column is wrong."
        )


# Gravity, its unit in rates and in increments, and what else to do.
_READINGS = (
    (G, "m/s^2", "m/s", ""),
    (1.0, "g", "g s", " (and the accelerations by 9.80665)"),
)


def _causes(imu: ImuTable, step_s: float, measured: float) -> Iterator[tuple[str, str]]:
    """Codes and causes of a specific force at rest that is not gravity in m/s^2.

    Of increments labelled as rates it is gravity times the step. A residual bias after removal of
    gravity looks alike, but then the motion is far larger. Of rates labelled as increments the raw
    specific force has the size of gravity.
    """
    if imu.kind == "rate":
        moving = np.nanpercentile(np.linalg.norm(imu.accel, axis=1), 99.0)
        for scale, _, unit, by_g in _READINGS:
            if is_near(measured, scale * step_s) and not moving > _LIVELY * measured:
                yield (
                    "increments_as_rates",
                    f"The rows are increments over {step_s * 1e3:.4g} ms in {unit}, not rates: "
                    f"divide both sensors by that time{by_g}, or name a format of increments",
                )
    elif (raw := signal_of(dataclasses.replace(imu, kind="rate"))) is not None:
        windows = windows_of(raw)
        size = float(np.median(np.linalg.norm(windows.accel[windows.calm], axis=-1)))
        for scale, unit, _, by_g in _READINGS:
            if is_near(size, scale):
                yield (
                    "rates_as_increments",
                    f"The rows are rates in {unit}, not increments over {step_s * 1e3:.4g} ms: "
                    f"multiply accelerations{by_g} and angular rates by that time, or name a "
                    "format of rates",
                )
    for value, (unit, remedy) in FORCE_UNITS.items():
        if is_near(measured, value):
            yield "gravity_unit", f"The unit is probably {unit}: {remedy}"


def _direction(windows: Windows) -> np.ndarray:
    """Direction (3,) of the specific force in calm windows."""
    force = windows.accel[windows.calm]
    return np.median(force / np.linalg.norm(force, axis=-1, keepdims=True), axis=0)


def _free(imu: ImuTable, windows: Windows) -> Iterator[Finding]:
    x, y, z = _direction(windows)
    if (z if imu.body == "FRD" else -z) > -0.7:
        yield note(imu, "sensor_axes", float(z))(
            f"at rest the specific force lies along ({x:+.2f}, {y:+.2f}, {z:+.2f}) of x, y, z. The "
            "axes are those of the sensor, and attitude will be that of the sensor; for roll, "
            "pitch and heading of a vehicle give a mounting."
        )


def _up(imu: ImuTable, windows: Windows) -> Iterator[Finding]:
    """Check the sign of gravity along z: specific force at rest points up."""
    direction = _direction(windows)
    down = direction[2] if imu.body == "FRD" else -direction[2]
    axes = "forward-right-down" if imu.body == "FRD" else "right-forward-up"
    sign = "-" if imu.body == "FRD" else "+"
    if down > 0.7:
        yield error(imu, "z_axis_reversed", float(direction[2]))(
            f"gravity shows as {direction[2] * 9.8:+.1f} m/s^2 on accel_z, in {axes} axes a level "
            f"vehicle at rest shows {sign}9.8. The sensor's z points the other way, or the log "
            "holds gravity instead of specific force; turn the axes with a mounting (roll 180 deg "
            "if z points up and x forward)."
        )
    elif down > -0.7:
        k = int(np.argmax(np.abs(direction)))
        yield warning(imu, "not_level", float(direction[k]))(
            f"gravity lies along ({direction[0]:+.2f}, {direction[1]:+.2f}, {direction[2]:+.2f}) "
            f"of x, y, z. The sensor is mounted on its side or the vehicle stands steep; if it is "
            f"the mounting, give its angles, for speed along the body is taken along x ({axes})."
        )


def _rates(imu: ImuTable, signal: ImuSignal, windows: Windows) -> Iterator[Finding]:
    """Rates beyond any vehicle, and the Earth's rate in another unit.

    The unit is named only if the Earth's rate reveals it; otherwise several units are equally
    plausible.
    """
    fastest = np.linalg.norm(signal.gyro, axis=-1)
    k = int(np.argmax(fastest))
    calm = windows.at_rest & (windows.restless <= np.percentile(windows.restless, 25))
    rest = windows.gyro[calm] if calm.any() else windows.gyro[:0]
    mean = rest.mean(axis=0) if len(rest) else np.zeros(3)
    size = float(np.linalg.norm(mean))
    bias = rate_across(mean, windows.accel[calm].mean(axis=0)) if len(rest) else 0.0
    row = int(signal.rows[windows.first[np.argmax(calm)] if bias > REST_RATE else k])
    if len(rest) >= 30 and (unit := _earth_rate_in(rest, size)):
        yield finding("error" if size > REST_RATE else "warning", imu, "gyro_unit", size)(
            f"at rest the mean rate is {size:.4g} rad/s, just the Earth's 15.04 deg/h in {unit}. "
            f"The gyro column is in {unit}; convert it to rad/s."
        )
    elif bias > REST_RATE or fastest[k] > FASTEST:
        most = bias if bias > REST_RATE else float(fastest[k])
        shown = (
            f"at rest the gyros read {most:.3g} rad/s ({np.rad2deg(most):.4g} deg/s) across gravity"
            if bias > REST_RATE
            else f"the gyros reach {most:.4g} rad/s ({np.rad2deg(most):.4g} deg/s)"
        )
        yield error(imu, "gyro_unit", most, row)(
            f"{shown}, too much for the gyro of a vehicle. The columns are not in rad/s; these "
            "numbers alone do not tell in what else (deg/s, mrad/s, counts). Take the unit from "
            "the data sheet, or compare a turn by a known angle."
        )


def _earth_rate_in(rest: np.ndarray, size: float) -> str:
    """Unit in which a steady mean rate at rest is the Earth's; "" if there is none.

    Means over one second must be steady too, as of gyros that can measure the Earth's rate: a
    low-cost one may have a bias of that size.
    """
    if np.linalg.norm(rest.std(axis=0)) > 0.01 * size:
        return ""
    for unit, factor in (("deg/s", 180.0 / np.pi), ("deg/h", 180.0 / np.pi * 3600.0)):
        if abs(size / (EARTH_RATE * factor) - 1.0) < 0.02:
            return unit
    return ""


_STUCK_S = 2.0
_STUCK_SAMPLES = 100
_STOPPED, _PILED = 5, 3.0  # samples at a limit, and their ratio to those just inside
_INSIDE = 4  # steps of a column; the outermost of a sine has no more samples than the next four
_FEW_STEPS = 16  # between the extremes; a coarser column cannot show a limit
_SHIFTED = 0.02  # m/s^2, smallest change of a mean that is reported
_COARSE = 64  # distinct values of a coarse column
_REPEATED = 0.4  # share of readings equal to the previous; 0.28 if sigma of the noise is one step
_FULL_SCALES = {
    "gyro": [np.deg2rad(v) for v in (125, 245, 250, 450, 500, 1000, 2000, 4000)],
    "accel": [9.80665 * v for v in (2, 4, 6, 8, 16, 24, 30, 32, 40)],
}


def check_columns(imu: ImuTable) -> Iterator[Finding]:
    """All findings about the six columns of an IMU table, each by itself."""
    if len(imu) < 2:
        return
    step_s = usual_step_s(imu.time_ns)
    for sensor in ("gyro", "accel"):
        triad = getattr(imu, sensor)
        fresh = np.concatenate([[True], np.diff(triad, axis=0).any(axis=1)])
        for k, axis in enumerate("xyz"):
            name, column = f"{sensor}_{axis}", triad[:, k]
            good = np.isfinite(column)
            if not good.all():
                yield _missing(imu, name, column, good)
            if np.count_nonzero(good) < 10:
                continue
            if np.ptp(column[good]) == 0.0:
                yield error(imu, "axis_stuck", float(column[good][0]))(
                    f"{name} is {column[good][0]:g} in every sample. A real sensor always has "
                    "noise: the axis is dead, not connected, or this is another column."
                )
                continue
            stops = list(_saturated(imu, name, column, good & fresh, step_s))
            yield from stops
            yield from _stuck(imu, name, column, step_s, {f.value for f in stops})
            yield from _coarse(imu, name, column, good)


def _missing(imu: ImuTable, name: str, column: np.ndarray, good: np.ndarray) -> Finding:
    first = int(np.argmin(good))
    bad = int(np.count_nonzero(~good))
    if bad == len(imu):
        return error(imu, "column_missing", bad)(
            f"{name} is {column[0]} in every sample. The sensor was not recorded, or the columns "
            "are in another order; without it there is no inertial navigation."
        )
    most = bad > 0.5 * len(imu)
    then = (
        "More than half of the log is lost: too little is left to navigate"
        if most
        else "A replay leaves those samples out and declares the gaps"
    )
    return (error if most else warning)(imu, "not_finite", bad, first)(
        f"{name} is {column[first]} here, and not a number in {bad} samples in all. The sensor or "
        f"the logger skipped them. {then}."
    )


def _stuck(
    imu: ImuTable, name: str, column: np.ndarray, step_s: float, stops: set[Value]
) -> Iterator[Finding]:
    start, length = longest_run((np.diff(column) == 0.0) & ~np.isin(column[1:], list(stops)))
    if length >= _STUCK_SAMPLES and length * step_s >= _STUCK_S:
        yield warning(imu, "axis_stuck_for_a_while", length, start)(
            f"{name} stays at {column[start]:g} for {length + 1} samples ({length * step_s:.1f} s) "
            "from here. The sensor or its bus hung; a filter would take this for a perfect "
            "measurement, so cut the log here or refuse these samples."
        )


def _saturated(
    imu: ImuTable, name: str, column: np.ndarray, readings: np.ndarray, step_s: float
) -> Iterator[Finding]:
    """Extremes of a column with many more readings than just inside of them, consecutive or not.

    An unsaturated signal has no more readings at its extreme than in the next few steps of the
    column: a sine of constant amplitude four fifths of them, noise far fewer.
    """
    sensor, unit = ("gyro", "rad/s") if name.startswith("gyro") else ("accel", "m/s^2")
    values = column[readings]
    distinct = np.unique(values)
    least = 1e-9 * np.abs(distinct).max()  # tolerance, since rotated axes make equal numbers differ
    steps = np.diff(distinct)
    step = float(np.median(steps[steps > least])) if np.any(steps > least) else np.inf
    if np.ptp(distinct) < _FEW_STEPS * step:
        return
    inside = max(_INSIDE * step, least)
    for extreme in (float(distinct[-1]), float(distinct[0])):
        away = np.abs(values - extreme)
        count, near = np.count_nonzero(away <= least), np.count_nonzero(away <= inside)
        scale = min(_FULL_SCALES[sensor], key=lambda scale: abs(abs(extreme) - scale))
        usual = abs(abs(extreme) / scale - 1.0) < 0.03
        share = count / len(values)
        # A value of most readings is no limit, as of a sensor without noise.
        if count < _STOPPED or count <= _PILED * (near - count) or not (usual or share < 0.5):
            continue
        stopped = np.abs(column - extreme) <= least
        range_ = f", a usual full scale ({scale:.4g} {unit})" if usual else ""
        shift = _shift(column, stopped, extreme, step_s) if sensor == "accel" else 0.0
        shift /= step_s if imu.kind == "increment" else 1.0
        lost = (
            f"Judged by its other side, that shifts the mean of {name} by {shift:+.2g} m/s^2 while "
            "it lasts, which a filter takes for a bias"
            if abs(shift) > _SHIFTED
            else "Expect a jump of attitude or velocity here"
        )
        yield warning(imu, "saturated", extreme, int(np.argmax(stopped)))(
            f"{name} stops at {extreme:.6g}{range_} in {count} readings ({share:.1%} of all), this "
            "one first. The sensor is saturated and the motion beyond is lost; choose a larger "
            f"range or damp the mounting. {lost}."
        )


def _shift(column: np.ndarray, stopped: np.ndarray, extreme: float, step_s: float) -> float:
    """Change of the mean due to clipping, over the seconds with clipping.

    A vibration is assumed symmetric about its median: the clipped part is that by which the other
    side exceeds the limit.
    """
    n = max(round(1.0 / step_s), 10)
    count = len(column) // n
    cut = stopped[: count * n].reshape(count, n).any(axis=1)
    part = column[: count * n].reshape(count, n)[cut]
    part = part[np.isfinite(part)]
    if not len(part):
        return 0.0
    middle = float(np.median(part))
    sign = np.sign(extreme - middle)
    beyond = sign * (middle - part) - abs(extreme - middle)
    return float(-sign * np.mean(np.maximum(beyond, 0.0)))


def _coarse(imu: ImuTable, name: str, column: np.ndarray, good: np.ndarray) -> Iterator[Finding]:
    values = column[good]
    if len(values) < 1000:
        return
    distinct = np.unique(values)
    # Noise of a step or more acts as dither: means of coarse numbers are then as good as others.
    if len(distinct) <= _COARSE and np.mean(np.diff(values) == 0.0) > _REPEATED:
        step = float(np.median(np.diff(distinct)))
        yield warning(imu, "coarse", step)(
            f"{name} takes only {len(distinct)} different values, {step:.3g} apart. The recording "
            "has too few bits or decimals; slow motion below one step is lost. Log with more "
            "digits or a smaller range."
        )
