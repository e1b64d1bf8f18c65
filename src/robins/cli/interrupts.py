"""Handling of Ctrl-C: an interrupt must not get lost in a compiler or a garbage collector.

Python raises KeyboardInterrupt wherever the main thread happens to be. After a long call into
compiled code that is often a callback of the garbage collector, from which nothing can be raised:
the interrupt would be printed and forgotten.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

# Functions whose exceptions Python ignores; JAX adds the first to every garbage collection.
_SWALLOWING = frozenset({"_xla_gc_callback", "__del__"})
_AGAIN_S = 0.05
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)

_asked = False


def _swallows_interrupts(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_name in _SWALLOWING:
            return True
        frame = frame.f_back
    return False


def _interrupt(_number: int, frame: FrameType | None) -> None:
    global _asked
    _asked = True
    if _swallows_interrupts(frame):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)  # try again a little later
        return
    raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Context in which SIGINT, SIGTERM and SIGHUP raise KeyboardInterrupt on receipt.

    SIGTERM and SIGHUP too, so that a command that is killed, or whose terminal is closed, unwinds
    and leaves no incomplete folder. A SIGHUP ignored by `nohup` stays ignored.
    """
    global _asked
    _asked = False
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    numbers = [n for n in _SIGNALS if not (nohup and n == signal.SIGHUP)]
    before = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt_requested() -> bool:
    """True if an interrupt was requested."""
    return _asked


def raise_if_interrupted() -> None:
    """Raise KeyboardInterrupt if one was requested and swallowed by other code on its way."""
    if _asked:
        raise KeyboardInterrupt
