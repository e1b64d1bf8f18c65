"""Evaluation of a run and contents of its page, as a rig defines them, and their defaults.

By default all numbers of the messages of a rig are shown, and the faults of its lines offered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import xarray as xr

from robins.bench.accounting import Latencies
from robins.bench.broker.faults import FaultTable
from robins.bench.broker.link import Health
from robins.bench.live.feed import Signal
from robins.bench.recording.layout import Event
from robins.bench.wire.fields import Field, Message, Values
from robins.results import array


@dataclass(frozen=True)
class MessageSeries(Mapping[str, np.ndarray]):
    """Fields of messages over a run, by ``message.field``; E steps.

    A field of one number has the shape (E,), others (E, length). NaN stands where nothing was
    received, 0 for whole numbers.

    Attributes:
        time_s: (E,) at the end of each step.
        arrays: by name.
    """

    time_s: np.ndarray
    arrays: Mapping[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        """Values of a field, leading axis E."""
        return self.arrays[name]

    def __iter__(self) -> Iterator[str]:
        """Names of the fields."""
        return iter(self.arrays)

    def __len__(self) -> int:
        """Number of fields."""
        return len(self.arrays)

    def until(self, steps: int) -> MessageSeries:
        """The first steps."""
        return MessageSeries(
            self.time_s[:steps], {name: x[:steps] for name, x in self.arrays.items()}
        )


class OperatorEvent(NamedTuple):
    """A message that the operator sent through the bench."""

    step: int  # first step whose parts received it
    message: str
    values: Values


class RunResult(NamedTuple):
    """Result of a run."""

    series: MessageSeries
    config: Any  # input of the parts, as the rig prepared it
    steps: int  # completed
    seconds: float  # of the wall clock, from the first tick to the last answer
    latencies: Latencies
    health: Mapping[str, Health]
    injected: Mapping[tuple[str, str], int]
    silent: Mapping[str, int]
    events: list[Event]
    deaths: int
    failure: str  # empty: the run came to its end
    stopped: bool  # by an observer
    operator_events: tuple[OperatorEvent, ...] = ()  # by the operator


class RunFigures(NamedTuple):
    """Evaluation of a run by its rig.

    Attributes:
        metrics: figures of merit by name, which ends in the unit.
        counts: of anomalies, by name.
        warnings: reasons to doubt the figures.
        arrays: of the solution, as `robins.results.array` makes them.
        lines: figures for a terminal.
    """

    metrics: Mapping[str, float | None] = MappingProxyType({})
    counts: Mapping[str, int] = MappingProxyType({})
    warnings: Sequence[str] = ()
    arrays: Mapping[str, Any] = MappingProxyType({})
    lines: Sequence[str] = ()


class Alert(NamedTuple):
    """A notice for the user; levels are those of the page."""

    level: Any
    text: str


@runtime_checkable
class Alarms(Protocol):
    """Watches a run step by step and raises notices."""

    def observe(self, series: MessageSeries, step: int) -> list[Alert]:
        """Notices raised in a step."""
        ...


Offer = dict[str, Any]
"""A fault on the page: its ``label``, and the ``fault`` as a scenario gives it, without a time."""


class PageView(NamedTuple):
    """Contents of the page of a rig.

    Attributes:
        signals: plotted signals, by the parameters of the vehicle.
        sample: (arrays, config, first step since the last sample, step) -> their values.
        alarms: factory of the `Alarms` of a run.
        counts: (arrays, steps done) -> counts, by name.
        offered: faults that can be injected, each with its label; default: those of every line,
            and those of sensors and actuators that need no parameter.
        console_messages: what the operator can send, by label: (arrays, config, last step that was
            done) -> the message and its values.
    """

    signals: Callable[[Any], list[Signal]]
    sample: Callable[[MessageSeries, Any, int, int], Sequence[float]]
    alarms: Callable[[], Alarms | None] = lambda: None
    counts: Callable[[MessageSeries, int], dict[str, int]] = lambda series, done: {}
    offered: tuple[Offer, ...] = ()
    console_messages: Mapping[str, Callable[[MessageSeries, Any, int], tuple[str, Values]]] = (
        MappingProxyType({})
    )


# ------------------------------------------------------------------- defaults, of any messages

_LINE_FAULTS: tuple[tuple[str, str, dict[str, float]], ...] = (
    ("silent", "link silent", {}),
    ("loss", "2 % of frames lost", {"share": 0.02}),
    ("bit errors", "2 % of frames damaged", {"share": 0.02}),
)
_AXES, _WXYZ = "xyz", "wxyz"


def plottable(messages: Sequence[Message]) -> list[tuple[Message, Field]]:
    """Fields that can be plotted, each with its message."""
    return [(m, f) for m in messages for f in m.fields if f.kind == "f64"]


def axes_of(f: Field) -> list[str]:
    """Names of the components of a field."""
    if f.length == len(_WXYZ) and f.name.startswith("q_"):
        return list(_WXYZ)
    return list(_AXES) if f.length == len(_AXES) else [str(k) for k in range(f.length)]


def view_of(messages: Sequence[Message]) -> PageView:
    """Default page: a plot of every number."""
    fields = plottable(messages)
    names = [f"{m.name}.{f.name}" for m, f in fields]

    def signals(given: Any) -> list[Signal]:
        return [
            Signal(f"{m.name} {f.name} {axis}" if f.length > 1 else plot, f.unit, plot)
            for m, f in fields
            for plot in (f"{m.name} {f.name}",)
            for axis in axes_of(f)
        ]

    def sample(series: MessageSeries, config: Any, since: int, step: int) -> Sequence[float]:
        every = [np.ravel(latest(series[name], since, step)) for name in names]
        return np.concatenate(every).tolist()

    return PageView(signals, sample)


def offers_of(table: FaultTable) -> tuple[Offer, ...]:
    """Faults for the page of a rig that offers none: those of its lines, then of its devices."""
    line = [
        {"label": f"{part}: {words}", "fault": {"kind": kind, "link": part, **how} | at}
        for part in table.wire.parts[1:]
        for at in [{} if table.sends[part] else {"direction": "to"}]
        for kind, words, how in _LINE_FAULTS
    ]
    own = [
        {"label": f"{one.link}: {kind}", "fault": {"kind": kind}}
        for kind, one in table.device_faults.items()
        if not one.needs
    ]
    return (*line, *own)


def latest(values: np.ndarray, since: int, step: int) -> np.ndarray:
    """Last received row from step `since` to `step`, both included; NaN if none came."""
    some = values[since : step + 1]
    heard = np.flatnonzero(np.isfinite(some.reshape(len(some), -1)).any(axis=1))
    return np.asarray(some[heard[-1]] if len(heard) else np.full(values.shape[1:], np.nan))


def rms(error: np.ndarray) -> float | None:
    """RMS norm of the rows (E, ...) without NaN; None: there are none."""
    squares = np.sum(np.square(error), axis=tuple(range(1, error.ndim)))
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(np.mean(known))) if len(known) else None


_UNITS = {"arcsec": "arcsec", "deg": "deg", "m_s": "m/s", "m": "m"}


def figures_of(metrics: Mapping[str, float | int | None]) -> list[str]:
    """Lines of figures for a terminal; their names end in the unit."""
    lines = []
    for name, value in metrics.items():
        unit = next((end for end in _UNITS if name.endswith(f"_{end}")), "")
        if unit and value is not None:
            words = name.removesuffix(f"_{unit}").replace("_", " ")
            lines.append(f"{words:<24}{value:10.3f} {_UNITS[unit]}")
    return lines


def arrays_of(messages: Sequence[Message], series: MessageSeries) -> dict[str, xr.Variable]:
    """Every number as an array of the solution, with its unit."""
    out: dict[str, xr.Variable] = {}
    for m, f in plottable(messages):
        values = series[f"{m.name}.{f.name}"].reshape(1, len(series.time_s), f.length)
        about = {"unit": f.unit, "long_name": f"{m.name}: {f.name}", "comment": f.text}
        out |= array("value", values, f"{m.name}_{f.name}", axes=axes_of(f), frame=m.name, **about)
    return out
