"""What was computed is kept where it cannot be written as a result: hours of work may be in it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from robins.results import folder

ARRAYS = "arrays.npz"


class NotWritten(RuntimeError):
    """A result was computed and could not be written; the message tells where its numbers are."""


@contextmanager
def rescued(path: str | os.PathLike[str]) -> Iterator[Callable[[Any], None]]:
    """Keep what was computed if the result folder at `path` cannot be written.

    Yields:
        A function that is told what is worth keeping, any tree of arrays; the last call counts. The
        arrays are written only if an error follows, into a new folder beside the result, or among
        the temporary files where nothing can be written there.

    Raises:
        NotWritten: in place of the error, where something was kept.
    """
    held: list[Any] = []

    def keep(tree: Any) -> None:
        held[:] = [tree]

    try:
        yield keep
    except Exception as error:
        kept = _saved(Path(path), held[0]) if held else None
        if kept is None:
            raise
        raise NotWritten(
            f"the result was computed and could not be written: {error}\n"
            f"Its numbers are kept in {kept / ARRAYS}; numpy.load reads them."
        ) from error


def _saved(path: Path, tree: Any) -> Path | None:
    """The folder that now holds the arrays of a tree; None if no disk takes them."""
    arrays = dict(_arrays("", tree))
    for parent in (folder.resolve(path).parent, Path(tempfile.gettempdir())):
        try:
            parent.mkdir(parents=True, exist_ok=True)
            made = Path(tempfile.mkdtemp(prefix=f"{path.name[:100]}-not-written-", dir=parent))
            np.savez(made / ARRAYS, allow_pickle=False, **arrays)
        except OSError:
            continue
        return made
    return None


def _arrays(name: str, tree: Any) -> Iterator[tuple[str, np.ndarray]]:
    """All arrays of a tree, each under the way to it: ``ekf.rms``."""
    if isinstance(tree, list | tuple):
        tree = dict(enumerate(tree))
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _arrays(f"{name}.{key}".lstrip("."), value)
    elif np.asarray(tree).dtype.kind in "biufcUS":
        yield name.replace("/", " per "), np.asarray(tree)
