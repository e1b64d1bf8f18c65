"""Injection of faults into the links, at the bench.

A fault of the line acts on bytes: bit errors (the check is then wrong), loss, duplication,
disorder, delay, silence. A fault of a sensor or an actuator acts on the content: the payload
changes, and the frame stays valid. Those are applied first, as on the way of a frame.

Random numbers come from a counter-based generator (Salmon et al., "Parallel random numbers: as easy
as 1, 2, 3", SC 2011: NumPy's Philox), addressed by the seed, the number of the fault, link,
direction, and the count of frames that the fault met there. So the result depends on the frames and
the clock of the run only, never on its speed or on other faults.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from robins.bench.broker.faults import PROCESS, Direction, FaultTable, LinkFault, Stage
from robins.bench.wire.frames import Frame, encode_frame
from robins.bench.wire.schema import FIRST_DATA

_SECOND_NS = 1_000_000_000
_CHANCE, _BITS = 0, 1  # use of a random number: to hit a frame, to choose bits
_BLOCK = 256  # chances drawn at once


class LineOutput(NamedTuple):
    """Output of the injector: bytes as the line damaged them, or a frame that gets a new header."""

    raw: bytes | None
    frame: Frame | None


class _HeldFrame(NamedTuple):
    due_ns: float | int
    piece: LineOutput
    type: int
    fault: int | None  # number of a reorder fault, which holds the frame until the next of its type


class _Fault(NamedTuple):
    """A fault with its number, its times and the type of its message."""

    number: int
    begin_ns: int
    end_ns: float | int
    type: int | None  # of the message
    is_: LinkFault

    def applies_to(self, link: str, direction: str, kind: int, now_ns: int) -> bool:
        return (
            self.begin_ns <= now_ns < self.end_ns
            and self.is_.link in (None, link)
            and self.is_.direction == direction
            and self.type in (None, kind)
            and self.is_.kind not in PROCESS
        )


class Injector:
    """Applies faults to the frames that pass.

    Attributes:
        counts: frames hit so far, by kind and link; parts for "killed" and "power".
    """

    def __init__(self, table: FaultTable, faults: Iterable[LinkFault] = (), seed: int = 0) -> None:
        """Set up the faults of a run.

        Args:
            table: the faults of the rig.
            faults: active or planned at the start.
            seed: of their random numbers.

        Raises:
            ValueError: a seed below 0 or of more than 64 bits.
        """
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed must be from 0 to 2^64 - 1, got {seed}")
        self.counts: Counter[tuple[str, str]] = Counter()
        self._seed, self._table, self._wire = seed, table, table.wire
        repeated = [one.message for one in table.device_faults.values() if one.stage == "repeated"]
        self._repeated = {table.wire.numbers[name] for name in repeated}
        self._faults: list[_Fault] = []
        self._added = 0
        self._met: Counter[tuple[int, str, str]] = Counter()
        self._chances: dict[tuple[int, str, str], np.ndarray] = {}
        self._said: dict[tuple[str, str, int], bytes] = {}
        self._held: dict[tuple[str, str], list[_HeldFrame]] = {}
        self._killed: set[int] = set()
        for fault in faults:
            self.add(fault)

    def add(self, fault: LinkFault) -> None:
        """Add a fault after the present ones; if its begin is past, it acts from now on."""
        kind = None if fault.message is None else self._wire.numbers[fault.message]
        # a number is never used again, even when faults are cleared: each has its own noise
        self._faults.append(_Fault(self._added, fault.begin_ns, fault.end_ns, kind, fault))
        self._added += 1

    def clear(self) -> None:
        """Remove all faults; frames that are held back are due now."""
        self._faults.clear()
        for held in self._held.values():
            held[:] = [one._replace(due_ns=-math.inf, fault=None) for one in held]

    def remove(self, fault: LinkFault) -> None:
        """Remove a fault; frames that it holds back still come at their time."""
        self._faults = [one for one in self._faults if one.is_ is not fault]

    def active(self, now_ns: int) -> list[LinkFault]:
        """Faults that are active at that time of the run."""
        return [fault.is_ for fault in self._faults if fault.is_.holds(now_ns)]

    def killed(self, now_ns: int) -> list[str]:
        """Links whose part is to be killed by now; each fault is listed once."""
        found = []
        for fault in self._faults:
            link, due = fault.is_.link, fault.begin_ns <= now_ns
            if fault.is_.kind == "killed" and link and due and fault.number not in self._killed:
                self._killed.add(fault.number)
                self.counts["killed", link] += 1
                found.append(link)
        return found

    def off(self, now_ns: int) -> set[str]:
        """Links whose part has no power at that time of the run."""
        return {f.link for f in self.active(now_ns) if f.kind == "power" and f.link}

    def pass_on(
        self, link: str, direction: Direction, frame: Frame, raw: bytes, now_ns: int
    ) -> list[LineOutput]:
        """Output for a frame: one or two pieces; none if it is lost or held back.

        Args:
            link: part whose link it is.
            direction: from the part, or to it.
            frame: as received, or as it would be sent.
            raw: its bytes, zeros at both ends included.
            now_ns: time of the run, that of the end of the step.
        """
        kind = frame.header.type
        if kind < FIRST_DATA:
            return [LineOutput(None, frame)]
        where = link, direction
        met = [one for one in self._faults if one.applies_to(link, direction, kind, now_ns)]
        if met or kind in self._repeated:
            payload = self._faulty_payload(where, kind, frame.payload, met, now_ns)
            if payload is not frame.payload:
                frame = frame._replace(payload=payload)
                raw = encode_frame(*frame)
        pieces = [LineOutput(None, frame)]
        for one in met:
            if pieces and one.is_.kind not in self._table.device_faults:
                pieces = self._damaged(where, kind, one, pieces, raw, now_ns)
        if pieces and where in self._held:
            pieces += self._reordered(where, kind)
        return pieces

    def release(self, link: str, direction: Direction, now_ns: int) -> list[LineOutput]:
        """Frames that were held back and are due, the earliest first."""
        held = self._held.get((link, direction))
        if not held:
            return []
        due = sorted((one for one in held if one.due_ns <= now_ns), key=lambda one: one.due_ns)
        held[:] = [one for one in held if one.due_ns > now_ns]
        return [one.piece for one in due]

    def _hit(self, where: tuple[str, str], one: _Fault) -> int | None:
        """Number of earlier frames on a link that a fault affected; None: it does not affect this
        one.
        """
        stream = one.number, *where
        count = self._met[stream]
        self._met[stream] += 1
        if one.is_.share < 1.0:
            if count % _BLOCK == 0:
                self._chances[stream] = self._noise(where, one, count, _CHANCE).random(_BLOCK)
            if self._chances[stream][count % _BLOCK] >= one.is_.share:
                return None
        self.counts[one.is_.kind, where[0]] += 1
        return count

    def _noise(
        self, where: tuple[str, str], one: _Fault, count: int, use: int
    ) -> np.random.Generator:
        """Random generator of a fault for one frame and one use."""
        parts = self._wire.parts
        place = 2 * parts.index(where[0]) + (where[1] == "to")
        key = [self._seed, one.number * 2 * len(parts) + place]
        return np.random.Generator(np.random.Philox(key=key, counter=[0, count, use, 0]))

    # ------------------------------------------------------------------- payloads

    def _faulty_payload(
        self, where: tuple[str, str], kind: int, payload: bytes, met: list[_Fault], now_ns: int
    ) -> bytes:
        """Payload of a sensor or an actuator under its faults; see `Stage`."""
        name = self._wire.names.get(kind)
        if name is None or len(payload) != self._wire.size_of(name):
            return payload  # no such message; its receiver will refuse it
        says = self._table.device_faults
        hits = [
            one.is_ for one in met if one.is_.kind in says and self._hit(where, one) is not None
        ]

        def at(stage: Stage) -> list[LinkFault]:
            return [fault for fault in hits if says[fault.kind].stage == stage]

        def changed(payload: bytes, faults: list[LinkFault]) -> bytes:
            for fault in faults:
                values = self._wire.decode(name, payload)
                payload = self._wire.encode(name, says[fault.kind].act(values, fault, now_ns))
            return payload

        payload, of = changed(payload, at("sensed")), (*where, kind)
        if at("repeated"):
            payload = self._said.get(of, payload)
        blind = at("blind")
        if kind in self._repeated and not blind and not self._lacks(name, payload):
            self._said[of] = payload
        return changed(changed(payload, at("said")), blind)

    def _lacks(self, name: str, payload: bytes) -> bool:
        """True if a number of a message is missing."""
        values = self._wire.decode(name, payload)
        fields = self._wire.message(name).fields
        return any(f.missing and np.isnan(values[f.name]).any() for f in fields)

    # ---------------------------------------------------------------- what the line does

    def _damaged(
        self,
        where: tuple[str, str],
        kind: int,
        one: _Fault,
        pieces: list[LineOutput],
        raw: bytes,
        now_ns: int,
    ) -> list[LineOutput]:
        """Pieces of a frame after a fault of the line."""
        fault, held = one.is_, self._held.setdefault(where, [])
        waits = any(h.fault == one.number and h.type == kind for h in held)
        if fault.kind == "reorder" and waits:
            return pieces  # the frame for which an earlier, reordered one waits
        count = self._hit(where, one)
        if count is None:
            return pieces
        if fault.kind == "bit errors":
            noise = self._noise(where, one, count, _BITS)
            return [LineOutput(_inverted(p.raw or raw, fault.bits, noise), None) for p in pieces]
        if fault.kind == "duplication":
            return pieces * 2
        if fault.kind == "delay" and fault.delay is not None:
            due = now_ns + round(fault.delay * _SECOND_NS)
            held += [_HeldFrame(due, piece, kind, None) for piece in pieces]
        elif fault.kind == "reorder":
            held += [_HeldFrame(one.end_ns, piece, kind, one.number) for piece in pieces]
        return []  # held, or lost

    def _reordered(self, where: tuple[str, str], kind: int) -> list[LineOutput]:
        """Reordered frames that waited for a frame of this type."""
        held = self._held[where]
        out = [one.piece for one in held if one.fault is not None and one.type == kind]
        if out:
            held[:] = [one for one in held if one.fault is None or one.type != kind]
        return out


def _inverted(raw: bytes, bits: int, noise: np.random.Generator) -> bytes:
    """Copy of a frame with `bits` different bits inverted."""
    out = bytearray(raw)
    for k in noise.choice(8 * len(raw), min(bits, 8 * len(raw)), replace=False):
        out[k // 8] ^= 1 << int(k % 8)
    return bytes(out)
