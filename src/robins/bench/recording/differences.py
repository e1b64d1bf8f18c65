"""A part's messages in two runs, field by field: where they differ, by how much, since when."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from robins.bench.status import aligned
from robins.bench.wire.fields import Field, Message
from robins.bench.wire.frames import Frame
from robins.bench.wire.schema import FIRST_DATA, Wire

Payloads = dict[tuple[int, int, int], bytes]
"""Payloads by message, time, and which of those with both alike."""


@dataclass(frozen=True)
class FieldDifference:
    """One number of one message, over all frames in which it differs.

    What cannot be told by fields has an empty `field`: frames that only one of the two has, and
    frames of a message that this version does not know or knows by another length. Then `a` and
    `b` count the frames, and the other measures are 0.
    """

    message: str
    field: str
    component: int  # of a vector, from 0; -1: the field is one number, or there is none
    unit: str
    max_abs: float  # infinite for NaN against a number, 0 for -0.0 against 0.0
    max_rel: float  # of the larger one of the two
    first_step: int  # from 0; -1: the length of a step is not known
    first_time_s: float
    a: float  # of the first frame that differs
    b: float
    count: int  # of frames that differ


def differences(
    wire: Wire, a: Iterable[Frame], b: Iterable[Frame], step_ns: int = 0
) -> list[FieldDifference]:
    """Where the frames of two runs differ, the earliest difference first; none: an empty list.

    Frames belong together if message and time are the same; of several such, as of a tick that was
    repeated, the first to the first. Numbers are compared bit by bit, so -0.0 is not 0.0, but NaN
    is NaN, whatever its bits. Run and sequence in the header are not looked at, and messages of the
    protocol are left out.

    Args:
        wire: their messages.
        a: frames of one run.
        b: frames of the other.
        step_ns: length of a step, to tell steps; 0: not known.
    """
    of_a, of_b = _by_key(a), _by_key(b)
    found: list[FieldDifference] = []
    for number in sorted({key[0] for key in (*of_a, *of_b)}):
        found += _of_message(wire, number, of_a, of_b, step_ns)
    return sorted(found, key=lambda d: d.first_time_s)


def _by_key(frames: Iterable[Frame]) -> Payloads:
    found: Payloads = {}
    seen: dict[tuple[int, int], int] = {}
    for frame in frames:
        number, time_ns = frame.header.type, frame.header.time_ns
        if number < FIRST_DATA:
            continue
        again = seen.get((number, time_ns), 0)
        seen[number, time_ns] = again + 1
        found[number, time_ns, again] = frame.payload
    return found


def _of_message(
    wire: Wire, number: int, a: Payloads, b: Payloads, step_ns: int
) -> list[FieldDifference]:
    of = wire.message(number) if number in wire.names else None
    only_a: list[int] = []  # times [ns] of frames that only one has
    only_b: list[int] = []
    as_bytes: list[int] = []  # of frames that both have and no field tells apart
    by_fields: list[tuple[int, bytes, bytes]] = []
    for key in sorted(key for key in a.keys() | b.keys() if key[0] == number):
        x, y, time_ns = a.get(key), b.get(key), key[1]
        if y is None:
            only_a.append(time_ns)
        elif x is None:
            only_b.append(time_ns)
        elif x != y and of and len(x) == len(y) == of.size:
            by_fields.append((time_ns, x, y))
        elif x != y:
            as_bytes.append(time_ns)
    found = _of_fields(wire, of, by_fields, step_ns) if of and by_fields else []
    name = of.name if of else f"message {number}"
    for times, in_a, in_b in ((only_a, 1.0, 0.0), (only_b, 0.0, 1.0), (as_bytes, 1.0, 1.0)):
        if n := len(times):
            when = _when(times[0], step_ns)
            found.append(FieldDifference(name, "", -1, "", 0.0, 0.0, *when, in_a * n, in_b * n, n))
    return found


def _when(time_ns: int, step_ns: int) -> tuple[int, float]:
    """Step and time [s]; a message has the time of its step's end."""
    return time_ns // step_ns - 1 if step_ns else -1, time_ns * 1e-9


def _of_fields(
    wire: Wire, of: Message, frames: Sequence[tuple[int, bytes, bytes]], step_ns: int
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
            most, when = _how_much(x[where, k], y[where, k]), _when(frames[first][0], step_ns)
            values = float(x[first, k]), float(y[first, k])
            found.append(FieldDifference(*place, *most, *when, *values, len(where)))
    return found


def _differ(f: Field, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    bits = np.ascontiguousarray(x).view(np.uint64) != np.ascontiguousarray(y).view(np.uint64)
    return bits & ~(np.isnan(x) & np.isnan(y)) if f.kind == "f64" else bits


def _how_much(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """The largest difference and the largest relative one."""
    with np.errstate(all="ignore"):  # infinities and NaN are dealt with below
        # whole numbers have no sign to go below zero
        apart = np.where(x > y, x - y, y - x).astype(np.float64)
        apart[np.isnan(apart)] = np.inf
        larger = np.fmax(np.abs(x), np.abs(y)).astype(np.float64)
        relative = np.where(np.isinf(apart), np.inf, apart / larger)
    relative[apart == 0] = 0.0
    return float(apart.max()), float(relative.max())


def table(
    found: Sequence[FieldDifference], names: tuple[str, str] = ("recorded", "replayed")
) -> str:
    """Differences for people, one line each.

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
    """Such as ``estimate.q_ib[2]``."""
    index = "" if d.component < 0 else f"[{d.component}]"
    return f"{d.message}.{d.field}{index}" if d.field else d.message


def _row(d: FieldDifference) -> tuple[str, ...]:
    a, b = f"{d.a:.9g}", f"{d.b:.9g}"
    if a == b:  # as many digits as it takes
        a, b = repr(d.a), repr(d.b)
    when = "-" if d.first_step < 0 else str(d.first_step), f"{d.first_time_s:.9g}"
    most = f"{d.max_abs:.3g}", f"{d.max_rel:.3g}"
    return (name_of(d), d.unit, str(d.count), *when, a, b, *most)


def _sentence(d: FieldDifference, names: tuple[str, str]) -> str:
    when = f"from {d.first_time_s:.9g} s on" if d.count > 1 else f"at {d.first_time_s:.9g} s"
    if d.a and d.b:
        return f"{d.message}: {d.count} frames of a length that is not that of the message, {when}."
    return f"{d.message}: {d.count} frames only {names[0] if d.a else names[1]}, {when}."
