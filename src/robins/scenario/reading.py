"""Reader of a scenario's text into parameters, with messages for its faults.

pydantic's findings become one line a fault, with path, value and fix.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import pydantic
import pydantic_core

from robins.scenario.parameters import Parameters
from robins.scenario.text import (
    ScenarioError,
    Table,
    Toml,
    date_text,
    dotted,
    mapping_of,
    named,
    override,
    read_text,
    shown_value,
)


def faults(
    cls: type[pydantic.BaseModel],
    mapping: Table,
    errors: list[pydantic_core.ErrorDetails],
) -> list[str]:
    """One line for each fault in the tables of a scenario, unknown keys first."""
    unknown, missing, wrong = [], {}, []
    for error in errors:
        path, value = _locate(mapping, error["loc"])
        if error["type"] == "extra_forbidden":
            unknown.append((path, error["loc"]))
        elif error["type"] == "missing":
            missing[dotted(path)] = f"{dotted(path)}: required, but not given"
        else:
            # A fault of the whole scenario names its keys itself.
            where = f"{dotted(path)} = {_shown(value)}: " if path else ""
            wrong.append(where + _reason(error))
    lines = []
    for path, loc in unknown:
        meant, line = _unknown_key(cls, path, loc)
        missing.pop(meant, None)  # one line per error
        lines.append(line)
    return [*lines, *missing.values(), *wrong]


def _locate(mapping: Toml, loc: tuple[int | str, ...]) -> tuple[list[int | str], Toml]:
    """Path and value of a fault, without pydantic's names for the branches of a union."""
    path: list[int | str] = []
    value: Any = mapping
    for i, step in enumerate(loc):
        try:
            value = value[step]
        except (KeyError, IndexError, TypeError):
            if i < len(loc) - 1 or type(value) not in (dict, list):
                continue
        path.append(step)
    return path, value


def _shown(value: Toml) -> str:
    text = shown_value(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# Words of TOML for the concepts of pydantic.
_TABLE = "should be a table"
_LIST = "should be a list"
_WORDS = {
    "model_type": _TABLE,
    "model_attributes_type": _TABLE,
    "dict_type": _TABLE,
    "tuple_type": _LIST,
    "list_type": _LIST,
    "too_short": "should hold {min_length} or more",
    "union_tag_not_found": "{discriminator} is required, but not given",
    "union_tag_invalid": "{discriminator} should be one of {expected_tags}",
}


def _reason(error: pydantic_core.ErrorDetails) -> str:
    context = error.get("ctx", {})
    if error["type"] == "value_error":
        return str(context["error"])
    words = _WORDS.get(error["type"])
    reason = words.format(**context) if words else error["msg"].replace("Input should", "should")
    chosen = context.get("tag", error["input"])
    choices = context.get("expected_tags", context.get("expected", ""))
    near = _nearest(chosen, re.findall(r"'([^']*)'", choices)) if isinstance(chosen, str) else None
    return " ".join(reason.split()) + (f"; did you mean {near!r}?" if near else "")


def _nearest(word: str, among: list[str]) -> str | None:
    return next(iter(difflib.get_close_matches(word, [w for w in among if w != word], n=1)), None)


def _unknown_key(
    cls: type[pydantic.BaseModel], path: list[int | str], loc: tuple[int | str, ...]
) -> tuple[str, str]:
    """Dotted key that was probably meant (or empty), and the line of the message."""
    models = [cls]
    for step in loc[:-1]:
        inner = [m.model_fields[step].annotation for m in models if step in m.model_fields]
        within = [m for annotation in inner for m in _models(annotation)]
        models = within or [m for m in models if _is_branch(m, step)] or models
    key = str(path[-1])
    allowed = list(dict.fromkeys(name for model in models for name in model.model_fields))
    near = _nearest(key, allowed)
    elsewhere = [p for p in _paths(cls) if p.split(".")[-1] == key and p != dotted(path)]
    meant = dotted([*path[:-1], near]) if near else "".join(elsewhere[:1])
    hint = f"; did you mean {near or meant}?" if meant else ""
    return meant, f"{dotted(path)}: unknown key{hint} (allowed: {', '.join(allowed)})"


def _is_branch(model: type[pydantic.BaseModel], step: int | str) -> bool:
    """True if a step is pydantic's name of a class in a union: that of the class or its tag."""
    tags = [tag for info in model.model_fields.values() for tag in get_args(info.annotation)]
    return step == model.__name__ or step in tags


def _models(annotation: Any) -> list[type[pydantic.BaseModel]]:
    """The parameter classes inside an annotation, be it optional, a list or a choice."""
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models(inner)]


def _paths(cls: type[pydantic.BaseModel], seen: tuple[type, ...] = ()) -> Iterator[str]:
    """Every key that can be written without the number or the name of an item."""
    for name, info in cls.model_fields.items():
        yield name
        for model in _models(info.annotation):
            if model not in seen and get_origin(info.annotation) not in (tuple, list, dict):
                yield from (f"{name}.{path}" for path in _paths(model, (*seen, cls)))


P = TypeVar("P", bound=Parameters)


def load(cls: type[P], path: str | Path, settings: Iterable[str] = ()) -> P:
    """Read a scenario file; see `parse`.

    Raises:
        ScenarioError: the file cannot be read, or its text cannot be used.
    """
    return parse(cls, read_text(path), settings, source=str(path))


def parse(cls: type[P], text: str, settings: Iterable[str] = (), *, source: str = "") -> P:
    """Read scenario text, apply the settings, and check it.

    Args:
        cls: the parameter class wanted.
        text: TOML.
        settings: changes such as ``"imu.gyro_bias=2 deg/h"``; see `override`.
        source: name of the text in messages, such as its file.

    Raises:
        ScenarioError: not TOML, an unknown or missing key, a wrong unit or value.
    """
    return validate(cls, override(mapping_of(text, source=source), settings), source=source)


def validate(cls: type[P], mapping: Table, *, source: str = "") -> P:
    """Check the tables of a scenario.

    Raises:
        ScenarioError: an unknown or missing key, a wrong unit or value.
    """
    # As JSON, so that a TOML list can fill a tuple, and a text a path or a choice, while numbers,
    # booleans and texts are never converted into each other.
    try:
        return cls.model_validate_json(json.dumps(mapping, default=date_text))
    except pydantic.ValidationError as error:
        found = faults(cls, mapping, error.errors(include_url=False))
        raise ScenarioError(named(source, fault) for fault in found) from None
