"""Text of a scenario: reading TOML, applying settings of the command line, writing TOML."""

from __future__ import annotations

import datetime
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from robins.errors import RobinsError

Toml = Any  # a value of TOML: text, number, flag, date, list or table
Table = Mapping[str, Toml]


class ScenarioError(RobinsError, ValueError):
    """A scenario that cannot be used; `faults` has one line for each fault."""

    def __init__(self, faults: Iterable[str]):
        self.faults = tuple(faults)
        super().__init__("\n".join(self.faults))


def named(source: str, fault: str) -> str:
    """The line of a fault, with the file or other source in front."""
    return f"{source}: {fault}" if source else fault


_LONGEST = 1_000_000  # bytes; keeps a log named by mistake out of memory


def read_text(path: str | Path) -> str:
    """Text of a scenario file.

    Raises:
        ScenarioError: the file cannot be read, is not a UTF-8 text, is longer than a megabyte, or
            is not TOML; the message names the file.
    """
    try:
        with Path(path).open("rb") as file:
            content = file.read(_LONGEST + 1)
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError([f"{path}: byte {error.start} is not UTF-8 text"]) from None
    except OSError as error:
        raise ScenarioError([f"{path}: {error.strerror or error}"]) from None
    if len(content) > _LONGEST:
        raise ScenarioError([f"{path}: longer than {_LONGEST} bytes, so hardly a scenario"])
    mapping_of(text, source=str(path))
    return text


def mapping_of(text: str, *, source: str = "") -> dict[str, Toml]:
    """Parse a TOML text into its tables.

    Raises:
        ScenarioError: not TOML; the message names line and column.
    """
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError([named(source, f"not TOML: {error}")]) from None


def override(mapping: Table, settings: Iterable[str]) -> dict[str, Toml]:
    """Copy of the tables with ``path=value`` settings applied; later ones override earlier ones.

    The value is read as TOML (``3``, ``true``, ``["1 m", "2 m"]``), else it is text as it stands
    (``2 deg/h``). Items of a list are named by their number, from 0. `validate`, which knows all
    keys, checks that the path exists.

    Raises:
        ScenarioError: not ``path=value``, or a path that leads through a plain value.
    """
    out = _copy(mapping)
    for setting in settings:
        path, equals, raw = setting.partition("=")
        keys = [key.strip() for key in path.split(".")]
        if not equals or not all(keys):
            raise ScenarioError([f"{setting!r}: a setting is written path.to.key=value"])
        inner = out
        for depth, key in enumerate(keys):
            last = depth == len(keys) - 1
            if isinstance(inner, list) and key.isdecimal() and int(key) < len(inner):
                at: Any = int(key)
            elif isinstance(inner, dict):
                at = key
            else:
                above = dotted(keys[:depth])
                raise ScenarioError([f"{dotted(keys)}: {above} holds no {key!r} to set"])
            if last:
                inner[at] = _value(raw.strip())
            else:
                inner = inner[at] if isinstance(inner, list) else inner.setdefault(at, {})
    return out


def text_of(mapping: Table) -> str:
    """TOML text of the tables, so that a changed scenario can be kept and run again."""
    return "\n".join(_toml_lines(mapping, ())) + "\n"


def _copy(value: Toml) -> Toml:
    if isinstance(value, Mapping):
        return {k: _copy(v) for k, v in value.items()}
    return [_copy(v) for v in value] if isinstance(value, list) else value


def _value(raw: str) -> Toml:
    try:
        read = tomllib.loads(f"value = {raw}")
    except (ValueError, RecursionError):
        return raw
    return read["value"] if list(read) == ["value"] else raw


def date_text(value: Toml) -> str:
    """A date or time as TOML and JSON write it."""
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    raise TypeError(f"{value!r} is nothing a scenario can hold")


def _key(key: str | int) -> str:
    text = str(key)
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else _quoted(text)


def dotted(path: Iterable[str | int]) -> str:
    """A path as TOML writes it: ``imu.gyro_bias``."""
    return ".".join(map(_key, path))


def _quoted(text: str) -> str:
    # JSON's escapes are valid TOML, except for one control character that JSON does not escape.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def shown_value(value: Toml) -> str:
    """A value as TOML writes it, on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {shown_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(shown_value, value)) + "]"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, int | float) else date_text(value)


def _toml_lines(table: Table, path: tuple[str, ...]) -> Iterator[str]:
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping)}
    if path and (plain or not table):
        yield f"[{dotted(path)}]"
    yield from (f"{_key(k)} = {shown_value(v)}" for k, v in plain.items())
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _toml_lines(value, (*path, key))
