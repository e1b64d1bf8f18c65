"""Faults of the star simulator, in addition to those of the satellite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import pydantic

from robins.bench.broker.faults import Said
from robins.bench.rig import View
from robins.bench.rigs.laboratory.parts import STARS
from robins.bench.rigs.satellite import faults
from robins.bench.rigs.satellite.view import VIEW


def _dark(said: Mapping[str, Any], *_: Any) -> dict[str, Any]:
    return {name: np.full_like(x, np.nan) for name, x in said.items()}


def _hidden(said: Mapping[str, Any], fault: Any, _: int) -> Mapping[str, Any]:
    """Stars without the brightest."""
    said["vectors_s"][: 3 * fault.stars] = np.nan
    said["magnitude"][: fault.stars] = np.nan
    return said


_SAID: dict[str, Said] = {
    "dark": Said("sky", "stars", "blind", _dark),
    "hidden": Said("sky", "stars", "said", _hidden, ("stars",)),
}
"""A star simulator that shows nothing, or all but its brightest ``stars``."""
_STARS = Annotated[int, pydantic.Field(ge=1, le=STARS)]
_OFFERED: tuple[dict[str, Any], ...] = (
    {"label": "sky: dark", "fault": {"kind": "dark"}},
    {"label": "sky: without the brightest star", "fault": {"kind": "hidden"}},
)


def said() -> tuple[Mapping[str, Said], Mapping[str, Any]]:
    """All faults of sensors and actuators, and their parameters."""
    kinds, parameters = faults.said()
    return {**kinds, **_SAID}, {**parameters, "stars": (_STARS, 1)}


def view() -> View:
    """Page of the satellite, with these faults."""
    return VIEW._replace(offered=(*VIEW.offered, *_OFFERED))
