"""Scaling of a parameter of a scenario by a factor, in the unit in which it is written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pydantic

from robins.scenario.parameters import Parameters
from robins.scenario.text import ScenarioError, Table, Toml, shown_value

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def written(parameters: Parameters, mapping: Table, key: str) -> Toml:
    """A parameter as the scenario writes it, or as its class writes its default.

    Args:
        parameters: the scenario as read.
        mapping: its tables.
        key: path, such as "imu.gyro_noise"; items of a list are named by their number.

    Raises:
        ScenarioError: there is no such parameter, or it has no value.
    """
    of: Any = parameters
    inner: Any = mapping
    value: Any = None
    for step in key.split("."):
        at: Any = int(step) if isinstance(of, list | tuple) and step.isdecimal() else step
        try:
            value = inner = inner[at] if inner is not None else None
        except (KeyError, IndexError, TypeError):
            value = inner = None
        try:
            if isinstance(of, pydantic.BaseModel):
                field = type(of).model_fields[step]
                of = getattr(of, step)
                if inner is None and field.default_factory is None:
                    value = field.default
            else:
                value, of = (of[at] if inner is None else inner), of[at]
        except (KeyError, IndexError, TypeError):
            raise ScenarioError([f"{key}: there is no such parameter"]) from None
    if value is None or isinstance(value, Mapping):
        raise ScenarioError([f"{key}: has no value here that could be scaled; give one"])
    return value


def scaled(key: str, value: Toml, factor: float) -> Toml:
    """A value as it is written, times a factor: a number, a text with a unit, or a list of these.

    Raises:
        ScenarioError: it is none of these, or it is zero, which no factor changes.
    """
    of = _scaled(key, value, factor)
    if factor != 1.0 and of == _scaled(key, value, 1.0):
        raise ScenarioError([f"{key} = {shown_value(value)}: no factor changes zero"])
    return of


def _scaled(key: str, value: Toml, factor: float) -> Toml:
    if isinstance(value, list | tuple):
        return [_scaled(key, one, factor) for one in value]
    found = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if found:
        return f"{float(found[1]) * factor!r} {found[2]}".rstrip()
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value * factor
    raise ScenarioError([f"{key} = {shown_value(value)}: is no number that could be scaled"])


def setting(key: str, value: Toml) -> str:
    """The text ``key=value`` that sets a parameter to a value as it is written."""
    return f"{key}={value if isinstance(value, str) else shown_value(value)}"
