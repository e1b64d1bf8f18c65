"""A part's messages in two runs, field by field: where they differ, by how much, since when."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from robins.bench.status import aligned
from robins.bench.wire.fields import Field, Message
from robins.bench.wire.frames import Frame
from robins.bench.wire.schema import FIRST_DATA, Wire

_Pair = tuple[int, bytes, bytes]  # time [ns], and the payloads of both
_BATCH = 1024  # pairs compared at once, to spread the overhead of a NumPy call


@dataclass(frozen=True)
class FieldDifference:
    """One number of one message, over all frames in which it differs.

    `field` is empty for frames that cannot be compared by field: those that only one of the two
    has, and those of a message that this version does not know or whose length differs. Then `a`
    and `b` count the frames, and the other measures are 0.
    """

    message: str
    field: str
    component: int  # of a vector, from 0; -1: the field is one number, or there is none
    unit: str
    max_abs: float  # infinite for NaN against a number, 0 for -0.0 against 0.0
    max_rel: float  # of the larger one of the two
    first_step: int  # from 0; -1: the length of a step is not known
    first_time_s: float
    a: float  # value in the first frame that differs
    b: float
    count: int  # of frames that differ


class Differences:
    """Differences between the frames of two runs, found as the frames come.

    Frames are paired by message and time; several of the same message and time, as after a repeated
    tick, in their order. Numbers are compared bit by bit, so -0.0 is not 0.0, but NaN equals NaN,
    whatever its bits. Run and sequence in the header are ignored, and messages of the protocol are
    left out. Only unpaired frames are kept.

    Attributes:
        frames: number of data frames of each run.
        until_ns: latest time of each.
    """

    def __init__(self, wire: Wire, step_ns: int = 0):
        """Set up a comparison.

        Args:
            wire: the messages of both.
            step_ns: length of a step, to number steps; 0: not known.
        """
        self._wire, self._step_ns = wire, step_ns
        self.frames, self.until_ns = [0, 0], [0, 0]
        # unpaired frames by message and time: run (0 or 1), payloads
        self._waiting: dict[tuple[int, int], tuple[int, deque[bytes]]] = {}
        self._pairs: dict[int, list[_Pair]] = {}  # that differ, by message
        self._odd: dict[int, list[int]] = {}  # times of pairs that differ in no field
        self._found: dict[tuple[str, str, int], FieldDifference] = {}

    def take(self, which: int, frame: Frame) -> None:
        """Add a frame of the first run (0) or of the second (1)."""
        key = number, time_ns = frame.header.type, frame.header.time_ns
        if number < FIRST_DATA:
            return
        self.frames[which] += 1
        self.until_ns[which] = max(self.until_ns[which], time_ns)
        whose, waiting = self._waiting.setdefault(key, (which, deque()))
        if whose == which:
            return waiting.append(frame.payload)
        other = waiting.popleft()
        if not waiting:
            del self._waiting[key]
        x, y = (other, frame.payload) if which else (frame.payload, other)
        if x != y:
            self._differ(number, time_ns, x, y)

    def take_both(self, a: Frame | None, b: Frame | None) -> None:
        """Add a frame of each run, which need not be a pair; None: the run has no more."""
        for which, frame in enumerate((a, b)):
            if frame is not None:
                self.take(which, frame)

    def found(self) -> list[FieldDifference]:
        """Differences in the frames so far, the earliest first."""
        for number in self._pairs:
            self._compare(number)
        only: tuple[dict[int, list[int]], ...] = ({}, {})
        for (number, time_ns), (which, waiting) in self._waiting.items():
            only[which].setdefault(number, []).extend([time_ns] * len(waiting))
        found = list(self._found.values())
        for of, in_a, in_b in ((only[0], 1.0, 0.0), (only[1], 0.0, 1.0), (self._odd, 1.0, 1.0)):
            for number, times in of.items():
                message = self._message(number)
                name, n = message.name if message else f"message {number}", len(times)
                when = _when(min(times), self._step_ns)
                odd = FieldDifference(name, "", -1, "", 0.0, 0.0, *when, in_a * n, in_b * n, n)
                found.append(odd)
        return sorted(found, key=lambda d: (d.first_time_s, self._place(d)))

    def _place(self, d: FieldDifference) -> tuple[int, int, int]:
        """Sort key: place in the table of messages; a difference without a field comes last."""
        of = next((m for m in self._wire.data if m.name == d.message), None)
        if of is None:
            return 1 << 16, 0, 0
        fields = [f.name for f in of.fields]
        return of.number, fields.index(d.field) if d.field else len(fields), d.component

    def _message(self, number: int) -> Message | None:
        return self._wire.message(number) if number in self._wire.names else None

    def _differ(self, number: int, time_ns: int, x: bytes, y: bytes) -> None:
        of = self._message(number)
        if of is None or not len(x) == len(y) == of.size:
            self._odd.setdefault(number, []).append(time_ns)
            return
        pairs = self._pairs.setdefault(number, [])
        pairs.append((time_ns, x, y))
        if len(pairs) == _BATCH:
            self._compare(number)

    def _compare(self, number: int) -> None:
        """Compare the pairs that differ field by field."""
        pairs, of = sorted(self._pairs[number]), self._message(number)
        self._pairs[number].clear()
        for new in _of_fields(self._wire, of, pairs, self._step_ns) if of and pairs else ():
            key = new.message, new.field, new.component
            old = self._found.get(key, new)
            if old is not new:
                new = replace(
                    min(old, new, key=lambda d: d.first_time_s),
                    max_abs=max(old.max_abs, new.max_abs),
                    max_rel=max(old.max_rel, new.max_rel),
                    count=old.count + new.count,
                )
            self._found[key] = new


def differences(
    wire: Wire, a: Iterable[Frame], b: Iterable[Frame], step_ns: int = 0
) -> list[FieldDifference]:
    """Fields in which the frames of two runs differ; see `Differences`."""
    of = Differences(wire, step_ns)
    for pair in zip_longest(a, b):
        of.take_both(*pair)
    return of.found()


def _when(time_ns: int, step_ns: int) -> tuple[int, float]:
    """Step and time [s] of a message, which is stamped with the end of its step."""
    return time_ns // step_ns - 1 if step_ns else -1, time_ns * 1e-9


def _of_fields(
    wire: Wire, of: Message, frames: Sequence[_Pair], step_ns: int
) -> list[FieldDifference]:
    a = [wire.decode(of.name, x) for _, x, _ in frames]
    b = [wire.decode(of.name, y) for _, _, y in frames]
    found = []
    for f in of.fields:
        kind = np.float64 if f.kind == "f64" else np.uint64
        x = np.array([np.ravel(v[f.name]) for v in a], dtype=kind)  # (frames, length)
        y = np.array([np.ravel(v[f.name]) for v in b], dtype=kind)
        for k in range(f.length):
            where = np.flatnonzero(_differ(f, x[:, k], y[:, k]))
            if not len(where):
                continue
            first = int(where[0])
            place = of.name, f.name, -1 if f.length == 1 else k, f.unit
            most, when = _largest(x[where, k], y[where, k]), _when(frames[first][0], step_ns)
            values = float(x[first, k]), float(y[first, k])
            found.append(FieldDifference(*place, *most, *when, *values, len(where)))
    return found


def _differ(f: Field, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    bits = np.ascontiguousarray(x).view(np.uint64) != np.ascontiguousarray(y).view(np.uint64)
    return bits & ~(np.isnan(x) & np.isnan(y)) if f.kind == "f64" else bits


def _largest(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Largest absolute and largest relative difference."""
    with np.errstate(all="ignore"):  # infinities and NaN are dealt with below
        # unsigned numbers cannot go below zero
        apart = np.where(x > y, x - y, y - x).astype(np.float64)
        apart[np.isnan(apart)] = np.inf
        larger = np.fmax(np.abs(x), np.abs(y)).astype(np.float64)
        relative = np.where(np.isinf(apart), np.inf, apart / larger)
    relative[apart == 0] = 0.0
    return float(apart.max()), float(relative.max())


def table(
    found: Sequence[FieldDifference], names: tuple[str, str] = ("recorded", "replayed")
) -> str:
    """Text table of differences, one line each.

    Args:
        found: of `differences`.
        names: of the two runs, in the order in which they were given.
    """
    if not found:
        return "No difference: every number has the same bits."
    numbers = [d for d in found if d.field]
    lines = []
    if numbers:
        head = ("number", "unit", "frames", "since step", "since s", *names, "most", "relative")
        lines += aligned([head, *(_row(d) for d in numbers)])
    lines += [_sentence(d, names) for d in found if not d.field]
    if any(d.max_abs == 0 for d in numbers):
        lines.append(
            "A difference of 0 is one of sign: -0.0 and 0.0 are equal, their bits are not."
        )
    return "\n".join(lines)


def name_of(d: FieldDifference) -> str:
    """Name of a number, such as ``estimate.q_ib[2]``."""
    index = "" if d.component < 0 else f"[{d.component}]"
    return f"{d.message}.{d.field}{index}" if d.field else d.message


def _row(d: FieldDifference) -> tuple[str, ...]:
    a, b = f"{d.a:.9g}", f"{d.b:.9g}"
    if a == b:  # as many digits as are needed to tell them apart
        a, b = repr(d.a), repr(d.b)
    when = "-" if d.first_step < 0 else str(d.first_step), f"{d.first_time_s:.9g}"
    most = f"{d.max_abs:.3g}", f"{d.max_rel:.3g}"
    return (name_of(d), d.unit, str(d.count), *when, a, b, *most)


def _sentence(d: FieldDifference, names: tuple[str, str]) -> str:
    when = f"from {d.first_time_s:.9g} s on" if d.count > 1 else f"at {d.first_time_s:.9g} s"
    if d.a and d.b:
        return f"{d.message}: {d.count} frames of a length that is not that of the message, {when}."
    return f"{d.message}: {d.count} frames only {names[0] if d.a else names[1]}, {when}."
