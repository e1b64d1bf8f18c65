"""Archives of arrays as named columns: NumPy, MATLAB, HDF5 and Parquet.

An array of n numbers is the column of its name; column j of an array (n, k) is ``name[:,j]``. An
array in a MATLAB struct or an HDF5 group is ``outer/name``. The longer side is taken as rows, since
MATLAB's own HDF5 (v7.3) has its arrays transposed. A format finds its columns by these names as by
those of a header.

Nothing in a file is executed: pickles, objects, function handles, links to other files and computed
arrays are skipped (`robins.foreign` has the decoders).
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from functools import lru_cache, partial

import numpy as np

from robins.foreign import (
    archive_of,
    array_of,
    arrays_of,
    arrays_of_hdf5,
    arrays_of_matlab,
    columns_of_parquet,
)
from robins.logs.findings import AnyPath, LogError
from robins.logs.opening import read_beginning, read_whole
from robins.logs.text import Columns, Head, TextLayout, peek

_LARGEST = 1 << 30  # bytes, largest file
_TEXT = "S40"  # type of time stamps, as in `robins.logs.text`
_WIDEST = 64  # most columns of an array; images and point clouds are skipped
_HEADER = 30  # bytes before the name of the first member of a zip archive
_KINDS = {
    "npz": "an archive of NumPy,",
    "npy": "an array of NumPy,",
    "hdf5": "an HDF5 file,",
    "mat": "a MATLAB file,",
    "parquet": "a Parquet file,",
    "": "no archive, or one",
}
_HDF5 = b"\x89HDF\r\n\x1a\n"


def kind_of_archive(start: bytes) -> str:
    """Kind of an archive by the first bytes of a file; "" if it is none."""
    member = start[_HEADER : _HEADER + int.from_bytes(start[26:28], "little")]
    kinds = {
        "npz": start.startswith(b"PK\x03\x04") and member.endswith(b".npy"),
        "npy": start.startswith(b"\x93NUMPY"),
        "hdf5": start.startswith((_HDF5, b"MATLAB 7.3")),
        "mat": start.startswith(b"MATLAB 5.0"),
        "parquet": start.startswith(b"PAR1"),
    }
    return next((kind for kind, fits in kinds.items() if fits), "")


@lru_cache(maxsize=4)
def names_in(path: str, changed_ns: int) -> frozenset[str]:
    """Names of the arrays of an archive; the time of its last change is a key of the cache.

    Raises:
        LogError: as `arrays_in`.
    """
    if kind_of_archive(read_beginning(path)) == "npz":
        data, _ = read_whole(path, _LARGEST)
        members = archive_of(data, partial(_damaged, path, "npz", len(data))).namelist()
        return frozenset(name.removesuffix(".npy") for name in members)
    return frozenset(arrays_in(path))


def _damaged(path: str, kind: str, size: int, why: str) -> LogError:
    remedy = (
        "fetch it again, or save it as plain numbers; nothing of it was used, for no number in it "
        "can be trusted"
    )
    what = f"is {_KINDS[kind]} cut short or damaged after {size} bytes: {why}"
    return LogError(path, what, remedy)


def arrays_in(path: AnyPath, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Numeric arrays of an archive by name.

    Args:
        path: the file, plain or compressed.
        names: those to read from a NumPy archive; None: all.

    Raises:
        LogError: the file is cut or damaged, or a package to read it is not installed. Nothing is
            read from a damaged one.
    """
    data, _ = read_whole(path, _LARGEST)
    kind = kind_of_archive(data[:256])
    damaged = partial(_damaged, os.fspath(path), kind, len(data))
    if kind == "npz":
        return arrays_of(data, damaged, names)
    if kind == "npy":
        return {"": array_of(data, "it", damaged)}
    others = {"parquet": columns_of_parquet, "hdf5": arrays_of_hdf5}
    return others.get(kind, arrays_of_matlab)(data, damaged)


def head_of(path: AnyPath) -> Head:
    """Beginning of a text file, or names and columns of an archive.

    Raises:
        LogError: as `arrays_in` and `robins.logs.text.peek`; an archive holds no columns.
    """
    start = read_beginning(path)
    if not kind_of_archive(start):
        return peek(path)
    columns = dict(_columns(arrays_in(path)))
    if not columns:
        raise LogError(os.fspath(path), "holds no arrays of numbers", "save the samples in arrays")
    return Head(os.fspath(path), [], start, tuple(columns), tuple(columns.values()))


def _columns(arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    for name, array in arrays.items():
        one = array.squeeze()
        if one.dtype.kind not in "biufM" or not 0 < one.ndim < 3 or not one.size:
            continue
        if one.ndim == 1:
            yield name, one
            continue
        rows = one if one.shape[0] >= one.shape[1] else one.T
        for k in range(rows.shape[1] if rows.shape[1] <= _WIDEST else 0):
            yield f"{name}[:,{k}]", rows[:, k]


def rows_of(head: Head, layout: TextLayout) -> Columns:
    """Columns of an archive in the form of those of a text file, rows numbered from 1.

    Raises:
        LogError: they differ in length, or hold dates instead of numbers.
    """
    numbers = layout.numbers
    if numbers is None:
        numbers = tuple(k for k in range(len(head.names)) if k not in layout.texts)
    sizes = {head.names[k]: len(head.arrays[k]) for k in layout.texts + numbers}
    if len(set(sizes.values())) != 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        remedy = "declare columns of one sensor, which have one length"
        raise LogError(head.file, f"the columns differ in length: {listed}", remedy)
    if dates := [head.names[k] for k in numbers if head.arrays[k].dtype.kind == "M"]:
        raise LogError(head.file, f"{dates[0]} holds dates, not numbers", "declare it as the time")
    rows = next(iter(sizes.values()))
    with np.errstate(invalid="ignore"):  # a signalling NaN stays NaN
        values = [head.arrays[k].astype(np.float64) for k in numbers]
    texts = [head.arrays[k].astype(_TEXT) for k in layout.texts]
    return Columns(
        np.stack(texts, axis=-1) if texts else np.zeros((rows, 0), _TEXT),
        np.stack(values, axis=-1) if values else np.zeros((rows, 0)),
        np.arange(1, rows + 1),
    )
