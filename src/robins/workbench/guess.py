"""The command `guess`: which columns of a table hold what, from its headings and its numbers.

Names and units are those that loggers use. A unit that no heading states is proved where it can be:
specific force by the size of gravity, a magnetic field by that of the Earth, stamps by the year,
gyros by the doctor, which compares them with gravity and, where there are fixes, with the course.
What is only likely is marked in a comment, and what is not known is left out.

Examples::

    robins guess my.csv > my.toml
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files

import numpy as np

from robins import logs
from robins.dataset import ImuTable
from robins.logs.archives import head_of, kind_of_archive
from robins.logs.declared import format_of
from robins.logs.opening import read_beginning
from robins.logs.quantities import CLOCKS, GROUPS, QUANTITIES, parts
from robins.logs.tables import Table, tables_of
from robins.logs.text import Head
from robins.units import KINDS, UnitError, to_si
from robins.units import unit as unit_of
from robins.workbench.errors import InputError
from robins.workbench.options import Log

_G = 9.80665
_WORDS: dict[str, dict[str, str]] = tomllib.loads(
    (files("robins.workbench") / "guess.toml").read_text("utf-8")
)
_UNIT_OF = {word: unit for unit, line in _WORDS["units"].items() for word in line.split()}
_QUANTITY_OF = {word: of for of, line in _WORDS["quantities"].items() for word in line.split()}
_SENSORS = {sensor: set(line.split()) for sensor, line in _WORDS["sensors"].items()}
_NOT_RAW, _NO_HEIGHT, _NO_UNIT = (set(line.split()) for line in _WORDS["others"].values())
_MILLI = {"mdeg/s": ("deg/s", 1e-3)}  # spelt by loggers, unknown to `robins.units`
_ISO = re.compile(r'"?\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d[.,\d]*(Z|[-+]\d\d:?\d\d)?"?')
_EPOCHS = {"s": 1e9, "ms": 1e12, "us": 1e15, "ns": 1e18}  # today since 1970, roughly
_FIELD_T = (2.0e-5, 7.0e-5)
_FEWEST = 20  # least number of 0.2 s windows for a comparison with gravity
_FASTEST = 35.0  # rad/s, 2000 deg/s: the range of most gyros

Columns = dict[str, tuple[str, str, str]]  # quantity -> name, unit or "", why


def guess(path: Log) -> str:
    """Print TOML that declares the columns of LOG, for the option --columns of other commands.

    Headings tell what columns hold. Units that they do not state are proved by gravity, by the
    field of the Earth and by the doctor; what is only likely is marked GUESSED in a comment, and
    what is not known is left out.

    Args:
        path: text with headings, or an archive of arrays.

    Raises:
        InputError: there are no headings, or none that is known; it is a recording, not a table.
        robins.logs.LogError: the file cannot be read.
    """
    start = Head(os.fspath(path), [], read_beginning(path))
    for row in logs.FORMATS if not kind_of_archive(start.start) else ():
        if row.binary and row.recognise(start):
            mend = "give it to the commands as it is; no columns are needed."
            raise InputError(f"is a recording whose format is known: {row.about}", start.file, mend)
    head = head_of(path)
    names, separator, decimal, cells = _read_cells(head)
    found, aside = _known(names)
    if "time" not in found and (clock := _unnamed_clock(names, cells, decimal, aside)):
        found["time"] = clock
        del aside[clock[0]]
    used = _whole(set(found))
    aside |= {found[q][0]: _missing_column(q, set(found)) for q in set(found) - used - {"time"}}
    columns = {q: found[q] for q in QUANTITIES if q in used | {"time"} and q in found}
    sizes = dict(zip(head.names, map(len, head.arrays), strict=True))
    others = [name for name in sizes if name not in names]
    aside |= {name: f"has {sizes[name]} rows, not {sizes[names[0]]}" for name in others}
    if not used:
        held = ", ".join([*names, *others][:30])
        mend = 'write the columns yourself, as "A format of your own" of docs/logs.md shows.'
        lacks = {_missing_column(q, set(found)) for q in set(found) - {"time"}}
        what = "; ".join(["no sensor has all its headings", *sorted(lacks), f"there are {held}"])
        raise InputError(what, os.fspath(path), mend)
    texts = {q: [row[names.index(name)] for row in cells] for q, (name, _, _) in columns.items()}
    numbers = {q: np.array([_number(text, decimal) for text in texts[q]]) for q in columns}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns without a number
        _fill_in_units(columns, numbers, texts.get("time", []))
        settings, notes = _settings(separator, decimal, numbers, columns)
        _prove_gyros(path, settings, columns, numbers)
    taken = {name for name, _, _ in columns.values()}
    rest = [name for name in [*names, *others] if name not in taken]
    unused = [f"  {name}: {aside.get(name, 'not known')}" for name in rest]
    if any(name in _numbered(names) for name in taken):
        notes.append("GUESSED: 1, 2 and 3 behind a name are x, y and z")
    notes += ["not used:", *unused] if unused else []
    title = f"# {os.path.basename(path)}, by `robins guess`"
    comments = (f"# {note}" for note in notes)
    return "\n".join([title, *settings, *comments, "", *_lines(columns)]) + "\n"


def _whole(found: set[str]) -> set[str]:
    """Quantities of whole tables that may share a file."""
    groups = {name for name in GROUPS if set(parts(name)) <= found}
    imu = {"gyro", "accel"} <= groups
    keep = {"gyro", "accel", "mag"} if imu else {"mag"} - ({"mag"} if "place" in groups else set())
    keep |= {"place", "velocity"} if "place" in groups else set()
    return {q for group in groups & keep for q in parts(group)}


def _missing_column(quantity: str, found: set[str]) -> str:
    """Reason why a quantity is left out: what its table lacks."""
    group = next(name for name in GROUPS if quantity in parts(name))
    needed = {"gyro": "gyro accel", "accel": "accel gyro", "velocity": "velocity place"}
    for name in needed.get(group, group).split():
        if lacking := [q for q in parts(name) if q not in found]:
            left = "the three are left out" if name == group else f"no {group} is used"
            verb = "is" if len(lacking) == 1 else "are"
            return f"{', '.join(lacking)} {verb} not found, so {left}"
    return "a table of fixes has no such column"


# ------------------------------------------------------------------------------------ headings


def _read_cells(head: Head) -> tuple[list[str], str, str, list[list[str]]]:
    """Names, separator, decimal mark and cells of the first rows.

    Raises:
        InputError: no line of names stands above rows of numbers.
    """
    if head.names:
        by_size: dict[int, dict[str, np.ndarray]] = {}
        for name, array in zip(head.names, head.arrays, strict=True):
            by_size.setdefault(len(array), {})[name] = array[:5000]
        groups = [by_size[size] for size in sorted(by_size, reverse=True)]
        columns = next((g for g in groups if _whole(set(_known([*g])[0]))), groups[0])
        cells = [array.astype("S40").astype(str) for array in columns.values()]
        return [*columns], "", ".", np.stack(cells, axis=-1).tolist()
    best: tuple[list[str], str, str, list[list[str]]] = ([], "", ".", [])
    lines = [text.lstrip("#% ") for text in head.lines if text.strip()]
    for separator in (",", ";", "\t", "|", " "):
        rows = [text.split(None if separator == " " else separator) for text in lines]
        for k, (names, below) in enumerate(itertools.pairwise(rows)):
            named = sum(bool(re.search("[A-Za-z]", name)) for name in names)
            counted = sum(bool(re.fullmatch(r"[-+\d.,eE]+", cell.strip())) for cell in below)
            whole = len(below) == len(names) > len(best[0])
            if whole and 2 * named > len(names) and 2 * counted > len(names):
                comma = separator != "," and any(re.fullmatch(r"-?\d+,\d+", c) for c in below)
                plain = [name.strip().strip('"') for name in names]
                after = [row for row in rows[k + 1 :] if len(row) == len(names)]
                best = (plain, separator, "," if comma else ".", after)
    if not best[0]:
        mend = "name the columns by place; docs/logs.md shows how."
        raise InputError("no line of names stands above rows of numbers", head.file, mend)
    return best


def _known(names: Sequence[str]) -> tuple[Columns, dict[str, str]]:
    """Quantities that the names hold, and the reasons to leave others aside."""
    found: Columns = {}
    aside: dict[str, str] = {}
    axes = _numbered(names)
    for name in names:
        quantity, unit, doubt = _named(axes.get(name, name))
        if not quantity:
            aside[name] = doubt or "not known"
        elif quantity in found:
            aside[name] = f"{found[quantity][0]} is taken for {quantity}"
        else:
            found[quantity] = (name, unit, "unit by its heading" if unit else doubt)
    return found, aside


def _numbered(names: Sequence[str]) -> dict[str, str]:
    """Names that end in 1, 2, 3, with x, y, z instead, where all three are there."""
    cuts = {name: re.fullmatch(r"(.*[A-Za-z])[ _]?([123])(\s*[\[(].*)?", name) for name in names}
    parted = {name: (cut[1], cut[3] or "", int(cut[2]) - 1) for name, cut in cuts.items() if cut}
    count = Counter(around[:2] for around in parted.values())
    return {
        name: f"{stem}_{'xyz'[axis]}{rest}"
        for name, (stem, rest, axis) in parted.items()
        if count[stem, rest] == 3
    }


def _unnamed_clock(
    names: Sequence[str], cells: Sequence[Sequence[str]], decimal: str, free: Mapping[str, str]
) -> tuple[str, str, str] | None:
    """Column that must be the time: it rises, and its unit is one of time or its steps are even.

    Whole numbers that count by one may be numbers of rows, unless a unit is stated.
    """
    for name in (one for one in names if one in free):
        values = np.array([_number(row[names.index(name)], decimal) for row in cells])
        step = np.diff(values)
        if len(step) < 2 or not (step > 0.0).all():
            continue
        unit, even = _stated(name)[1], np.ptp(step) < 1e-3 * np.median(step)
        if unit in CLOCKS:
            return name, unit, "GUESSED: it rises, and its heading has a unit of time"
        if even and np.median(step) != 1.0:
            return name, "", ""
    return None


def _stated(name: str) -> tuple[str, str, str]:
    """Name without its unit, that unit, "" where none is stated, and a doubt."""
    base, unit, doubt = name, "", ""
    if bracketed := re.fullmatch(r"(.*?)\s*[\[(]([^\])]*)[\])]", name):
        stated = re.sub(r"[\s*·]", "", bracketed[2].lower())
        if not re.fullmatch(r":,\d+", stated):
            base, unit = bracketed[1], _UNIT_OF.get(stated, "") or _symbol(bracketed[2])
            if stated not in {"", *_NO_UNIT}:
                doubt = f"UNIT NOT KNOWN: the heading states [{bracketed[2]}]"
    else:
        cuts = (m.start() for m in re.finditer("_", name))
        ends = [(name[:at], _UNIT_OF.get(name[at + 1 :].lower(), "")) for at in cuts]
        base, unit = next(((b, u) for b, u in ends if u), (name, ""))
    return base, unit, doubt


def _named(name: str) -> tuple[str, str, str]:
    """Quantity and unit that a name states, "" where it states none, and a doubt."""
    base, unit, doubt = _stated(name)
    words = [w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", base)]
    if column := re.search(r"\[:,([012])\]$", name):
        words.append("xyz"[int(column[1])])
    joined = "".join(words)
    if len(words) > 1 and words[-1] in ("n", "e", "d", "north", "east", "down"):
        joined = "".join(w for w in words if w not in ("gps", "gnss"))
    for word in (joined, *words):
        if quantity := _QUANTITY_OF.get(word):
            refused = _NOT_RAW | (_NO_HEIGHT if quantity == "height" else set())
            if barred := {*words, *re.findall("[a-z]+", name[len(base) :].lower())} & refused:
                return "", "", f"its heading states {', '.join(sorted(barred))}"
            return quantity, *_of_kind(quantity, unit, doubt)
    axis = joined[-1:]
    stem = {*words[:-1]} if words and words[-1] == axis else {joined[:-1]}
    if axis not in ("x", "y", "z"):
        return "", "", ""
    if stem & _NOT_RAW:
        return "", "", "no reading of the sensor itself"
    sensors = [s for s, known in _SENSORS.items() if stem & known]
    if len(sensors) != 1:
        return "", "", ""
    if sensors[0] == "mag":
        unit = {"g": "G", "mg": "mG"}.get(unit, unit)
    quantity = f"{sensors[0]}_{axis}"
    return quantity, *_of_kind(quantity, unit, doubt)


def _of_kind(quantity: str, unit: str, doubt: str) -> tuple[str, str]:
    """A unit that the quantity can have, or "" and the doubt."""
    known = {"time": CLOCKS, "angle rate": (*KINDS["angle rate"], *_MILLI)}
    kind = QUANTITIES[quantity]
    return (unit, "") if unit in known.get(kind, KINDS[kind]) else ("", doubt)


def _symbol(text: str) -> str:
    try:
        return unit_of(text).symbol
    except UnitError:
        return ""


# --------------------------------------------------------------------------------------- units


def _number(text: str, decimal: str) -> float:
    try:
        return float(text.strip().replace(decimal, "."))
    except ValueError:
        return np.nan


def _fill_in_units(columns: Columns, numbers: dict[str, np.ndarray], stamps: Sequence[str]) -> None:
    """Fill in units that follow from the numbers."""
    if "time" in columns and not columns["time"][1]:
        name, _, doubt = columns["time"]
        unit, why = _clock(numbers["time"], stamps, "lat" in columns and "accel_x" not in columns)
        sure = not doubt or unit.startswith("iso") or "1970" in why
        columns["time"] = (name, unit, why) if sure else (name, "", doubt)
    sized: list[tuple[str, Callable[[float], Iterator[tuple[str, str]]]]] = [
        ("accel", _gravity),
        ("mag", _field),
    ]
    for sensor, candidates in sized:
        group = parts(sensor)
        if group[0] not in columns or columns[group[0]][1]:
            continue
        doubt = columns[group[0]][2]
        if doubt and sensor == "mag":
            continue  # counts may have the size of a field by chance
        size = float(np.nanmedian(np.linalg.norm([numbers[q] for q in group], axis=0)))
        unit, why = next(candidates(size), ("", doubt or f"UNIT NOT KNOWN: median size {size:.4g}"))
        columns |= {q: (columns[q][0], unit, why) for q in group}
    for quantity, (name, unit, doubt) in list(columns.items()):
        kind = QUANTITIES[quantity]
        if not unit and not doubt and kind in ("angle", "length", "speed"):
            guessed = {"angle": "deg", "length": "m", "speed": "m/s"}[kind]
            columns[quantity] = (name, guessed, "GUESSED: no heading states the unit")


def _clock(values: np.ndarray, stamps: Sequence[str], fixes: bool) -> tuple[str, str]:
    """Unit of stamps and why; fixes alone are slower than an IMU."""
    if stamps and (date := _ISO.fullmatch(stamps[0].strip())):
        return ("iso", "dates") if date[1] else ("iso UTC", "GUESSED: dates without offset, in UTC")
    typical, step = float(np.nanmedian(values)), np.diff(values)
    for unit, size in _EPOCHS.items():
        if 0.2 * size < typical < 4.0 * size:
            leap = round(18.0 / to_si(1.0, unit))
            return unit, f"counts from 1970; offset = {leap} would turn UTC into GPS time of today"
    step_s = float(np.nanmedian(step[step > 0.0])) if (step > 0.0).any() else np.nan
    for low, high in (*([(0.1, 20.0)] if fixes else []), (20.0, 4000.0), (0.5, 20e3)):
        for unit in ("s", "ms", "us", "ns"):
            rate = 1.0 / to_si(step_s, unit) if step_s > 0.0 else 0.0
            if low <= rate <= high:
                return unit, f"GUESSED: {rate:.4g} rows a second"
    return "", "UNIT NOT KNOWN"


def _gravity(size: float) -> Iterator[tuple[str, str]]:
    for unit in ("m/s^2", "g", "mg"):
        if 0.9 < to_si(size, unit) / _G < 1.1:
            yield unit, f"proved by gravity: median size {size:.4g}"
    for bits in range(8, 17):  # counts of a range of so many g
        if 0.95 < size / 2.0**bits < 1.05:
            yield f"{2.0**-bits!r} g", f"GUESSED: {2**bits} counts a g by gravity, {size:.6g}"


def _field(size: float) -> Iterator[tuple[str, str]]:
    for unit in KINDS["magnetic field"]:
        if _FIELD_T[0] < to_si(size, unit) < _FIELD_T[1]:
            yield unit, f"by the field of the Earth: median size {size:.4g}"


def _prove_gyros(
    path: str | os.PathLike[str],
    settings: Sequence[str],
    columns: Columns,
    numbers: dict[str, np.ndarray],
) -> None:
    """Fill in the gyro unit that gravity proves, or to which alone the doctor does not object."""
    if "gyro_x" not in columns or columns["gyro_x"][1]:
        return

    def tried(unit: str, why: str) -> Columns:
        return columns | {q: (columns[q][0], unit, why) for q in parts("gyro")}

    text = "\n".join([*settings, *_lines(tried("rad/s", ""))])
    try:
        opened = logs.open_log(path, format_of(text, os.fspath(path)), [])
    except logs.LogError:
        opened = None  # a unit is missing above
    tables = () if opened is None else tables_of(opened)
    imu = next((table for table in tables if isinstance(table, ImuTable)), None)
    rates = np.array([numbers[q] for q in parts("gyro")]) if imu is None else imu.gyro
    fastest = float(np.nanmax(np.abs(rates)))
    unit, why = "rad/s", f"GUESSED: it may be deg/s; largest number {fastest:.4g}"
    if doubt := columns["gyro_x"][2]:
        unit, why = "", doubt
    elif fastest > _FASTEST:
        unit, why = "deg/s", f"GUESSED: {fastest:.4g} rad/s is beyond the range of gyros"
    if imu is not None:
        others = [table for table in tables if table is not imu]
        scale, trust = _turned_by_gravity(imu)
        fitting = [u for u in (*KINDS["angle rate"], *_MILLI) if abs(scale / _si(u) - 1.0) < 0.15]
        sound = [u for u in ("rad/s", "deg/s") if not _doctor_objects(imu, others, _si(u))]
        if trust and fitting:
            unit, why = (
                fitting[0],
                f"proved by gravity, which turns {scale / _si(fitting[0]):.3f} times so",
            )
        elif trust:
            unit, why = "", f"UNIT NOT KNOWN: by gravity one is {scale:.4g} rad/s"
        elif len(sound) == 1 and not doubt:
            unit, why = sound[0], "proved by the doctor: in the other unit it would be wrong"
    columns |= tried(unit, why)


def _si(unit: str) -> float:
    """Value of a unit of angular rate, in rad/s."""
    symbol, scale = _MILLI.get(unit, (unit, 1.0))
    return to_si(scale, symbol)


def _turned_by_gravity(imu: ImuTable) -> tuple[float, bool]:
    """Scale factor of gyro rates from the turning of gravity, and True if it can be trusted.

    Without acceleration, specific force has f' = f x omega. Both sides are integrated over 0.2 s;
    the factor is the least-squares one, trusted where they correlate by more than 0.9.
    """
    if len(imu) < _FEWEST:
        return 0.0, False
    dt = np.diff(imu.time_ns) * 1e-9
    size = max(int(0.2 / max(float(np.median(dt)), 1e-6)), 1)
    f, n = imu.accel, len(imu.accel) // size
    if n < _FEWEST:
        return 0.0, False
    change = np.cross(f[:-1], imu.gyro[:-1]) * dt[:, None]
    summed = np.add.reduceat(change, np.arange(0, len(change), size))[: n - 1]
    smooth = np.add.reduceat(f, np.arange(0, len(f), size))[:n] / size
    # means of adjacent windows lie one window apart: compare with the mean turn of both windows
    turned = np.diff(smooth, axis=0)[: len(summed) - 1]
    between = 0.5 * (summed[:-1] + summed[1:])[: len(turned)]
    good = np.isfinite(turned).all(axis=1) & np.isfinite(between).all(axis=1)
    a, b = turned[good].ravel(), between[good].ravel()
    energy = float(b @ b)
    if not energy:
        return 0.0, False
    alike = float(a @ b) / math.sqrt(energy * max(float(a @ a), 1e-300))
    return float(a @ b) / energy, alike > 0.9


def _doctor_objects(imu: ImuTable, others: list[Table], scale: float) -> bool:
    """True if the doctor objects to the unit of the rates, multiplied by this scale."""
    found = logs.examine([replace(imu, gyro=imu.gyro * scale), *others])
    return any(finding.code == "gyro_unit" for finding in found)


# ----------------------------------------------------------------------------------------- TOML


def _settings(
    separator: str, decimal: str, numbers: dict[str, np.ndarray], columns: Columns
) -> tuple[list[str], list[str]]:
    """Settings above the columns, and comments."""
    lines = [f"separator = {json.dumps(separator)}"] if separator not in ("", ",") else []
    lines += ['decimal = ","'] if decimal == "," else []
    notes = []
    if "time" not in columns:
        notes.append('rate = "100 Hz"   NOT KNOWN: no column of time was found; state the rate')
    if "accel_x" in columns:
        mean = np.nanmean([numbers[q] for q in parts("accel")], axis=1)
        up = mean / max(float(np.linalg.norm(mean)), 1e-300)
        if up[2] > 0.8:
            lines.append('body = "FLU"   # z points up by gravity; GUESSED: x forward, y left')
        elif up[2] > -0.8:
            notes.append(
                f"gravity is along {np.round(up, 2)} of x, y, z: body may have to be stated"
            )
    return lines, notes


def _lines(columns: Columns) -> Iterator[str]:
    yield "[columns]"
    for quantity, (name, unit, why) in columns.items():
        symbol, scale = _MILLI.get(unit, (unit, 1.0))
        more = "" if scale == 1.0 else f", scale = {scale!r}"
        line = f"{quantity} = {{ name = {json.dumps(name, ensure_ascii=False)}"
        known = f", unit = {json.dumps(symbol)}{more} }}"
        yield f"{'' if symbol else '# '}{line}{known}{'   # ' + why if why else ''}"
