"""What a part remembers, put aside every so many steps, for the one that is started in its place.

That one goes on from the latest memory that is older than what it is told again, so a death costs
the time of some hundred steps, however long the run has been. A memory is a file in the folder of
the bench's processes; the part writes it before it answers the tick of that step.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

EVERY = 256  # steps


def is_due(step: int) -> bool:
    """Whether a part puts its memory aside after a step."""
    return (step + 1) % EVERY == 0


def path_of(folder: Path, part: str, step: int) -> Path:
    """Where the memory of a part after a step is."""
    return folder / f"{part}.{step}.memory"


def put_aside(folder: Path, part: str, step: int, memory: bytes) -> None:
    """Write a memory, whole or not at all; the one before it stays, older ones go.

    Where it cannot be written, those that are there stay, and the run goes on.
    """
    path = path_of(folder, part, step)
    with contextlib.suppress(OSError):
        path.with_suffix(".new").write_bytes(memory)
        os.replace(path.with_suffix(".new"), path)
        path_of(folder, part, step - 2 * EVERY).unlink(missing_ok=True)
