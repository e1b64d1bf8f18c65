"""Reading of text logs of any format: columns become tables in SI units."""

from __future__ import annotations

import re
from dataclasses import replace
from decimal import Decimal
from typing import Any, Literal, NamedTuple

import numpy as np

from robins import rotation
from robins.dataset import (
    AttitudeTable,
    BodyFrame,
    Dataset,
    GnssTable,
    ImuTable,
    MagTable,
    NavFrame,
    OdometryTable,
    Trajectory,
)
from robins.ins.frames import swap, swap_q
from robins.logs.archives import head_of, rows_of
from robins.logs.findings import AnyPath, Findings, LogError, finding_reporter, refused
from robins.logs.merging import interpolated
from robins.logs.mounting import LocalPath, Origin, from_local
from robins.logs.quantities import CLOCKS, DATES, QUANTITIES, TABLES, parts, words_of
from robins.logs.tables import Table, kind_of, stem_of, unit_quaternions
from robins.logs.text import COMMENTS, Columns, Head, TextLayout, read_columns
from robins.logs.text_format import (
    PAIRS,
    Axes,
    Column,
    ColumnHeader,
    FoundColumn,
    TextFormat,
    columns_of,
    header_of,
    tick_of,
)
from robins.logs.timebase import (
    LIMIT_NS,
    WEEK_NS,
    dates_to_ns,
    stamps_to_ns,
    unrolled,
    weeks_of,
)
from robins.units import from_si, to_si, unit

NOWHERE = Origin(0.0, 0.0, 0.0)
_TEXTS = ("time", "time_of_week", "week")
# A larger angle is in another unit or column; a heading may be unwrapped a little.
_LIMIT_DEG = {"lat": 90.0, "lon": 400.0, "roll": 400.0, "pitch": 90.0, "heading": 400.0}
_NUMBER = r"([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?)"
_ORIGIN = re.compile(rf"\borigin: {_NUMBER} deg,? {_NUMBER} deg,? {_NUMBER} m\b")


class TextContents(NamedTuple):
    """Contents of the columns of a file."""

    file: str
    columns: dict[str, FoundColumn]
    values: dict[str, np.ndarray]  # by quantity, SI
    time_ns: np.ndarray
    rows: np.ndarray
    nav: NavFrame
    body: BodyFrame
    findings: Findings

    def has(self, group: str) -> bool:
        """True if there is such a group of columns."""
        return parts(group)[0] in self.values

    def stack(self, group: str) -> np.ndarray:
        """Columns of a group, stacked; NaN if there are none."""
        missing = np.full(len(self.rows), np.nan)
        return np.stack([self.values.get(q, missing) for q in parts(group)], axis=-1)

    @property
    def origin(self) -> dict[str, Any]:
        """Source of the numbers, for a table."""
        return {"source": self.file, "rows": self.rows}

    def of(self, rows: np.ndarray) -> TextContents:
        """Some of the rows."""
        values = {q: v[rows] for q, v in self.values.items()}
        return self._replace(values=values, time_ns=self.time_ns[rows], rows=self.rows[rows])


def read_text(
    format: TextFormat, path: AnyPath, findings: Findings = None, origin: Origin | None = None
) -> Table | Dataset:
    """Read a log of this format.

    Args:
        format: of the columns.
        path: the file or archive of arrays, plain or compressed.
        findings: receives omissions and doubts; without it they are issued as `LogWarning`.
        origin: position on the Earth of local metres; by default that in a comment.

    Returns:
        The table of the file, or a dataset of several.

    Raises:
        LogError: columns are missing, named twice, in another unit, or not numeric.
    """
    file, head = str(path), head_of(path)
    header = header_of(format, head)
    columns = columns_of(format, file, header)
    texts = {q: f for q, f in columns.items() if q in _TEXTS}
    numbers = {q: f for q, f in columns.items() if q not in _TEXTS}
    marks = _marks(file, header, columns)
    layout = TextLayout(
        tuple(header.names),
        format.delimiter,
        texts=tuple(sorted({*(f.place for f in texts.values()), *marks.values()})),
        numbers=tuple(sorted({f.place for f in numbers.values()})) if format.others else None,
        skip=header.line,
        all_named=header.all_named,
        decimal=format.decimal,
    )
    table = rows_of(head, layout) if head.names else read_columns(path, layout, findings)
    stamps = {q: table.texts[:, layout.texts.index(f.place)] for q, f in texts.items()}
    nav, body = _frames(format, head)
    read = TextContents(
        file,
        numbers,
        {q: _column(f, table, layout, marks) for q, f in numbers.items()}
        | {c.holds: _si(c, c.unit, np.full(len(table.rows), c.value)) for c in format.stated},
        _times(file, texts, stamps, table.rows, format.rate_hz),
        table.rows,
        nav,
        body,
        findings,
    )
    if format.body not in ("FRD", "RFU"):
        for group in ("gyro", "accel", "dtheta", "dv", "mag", "omega"):
            if read.has(group):
                turned = Axes.of(format.body).to_frd(read.stack(group))
                read.values.update(zip(parts(group), turned.T, strict=True))
    if format.local:
        origin = origin or _origin(head)
    return _tables(format, read, origin, known=any(f.sure for f in texts.values()))


def _marks(file: str, header: ColumnHeader, columns: dict[str, FoundColumn]) -> dict[str, int]:
    """Indices of the columns whose text selects the rows of a quantity.

    Raises:
        LogError: the header has no such column.
    """
    names = {f.column.where[0] for f in columns.values()} - {""}
    if lacking := sorted(names - set(header.names)):
        cause = f"the header lacks {lacking[0]}; it has {', '.join(header.names)}"
        raise refused(file, f"line {header.line}")(cause, "name it as it is")
    return {name: header.names.index(name) for name in names}


def _column(
    found: FoundColumn, table: Columns, layout: TextLayout, marks: dict[str, int]
) -> np.ndarray:
    """Numbers of a column in SI units; NaN in rows of other sensors."""
    values = _si(found.column, found.unit, table.values[:, layout.number(found.place)])
    name, text = found.column.where
    if name:
        marked = np.char.strip(table.texts[:, layout.texts.index(marks[name])], b'" ')
        values[marked != text.encode()] = np.nan
    return values


def _si(column: Column, symbol: str, values: np.ndarray) -> np.ndarray:
    exact = column.scale == 1.0 and column.offset == 0.0
    with np.errstate(over="ignore", invalid="ignore"):  # infinite: for `clean` to count
        scaled = values if exact else values * column.scale + column.offset + 0.0  # no minus zero
        return to_si(scaled, unit(symbol, QUANTITIES[column.holds])).copy()


def _times(
    file: str,
    texts: dict[str, FoundColumn],
    stamps: dict[str, np.ndarray],
    rows: np.ndarray,
    rate_hz: float,
) -> np.ndarray:
    if rate_hz:
        return np.round(np.arange(len(rows)) * (1e9 / rate_hz)).astype(np.int64)
    clock = "time" if "time" in texts else "time_of_week"
    column, _, name, symbol = texts[clock]
    if symbol in DATES:
        exponent, time_ns = 9, dates_to_ns(file, name, stamps[clock], rows, symbol[4:])
    else:
        exponent = CLOCKS[unit(symbol).symbol]
        time_ns = stamps_to_ns(file, name, stamps[clock], rows, *tick_of(column, symbol))
    shift = round(Decimal(repr(column.offset)).scaleb(exponent))
    if abs(shift) >= LIMIT_NS:
        raise refused(file, field=name, value=column.offset)(
            "is an offset of 146 years or more", "give it in the unit of the column"
        )
    time_ns = time_ns + shift
    if clock == "time":
        return time_ns
    if "week" in stamps:
        week = weeks_of(file, texts["week"].name, stamps["week"], rows)
        time_ns = time_ns + (week - week[0]) * WEEK_NS
    return unrolled(time_ns)


def _frames(format: TextFormat, head: Head) -> tuple[NavFrame, BodyFrame]:
    """Frames of the format, or those stated by a comment above the rows.

    Raises:
        LogError: a comment states others than NED FRD or ENU RFU.
    """
    nav: NavFrame = "ENU" if format.nav == "ENU" else "NED"
    body: BodyFrame = "RFU" if format.body == "RFU" else "FRD"
    for number, text in _comments(head) if format.states_frames else ():
        matched = re.search(r"\bframes?:\s*(.+)", text)
        if matched is None:
            continue
        words = set(re.findall(r"[A-Z]{3}", matched[1]))
        fitting = [pair for pair in PAIRS if words and words <= set(pair)]
        if len(fitting) != 1:
            remedy = "convert the columns to one of the two and say which"
            at = refused(head.file, f"line {number}", "frames", matched[1].strip())
            raise at("is neither NED FRD nor ENU RFU", remedy)
        return fitting[0]
    return nav, body


def _origin(head: Head) -> Origin | None:
    matched = (_ORIGIN.search(text) for _, text in _comments(head))
    return next((Origin(*map(float, found.groups())) for found in matched if found), None)


def _comments(head: Head) -> list[tuple[int, str]]:
    """Comments before the first line of data."""
    first = (head.data(1) or [(len(head.lines) + 1, "")])[0][0]
    lines = enumerate(head.lines[: first - 1], start=1)
    return [(k, text) for k, text in lines if text.lstrip().startswith(COMMENTS)]


def _tables(
    format: TextFormat, read: TextContents, origin: Origin | None, known: bool
) -> Table | Dataset:
    made = []
    for kind in format.kinds:
        own = {q for need in TABLES[kind].needs for q in parts(need)} & set(read.values)
        own -= {column.holds for column in format.stated}
        if not own:
            continue
        part = read
        if format.sparse:
            part = read.of(np.any([np.isfinite(read.values[q]) for q in own], axis=0))
            if not len(part.rows):
                raise LogError(read.file, f"no line has {words_of(kind)}", "record that as well")
        made.append(_path(part, origin) if kind == "trajectory" else _MAKERS[kind](part))
    if len(format.kinds) == 1 or len(made) == 1:
        return made[0]
    tables = {kind_of(table): table for table in made}
    return Dataset(stem_of(read.file), **tables, time_unit_known=(read.file,) if known else ())


def _imu(read: TextContents) -> ImuTable:
    if read.has("dt"):
        _compare_dt(read)
    rate = read.has("gyro")
    turn, force = map(read.stack, ("gyro", "accel") if rate else ("dtheta", "dv"))
    turns, forces = (np.asarray(np.isfinite(v).any(axis=1)) for v in (turn, force))
    if rate and turns.any() and forces.any() and not (turns & forces).any():
        force = interpolated(read.time_ns[turns], read.time_ns[forces], force[forces])
        read, turn = read.of(turns), turn[turns]
    kind: Literal["rate", "increment"] = "rate" if rate else "increment"
    return ImuTable(read.time_ns, turn, force, kind, read.body, **read.origin)


def _mag(read: TextContents) -> MagTable:
    return MagTable(read.time_ns, read.stack("mag"), read.body, **read.origin)


def _gnss(read: TextContents) -> GnssTable:
    quality = read.values.get("quality")
    if quality is not None:
        quality = np.where(np.abs(quality) < 100.0, quality, 0.0).astype(np.int64)
    v_n = sigma_v = None
    if read.has("velocity"):
        v_n, sigma_v = read.stack("velocity"), read.stack("sigma_v")
    (lat, lon, height), sigma_m = (read.values[q] for q in parts("place")), read.stack("sigma")
    now = read.time_ns
    return GnssTable(now, lat, lon, height, sigma_m, v_n, sigma_v, quality, **read.origin)


def _attitude(read: TextContents) -> AttitudeTable:
    q_nb = _quaternions(read)
    return AttitudeTable(read.time_ns, q_nb, read.nav, read.body, **read.origin)


def _path(read: TextContents, origin: Origin | None) -> Trajectory:
    for quantity in _LIMIT_DEG:
        _within_limits(read, quantity)
    q_nb, v_n = _quaternions(read), read.stack("velocity")
    omega = read.stack("omega") if read.has("omega") else None
    if read.has("local"):
        if origin is None:
            finding_reporter(read.findings, "note", "no_place", read.file, value="0 0 0")(
                "positions are local metres; they are put at latitude 0, longitude 0, height "
                "0, x to the east. Gravity and Earth rate there are not those of the "
                "recording; give an origin if that matters."
            )
        local = LocalPath(read.time_ns, read.stack("local"), swap(v_n), q_nb)
        path = from_local(local, origin or NOWHERE, source=read.file)
        return replace(path, body=read.body, omega_ib_b=omega, rows=read.rows)
    v_n = swap(v_n) if read.nav == "ENU" else v_n
    lat, lon, height = (read.values[q] for q in parts("place"))
    origin_of = {"omega_ib_b": omega, "nav": read.nav, "body": read.body} | read.origin
    return Trajectory(read.time_ns, lat, lon, height, v_n, q_nb, **origin_of)


def _odometry(read: TextContents) -> OdometryTable:
    speed, sigma = (read.values[q] for q in parts("wheels"))
    unknown = np.full(len(speed), np.nan)
    return OdometryTable(read.time_ns, speed, unknown, sigma, unknown, **read.origin)


_MAKERS = {"imu": _imu, "mag": _mag, "gnss": _gnss, "attitude": _attitude, "odometry": _odometry}


def _quaternions(read: TextContents) -> np.ndarray:
    """Quaternions as recorded, or from roll, pitch and heading, equal in both pairs of frames."""
    if read.has("quaternion"):
        first, *_, last = (read.columns[q].name for q in parts("quaternion"))
        name, q = f"{first} .. {last}", read.stack("quaternion")
        return unit_quaternions(read.file, name, q, read.rows, read.findings)
    q = np.asarray(rotation.from_euler(*read.stack("euler").T))
    return np.asarray(swap_q(q)) if read.nav == "ENU" else q


def _within_limits(read: TextContents, quantity: str) -> None:
    """Remove impossible angles; refuse the column if they are many.

    Raises:
        LogError: more than half of the angles are beyond the limit.
    """
    if quantity not in read.values:
        return
    values, limit, found = read.values[quantity], _LIMIT_DEG[quantity], read.columns[quantity]
    beyond = np.abs(values) > np.deg2rad(limit) * (1.0 + 1e-9)
    if not beyond.any():
        return
    k = int(np.argmax(beyond))
    shown = float(from_si(values[k], found.unit))
    allowed = f"+-{from_si(np.deg2rad(limit), found.unit):.4g} {found.unit}"
    count = f"{beyond.sum()} of {np.isfinite(values).sum()} rows"
    if 2 * beyond.sum() > np.isfinite(values).sum():
        radians = found.unit == "rad"
        other = "degrees under a name that says radians" if radians else "another unit"
        cause = f"beyond {allowed}, as in {count}: probably {other}, or another column"
        remedy = "name the column with the unit it is in"
        raise refused(read.file, f"line {read.rows[k]}", found.name, shown)(cause, remedy)
    values[beyond] = np.nan
    finding_reporter(
        read.findings, "warning", "angle_range", read.file, f"line {read.rows[k]}", shown
    )(f"{found.name} is {shown:g}, beyond {allowed} ({count}). What cannot be is taken as missing.")


def _compare_dt(read: TextContents) -> None:
    """Report if dt differs from the time since the previous row, the duration of an increment."""
    dt, elapsed = read.values["dt"], np.diff(read.time_ns) * 1e-9
    off = np.flatnonzero(np.abs(dt[1:] - elapsed) > 0.01 * np.abs(dt[1:]))
    if len(off):
        first = int(off[0]) + 1
        where, shown = f"line {read.rows[first]}", float(dt[first])
        finding_reporter(read.findings, "warning", "dt_disagrees", read.file, where, shown)(
            f"dt is {shown:g} s but the time has grown by {elapsed[first - 1]:g} s ({len(off)} "
            "such rows). Increments are taken over the time since the row before; rows are "
            "missing, or dt belongs to the next row."
        )
