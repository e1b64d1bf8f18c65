"""Checks of a magnetometer: unit, missing, zero, stuck, saturated and repeated values, iron.

The Earth's field is 20 to 70 uT everywhere on the ground, so its magnitude reveals the unit, and a
magnitude that varies with direction reveals iron or magnets fixed to the sensor.

The field is constant, so in sensor axes it must rotate as the gyros measure, m(t + dt) = C' m(t).
Magnetometers are often separate chips with other axes than the gyros. Each permutation of the
columns with signs is tried, with an offset (hard iron) of its own; a field and its opposite rotate
alike, so of each pair only the right-handed one is tried.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable, MagTable
from robins.ins.plausible import EARTH_FIELD_T, FIELD_UNITS
from robins.logs.checks_motion import SCALES, words_of
from robins.logs.findings import Finding, Severity
from robins.logs.limits import FIELD_LIMIT_T, few_beyond
from robins.logs.motion import (
    ImuSignal,
    TurnSteps,
    at,
    signed_permutations,
    steps_of,
    turned_over,
)
from robins.logs.ordering import increasing
from robins.logs.quiet import error, finding, longest_run, note, signal_of, usual_step_s, warning

_FEW = 10  # fewest samples for any check
_STUCK_S, _STUCK_SAMPLES = 2.0, 100
_STOP_T = 80e-6  # limits below this, near the Earth's field, are no end of a range
_STOPPED = 3  # successive different readings at the same extreme
_REPEATED = 0.2  # share of rows that repeat the previous one
_SPREAD = 0.25  # of the magnitude, between its 5th and 95th percentiles
_FAR = 0.3  # deviation of a disturbed sample, in usual magnitudes
_TURNED = 0.02  # smallest spread of directions that determines a centre
_STRONGEST = 5.0  # hard iron, in usual magnitudes
_WRONG, _RIGHT, _BETTER = 0.4, 0.15, 0.25  # shares of the change not explained by the gyros

# Power of ten by which the numbers are too large -> severity, cause, remedy.
_SHIFTS: dict[int, tuple[Severity, str, str]] = {
    **{
        shift: ("error", f"The numbers are probably in {unit}", f"{fix} for tesla")
        for shift, (unit, fix) in FIELD_UNITS.items()
    },
    3: ("error", "They are probably in nT where uT is said, or uT where mT", "divide by 1000"),
    2: ("error", "They are probably in uT where gauss is said", "divide by 100"),
    1: ("warning", "They may be in mG where uT is said, or a magnet is near", "divide by 10"),
    -1: ("warning", "They may be in uT where mG is said, or it is shielded", "multiply by 10"),
    -2: ("error", "They are probably in gauss where uT is said", "multiply by 100"),
    -3: ("error", "They are probably in uT where nT is said, or mT where uT", "multiply by 1000"),
}


def check_mag(mag: MagTable) -> Iterator[Finding]:
    """All findings about a table of magnetic field by itself, except its stamps."""
    good = np.asarray(np.isfinite(mag.field_t).all(axis=1))
    if not good.all():
        yield _missing(mag, good)
    good &= ~few_beyond(mag.field_t, FIELD_LIMIT_T)
    if np.count_nonzero(good) < _FEW:
        return
    zero = good & (np.linalg.norm(mag.field_t, axis=1) == 0.0)
    if zero.any():
        yield _zero(mag, np.asarray(zero))
    rows = np.flatnonzero(good & ~zero)
    if len(rows) < _FEW:
        return
    field = mag.field_t[rows]
    size = np.linalg.norm(field, axis=1)
    dead = [axis for axis, column in zip("xyz", field.T, strict=True) if np.ptp(column) == 0.0]
    if dead:
        yield _dead(mag, dead, field[0])
    of_unit = list(_unit(mag, float(np.median(size))))
    yield from of_unit
    fresh = np.concatenate([[True], np.diff(field, axis=0).any(axis=1)])
    yield from _stuck(mag, rows, fresh)
    yield from _repeated(mag, fresh)
    if not of_unit:
        yield from _stopped(mag, rows, fresh)
        if not dead:
            yield from _iron(mag, rows, field, size)


def _missing(mag: MagTable, good: np.ndarray) -> Finding:
    first, bad = int(np.argmin(good)), int(np.count_nonzero(~good))
    lacking = [a for a, c in zip("xyz", mag.field_t.T, strict=True) if not np.isfinite(c).any()]
    whole = f"; of {', '.join(f'field_{a}' for a in lacking)} there is nothing at all"
    return warning(mag, "field_missing", bad, first)(
        f"{bad} of {len(mag)} samples ({bad / len(mag):.1%}) of the magnetic field are not numbers"
        f"{whole if lacking else ', this one first'}. What is missing is not used; heading is held "
        "by the gyros meanwhile."
    )


def _zero(mag: MagTable, zero: np.ndarray) -> Finding:
    count = int(np.count_nonzero(zero))
    everywhere = count == len(mag)
    severity = "error" if everywhere else "warning"
    return finding(severity, mag, "field_zero", count, int(np.argmax(zero)))(
        f"the magnetic field is exactly 0 0 0 in {count} of {len(mag)} samples"
        f"{'' if everywhere else ', this one first'}. The sensor was not connected or not yet "
        "measuring; write nan there, for a field of zero has no direction."
    )


def _dead(mag: MagTable, axes: list[str], field: np.ndarray) -> Finding:
    value = float(field["xyz".index(axes[0])])
    return error(mag, "field_stuck", value)(
        f"field_{', field_'.join(axes)} never changes ({value * 1e6:.4g} uT in every sample). A "
        "real sensor always has noise: the axis is dead, or this is another column."
    )


def _unit(mag: MagTable, size: float) -> Iterator[Finding]:
    shown = f"the magnetic field is {size * 1e6:.4g} uT strong where the Earth's is 20 to 70"
    for shift, (severity, cause, remedy) in _SHIFTS.items():
        if EARTH_FIELD_T[0] <= size / 10.0**shift <= EARTH_FIELD_T[1]:
            yield finding(severity, mag, "field_unit", size)(f"{shown}. {cause}: {remedy}.")
            return
    # The field of iron in a low-cost casing is often stronger than the Earth's.
    if not EARTH_FIELD_T[0] / 2 <= size <= 10 * EARTH_FIELD_T[1]:
        yield error(mag, "field_unit", size)(
            f"{shown}, and no usual unit makes it that. These are counts of a converter, or other "
            "columns."
        )


def _stuck(mag: MagTable, rows: np.ndarray, fresh: np.ndarray) -> Iterator[Finding]:
    start, length = longest_run(~fresh)
    step_s = usual_step_s(mag.time_ns)
    if length >= _STUCK_SAMPLES and length * step_s >= _STUCK_S:
        yield warning(mag, "field_stuck_for_a_while", length, int(rows[max(start - 1, 0)]))(
            f"the magnetic field does not change at all for {length + 1} samples "
            f"({length * step_s:.1f} s) from here. The sensor or its bus hung; a filter would take "
            "this for a perfect measurement, so write nan there."
        )


def _repeated(mag: MagTable, fresh: np.ndarray) -> Iterator[Finding]:
    share = 1.0 - float(fresh.mean())
    if share > _REPEATED and fresh.sum() > _FEW:
        rate = 1.0 / usual_step_s(mag.time_ns)
        yield note(mag, "field_repeated", share)(
            f"{share:.0%} of the samples of the magnetic field repeat the one before: the sensor "
            f"measures about {rate * (1.0 - share):.3g} times a second, the log has {rate:.4g} "
            "rows a second. The noise of one row is that of fewer measurements than it seems."
        )


def _stopped(mag: MagTable, rows: np.ndarray, fresh: np.ndarray) -> Iterator[Finding]:
    """Saturation: successive different readings at an extreme beyond the Earth's field."""
    readings = np.flatnonzero(fresh)
    field = mag.field_t[rows[readings]]
    for axis, column in zip("xyz", field.T, strict=True):
        for extreme in (float(column.max()), float(column.min())):
            start, length = longest_run(column == extreme)
            if abs(extreme) < _STOP_T or length < _STOPPED:
                continue
            total = int(np.count_nonzero(column == extreme))
            yield warning(mag, "field_saturated", extreme, int(rows[readings[start]]))(
                f"field_{axis} stops at {extreme * 1e6:.6g} uT in {total} readings, {length} in a "
                "row here, while the others go on. The sensor is saturated by a magnet or iron; "
                "what it shows there has neither size nor direction of the field."
            )


def _iron(
    mag: MagTable, rows: np.ndarray, field: np.ndarray, size: np.ndarray
) -> Iterator[Finding]:
    """Varying magnitude: hard iron if another centre steadies it, else soft iron or places."""
    usual = float(np.median(size))
    low, high = np.percentile(size, [5, 95])
    off = np.abs(size / usual - 1.0) > _FAR
    shown = f"between {low * 1e6:.3g} and {high * 1e6:.3g} uT (of 90 % of the samples)"
    centre = _centre(field / usual)
    if centre is not None:
        left = np.linalg.norm(field / usual - centre, axis=1)
        steadied = left.std() / left.mean() < 0.5 * size.std() / size.mean()
        if steadied and np.linalg.norm(centre) > 0.1:
            offset = ", ".join(f"{c:+.1f}" for c in centre * usual * 1e6)
            yield warning(mag, "field_offset", float(np.linalg.norm(centre)) * usual)(
                f"the size of the magnetic field changes while the sensor turns, {shown}, and it "
                f"hardly would without an offset of ({offset}) uT. That is hard iron: run "
                "`robins calibrate` on a log in which the sensor is turned all about, or heading "
                "errs by several degrees."
            )
            return
    if (high - low) / usual > _SPREAD:
        yield warning(mag, "field_varies", float((high - low) / usual))(
            f"the size of the magnetic field changes {shown}. That is hard or soft iron that turns "
            "with the sensor, for which run `robins calibrate`; or it was carried past steel and "
            "magnets, against which only a filter helps that refuses such samples."
        )
    elif off.any():
        yield note(mag, "field_disturbed", float(off.mean()), int(rows[np.argmax(off)]))(
            f"the magnetic field is {_FAR:.0%} weaker or stronger than usual in "
            f"{np.count_nonzero(off)} samples ({off.mean():.1%}), this one first. Steel or a "
            "magnet was near; a filter should not take its heading from them."
        )


def _centre(field: np.ndarray) -> np.ndarray | None:
    """Least-squares centre of a sphere through points (n, 3); None if directions hardly vary."""
    direction = field / np.linalg.norm(field, axis=1, keepdims=True)
    if np.linalg.eigvalsh(np.cov(direction.T))[0] < _TURNED:
        return None
    # |m - c|^2 = r^2 is linear in c and in r^2 - |c|^2.
    known = np.column_stack([2.0 * field, np.ones(len(field))])
    return np.linalg.lstsq(known, np.sum(field * field, axis=1), rcond=None)[0][:3]


def check_mag_axes(imu: ImuTable, mag: MagTable) -> Iterator[Finding]:
    """Findings about a field that does not rotate as the gyros do; none with little rotation."""
    signal = signal_of(imu)
    if signal is None or mag.body != imu.body:
        return
    time_s, field = _readings(mag, int(imu.time_ns[signal.rows[0]]))
    other = list(_other_gyros(imu, mag, signal, time_s, field))
    yield from other
    steps = steps_of(signal, time_s)
    if other or steps is None:
        return
    maps = signed_permutations(proper=True)
    left = _left_over(time_s, field, steps, maps)
    k = int(np.argmin(left))
    if left[0] < _WRONG or left[k] > min(_RIGHT, _BETTER * left[0]):
        return
    yield error(mag, "field_axes", float(left[0]))(
        f"the magnetic field does not turn as the gyros say ({left[0]:.0%} of its change is left "
        f"over), but it does ({left[k]:.0%}) with the columns {words_of(maps[k], 'field')}, or all "
        "three of these reversed. The magnetometer is mounted otherwise than the gyros: exchange "
        "its columns so."
    )


def _other_gyros(
    imu: ImuTable, mag: MagTable, signal: ImuSignal, time_s: np.ndarray, field: np.ndarray
) -> Iterator[Finding]:
    """Finding about rates of the opposite sense or in another unit, by the turning of the field.

    A unit that was turned slowly, about one axis, is enough: both differ from what it is by far.
    """
    for factor in (-1.0, *SCALES):
        scaled = signal._replace(gyro=factor * signal.gyro)
        steps = steps_of(scaled, time_s, slow=True)
        if steps is None:
            continue
        given = turned_over(signal, steps.begin_s, steps.end_s)
        left, before = (
            float(_left_over(time_s, field, s, np.eye(3)[None])[0]) for s in (steps, given)
        )
        if before < _WRONG or left > min(_RIGHT, _BETTER * before):
            continue
        shown = (
            f"the magnetic field does not turn as the gyros say ({min(before, 1.0):.0%} of its "
            f"change is left over), but it does ({left:.0%})"
        )
        if factor < 0.0:
            yield error(mag, "field_turns_back", before)(
                f"{shown} if they have the opposite sense: a gyro about an axis that it was turned "
                "about has the wrong sign, or axes of the magnetometer are exchanged or reversed. "
                "Compare both with the data sheet."
            )
        else:
            unit, fix = SCALES[factor]
            yield error(imu, "gyro_unit", factor)(
                f"{shown} if the rates are multiplied by {factor:.4g}. The gyro columns are "
                f"probably {unit}: {fix}."
            )
        return


def _readings(mag: MagTable, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and directions of the field, each reading once and in order."""
    good = np.isfinite(mag.field_t).all(axis=1) & (np.linalg.norm(mag.field_t, axis=1) > 0.0)
    good &= ~few_beyond(mag.field_t, FIELD_LIMIT_T)
    rows = np.flatnonzero(good)
    rows = rows[increasing(mag.time_ns[rows])]
    field = mag.field_t[rows]
    fresh = np.concatenate([[True], np.diff(field, axis=0).any(axis=1)])[: len(rows)]
    field = field[fresh]
    size = np.median(np.linalg.norm(field, axis=1)) if len(field) else 1.0
    return (mag.time_ns[rows[fresh]] - start_ns) * 1e-9, field / size


def _left_over(
    time_s: np.ndarray, field: np.ndarray, steps: TurnSteps, maps: np.ndarray
) -> np.ndarray:
    """Share (h,) of the change of the field not explained by each map with its best offset.

    A rotation too small for the change would fit about a centre far away: no iron is that strong.
    """
    before, after = (at(when, time_s, field) for when in (steps.begin_s, steps.end_s))
    turn = np.swapaxes(steps.C, 1, 2)
    rest = np.einsum("hij,nj->hni", maps, after)
    rest = rest - np.einsum("nij,hjk,nk->hni", turn, maps, before, optimize=True)
    by_offset = (np.eye(3) - turn).reshape(-1, 3)
    flat = rest.reshape(len(maps), -1).T
    offset = np.linalg.lstsq(by_offset, flat, rcond=1e-3)[0]
    offset *= np.linalg.norm(offset, axis=0) < _STRONGEST
    return np.sum((flat - by_offset @ offset) ** 2, axis=0) / np.sum((after - before) ** 2)
