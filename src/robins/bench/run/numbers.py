"""Defaults of page and report for any rig: all numbers of its messages, faults of its lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robins.bench.live.feed import Signal
from robins.bench.rig import Offer, Rig, View
from robins.bench.run.telemetry import Flown
from robins.bench.wire.fields import Field, Message
from robins.results import array

_LINE_FAULTS: tuple[tuple[str, str, dict[str, float]], ...] = (
    ("silent", "link silent", {}),
    ("loss", "2 % of frames lost", {"share": 0.02}),
    ("bit errors", "2 % of frames damaged", {"share": 0.02}),
)
_AXES, _WXYZ = "xyz", "wxyz"


def kept_fields(rig: Rig) -> list[tuple[Message, Field]]:
    """Fields with numbers that can be drawn, of the messages that are kept."""
    every = [m for m in rig.wire.data if m.name in rig.kept or not rig.kept]
    return [(m, f) for m in every for f in m.fields if f.kind == "f64"]


def axes_of(f: Field) -> list[str]:
    """Names of the components of a field."""
    if f.length == len(_WXYZ) and f.name.startswith("q_"):
        return list(_WXYZ)
    return list(_AXES) if f.length == len(_AXES) else [str(k) for k in range(f.length)]


def view_of(rig: Rig) -> View:
    """A page that draws every number."""
    fields = kept_fields(rig)
    names = [f"{m.name}.{f.name}" for m, f in fields]

    def signals(given: Any) -> list[Signal]:
        return [
            Signal(f"{m.name} {f.name} {axis}" if f.length > 1 else plot, f.unit, plot)
            for m, f in fields
            for plot in (f"{m.name} {f.name}",)
            for axis in axes_of(f)
        ]

    def sample(flown: Flown, kit: Any, since: int, step: int) -> Sequence[float]:
        every = [np.ravel(latest(flown[name], since, step)) for name in names]
        return np.concatenate(every).tolist()

    return View(signals, sample)


def faults_of(rig: Rig) -> tuple[Offer, ...]:
    """Faults for the page of a rig that offers none: of its lines, then of what it can itself."""
    line = [
        {"label": f"{part}: {words}", "fault": {"kind": kind, "link": part, **how} | at}
        for part in rig.parts
        for at in [{} if rig.sends[part] else {"direction": "to"}]
        for kind, words, how in _LINE_FAULTS
    ]
    own = [
        {"label": f"{one.link}: {kind}", "fault": {"kind": kind}}
        for kind, one in rig.table.said.items()
        if not one.needs
    ]
    return (*line, *own)


def latest(values: np.ndarray, since: int, step: int) -> np.ndarray:
    """Last received row between two steps; else NaN."""
    some = values[since : step + 1]
    heard = np.flatnonzero(np.isfinite(some.reshape(len(some), -1)).any(axis=1))
    return np.asarray(some[heard[-1]] if len(heard) else np.full(values.shape[1:], np.nan))


_UNITS = {"arcsec": "arcsec", "deg": "deg", "m_s": "m/s", "m": "m"}


def figures_of(metrics: Mapping[str, Any]) -> list[str]:
    """Lines of figures for a terminal; their names end in the unit."""
    lines = []
    for name, value in metrics.items():
        unit = next((end for end in _UNITS if name.endswith(f"_{end}")), "")
        if unit and value is not None:
            words = name.removesuffix(f"_{unit}").replace("_", " ")
            lines.append(f"{words:<24}{value:10.3f} {_UNITS[unit]}")
    return lines


def arrays_of(rig: Rig, flown: Flown) -> dict[str, Any]:
    """Every number as an array of the solution, with its unit."""
    out: dict[str, Any] = {}
    for m, f in kept_fields(rig):
        values = flown[f"{m.name}.{f.name}"].reshape(1, len(flown.time_s), f.length)
        about = {"unit": f.unit, "long_name": f"{m.name}: {f.name}", "comment": f.text}
        out |= array("value", values, f"{m.name}_{f.name}", axes=axes_of(f), frame=m.name, **about)
    return out
