"""Formats of text logs as data: columns, and how to find them in a file.

`robins.logs.text_formats` lists the formats, `read_text` and `write_text` read and write them,
`robins.logs.declared` reads one from a TOML file. A column is found by its name in the header,
which is the first line that is no comment, or a comment before it; or by its index, if the format
gives one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from decimal import Decimal
from difflib import get_close_matches
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from robins.dataset import BodyFrame, NavFrame
from robins.logs.findings import refused
from robins.logs.quantities import (
    CLOCKS,
    DATES,
    QUANTITIES,
    TABLES,
    groups_of,
    parts,
    tables_of_groups,
)
from robins.logs.text import COMMENTS, Head
from robins.units import KINDS, UnitError, unit

_WAYS = {way: (k // 2, -1.0 if k % 2 else 1.0) for k, way in enumerate("FBRLDU")}


class Axes(NamedTuple):
    """Directions of axes x, y, z: component of forward, right, down for each, and its sign."""

    component: tuple[int, ...]
    sign: tuple[float, ...]

    @classmethod
    def of(cls, ways: str) -> Axes:
        """Axes from three letters, such as "FLU".

        Raises:
            ValueError: the axes are not orthogonal, or left-handed.
        """
        if len(ways) != 3 or not set(ways) <= set(_WAYS):
            raise ValueError("is not three of the ways F, B, R, L, D, U, such as FLU")
        index, sign = zip(*(_WAYS[way] for way in ways), strict=True)
        if len(set(index)) < 3:
            raise ValueError("names one axis twice; give three at right angles, such as FLU")
        even = index in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        if (1 if even else -1) * sign[0] * sign[1] * sign[2] < 0:
            raise ValueError(
                "is left-handed; give a right-handed triad, and a scale of -1 where due"
            )
        return cls(index, sign)

    def to_frd(self, v: np.ndarray) -> np.ndarray:
        """Convert components (n, 3) in these axes to forward, right, down; exact."""
        out = np.empty_like(v)
        out[:, self.component] = v * self.sign
        return out

    def from_frd(self, v: np.ndarray) -> np.ndarray:
        """The inverse of `to_frd`."""
        return v[:, self.component] * self.sign


RATES_HZ = (0.1, 1e5)
"""Range of plausible rates [Hz] of a recording whose time is made from its rate."""

_ABOVE = 40  # lines searched for a header
_LETTER = re.compile("[A-Za-z]")

ANY = "*"
"""As the name of the time, any name of the first column; among units, any of the right kind."""

PAIRS: tuple[tuple[NavFrame, BodyFrame], ...] = (("NED", "FRD"), ("ENU", "RFU"))
"""Pairs of navigation and body frames."""

Looks = Callable[[list[list[float]]], bool]


class Column(NamedTuple):
    """One column: value = (number * scale + offset) * unit; or a constant that is not in the file.

    In the name, ``{unit}`` stands for the unit, ``{unit_}`` for its form in names (rad_s for
    rad/s); names separated by `` | `` are alternatives, of which the first is written.
    """

    holds: str  # one of `QUANTITIES`
    name: str
    units: tuple[str, ...] = ()  # possible units, the first is written; default: SI
    scale: float = 1.0
    place: int = 0  # column number from 1, if columns have no names
    offset: float = 0.0
    value: float | None = None  # value of a constant
    where: tuple[str, str] = ("", "")  # another column, and its text in rows with this one

    @property
    def unit(self) -> str:
        """Unit for writing."""
        return self.units[0] if self.units else KINDS[QUANTITIES[self.holds]][0]

    @property
    def names(self) -> list[str]:
        """Names with every unit."""
        units = [u for u in self.units or (self.unit,) if u != ANY]
        return [_named(template, u) for template in self.name.split(" | ") for u in units]

    def unit_of(self, name: str) -> str | None:
        """Unit of a column of this name; None if the name is not one of this column."""
        for template in self.name.split(" | "):
            if template == name:
                return self.unit
            for symbol in self.units:
                if symbol != ANY and _named(template, symbol) == name:
                    return symbol
            before, stands, after = template.partition("{unit}")
            if stands and ANY in self.units and name.startswith(before) and name.endswith(after):
                return name[len(before) : len(name) - len(after)]
        return None


def _named(template: str, symbol: str) -> str:
    plain = symbol.replace("/", "_").replace("^", "")
    return template.replace("{unit}", symbol).replace("{unit_}", plain)


@dataclass(frozen=True)
class TextFormat:
    """One format of text logs, as `robins.logs.open_log` and `robins.logs.write_log` take it."""

    name: str
    about: str  # one line for people
    columns: tuple[Column, ...]
    separator: str = ","  # " ": any number of blanks
    decimal: str = "."  # or ","
    rate_hz: float = 0.0  # of the rows, if no column has their time
    skip: int = 0  # lines before the header, or before the rows without one
    body: str = "FRD"  # directions of x, y, z; others than FRD and RFU are converted to FRD
    nav: str = "NED"  # or ENU: navigation frame of attitudes
    states_frames: bool = False  # in a comment "frames: ENU RFU", also written
    commented: bool = False  # the header is written as a comment
    choice: bool = False  # a file has one or more complete sets of these columns
    whole: bool = False  # its readers accept no missing components
    sparse: bool = False  # a row belongs to each table of which it has a number
    others: bool = False  # undeclared columns may hold anything
    looks: Looks | None = None  # recognises rows of numbers without names
    source: str = ""  # the file in which it was declared

    def __post_init__(self):
        """Check the format.

        Raises:
            LogError: an unknown quantity, unit or direction of axes; columns without a complete
                table.
        """
        _check(self)

    @cached_property
    def quantities(self) -> set[str]:
        """Quantities of the columns."""
        return {column.holds for column in self.columns}

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its tables, of `TABLES`."""
        return tables_of_groups(groups_of(self.quantities))

    @property
    def named(self) -> bool:
        """True if columns are found by their names."""
        return not any(column.place for column in self.columns)

    @property
    def stated(self) -> list[Column]:
        """Constants, which are in no column of a file."""
        return [column for column in self.columns if column.value is not None]

    @property
    def local(self) -> bool:
        """True if places are metres from an origin."""
        return "east" in self.quantities

    @property
    def delimiter(self) -> str | None:
        """Delimiter for `TextLayout`."""
        return None if self.separator == " " else self.separator

    def recognise(self, head: Head) -> bool:
        """True if a file begins like this format.

        One column besides the time suffices, so that missing ones are reported; all are needed if
        the time may have any name. A header that is a comment may be missing, if the rows match.
        """
        found = {f.column.holds: f for f in header_by_name(self, head).found if self.named}
        if not found and (not self.named or (self.commented and self.looks)):
            rows = self._rows_of_numbers(head)
            return bool(rows) and (self.looks is None or self.looks(rows))
        clock = found.get("time") or found.get("time_of_week")
        if (clock is None and not self.rate_hz) or len(found) < 2:
            return False
        any_name = clock is not None and ANY in clock.column.name.split(" | ")
        return not any_name or not sort_out(self, set(found))[1]

    def _rows_of_numbers(self, head: Head, lines: int = 20) -> list[list[float]]:
        """First complete rows; none if some are not numeric, or differ in width."""
        data = [text for k, text in head.data(self.skip + lines) if k > self.skip]
        rows = [text.replace(self.decimal, ".").split(self.delimiter) for text in data]
        if len({len(row) for row in rows[:2]}) == 2:  # the recording began mid-line
            rows = rows[1:]
        least = max(c.place for c in self.columns) or len(self.columns)
        if len({len(row) for row in rows}) != 1 or len(rows[0]) < least:
            return []
        places = range(len(rows[0]))
        if self.others:
            places = [c.place - 1 for c in self.columns if c.value is None and not _dated(c)]
        try:
            numbers = [[float(row[k].strip() or "nan") for k in places] for row in rows]
        except ValueError:
            return []
        return [row for row in numbers if not any(map(math.isnan, row))]


class FoundColumn(NamedTuple):
    """A column in a file."""

    column: Column
    place: int  # from 0
    name: str
    unit: str

    @property
    def sure(self) -> bool:
        """True if the file itself states the unit."""
        return "{unit" in self.column.name


class ColumnHeader(NamedTuple):
    """Line that names the columns, or its substitute."""

    line: int  # line number, or that of the last line before the rows
    names: list[str]  # of the columns
    found: list[FoundColumn]
    all_named: bool = False  # a comment need not name every column


def header_by_name(format: TextFormat, head: Head) -> ColumnHeader:
    """Line that names most columns: the first that is no comment, or one near the beginning.

    Lines above a header, such as device and settings, are skipped.
    """
    if head.names:
        return ColumnHeader(0, list(head.names), _found(format, list(head.names)), all_named=True)
    data = [(k, text) for k, text in head.data(format.skip + _ABOVE) if k > format.skip]
    first = data[0][0] if data else len(head.lines)
    named = {first, *(k for k, text in data if _LETTER.search(text))}
    candidates = [
        _header(format, k, text, all_named=k in named)
        for k, text in enumerate(head.lines[: max(named)], start=1)
        if k in named or text.lstrip().startswith(COMMENTS)
    ]
    candidates.sort(key=lambda header: header.line != first)
    return max(candidates, key=lambda header: len(header.found))


def header_of(format: TextFormat, head: Head) -> ColumnHeader:
    """Header of a format in a file; a header that is a comment may be missing."""
    if format.named:
        header = header_by_name(format, head)
        if header.found or not format.commented:
            return header
    places = [
        FoundColumn(column, (column.place or k) - 1, column.names[0], column.unit)
        for k, column in enumerate(format.columns, start=1)
        if column.value is None
    ]
    names = [f"column {k}" for k in range(1, 2 + max(f.place for f in places))]
    for f in places:
        names[f.place] = f.name
    return ColumnHeader(format.skip, names, places)


def _header(format: TextFormat, line: int, text: str, all_named: bool) -> ColumnHeader:
    stripped = (
        text.strip().lstrip("".join(COMMENTS)) if text.lstrip().startswith(COMMENTS) else text
    )
    names = [name.strip().strip('"') for name in stripped.split(format.delimiter)]
    return ColumnHeader(line, names, _found(format, names), all_named)


def _found(format: TextFormat, names: list[str]) -> list[FoundColumn]:
    found = []
    for place, name in enumerate(names):
        plain = name.replace("µ", "u").replace("μ", "u")
        for column in format.columns:
            symbol = column.unit_of(plain) if column.value is None else None
            if symbol is None and place == 0 and ANY in column.name.split(" | "):
                symbol = column.unit
            if symbol is not None:
                found.append(FoundColumn(column, place, name, symbol))
    return found


def sort_out(format: TextFormat, found: set[str]) -> tuple[set[str], set[str]]:
    """Quantities of a file that are used, and those that are missing."""
    if not format.choice:
        return found, format.quantities - found
    return whole_sets(format.kinds, format.quantities, found)


def whole_sets(
    kinds: tuple[str, ...], offered: set[str], found: set[str]
) -> tuple[set[str], set[str]]:
    """Quantities used and missing, by the most complete set of each table, the first required."""
    used, lacking = found & {"time", "time_of_week", "week"}, set()
    for k, kind in enumerate(kinds):
        sets = [set(parts(groups)) for groups in TABLES[kind].needs]
        best = min((s for s in sets if s <= offered), key=lambda s: len(s - found))
        if k and not best & found:
            continue
        more = [set(parts(group)) & offered for group in TABLES[kind].more]
        wanted = best.union(*(group for group in more if group & found))
        used, lacking = used | wanted & found, lacking | wanted - found
    return used, lacking


def columns_of(format: TextFormat, file: str, header: ColumnHeader) -> dict[str, FoundColumn]:
    """Quantity -> its column in a file.

    Raises:
        LogError: columns are missing, two have the same quantity, or a unit is unknown.
    """
    at = partial(refused, file, f"line {header.line}")
    out: dict[str, FoundColumn] = {}
    for f in header.found:
        if (other := out.get(f.column.holds)) is not None:
            raise at()(f"{other.name} and {f.name} are the same thing", "keep one")
        out[f.column.holds] = f
    used, lacking = sort_out(format, set(out) | {c.holds for c in format.stated})
    clocks = {"time", "time_of_week"} & format.quantities
    lacking |= clocks if not clocks & set(out) else set()
    if lacking:
        wanted = ", ".join(
            " or ".join(name for name in c.names if name != ANY)
            for c in format.columns
            if c.holds in lacking
        )
        remedy = "name the columns so, with their units"
        if format.source:
            between = next((s for s in ";\t|," if s in header.names[0]), "")
            remedy = f"state separator = {between!r}" if between else "state the names that it has"
            remedy += f" in {format.source}"
        raise at()(f"the header lacks {wanted}; it has {', '.join(header.names)}", remedy)
    out = {q: f for q, f in out.items() if q in used}
    for quantity, f in out.items():
        try:
            None if _dated(f.column) else unit(f.unit, QUANTITIES[quantity])
        except UnitError as error:
            raise at(f.name)(str(error), "state the unit") from error
    return out


def _dated(column: Column) -> bool:
    """True if a column holds times as dates."""
    return column.holds == "time" and column.unit in DATES


def _check_column(column: Column, source: str) -> None:
    """Raise if a column is invalid."""
    at = partial(refused, source)
    quantity, where = column.holds, f"columns.{column.holds}"
    clock = quantity in ("time", "time_of_week")
    if quantity not in QUANTITIES:
        raise at(where)("is no quantity that a column can hold", one_of(quantity, QUANTITIES))
    for symbol in () if _dated(column) else column.units:
        try:
            plain = symbol if symbol == ANY else unit(symbol, QUANTITIES[quantity]).symbol
        except UnitError as error:
            raise at(where, "unit", symbol)(str(error), "state one of these") from error
        if clock and plain not in CLOCKS:
            remedy = f"record it in one of {', '.join(CLOCKS)}"
            raise at(where, "unit", symbol)("is no unit of time stamps", remedy)
    numbers = (column.offset, 0.0 if column.value is None else column.value)
    if not all(map(math.isfinite, numbers)):
        raise at(where)("has an offset or value that is not finite", "give a number")
    if column.value is not None and (clock or quantity == "week"):
        raise at(where, "value", column.value)("is not for time", "state rate, such as 100 Hz")
    if not (math.isfinite(column.scale) and column.scale):
        remedy = "give a number other than 0, such as -1"
        raise at(where, "scale", column.scale)("cannot scale anything", remedy)
    if quantity == "week" and (column.scale, column.offset) != (1.0, 0.0):
        raise at(where)("is scaled or offset", "state weeks since 1980 as they are")
    if clock and column.scale < 0.0:
        raise at(where, "scale", column.scale)("turns time back", "give a positive number")


def _check(format: TextFormat) -> None:
    """Raise if a format is invalid."""
    at = partial(refused, format.source or f"format {format.name}")
    for column in format.columns:
        _check_column(column, format.source or f"format {format.name}")
    held = [column.holds for column in format.columns]
    if twice := [q for q in held if held.count(q) > 1]:
        raise at(f"columns.{twice[0]}")("is held by two columns", "keep one")
    if len({column.place > 0 for column in format.columns if column.value is None}) > 1:
        raise at("columns")("some have names and some have places", "give all the same way")
    if format.rate_hz and not RATES_HZ[0] <= format.rate_hz <= RATES_HZ[1]:
        between = f"is not between {RATES_HZ[0]:g} and {RATES_HZ[1]:g} Hz"
        raise at("", "rate", format.rate_hz)(between, "give rows a second, such as 100 Hz")
    if len({"time", "time_of_week"} & format.quantities) != (0 if format.rate_hz else 1):
        remedy = "state one column as time, or a rate of the rows"
        raise at("columns")("there is no time, or there are two", remedy)
    if "week" in format.quantities and "time" in format.quantities:
        raise at("columns.week")("needs the second of that week", "state time_of_week")
    kinds = format.kinds
    if not kinds or (len(kinds) > 1 and "imu" not in kinds):
        what = f"make {' and '.join(kinds)} alone" if kinds else "make no table"
        remedy = f"state all columns of a table: {'; '.join(map(_needs, TABLES))}"
        raise at("columns")(f"{what}, where several need an IMU" if kinds else what, remedy)
    used, lacking = whole_sets(kinds, set(QUANTITIES), format.quantities)
    if lacking:
        listed = ", ".join(q for q in QUANTITIES if q in lacking)
        remedy = f"state the columns that hold them: {'; '.join(map(_needs, kinds))}"
        raise at("columns")(f"without {listed} a table is not whole", remedy)
    if not format.choice and (idle := format.quantities - used):
        listed = ", ".join(q for q in QUANTITIES if q in idle)
        raise at("columns")(f"{listed} have no use in {' and '.join(kinds)}", "leave them out")
    if format.decimal not in (".", ",") or format.decimal == format.separator:
        remedy = 'give "," with another separator, such as ";"'
        raise at("", "decimal", format.decimal)("cannot be the sign of decimals", remedy)
    if len(format.separator) != 1 or format.separator.isalnum() or format.separator in '+-."#%':
        remedy = 'give one character, such as "," ";" "\\t" or " "'
        raise at("", "separator", format.separator)("cannot separate numbers", remedy)
    try:
        Axes.of(format.body)
    except ValueError as error:
        raise at("", "body", format.body)(str(error), "name the ways of x, y, z") from error
    if format.nav not in ("NED", "ENU"):
        raise at("", "nav", format.nav)("is neither NED nor ENU", "choose one")
    turned = groups_of(format.quantities) & {"euler", "quaternion"}
    if turned and not format.local and (format.nav, format.body) not in PAIRS:
        remedy = "use NED with FRD or ENU with RFU where there are attitudes"
        raise at("", "body", format.body)(f"does not go with nav {format.nav}", remedy)


def one_of(name: str, allowed: Iterable[str]) -> str:
    """Text of the fix for a name that is not among those allowed."""
    allowed = list(allowed)
    near = get_close_matches(name, allowed, n=1)
    choose = f"hoose one of {', '.join(allowed)}"
    return f"did you mean {near[0]}? If not, c{choose}" if near else f"c{choose}"


def _needs(kind: str) -> str:
    """Required columns of a table, in words."""
    sets = (", ".join(parts(groups)) for groups in TABLES[kind].needs)
    return f"the {kind} table needs {', or '.join(sets)}"


def tick_of(column: Column, symbol: str) -> tuple[int, int]:
    """Integers e and m of a time column whose unit is m * 10^e ns."""
    _, digits, exponent = Decimal(repr(column.scale)).normalize().as_tuple()
    return CLOCKS[unit(symbol).symbol] + int(exponent), int("".join(map(str, digits)))
