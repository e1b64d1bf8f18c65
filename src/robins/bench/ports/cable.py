"""A serial cable without hardware: two paths; bytes written to one are read from the other.

    python -m robins.bench.ports.cable

It replaces the cable between the bench, which opens one path like the port of a real board, and a
program that simulates the board, which opens the other.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections.abc import Iterator
from typing import NamedTuple

from robins.bench.ports.port import Pair, open_pair

_MOST = 65536


class Cable(NamedTuple):
    """The paths of the two ends."""

    bench: str
    board: str


@contextlib.contextmanager
def cable() -> Iterator[Cable]:
    """Context with a cable between two pseudo-terminals; unread bytes wait at its end."""
    with contextlib.ExitStack() as stack:
        one, other = (stack.enter_context(open_pair()) for _ in range(2))
        wake, woken = os.pipe()
        for end in (wake, woken):
            stack.callback(os.close, end)
        carrier = threading.Thread(target=_copy_both_ways, args=(one, other, wake), daemon=True)
        carrier.start()
        try:
            yield Cable(one.path, other.path)
        finally:
            os.write(woken, b"\0")
            carrier.join()


def _copy_both_ways(one: Pair, other: Pair, wake: int) -> None:
    """Copy both ways until woken."""
    across = {one.master: other.master, other.master: one.master}
    waiting = dict.fromkeys(across, b"")  # bytes to write, by end
    while True:
        # read an end only when its earlier bytes are written, so that no more than those are held
        free = [end for end in across if not waiting[across[end]]]
        full = [end for end in across if waiting[end]]
        readable, writable, _ = select.select([wake, *free], full, [])
        if wake in readable:
            return
        for end in readable:
            waiting[across[end]] = os.read(end, _MOST)
        for end in writable:
            with contextlib.suppress(BlockingIOError):
                waiting[end] = waiting[end][os.write(end, waiting[end]) :]


def main() -> None:
    """Run a cable until interrupted."""
    with cable() as ends, contextlib.suppress(KeyboardInterrupt):
        print(f"bench: {ends.bench}\nboard: {ends.board}\nCtrl-C ends it.", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
