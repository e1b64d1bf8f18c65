"""The doctor on the IMU alone: units by gravity, rates against increments, which way is up.

And on each of its columns: missing, stuck, saturated, coarse.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable
from robins.logs.findings import Finding
from robins.logs.quiet import (
    Signal,
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

G = 9.80665
EARTH_RATE = 7.292115e-5  # rad/s
_GRAVITY = (9.7, 9.9)  # m/s^2, every place where people live
_BIASED = 0.05  # share of gravity that a bad sensor may be off
_REST_RATE = 0.2  # rad/s (11 deg/s): more than the bias of almost any gyro
_FASTEST = 75.0  # rad/s (4300 deg/s): beyond the range of gyros for vehicles

UNITS = {
    1.0: ("g", "multiply by 9.80665"),
    1e3: ("milli-g", "multiply by 0.00980665"),
    100.0 * G: ("cm/s^2", "divide by 100"),
    1e3 * G: ("mm/s^2", "divide by 1000"),
    G / 0.3048: ("ft/s^2", "multiply by 0.3048"),
}


def check_imu(imu: ImuTable, in_vehicle: bool = True) -> Iterator[Finding]:
    """All findings about the IMU's units and axes that need no other sensor.

    Args:
        imu: the table.
        in_vehicle: a vehicle has a top, so gravity must lie along z; a sensor by itself has none.
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
    yield from _up(imu, windows) if in_vehicle else _free(imu, windows)
    if not any(f.code in ("rates_as_increments", "increments_as_rates") for f in of_force):
        yield from _rates(imu, signal, windows)


def _gravity(imu: ImuTable, signal: Signal, windows: Windows) -> Iterator[Finding]:
    size = np.linalg.norm(windows.accel[windows.calm], axis=-1)
    measured = float(np.median(size))
    row = int(signal.rows[windows.first[np.flatnonzero(windows.calm)[0]]])
    where = "at rest" if windows.at_rest.any() else "at its calmest (it never rests)"
    if _GRAVITY[0] <= measured <= _GRAVITY[1]:
        return
    if abs(measured / G - 1.0) < _BIASED:
        yield note(imu, "gravity_bias", measured, row)(
            f"{where} the specific force is {measured:.3f} m/s^2, gravity is 9.76 to 9.83. The "
            f"unit is right; the accelerometers are off by {measured - 9.8:+.2f} m/s^2 "
            f"({(measured - 9.8) / G * 1e3:+.0f} mg), usual for cheap sensors. Begin the filter "
            "with a bias sigma of at least that."
        )
        return
    causes = [*_rates_for_increments(imu, signal.step_s), *_unit_causes(measured)]
    causes = [*_increments_for_rates(imu, signal.step_s, measured), *causes]
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


_READINGS = ((G, "m/s^2", "m/s"), (1.0, "g", "g s"))


def _rates_for_increments(imu: ImuTable, step_s: float) -> Iterator[tuple[str, str]]:
    """Rates taken for increments: gravity shows before anything is divided by time."""
    raw = signal_of(dataclasses.replace(imu, kind="rate"))
    if imu.kind == "rate" or raw is None:
        return
    windows = windows_of(raw)
    measured = float(np.median(np.linalg.norm(windows.accel[windows.calm], axis=-1)))
    for scale, unit, _ in _READINGS:
        if _near(measured, scale):
            yield (
                "rates_as_increments",
                f"The rows are rates in {unit}, not increments over {step_s * 1e3:.4g} ms: "
                f"multiply accelerations{_g_word(unit)} and angular rates by that time, or name a "
                "format of rates",
            )


def _increments_for_rates(
    imu: ImuTable, step_s: float, measured: float
) -> Iterator[tuple[str, str]]:
    """Increments taken for rates: gravity shows as what it adds up to over one step."""
    for scale, unit, summed in _READINGS:
        if imu.kind == "rate" and _near(measured, scale * step_s):
            yield (
                "increments_as_rates",
                f"The rows are increments over {step_s * 1e3:.4g} ms in {summed}, not rates: "
                f"divide both sensors by that time{_g_word(unit)}, or name a format of increments",
            )


def _g_word(unit: str) -> str:
    return " (and the accelerations by 9.80665)" if unit == "g" else ""


def _unit_causes(measured: float) -> list[tuple[str, str]]:
    return [
        ("gravity_unit", f"The unit is probably {unit}: {mend}")
        for value, (unit, mend) in UNITS.items()
        if _near(measured, value)
    ]


def _near(measured: float, expected: float) -> bool:
    return abs(measured / expected - 1.0) < _BIASED


def _direction(windows: Windows) -> np.ndarray:
    """(3,) of the specific force when it is calm."""
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
    """The sign of gravity along z: specific force at rest points up."""
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


def _rates(imu: ImuTable, signal: Signal, windows: Windows) -> Iterator[Finding]:
    """Angular rates that no vehicle has, and the Earth's rate in another unit."""
    fastest = np.linalg.norm(signal.gyro, axis=-1)
    k = int(np.argmax(fastest))
    calm = windows.at_rest & (windows.restless <= np.percentile(windows.restless, 25))
    rest = windows.gyro[calm] if calm.any() else windows.gyro[:0]
    mean = rest.mean(axis=0) if len(rest) else np.zeros(3)
    size = float(np.linalg.norm(mean))
    if len(rest) >= 30 and (unit := _earth_rate_in(rest, size)):
        yield finding("error" if size > _REST_RATE else "warning", imu, "gyro_unit", size)(
            f"at rest the mean rate is {size:.4g} rad/s, just the Earth's 15.04 deg/h in {unit}. "
            f"The gyro column is in {unit}; convert it to rad/s."
        )
    elif size > _REST_RATE or fastest[k] > _FASTEST:
        first = windows.first[np.flatnonzero(calm)[0]] if size > _REST_RATE else k
        row = int(signal.rows[first])
        most = max(size, float(fastest[k]))
        shown = (
            f"at rest the gyros show {size:.3g} rad/s ({np.rad2deg(size):.0f} deg/s)"
            if size > _REST_RATE
            else f"the gyros reach {most:.4g} rad/s ({np.rad2deg(most):.0f} deg/s)"
        )
        # More than 4500 deg/s is beyond the range of gyros as well, so then it is deg/h.
        unit, mend = ("deg/s", "pi/180") if most < 4500.0 else ("deg/h", "pi/180/3600")
        yield error(imu, "gyro_unit", most, row)(
            f"{shown}, too much for the gyro of a vehicle. The columns are probably in {unit}: "
            f"multiply by {mend}."
        )


def _earth_rate_in(rest: np.ndarray, size: float) -> str:
    """The unit in which a steady mean rate at rest is the Earth's; empty if in none."""
    scatter = rest.std(axis=0) / np.sqrt(len(rest))
    if np.linalg.norm(scatter) > 0.01 * size:
        return ""
    for unit, factor in (("deg/s", 180.0 / np.pi), ("deg/h", 180.0 / np.pi * 3600.0)):
        if abs(size / (EARTH_RATE * factor) - 1.0) < 0.02:
            return unit
    return ""


_STUCK_S = 2.0
_STUCK_SAMPLES = 100
_SATURATED_RUN, _SATURATED_LONG = 3, 10
_COARSE = 64  # distinct values of a column
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
        for k, axis in enumerate("xyz"):
            name, column = f"{sensor}_{axis}", getattr(imu, sensor)[:, k]
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
            yield from _stuck(imu, name, column, step_s)
            yield from _saturated(imu, sensor, name, column, good)
            yield from _coarse(imu, name, column, good)


def _missing(imu: ImuTable, name: str, column: np.ndarray, good: np.ndarray) -> Finding:
    first = int(np.argmin(good))
    bad = int(np.count_nonzero(~good))
    if bad == len(imu):
        return error(imu, "column_missing", bad)(
            f"{name} is {column[0]} in every sample. The sensor was not recorded, or the columns "
            "are in another order; without it there is no inertial navigation."
        )
    return warning(imu, "not_finite", bad, first)(
        f"{name} is {column[first]} here, and not a number in {bad} samples in all. The sensor or "
        "the logger skipped them; `clean` refuses those samples and declares the gaps."
    )


def _stuck(imu: ImuTable, name: str, column: np.ndarray, step_s: float) -> Iterator[Finding]:
    start, length = longest_run(np.diff(column) == 0.0)
    if length >= _STUCK_SAMPLES and length * step_s >= _STUCK_S:
        yield warning(imu, "axis_stuck_for_a_while", length, start)(
            f"{name} stays at {column[start]:g} for {length + 1} samples ({length * step_s:.1f} s) "
            "from here. The sensor or its bus hung; a filter would take this for a perfect "
            "measurement, so cut the log here or refuse these samples."
        )


def _saturated(
    imu: ImuTable, sensor: str, name: str, column: np.ndarray, good: np.ndarray
) -> Iterator[Finding]:
    values = column[good]
    middle = np.median(values)
    # A stop is an extreme met several times in a row that is far from the bulk, or held for long;
    # a coarse column holds its extremes for long without being stopped.
    fine = len(np.unique(values)) > _COARSE
    spread = np.subtract(*np.percentile(values, [95, 5])) / 3.3 + 1e-300
    for extreme in (float(values.max()), float(values.min())):
        start, length = longest_run(column == extreme)
        far = abs(extreme - middle) > 4.0 * spread
        if length < (_SATURATED_RUN if far else _SATURATED_LONG) or not (far or fine):
            continue
        total = int(np.count_nonzero(column == extreme))
        near = min(_FULL_SCALES[sensor], key=lambda scale: abs(abs(extreme) - scale))
        unit = "rad/s" if sensor == "gyro" else "m/s^2"
        usual = abs(abs(extreme) / near - 1.0) < 0.03
        range_ = f", a usual full scale ({near:.4g} {unit})" if usual else ""
        yield warning(imu, "saturated", extreme, start)(
            f"{name} stops at {extreme:.6g}{range_} in {total} samples, {length} in a row here. "
            "The sensor is saturated and the motion beyond is lost; choose a larger range or damp "
            "the mounting, and expect a jump of attitude or velocity here."
        )


def _coarse(imu: ImuTable, name: str, column: np.ndarray, good: np.ndarray) -> Iterator[Finding]:
    values = column[good]
    if len(values) < 1000:
        return
    distinct = np.unique(values)
    if len(distinct) <= _COARSE:
        step = float(np.median(np.diff(distinct)))
        yield warning(imu, "coarse", step)(
            f"{name} takes only {len(distinct)} different values, {step:.3g} apart. The recording "
            "has too few bits or decimals; slow motion below one step is lost. Log with more "
            "digits or a smaller range."
        )
