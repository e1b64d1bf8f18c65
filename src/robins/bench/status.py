"""Running benches of this machine report their state every second, for `robins bench status`."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

EACH_S = 1.0
_OLD_S = 10.0  # after which a bench that says nothing hangs
STARTING = "starting"  # its state until the first step: it may compile for long, and says nothing


def _folder() -> Path:
    base = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(base) / f"robins-bench-{os.getuid()}"


class Status:
    """What this bench tells; a context that takes it away at the end."""

    def __init__(self) -> None:
        self._path = _folder() / f"{os.getpid()}.json"
        self._told = 0.0

    def __enter__(self) -> Status:
        self._path.parent.mkdir(mode=0o700, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    @property
    def due(self) -> bool:
        """Whether it is time to tell again."""
        return time.monotonic() - self._told >= EACH_S

    def tell(self, said: Mapping[str, Any]) -> None:
        """Say how it is; a full disk is no reason to stop a run."""
        self._told = time.monotonic()
        new = self._path.with_suffix(".new")
        with contextlib.suppress(OSError):
            new.write_text(json.dumps({**said, "pid": os.getpid(), "at": time.time()}), "utf-8")
            new.replace(self._path)


def running() -> list[dict[str, Any]]:
    """What the benches of this user say, the oldest first; of those that are gone, nothing."""
    found = []
    for path in sorted(_folder().glob("*.json")):
        try:
            said = json.loads(path.read_text("utf-8"))
            os.kill(said["pid"], 0)
        except (ValueError, KeyError, OSError):  # gone, or was killed before it could tidy up
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            continue
        said["silent_s"] = round(max(time.time() - said["at"], 0.0), 1)
        found.append(said)
    return sorted(found, key=lambda said: said["pid"])


def table(benches: list[dict[str, Any]]) -> str:
    """The same for people."""
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
    """Rows as lines whose columns stand below each other."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
