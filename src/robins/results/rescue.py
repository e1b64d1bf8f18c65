"""Rescue of computed numbers that cannot be written as a result; they may have taken hours."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from robins.errors import RobinsError
from robins.results import folder

Tree = Any  # arrays in lists and mappings
ARRAYS = "arrays.npz"
_WHERE = "Its numbers are kept in {}; numpy.load reads them."
_KEPT = "computed"  # attribute of an error that carries the numbers


class NotWritten(RobinsError, RuntimeError):
    """A result that was computed but not written; the message names the folder of its numbers."""

    bad_input = False


@contextmanager
def keep_on_error(tree: Tree) -> Generator[None, None, None]:
    """Attach computed arrays to any error that leaves this block, for `rescued` to write.

    Args:
        tree: of arrays; of nested blocks the innermost counts.
    """
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        vars(error).setdefault(_KEPT, tree)
        raise


@contextmanager
def rescued(path: str | os.PathLike[str]) -> Generator[None, None, None]:
    """Write the arrays that an error carries (`keep_on_error`) if no result is written at `path`.

    They go into a new folder next to the result, or into the temporary folder if nothing can be
    written there. An interrupt is raised again, with a note that names the folder.

    Raises:
        NotWritten: in place of the error, if arrays were saved.
    """
    try:
        yield
    except KeyboardInterrupt as stop:
        kept = _saved(Path(path), stop)
        if kept is not None:
            stop.add_note(_WHERE.format(kept / ARRAYS))
        raise
    except Exception as error:
        kept = _saved(Path(path), error)
        if kept is None:
            raise
        raise NotWritten(
            f"the result was computed and could not be written: {error}\n"
            + _WHERE.format(kept / ARRAYS)
        ) from error


def _saved(path: Path, error: BaseException) -> Path | None:
    """Folder of the saved arrays of an error; None without any, or if no disk takes them."""
    if _KEPT not in vars(error):
        return None
    arrays = dict(_arrays("", vars(error)[_KEPT]))
    for parent in (folder.resolve(path).parent, Path(tempfile.gettempdir())):
        try:
            parent.mkdir(parents=True, exist_ok=True)
            made = Path(tempfile.mkdtemp(prefix=f"{path.name[:100]}-not-written-", dir=parent))
            np.savez(made / ARRAYS, allow_pickle=False, **arrays)
        except OSError:
            continue
        return made
    return None


def _arrays(name: str, tree: Tree) -> Iterator[tuple[str, np.ndarray]]:
    """All arrays of a tree with their paths, such as ``ekf.rms``."""
    if isinstance(tree, list | tuple):
        tree = dict(enumerate(tree))
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _arrays(f"{name}.{key}".lstrip("."), value)
    elif np.asarray(tree).dtype.kind in "biufcUS":
        yield name.replace("/", " per "), np.asarray(tree)
