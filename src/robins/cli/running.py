"""Execution of a command line: errors in a few lines, interrupts, failures of output."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

import click

from robins.cli import interrupts
from robins.cli.commands import app
from robins.cli.frame import ExitStatus
from robins.errors import RobinsError
from robins.systems import trust

_OF_A_PATH = {  # faults of a given path, not of the disk
    *(errno.ENAMETOOLONG, errno.EEXIST, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP),
    *(errno.EACCES, errno.EPERM),
}
_OF_THE_BENCH = ("serial", "cobs", "fastcrc", "mcap")  # packages of the extra "bench"


class _Output:
    """Standard output that accepts any character and records a failure to write.

    Characters that its encoding lacks become question marks, or escapes in JSON.
    """

    def __init__(self, stream: Any, as_json: bool):
        self._stream = stream
        self._as_json = as_json
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._watched():
            try:
                return self._stream.write(text)
            except UnicodeEncodeError:
                return self._stream.write("".join(map(self._encodable, text)))

    def _encodable(self, character: str) -> str:
        try:
            character.encode(self._stream.encoding)
            return character
        except UnicodeEncodeError:
            return json.dumps(character)[1:-1] if self._as_json else "?"

    def flush(self) -> None:
        with self._watched():
            self._stream.flush()

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.failure = error
            raise

    def abandon(self) -> None:
        """Discard buffered output, which the interpreter would try to write again at its end."""
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; the arguments of the process by default.

    Returns:
        The exit status, see `ExitStatus`. Errors are reported in a few lines on standard error,
        with the traceback only if ``--debug`` is among the arguments.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    with contextlib.ExitStack() as stack:
        if sys.stderr is None:  # closed by `2>&-`: the next file opened would get its number
            nowhere = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
            stack.enter_context(contextlib.redirect_stderr(nowhere))
        if sys.stdout is None:
            _print_error("cannot write to standard output: it is closed")
            return ExitStatus.FAILED
        output = _Output(sys.stdout, "--json" in given)
        stack.enter_context(interrupts.interruptible())
        stack.enter_context(contextlib.redirect_stdout(output))
        try:
            status = app.main(given, prog_name="robins", standalone_mode=False, obj=given)
            output.flush()
            return status if isinstance(status, int) else ExitStatus.DONE
        except (click.Abort, KeyboardInterrupt) as stop:
            for note in getattr(stop.__cause__ or stop, "__notes__", ()):  # click wraps Ctrl-C
                _print_error(note)
            return _interrupted(for_good=arguments is None)
        except Exception as error:
            if (
                interrupts.interrupt_requested()
            ):  # and turned into this on its way, as by a terminal that is gone
                return _interrupted(for_good=arguments is None)
            if output.failure is not None:
                output.abandon()
                if output.failure.errno != errno.EPIPE:  # a reader may close the pipe early
                    why = output.failure.strerror or output.failure
                    _print_error(f"cannot write to standard output: {why}")
                return ExitStatus.FAILED
            if "--debug" in given and not isinstance(error, click.ClickException):
                traceback.print_exception(error)
            text, status = _describe_error(error)
            _print_error(text)
            return status


def _interrupted(for_good: bool) -> ExitStatus:
    _print_error(
        "interrupted. No half result was written and an earlier one is as it was; the same "
        "command starts again."
    )
    if for_good:
        _exit_now(ExitStatus.INTERRUPTED)
    return ExitStatus.INTERRUPTED


def _exit_now(status: ExitStatus) -> NoReturn:
    """End the process without the clean-up of the interpreter.

    Compilation threads may still run during that clean-up, which then ends in a segmentation fault
    instead of the status. Files are already closed.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def _describe_error(error: Exception) -> tuple[str, ExitStatus]:
    """Error in a few lines, and its exit status."""
    bad_input = False
    if isinstance(error, click.UsageError):
        command = error.ctx.command_path if error.ctx else "robins"
        text = f"{error.format_message()}\n`{command} --help` lists what can be given."
        bad_input = True
    elif isinstance(error, click.ClickException):
        return error.format_message(), ExitStatus(error.exit_code)
    elif isinstance(error, RobinsError):
        text, bad_input = str(error), error.bad_input
    elif isinstance(error, ModuleNotFoundError) and error.name in _OF_THE_BENCH:
        install = "pip install 'robins[bench]'"
        text = f"the bench needs the extra 'bench': {install} ({error.name} is missing)"
        bad_input = True
    elif isinstance(error, MemoryError):
        text = "out of memory; ask for fewer runs or filters at a time."
    elif isinstance(error, OSError) and error.filename is not None:
        text = f"{os.fsdecode(error.filename)}: {error.strerror}; choose another path."
        bad_input = error.errno in _OF_A_PATH
    else:
        first = (str(error).strip().splitlines() or [""])[0]
        text = f"failed: {type(error).__name__}: {first}\n"
        own = trust.place(error)
        text += f"in {own}; " if own else "this may be a fault of robins; "
        text += "run it again with --debug to see where."
    return text, ExitStatus.BAD_INPUT if bad_input else ExitStatus.FAILED


def _print_error(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        for line in text.splitlines():
            print(f"robins: {line}", file=sys.stderr)
