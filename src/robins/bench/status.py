"""Running benches of this machine report their state every second, for `robins bench status`."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from robins.errors import RobinsError

EACH_S = 1.0
_OLD_S = 10.0  # after which a silent bench counts as hanging
_LARGEST = 1 << 20  # characters of a report
_REPORT = re.compile(r"[1-9][0-9]{0,9}\.(json|[0-9a-f]{8}\.new)")
Report = dict[str, Any]
STARTING = "starting"  # its state until the first step: it may compile for long, without a report


def _refused(what: str, path: Path, fix: str) -> RobinsError:
    error = RobinsError(f"reports of benches are kept here, and it {what}", path, fix)
    error.bad_input = False
    return error


@contextlib.contextmanager
def _folder() -> Iterator[int]:
    """Open the folder of this user's status files; create it if there is none.

    Its path can be predicted, so somebody else may have made it, with links in it. It is opened
    without following a link and checked by its descriptor; files are named relative to that.

    Yields:
        The descriptor.

    Raises:
        RobinsError: it belongs to another user, others may access it, or it is not a folder or a
            link.
    """
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    base = base if base.is_dir() else Path(tempfile.gettempdir())
    path = base / f"robins-bench-{os.getuid()}"
    fix = "remove it, or set XDG_RUNTIME_DIR to a folder of your own"
    try:
        with contextlib.suppress(OSError):
            path.mkdir(mode=0o700)
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        linked = "is a link, which is not followed" if path.is_symlink() else ""
        raise _refused(linked or f"cannot be used: {error.strerror or error}", path, fix) from None
    try:
        about = os.fstat(folder)
        if about.st_uid != os.getuid():
            raise _refused(f"belongs to the user with number {about.st_uid}", path, fix)
        if about.st_mode & 0o077:
            mode = f"is open to others (mode {about.st_mode & 0o777:o})"
            raise _refused(mode, path, f"chmod 700 {path}")
        yield folder
    finally:
        os.close(folder)


class BenchStatus:
    """Report of this bench to `robins bench status`; a context that removes it at the end.

    Attributes:
        refused: why there is no report; empty where there is one.
    """

    def __init__(self) -> None:
        self.refused = ""
        self._name = f"{os.getpid()}.json"
        self._told = 0.0

    def __enter__(self) -> BenchStatus:
        try:
            with _folder():
                pass
        except RobinsError as error:
            self.refused = f"`robins bench status` does not show this run: {error}"
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError, RobinsError), _folder() as folder:
            os.unlink(self._name, dir_fd=folder)

    @property
    def due(self) -> bool:
        """True when the next report is due."""
        return time.monotonic() - self._told >= EACH_S

    def report(self, state: Report) -> None:
        """Report the state; neither a full disk nor a folder of another user stops a run."""
        self._told = time.monotonic()
        content = json.dumps({**state, "pid": os.getpid(), "at": time.time()})
        new = f"{self._name}.{secrets.token_hex(4)}.new"
        with contextlib.suppress(OSError, RobinsError), _folder() as folder:
            way = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            try:
                with open(os.open(new, way, 0o600, dir_fd=folder), "w", encoding="utf-8") as file:
                    file.write(content)
                os.rename(new, self._name, src_dir_fd=folder, dst_dir_fd=folder)
            except OSError:
                os.unlink(new, dir_fd=folder)
                raise


def running() -> list[Report]:
    """Reports of this user's benches, oldest first; those of dead benches are removed.

    Raises:
        RobinsError: the folder of the reports belongs to somebody else.
    """
    found = []
    with _folder() as folder:
        for name in filter(_REPORT.fullmatch, os.listdir(folder)):
            pid, _, kind = name.partition(".")
            try:
                os.kill(int(pid), 0)
                if kind == "json":
                    found.append(_read(folder, name))
            except (ValueError, KeyError, TypeError, OverflowError, RecursionError, OSError):
                with contextlib.suppress(OSError):  # gone, or was killed before it could tidy up
                    os.unlink(name, dir_fd=folder)
    return sorted(found, key=lambda state: state["pid"])


def _read(folder: int, name: str) -> Report:
    """Read the report of a bench.

    Raises:
        OSError, ValueError, KeyError, TypeError, RecursionError: the file is no such report.
    """
    way = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with open(os.open(name, way, dir_fd=folder), encoding="utf-8") as file:
        state = json.loads(file.read(_LARGEST))
    state["pid"] = int(name.partition(".")[0])
    state["silent_s"] = round(max(time.time() - state["at"], 0.0), 1)
    return state


def table(benches: list[Report]) -> str:
    """Reports as a text table."""
    if not benches:
        return "No bench runs.\n  robins bench up satellite/s1   starts one"
    lines = []
    for b in benches:
        hangs = b["silent_s"] > _OLD_S and b["state"] != STARTING
        silent = f", silent for {b['silent_s']:.0f} s" if hangs else ""
        share = 100.0 * b["step"] / b["steps"]
        lines.append(
            f"{b['name']} ({b['filter']}, {b['clock']}), process {b['pid']}{silent}: {b['state']}, "
            f"{b['time_s']:.1f} s of the run ({share:.0f} %), {b['cycles_per_s']:.0f} steps/s"
        )
        if b.get("url"):
            lines.append(f"  page: {b['url']}")
        if not b["parts"]:
            continue
        rows = [("part", "process", "frames", "wrong", "lost", "late")]
        rows += [
            (name, str(p["process"] or p["port"]), *(str(p[k]) for k in ("frames", *rows[0][3:])))
            for name, p in b["parts"].items()
        ]
        lines += [f"  {line}" for line in aligned(rows)]
    return "\n".join(lines)


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines of text with aligned columns."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
