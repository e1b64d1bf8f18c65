"""A scenario's text into parameters."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import pydantic

from robins.scenario.errors import ScenarioError, named
from robins.scenario.faults import faults
from robins.scenario.parameters import Parameters
from robins.scenario.text import date_text, mapping_of, override, read_text

P = TypeVar("P", bound=Parameters)


def load(cls: type[P], path: str | Path, settings: Iterable[str] = ()) -> P:
    """Read a scenario file; see `parse`.

    Raises:
        ScenarioError: the file cannot be read, or its text cannot be used.
    """
    return parse(cls, read_text(path), settings, source=str(path))


def parse(cls: type[P], text: str, settings: Iterable[str] = (), *, source: str = "") -> P:
    """Read scenario text, change what the settings say, and check it.

    Args:
        cls: the parameter class wanted.
        text: TOML.
        settings: changes such as ``"imu.gyro_bias=2 deg/h"``; see `override`.
        source: name of the text in messages, such as its file.

    Raises:
        ScenarioError: not TOML, an unknown or missing key, a wrong unit or value.
    """
    return validate(cls, override(mapping_of(text, source=source), settings), source=source)


def validate(cls: type[P], mapping: Mapping[str, Any], *, source: str = "") -> P:
    """Check the tables of a scenario.

    Raises:
        ScenarioError: an unknown or missing key, a wrong unit or value.
    """
    # As JSON, for a TOML list may then fill a tuple and a text a path or a choice, while numbers,
    # truth values and texts are still never converted into each other.
    try:
        return cls.model_validate_json(json.dumps(mapping, default=date_text))
    except pydantic.ValidationError as error:
        found = faults(cls, mapping, error.errors(include_url=False))
        raise ScenarioError(named(source, fault) for fault in found) from None
