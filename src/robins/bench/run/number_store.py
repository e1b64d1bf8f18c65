"""Storage for the arrays of a run: in memory, or on disk if they are large.

On disk they are in a file that is unlinked as soon as it is open. The system frees it with the last
array, or with the process, however that ends; so nothing needs to be removed.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from robins.results.errors import result_error

LARGE = 64 << 20  # bytes above which arrays are stored on disk
_PIECE = 1 << 17  # numbers written at once

Shapes = Mapping[str, tuple[tuple[int, ...], float | int]]  # shape and fill value, by name


class NumberStore:
    """Arrays of 64-bit numbers by name.

    Attributes:
        arrays: readable and writable.
    """

    def __init__(self, shapes: Shapes, folder: Path | None = None):
        """Allocate the arrays.

        Args:
            shapes: shape and fill value of each array: NaN, or 0 for whole numbers.
            folder: of the file, if they are large; default: the temporary folder.

        Raises:
            robins.results.ResultError: the file system has not enough space for them.
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
            raise result_error(where, doing, error) from error
        self.arrays, at = {}, 0
        for name, (shape, what) in shapes.items():
            array = np.ndarray(shape, np.array(what).dtype, buffer=self._file, offset=at)
            self.arrays[name], at = array, at + array.nbytes

    def forget(self) -> None:
        """Release the memory of arrays on disk; they are read again when needed."""
        if self._file is not None and hasattr(mmap, "MADV_DONTNEED"):  # not on every system
            self._file.madvise(mmap.MADV_DONTNEED)


def _filled(shapes: Shapes, size: int, where: Path) -> mmap.mmap:
    """Memory map of an unlinked file. All of it is written, so that a full disk shows here."""
    with tempfile.TemporaryFile(dir=where) as file:
        for shape, what in shapes.values():
            count = int(np.prod(shape))
            piece = np.full(min(count, _PIECE), what).tobytes()
            for begin in range(0, count, _PIECE):
                file.write(piece[: 8 * (count - begin)])
        file.flush()
        return mmap.mmap(file.fileno(), size)
