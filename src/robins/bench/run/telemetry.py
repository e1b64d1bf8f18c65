"""Telemetry of a run on the bench: the messages that passed, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from robins.bench.broker.link import BenchError
from robins.bench.evaluation import MessageSeries
from robins.bench.rig import Rig
from robins.bench.run.number_store import NumberStore
from robins.bench.wire.fields import Field

_OFTEN = 1 << 12  # messages between two releases of memory


class Telemetry:
    """Recorder of the messages that pass, as arrays."""

    def __init__(self, rig: Rig, steps: int, step_ns: int, beside: Path | None = None):
        """Allocate the arrays.

        Args:
            rig: whose messages are recorded.
            steps: E.
            step_ns: length of a step.
            beside: a file in whose folder a long run is stored; None: the temporary folder.

        Raises:
            robins.results.ResultError: there is not enough space on disk.
        """
        self._wire, self._step_ns = rig.wire, step_ns
        every = rig.noted
        self._fields = {m.name: [(f.name, f"{m.name}.{f.name}") for f in m.fields] for m in every}

        def form(f: Field) -> tuple[tuple[int, ...], float | int]:
            shape = (steps, f.length) if f.length > 1 else (steps,)
            return shape, np.nan if f.kind == "f64" else 0

        time_s = np.arange(1, steps + 1) * (step_ns * 1e-9)
        shapes = {f"{m.name}.{f.name}": form(f) for m in every for f in m.fields}
        self._room = NumberStore(shapes, None if beside is None else beside.absolute().parent)
        self._heard = 0
        self.series = MessageSeries(time_s, self._room.arrays)

    def observe(self, message: str, time_ns: int, payload: bytes) -> None:
        """Record a message that passes."""
        fields = self._fields.get(message)
        k = time_ns // self._step_ns - 1
        if fields is None or not 0 <= k < len(self.series.time_s):
            return
        said, arrays = self._wire.decode(message, payload), self.series.arrays
        for field, name in fields:
            arrays[name][k] = said[field]
        self._heard += 1
        if self._heard % _OFTEN == 0:
            self._room.forget()


def require_truth(rig: Rig, series: MessageSeries, counted: slice, time_s: float) -> None:
    """Require that the truth is known in at least one counted step.

    Raises:
        BenchError: it is not.
    """
    if not (truth := rig.truth):
        return
    first = next(x for name, x in series.items() if name.startswith(f"{truth}."))
    known = first[counted]
    if len(known) and not np.any(np.all(np.isfinite(known.reshape(len(known), -1)), axis=-1)):
        speaker = next(part for part, sent in rig.sends.items() if truth in sent)
        raise BenchError(f"no true {truth} was received from '{speaker}' up to {time_s:.1f} s")


def difference(series: MessageSeries, inside: Mapping[str, np.ndarray]) -> float:
    """Greatest absolute difference of a run from the same run inside one program.

    Infinite if a number is missing in one of the two. Components that only one has, such as those
    of an unused wheel, are left out.
    """
    worst = 0.0
    for name, wanted in inside.items():
        a, b = series[name], wanted[: len(series[name])]
        if a.ndim > 1:
            a, b = (x[:, : min(a.shape[1], b.shape[1])] for x in (a, b))
        off = np.abs(a - b)
        if not np.all(np.isfinite(off)):
            return float("inf")
        worst = max(worst, float(np.max(off, initial=0.0)))
    return worst
