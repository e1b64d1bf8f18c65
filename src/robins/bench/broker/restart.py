"""Restarts a part that died and sends it the messages since its last saved memory.

The same part with the same frames reaches the same state to the last bit, so the run continues
unchanged. The cost is the start of the process, and some hundred steps to compute again.
"""

from __future__ import annotations

import math
import os
import select
import time
from collections import deque
from collections.abc import Callable, Sequence

from robins.bench.broker.link import BenchError, Link
from robins.bench.parts.station import is_due
from robins.bench.wire.frames import Frame, Header, encode_frame
from robins.bench.wire.receiver import Receiver
from robins.bench.wire.schema import BARE, NUMBERS

SentFrame = tuple[int | None, bytes]
"""Step and bytes of a tick sent to a part; the step is None for other frames."""


class SentFrames:
    """Frames sent to a part since it last saved its memory.

    Attributes:
        sent_frames: those frames.
        since: the step after which the memory was saved; -1: never.
    """

    def __init__(self, is_there: Callable[[int], bool]):
        """Start empty.

        Args:
            is_there: tells if the memory saved after a step has been written.
        """
        self.sent_frames: list[SentFrame] = []
        self.since = -1
        self._is_there = is_there

    def add(self, step: int | None, raw: bytes) -> None:
        """Add a frame, as `SentFrame`."""
        self.sent_frames.append((step, raw))

    def forget(self) -> None:
        """Drop all frames: the part has lost its memory and has received nothing."""
        self.sent_frames.clear()
        self.since = -1

    def answered(self, step: int) -> None:
        """Drop frames up to the last step whose memory the part has saved."""
        if is_due(step) and step > self.since and self._is_there(step):
            first = next(k for k, (of, _) in enumerate(self.sent_frames) if of == step)
            del self.sent_frames[: first + 1]
            self.since = step


def catch_up(
    link: Link,
    sent_frames: Sequence[SentFrame],
    begin: bytes,
    answered: int,
    timeout_s: float,
    poll_processes: Callable[[], None],
    idle_s: Callable[[], float] = lambda: math.inf,
) -> None:
    """Wait for the hello of a restarted part, and bring it to the state of the old one.

    Args:
        link: its link; nothing else reads or writes it meanwhile.
        sent_frames: all frames sent to the old one since the memory of this one, in order.
        begin: the frame that begins the run.
        answered: the last step whose tick the old one answered; ticks beyond are sent, but their
            answers are left to the broker. -1: none.
        timeout_s: time-out for its hello, and for each answer.
        poll_processes: called now and then.
        idle_s: idle time of its process [s]; a process that computes has no time-out.

    Raises:
        BenchError: it does not answer.
        OSError: the far end is gone.
    """
    receiver, came = Receiver(), deque[Frame]()

    def await_frame(name: str, step: int | None = None) -> None:
        began = time.monotonic()
        while True:
            while came:
                frame = came.popleft()
                if frame.header.type == NUMBERS[name] and (
                    step is None or BARE.decode(name, frame.payload)["step"] == step
                ):
                    return
            if min(time.monotonic() - began, idle_s()) > timeout_s:
                what = name if step is None else f"answer to the tick of step {step}"
                raise BenchError(
                    f"'{link.name}' was restarted, but there is no {what} from it in "
                    f"{timeout_s:g} s"
                )
            poll_processes()
            if select.select([link.fd], [], [], 0.05)[0]:
                came.extend(receiver.feed(os.read(link.fd, 65536)))

    await_frame("hello")
    _write(link.fd, begin)
    for step, raw in sent_frames:
        _write(link.fd, raw)
        if step is not None and step <= answered:
            await_frame("done", step)


def beginning(run: int, step_ns: int) -> bytes:
    """The frame that begins a run."""
    return encode_frame(
        Header(NUMBERS["begin"], run, 0, 0), BARE.encode("begin", {"step": step_ns})
    )


def _write(fd: int, raw: bytes) -> None:
    """Write all bytes to a port that may be full."""
    while raw:
        try:
            raw = raw[os.write(fd, raw) :]
        except BlockingIOError:
            select.select([], [fd], [], 0.05)
