"""Display of progress on a terminal, on standard error: a line at once, then a bar."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from typing import Any

from robins.cli import interrupts

WAIT_S = 1.0
_ERASED = "\r\x1b[2K"


class Progress:
    """Progress display, called with the share done (0 to 1) and the present activity.

    As a context manager it shows a line at once, before any slow import, and a bar after `WAIT_S`,
    even if it was not called yet (as in a compilation), and erases both at the end.
    """

    def __init__(self, what: str = "starting", stream: Any = None, wait_s: float = WAIT_S):
        self._stream = sys.stderr if stream is None else stream
        self._lock = threading.Lock()
        self._share, self._what = 0.0, what
        self._bar: Any = None
        self._task: Any = None
        self._timer = threading.Timer(wait_s, self._show)
        self._timer.daemon = True

    def __call__(self, share: float, what: str) -> None:
        """Update the progress.

        Raises:
            KeyboardInterrupt: an interrupt was requested, and swallowed by other code.
        """
        interrupts.raise_if_interrupted()
        with self._lock:
            self._share, self._what = min(max(share, 0.0), 1.0), what
            if self._bar is not None:
                self._bar.update(self._task, completed=self._share, description=self._what)

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            SpinnerColumn,
            TaskProgressColumn,
            TextColumn,
            TimeElapsedColumn,
        )
        from rich.progress import Progress as Bar

        columns = (
            SpinnerColumn("line"),  # shows activity in a compilation, which reports no share
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
        )
        with self._lock:
            if self._timer.finished.is_set():
                return  # the work ended while the bar was being made
            self._line(_ERASED)
            self._bar = Bar(*columns, console=Console(file=self._stream), transient=True)
            self._task = self._bar.add_task(self._what, total=1.0, completed=self._share)
            self._bar.start()

    def _line(self, text: str) -> None:
        """Write a line to a terminal that can erase it; the terminal may have been closed."""
        if self._stream.isatty() and os.environ.get("TERM") != "dumb":
            with contextlib.suppress(OSError):
                self._stream.write(text)
                self._stream.flush()

    def __enter__(self) -> Progress:
        self._line(f"{self._what} ...")
        if self._stream.isatty():
            self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        with self._lock:
            if self._bar is None:
                self._line(_ERASED)
                return
            with contextlib.suppress(OSError):  # the terminal may have been closed
                self._bar.stop()
            self._bar = None
