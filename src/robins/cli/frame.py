"""Common parts of all commands: exit status, errors of the user, choice of streams."""

from __future__ import annotations

import contextlib
import enum
import os
import sys
from collections.abc import Iterator

import click


class ExitStatus(enum.IntEnum):
    """Exit status of every command."""

    DONE = 0
    FAILED = 1
    BAD_INPUT = 2
    INTERRUPTED = 3  # the same command, run again, continues or starts again


@contextlib.contextmanager
def only_json(wanted: bool) -> Iterator[None]:
    """Redirect all prints of a command to standard error if JSON is wanted."""
    with contextlib.ExitStack() as stack:
        if wanted:
            stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        yield


def command_line() -> str:
    """The command as it was typed, to be typed again; bytes that are not UTF-8 as escapes."""
    import shlex

    typed = shlex.join(["robins", *(click.get_current_context().obj or [])])
    return os.fsencode(typed).decode("utf-8", "backslashreplace")
