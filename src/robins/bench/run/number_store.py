"""Room for the arrays of a run: in memory, or on disk where they are large.

On disk they lie in a file that has lost its name as soon as it was opened. It goes with the last
array that is used, or with the process, whatever ends it; so there is nothing to remove.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from robins.results.errors import cannot

LARGE = 64 << 20  # bytes, above which arrays lie on disk
_PIECE = 1 << 17  # numbers written at once

Shapes = Mapping[str, tuple[tuple[int, ...], float | int]]  # by name, with what fills them


class NumberStore:
    """Arrays of 64-bit numbers by name.

    Attributes:
        arrays: to be read and written.
    """

    def __init__(self, shapes: Shapes, folder: Path | None = None):
        """Make room.

        Args:
            shapes: of the arrays, with the number that fills each: nan, or 0 of whole numbers.
            folder: where the file is if they are large; by default that for temporary files.

        Raises:
            robins.results.ResultError: the file system has no room for them.
        """
        self._file: mmap.mmap | None = None
        size = sum(8 * int(np.prod(shape)) for shape, _ in shapes.values())
        if size <= LARGE:
            self.arrays = {name: np.full(shape, what) for name, (shape, what) in shapes.items()}
            return
        where = Path(tempfile.gettempdir()) if folder is None else folder
        try:
            self._file = _filled(shapes, size, where)
        except OSError as error:
            doing = f"keep {size / 1e6:.0f} MB of what passes in a run"
            raise cannot(where, doing, error) from error
        self.arrays, at = {}, 0
        for name, (shape, what) in shapes.items():
            array = np.ndarray(shape, np.array(what).dtype, buffer=self._file, offset=at)
            self.arrays[name], at = array, at + array.nbytes

    def forget(self) -> None:
        """Let go of the memory of what lies on disk; it is read again when it is needed."""
        if self._file is not None and hasattr(mmap, "MADV_DONTNEED"):  # not on every system
            self._file.madvise(mmap.MADV_DONTNEED)


def _filled(shapes: Shapes, size: int, where: Path) -> mmap.mmap:
    """A file without a name, as memory. It is written whole, so that a full disk is met here."""
    with tempfile.TemporaryFile(dir=where) as file:
        for shape, what in shapes.values():
            count = int(np.prod(shape))
            piece = np.full(min(count, _PIECE), what).tobytes()
            for begin in range(0, count, _PIECE):
                file.write(piece[: 8 * (count - begin)])
        file.flush()
        return mmap.mmap(file.fileno(), size)
