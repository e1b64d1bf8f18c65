"""Writing of a table as a text log of any format, with numbers that read back unchanged."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from decimal import Decimal

import numpy as np

from robins import rotation
from robins.dataset import (
    AttitudeTable,
    Dataset,
    GnssTable,
    ImuTable,
    MagTable,
    OdometryTable,
    Trajectory,
)
from robins.ins.frames import swap
from robins.logs.findings import AnyPath, LogError, refused
from robins.logs.mounting import Origin, to_local
from robins.logs.opening import write_lines
from robins.logs.quantities import DATES, parts, words_of
from robins.logs.tables import Table, kind_in_text, place_of, tables_of
from robins.logs.text_format import ANY, PAIRS, Axes, Column, TextFormat, tick_of
from robins.logs.timebase import GPS_EPOCH_NS, WEEK_NS, ns_to_decimal
from robins.units import from_si, unit

_CLOCKS = ("time", "time_of_week")
_ROWS = 50_000
_STEEP = 1.5  # rad of pitch; closer to the vertical, roll and heading lose digits
Values = dict[str, np.ndarray]  # by quantity, SI
Groups = dict[str, np.ndarray | None]
Cells = tuple[np.ndarray, Column]


def write_text(
    format: TextFormat,
    path: AnyPath,
    table: Table | Dataset,
    *,
    week: int | None = None,
    origin: Origin | None = None,
) -> None:
    """Write a log of this format; arguments as in `robins.logs.write_log`.

    Raises:
        LogError: the format does not hold such a table, or the file cannot be written.
    """
    dated = any(
        c.unit in DATES or (c.offset and c.holds in _CLOCKS) or c.where[0] for c in format.columns
    )
    if dated or format.stated or format.rate_hz or format.decimal != ".":
        cause = f"{format.name} has a rate, constants, dates, decimal commas or rows of one sensor"
        raise LogError(str(path), cause, "such a format is only read; choose another")
    tables = tables_of(table)
    for one in tables:
        _check(format, path, one)
    if format.local and origin is None:
        origin = next(Origin.of(one) for one in tables if isinstance(one, Trajectory))
    time_ns, values = _together(format, path, [(t, _values(format, t, origin)) for t in tables])
    written = values.keys() | {"time", "time_of_week", "week"}
    columns = [c for c in format.columns if not format.choice or c.holds in written]
    held = [values[c.holds] for c in columns if c.holds in values]
    good = np.all([np.isfinite(v) for v in held], axis=0)
    if format.whole and not good.all():
        at, cause = ns_to_decimal(int(time_ns[np.argmin(good)])), "cannot hold a missing component"
        remedy = "leave out the rows that are not complete"
        raise refused(str(path), f"time {at} s")(f"{format.name} {cause}", remedy)
    comments = []
    if format.states_frames:
        said = (getattr(tables[0], which, "") for which in ("nav", "body"))
        comments.append(f"# frames: {' '.join(filter(None, said))}")
    if origin is not None and format.local:
        comments.append("# origin: {!r} deg, {!r} deg, {!r} m".format(*map(float, origin)))
    write_lines(path, _blocks(format, comments, columns, _cells(columns, time_ns, values, week)))


def _check(format: TextFormat, path: AnyPath, table: Table) -> None:
    """Refuse a table that the format cannot hold."""
    kind = kind_in_text(table)
    if kind not in format.kinds:
        held = " and ".join(map(words_of, format.kinds))
        cause = f"{format.name} holds {held}, not {words_of(kind)}"
        raise LogError(str(path), cause, "choose another format")
    if isinstance(table, ImuTable):
        wanted, other, remedy = {
            "rate": ("gyro_x", "increment", "integrate them first"),
            "increment": ("dtheta_x", "rate", "divide them by their dt first"),
        }[table.kind]
        if wanted not in format.quantities:
            cause = f"{format.name} wants {other}s, these are {table.kind}s"
            raise LogError(str(path), cause, remedy)
    if format.states_frames:
        if isinstance(table, Trajectory) and (table.nav, table.body) not in PAIRS:
            cause = f"frames {table.nav} and {table.body} do not belong together"
            raise LogError(str(path), cause, "convert the table first")
        return
    body = "RFU" if format.body == "RFU" else "FRD"
    nav = format.nav if isinstance(table, Trajectory | AttitudeTable | GnssTable) else None
    for what, has, wants in (
        ("body", getattr(table, "body", body), body),
        ("nav", getattr(table, "nav", nav), "NED" if isinstance(table, GnssTable) else nav),
    ):
        if has != wants and not (format.local and what == "nav"):
            cause = f"{format.name} wants {what} frame {wants}, this table is in {has}"
            raise LogError(str(path), cause, "convert the table first")


def _groups(format: TextFormat, table: Table, origin: Origin | None) -> Groups:
    """Groups of quantities of a table; None for missing ones."""
    if isinstance(table, MagTable):
        return {"mag": table.field_t}
    if isinstance(table, OdometryTable):
        return {"wheels": np.stack([table.speed_mps, table.sigma_speed], axis=-1)}
    if isinstance(table, AttitudeTable):
        return _turned(format, table.q_nb, table.nav)
    if isinstance(table, Trajectory):
        return _path(format, table, origin)
    if isinstance(table, GnssTable):
        quality = None if table.quality is None else np.asarray(table.quality, float)[:, None]
        moving = {"velocity": table.v_n, "sigma_v": table.sigma_v}
        return {"place": place_of(table), "sigma": table.sigma_m, **moving, "quality": quality}
    if table.kind == "rate":
        return {"gyro": table.gyro, "accel": table.accel}
    elapsed = np.diff(table.time_ns) * 1e-9
    # the first row has no previous row; use the usual interval
    usual = [np.median(elapsed) if len(elapsed) else np.nan]
    dt = np.concatenate([usual, elapsed])[: len(table), None]
    return {"dtheta": table.gyro, "dv": table.accel, "dt": dt}


def _values(format: TextFormat, table: Table, origin: Origin | None) -> Values:
    groups = _groups(format, table, origin)
    if format.body not in ("FRD", "RFU"):
        axes = Axes.of(format.body)
        for group in set(groups) & {"gyro", "accel", "dtheta", "dv", "mag", "omega"}:
            if (v := groups[group]) is not None:
                groups[group] = axes.from_frd(v)
    return {
        quantity: column
        for group, v in groups.items()
        if v is not None
        for quantity, column in zip(parts(group), np.asarray(v).T, strict=True)
    }


def _path(format: TextFormat, table: Trajectory, origin: Origin | None) -> Groups:
    if format.local and origin is not None:
        local, omega = to_local(table, origin), {"omega": table.omega_ib_b}
        moving = {"velocity": swap(local.v_l), "quaternion": local.q_lb}
        return {"local": local.r_l} | moving | omega
    v_n = np.asarray(table.v_n)
    v_n = swap(v_n) if table.nav == "ENU" else v_n
    moving = {"velocity": v_n, "omega": table.omega_ib_b}
    return {"place": place_of(table)} | moving | _turned(format, table.q_nb, table.nav)


def _turned(format: TextFormat, q_nb: np.ndarray, nav: str) -> Groups:
    """Attitudes as angles, or quaternions if the format has them and angles would lose digits."""
    if "roll" not in format.quantities:
        return {"quaternion": q_nb}
    # roll, pitch and heading are the same in both pairs of frames
    roll, pitch, heading = rotation.to_euler(q_nb)
    angles = np.stack([roll, pitch, np.mod(heading, 2.0 * np.pi)], axis=-1)
    steep = np.nanmax(np.abs(angles[:, 1]), initial=0.0) > _STEEP
    if "q_w" in format.quantities and (nav == "ENU" or steep):
        return {"quaternion": q_nb}
    return {"euler": angles}


def _together(
    format: TextFormat, path: AnyPath, parts_: list[tuple[Table, Values]]
) -> tuple[np.ndarray, Values]:
    """Stamps and values of all tables, row by row."""
    times = [table.time_ns for table, _ in parts_]
    if all(np.array_equal(t, times[0]) for t in times):
        return times[0], {q: v for _, values in parts_ for q, v in values.items()}
    if not format.sparse:
        cause = f"{format.name} has one time for all, these tables have different times"
        raise LogError(str(path), cause, "write them to files of their own")
    stamps = np.concatenate(times)
    order = np.argsort(stamps, kind="stable")
    ends = np.cumsum([0, *map(len, times)])
    out: Values = {}
    for k, (_, values) in enumerate(parts_):
        for quantity, v in values.items():
            column = np.full(len(stamps), np.nan)
            column[ends[k] : ends[k + 1]] = v
            out[quantity] = column[order]
    return stamps[order], out


def _cells(
    columns: list[Column], time_ns: np.ndarray, values: Values, week: int | None
) -> dict[int, Cells]:
    """Columns by index from 0: texts unchanged, integers of a week or nanoseconds, floats."""
    absolute = len(time_ns) > 0 and bool(time_ns[0] >= GPS_EPOCH_NS)
    since_ns = time_ns - GPS_EPOCH_NS if absolute else time_ns
    weeks = since_ns // WEEK_NS + (0 if absolute else week or 0)
    if any(column.holds == "week" for column in columns):
        of_week_ns = since_ns % WEEK_NS
    elif absolute:
        of_week_ns = since_ns - (since_ns[0] // WEEK_NS if week is None else week) * WEEK_NS
    else:
        of_week_ns = time_ns
    stamps = {"time": time_ns, "time_of_week": of_week_ns, "week": weeks}
    missing = np.full(len(time_ns), np.nan)
    out: dict[int, Cells] = {}
    names: dict[str, int] = {}
    for column in columns:
        place = names.setdefault(column.name, column.place - 1 if column.place else len(names))
        if column.holds in stamps:
            out[place] = (stamps[column.holds], column)
        elif place not in out:
            in_units = from_si(values.get(column.holds, missing), unit(column.unit))
            exact = column.scale == 1.0 and column.offset == 0.0
            scaled = in_units if exact else (in_units - column.offset) / column.scale + 0.0
            out[place] = (scaled, column)
    return out


def _blocks(
    format: TextFormat, comments: list[str], columns: list[Column], cells: dict[int, Cells]
) -> Iterator[str]:
    separator = format.separator
    if format.named:
        names = [column.names[0] for _, (_, column) in sorted(cells.items())]
        line = separator.join(name for name in names if name != ANY)
        header = f"#{' ' if separator == ' ' else ''}{line}" if format.commented else line
        comments = [header, *comments] if format.commented else [*comments, header]
    else:
        comments = comments + ["#"] * format.skip
    yield "".join(f"{comment}\n" for comment in comments)
    width = 1 + max(cells)
    rows = len(cells[min(cells)][0])
    for start in range(0, rows, _ROWS):
        block = slice(start, start + _ROWS)
        texts = [
            _texts(cells[k], block) if k in cells else itertools.repeat("nan") for k in range(width)
        ]
        count = min(_ROWS, rows - start)
        lines = itertools.islice(zip(*texts, strict=False), count)
        yield "".join(f"{separator.join(line)}\n" for line in lines)


def _texts(cells: Cells, block: slice) -> list[str]:
    values, column = cells
    numbers = values[block].tolist()
    if column.holds in _CLOCKS:
        exponent, count = tick_of(column, column.unit)
        if count == 1 and exponent >= 0:
            return [ns_to_decimal(ns, exponent) for ns in numbers]
        return [str(Decimal(ns).scaleb(-exponent) / count) for ns in numbers]
    return list(map(str if column.holds == "week" else repr, numbers))
