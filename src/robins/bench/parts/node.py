"""A part of the vehicle as a process of its own, connected by its port alone.

python -m robins.bench.parts.node satellite gyro /dev/pts/5,460800 config

Given a folder, it saves its memory there; given a step too, it goes on from the memory of that
step.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from robins.bench.parts.config_files import take
from robins.bench.parts.station import Station, path_of, ready, save_memory, serve
from robins.bench.ports.port import address, open_port
from robins.bench.rigs import rig_of
from robins.errors import RobinsError

REALTIME = "ROBINS_BENCH_REALTIME"  # set by the bench: request SCHED_FIFO
_PRIORITY = 50
RARELY = 100_000  # allocations between two collections of garbage


def set_realtime() -> str:
    """Request a real-time scheduler; returns the reason of a refusal, or an empty string."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (AttributeError, OSError) as error:
        return f"no real-time scheduler: {error}"
    return ""


@contextlib.contextmanager
def realtime(wanted: bool) -> Iterator[str]:
    """Context with a real-time scheduler, if wanted; yields the reason of a refusal, or ""."""
    why = set_realtime() if wanted else ""
    try:
        yield why
    finally:
        if wanted and not why:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def fewer_collections() -> Iterator[None]:
    """Context with rare garbage collections, which would delay a step: reference counts free the
    objects of a run, and each collection scans all of JAX.
    """
    before = gc.get_threshold()
    gc.collect()
    gc.set_threshold(RARELY, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def main(arguments: Sequence[str]) -> int:
    """Run a part until the bench sends stop or disconnects."""
    try:
        return _run_part(arguments)
    except RobinsError as error:  # the bench shows its last line to the user
        print(error, file=sys.stderr)
        return 2


def _run_part(arguments: Sequence[str]) -> int:
    rig_name, name, port, config_path, *more = arguments
    # An interrupt of the terminal is for the bench, which then stops its parts.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    rig = rig_of(rig_name)
    config = take(Path(config_path))
    part = ready(rig.part(name, config), config.frames)
    station = Station(part, rig.wire)
    if more:
        folder, since = Path(more[0]), int(more[1])
        memory = None if since < 0 else path_of(folder, name, since).read_bytes()
        station = Station(part, rig.wire, memory, partial(save_memory, folder, name))
    if os.environ.get(REALTIME) and (why := set_realtime()):
        print(why, file=sys.stderr)
    gc.collect()
    gc.freeze()  # imported and compiled objects stay, and need not be scanned
    gc.set_threshold(RARELY)
    try:
        with open_port(address(port), timeout_s=None) as line:
            serve(line, station)
    except RobinsError:  # of which some are OSErrors too
        raise
    except OSError:  # of which pyserial's are
        return 0  # the bench is gone, and so are we
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
