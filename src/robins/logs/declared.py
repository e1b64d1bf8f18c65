"""A log format of your own, declared in TOML.

    separator = ";"                              # "," unless stated; " " is any number of blanks
    body = "FLU"                                 # directions of x, y, z: forward, left, up

    [columns]
    time = { name = "t", unit = "ms" }
    gyro_x = { name = "wx", unit = "deg/s" }     # the name in the header
    accel_x = { place = 5, unit = "g" }          # or the column number from 1, without a header
    mag_x = { name = "mx", unit = "uT", scale = 0.15 }    # counts of 0.15 uT; -1 reverses an axis
    sigma_north = { value = 0.5, unit = "m" }    # a constant, not in any column
    mag_y = { name = "y", unit = "uT", where = { sensor = "MAG" } }    # only in rows with this text

Units are those of `robins.units`, or multiples of them (``"0.1 ms"``); for ISO 8601 dates ``iso``,
which states its offset from UTC, ``iso UTC`` or ``iso GPS``. ``offset`` is added in the unit, after
``scale``. ``rate = "100 Hz"`` replaces a column of time, ``decimal = ","`` is for decimal commas.
Quantities are those of `robins.logs.quantities`. Undeclared columns may hold anything. `skip` lines
precede the header, or the rows if there is none.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from robins.foreign import decoding
from robins.logs.archives import head_of
from robins.logs.findings import AnyPath, LogError, os_errors, refused
from robins.logs.quantities import QUANTITIES
from robins.logs.registry import format_named, matching_formats
from robins.logs.tables import stem_of
from robins.logs.text import Head
from robins.logs.text_format import Column, TextFormat, columns_of, header_of, one_of
from robins.units import KINDS, UnitError, parse

NAMED = "format:"
"""Prefix of the name of a format among files of declarations."""

Paths = Iterable[AnyPath]
Types = dict[str, tuple[type, ...]]
_KEYS: Types = {"columns": (dict,), "separator": (str,), "skip": (int,)}
_KEYS |= {"body": (str,), "nav": (str,), "rate": (str,), "decimal": (str,)}
_COLUMN: Types = {"name": (str,), "place": (int,), "unit": (str,), "scale": (int, float)}
_COLUMN |= {"offset": (int, float), "value": (int, float), "where": (dict,)}
_WIDEST = 10_000  # most columns
_MANY = re.compile(r"([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?) (.+)")
_WORDS = {dict: "a table", str: "text", int: "a whole number", float: "a number"}


def columns_from(path: AnyPath) -> TextFormat:
    """Read a format from a TOML file.

    Raises:
        LogError: the file cannot be read or is not TOML; a key, quantity or unit is unknown;
            columns are missing. The message names file and key.
    """
    file = os.fspath(path)
    try:
        with os_errors(file):
            text = Path(path).read_text("utf-8")
    except UnicodeDecodeError as error:
        raise LogError(file, f"is no TOML: {error}", "repair it") from error
    return format_of(text, file)


def format_of(text: str, file: str) -> TextFormat:
    """Read a format from TOML text of a file, as `columns_from`."""
    with decoding(lambda why: LogError(file, f"is no TOML: {why}", "repair it")):
        content = tomllib.loads(text)
    _checked(file, "", content, _KEYS)
    if not content.get("columns"):
        remedy = 'state them, such as time = { name = "t", unit = "ms" }'
        raise refused(file, "columns")("states no columns", remedy)
    columns = tuple(_column(file, *item) for item in content.pop("columns").items())
    if content.get("skip", 0) < 0:
        at = refused(file, field="skip", value=content["skip"])
        raise at("is less than 0", "count lines from 0")
    if "rate" in content:
        try:
            content["rate_hz"] = parse(content["rate"], "frequency")
        except UnitError as error:
            raise refused(file, field="rate")(str(error), "give it like 100 Hz") from error
        del content["rate"]
    name = stem_of(file)
    row = TextFormat(name, f"declared in {file}", columns, others=True, source=file, **content)
    # a file of several sensors has empty cells for slower ones
    return replace(row, sparse=len(row.kinds) > 1 or any(c.where[0] for c in columns))


def _column(file: str, quantity: str, stated: Any) -> Column:
    key = f"columns.{quantity}"
    if not isinstance(stated, dict):
        remedy = 'write it like { name = "t", unit = "ms" }'
        raise refused(file, field=key, value=stated)("is not a table of name and unit", remedy)
    _checked(file, f"{key}.", stated, _COLUMN)
    ways = [way for way in ("name", "place", "value") if way in stated]
    if len(ways) != 1:
        remedy = "state the name in the header, or the place from 1 where there is none"
        both = f"both {' and '.join(ways)}" if ways else "neither name nor place"
        raise refused(file, key)(f"has {both}", remedy)
    if not 1 <= (place := stated.get("place", 1)) <= _WIDEST:
        wrong = "is less than 1" if place < 1 else f"is beyond {_WIDEST}"
        raise refused(file, key, "place", place)(wrong, "count from 1")
    kind = QUANTITIES.get(quantity, "ratio")
    if kind != "ratio" and "unit" not in stated:
        remedy = f"state one of {', '.join(KINDS[kind])}"
        raise refused(file, key)("has no unit", remedy)
    where = next(iter(stated.get("where", {}).items()), ("", ""))
    if len(stated.get("where", {"": ""})) != 1 or not isinstance(where[1], str):
        remedy = 'write it like { sensor = "GYR" }'
        raise refused(file, key, "where", stated["where"])("is not one column and its text", remedy)
    count, symbol = 1.0, stated.get("unit")
    if symbol is not None and (many := _MANY.fullmatch(symbol)):
        count, symbol = float(many[1]), many[2]
    return Column(
        quantity,
        stated.get("name", f"column {stated.get('place')}"),
        () if symbol is None else (symbol,),
        float(stated.get("scale", 1.0)) * count,
        stated.get("place", 0),
        float(stated.get("offset", 0.0)) * count,
        float(stated["value"]) if "value" in stated else None,
        where,
    )


def _checked(file: str, at: str, table: dict[str, Any], allowed: Types):
    """Refuse keys and types that are not allowed."""
    for key, value in table.items():
        if key not in allowed:
            raise refused(file, f"{at}{key}")("is not a known key", one_of(key, allowed))
        if not isinstance(value, allowed[key]) or isinstance(value, bool):
            words = _WORDS[allowed[key][-1]]
            raise refused(file, field=f"{at}{key}", value=value)(f"is not {words}", f"give {words}")


def formats_of(files: Paths, columns: Paths) -> dict[str, str | TextFormat]:
    """Formats that are declared or named for files: path -> format or its name.

    Args:
        files: of a log.
        columns: TOML files, see `columns_from`, each of which must fit one of the files; or text
            ``format:NAME`` for the only file, or for those without a uniquely recognised format.

    Raises:
        LogError: as `columns_from`; a declaration fits no file, or two fit one; there is no format
            of a name, or all files are recognised without it.
    """
    files, columns = list(files), list(columns)
    names = [c.removeprefix(NAMED) for c in columns if isinstance(c, str) and c.startswith(NAMED)]
    declared = [c for c in columns if not (isinstance(c, str) and c.startswith(NAMED))]
    heads = list(filter(None, map(_head, dict.fromkeys(files)))) if declared else []
    out: dict[str, str | TextFormat] = {}
    for row in map(columns_from, declared):
        fits = [head for head in heads if row.recognise(head)]
        for head in fits:
            if isinstance(earlier := out.get(head.file), TextFormat):
                both = f"fits both {earlier.source} and {row.source}"
                raise LogError(head.file, both, "give the columns of each file once")
            out[head.file] = row
        if not fits and heads:
            columns_of(row, heads[0].file, header_of(row, heads[0]))
        if not fits:
            remedy = "check separator, skip and places"
            raise LogError(row.source, "its columns fit none of the files", remedy)
    for name in names:
        format_named(name, "--format")
        plain = (os.fspath(file) for file in files if not os.path.isdir(file))
        open_ones = [file for file in plain if file not in out]
        meant = [f for f in open_ones if len(open_ones) == 1 or len(matching_formats(f)[1]) != 1]
        if not meant:
            raise LogError(f"--format {name}", "all files are recognised", "omit the name")
        out |= dict.fromkeys(meant, name)
    return out


def _head(path: AnyPath) -> Head | None:
    """Beginning of a text file; None for other files, which cannot be in a declared format."""
    try:
        return head_of(path)
    except LogError:
        return None
