"""Archives of arrays as columns with names: NumPy, MATLAB, HDF5 and Parquet.

An array of n numbers is the column of its name; of one of n rows and k columns column j is
``name[:,j]``. What lies in a struct of MATLAB or a group of HDF5 is ``outer/name``. The longer side
is taken for the rows, since MATLAB's own HDF5 (v7.3) has its arrays transposed. By these names a
format finds its columns as by those of a header.

Nothing in a file is carried out: pickles, objects, function handles, links to other files and
arrays that are computed are passed over. Sizes are compared with the bytes present. MATLAB v5 is
read here and not by SciPy, which asks for the memory that a damaged cell array declares and follows
structs as deep as the stack allows; the elements are those of MathWorks' "MAT-File Level 5 File
Format".
"""

from __future__ import annotations

import io
import math
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from robins.foreign import Refuse, archive_of, array_of, arrays_of, decoding, largest, within
from robins.logs.findings import LogError
from robins.logs.opening import beginning, whole
from robins.logs.text import Columns, Head, Layout, peek

if TYPE_CHECKING:
    import h5py

_LARGEST = 1 << 30  # bytes of a file
_TEXT = "S40"  # of time stamps, as `robins.logs.text` has them
_WIDEST = 64  # columns of an array; images and point clouds are none
_DEEPEST = 8
_HEADER = 30  # bytes before the name of the first member of a zip archive
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAT_START = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_NUMBERS |= {12: "i8", 13: "u8"}  # types of elements of MATLAB v5
_MATRIX, _COMPRESSED = 14, 15
_STRUCT, _NUMERIC = 2, range(6, 16)  # classes of matrices
_COMPLEX = 0x800


def kind_of_archive(start: bytes) -> str:
    """Kind of an archive by its first bytes, "" if it is none."""
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
    """Names of the arrays of an archive, which was changed at that time.

    Raises:
        LogError: as `arrays_in`.
    """
    if kind_of_archive(beginning(path)) == "npz":
        data, _ = whole(path, _LARGEST)
        members = archive_of(data, partial(_damaged, path, len(data))).namelist()
        return frozenset(name.removesuffix(".npy") for name in members)
    return frozenset(arrays_in(path))


def _damaged(path: str, size: int, why: str) -> LogError:
    mend = (
        "fetch it again, or save it as plain numbers; nothing of it was used, for no number in it "
        "can be trusted"
    )
    return LogError(path, f"is cut short or damaged after {size} bytes: {why}", mend)


def arrays_in(
    path: str | os.PathLike[str], names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Arrays of numbers of an archive by name.

    Args:
        path: the file, plain or compressed.
        names: those wanted of an archive of NumPy; None: all.

    Raises:
        LogError: it is cut or damaged, or a package to read it is not installed. Nothing is read
            from a damaged one.
    """
    data, _ = whole(path, _LARGEST)
    damaged = partial(_damaged, os.fspath(path), len(data))
    kind = kind_of_archive(data[:256])
    if kind == "npz":
        return arrays_of(data, damaged, names)
    if kind == "npy":
        return {"": array_of(data, "it", damaged)}
    if kind == "parquet":
        return _parquet(os.fspath(path), data, damaged)
    return _hdf5(data, damaged) if kind == "hdf5" else _matlab(data, damaged)


def head_of(path: str | os.PathLike[str]) -> Head:
    """Beginning of a text file, or names and columns of an archive.

    Raises:
        LogError: as `arrays_in` and `robins.logs.text.peek`; an archive holds no columns.
    """
    start = beginning(path)
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


def rows_of(head: Head, layout: Layout) -> Columns:
    """Columns of an archive as those of a text file, numbered from 1.

    Raises:
        LogError: they are of several lengths, or hold dates where numbers are needed.
    """
    wanted = layout.texts + (layout.numbers if layout.numbers is not None else ())
    numbers = layout.numbers
    if numbers is None:
        numbers = tuple(k for k in range(len(head.names)) if k not in layout.texts)
        wanted = layout.texts + numbers
    sizes = {head.names[k]: len(head.arrays[k]) for k in wanted}
    if len(set(sizes.values())) != 1:
        told = ", ".join(f"{name} {size}" for name, size in sizes.items())
        mend = "declare columns of one sensor, which have one length"
        raise LogError(head.file, f"the columns differ in length: {told}", mend)
    if dates := [head.names[k] for k in numbers if head.arrays[k].dtype.kind == "M"]:
        raise LogError(head.file, f"{dates[0]} holds dates, not numbers", "declare it as the time")
    rows = next(iter(sizes.values()))
    with np.errstate(invalid="ignore"):  # a NaN that signals stays a NaN
        values = [head.arrays[k].astype(np.float64) for k in numbers]
    texts = [head.arrays[k].astype(_TEXT) for k in layout.texts]
    return Columns(
        np.stack(texts, axis=-1) if texts else np.zeros((rows, 0), _TEXT),
        np.stack(values, axis=-1) if values else np.zeros((rows, 0)),
        np.arange(1, rows + 1),
    )


def _hdf5(data: bytes, refuse: Refuse) -> dict[str, np.ndarray]:
    import h5py

    out: dict[str, np.ndarray] = {}
    declared = 0

    def keep(name: str, item: h5py.Dataset | h5py.Group) -> None:
        nonlocal declared
        if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "biuf":
            return
        if item.is_virtual or item.external:
            return
        declared += item.nbytes
        within(declared, len(data), f"up to {name!r} it", refuse)
        out[name] = np.asarray(item[()])

    with decoding(refuse), h5py.File(io.BytesIO(data), "r") as file:
        file.visititems(keep)
    return out


def _parquet(file: str, data: bytes, refuse: Refuse) -> dict[str, np.ndarray]:
    try:
        from pyarrow import parquet, types
    except ImportError as error:
        mend = "install it with: pip install 'robins[parquet]'"
        raise LogError(
            file, "is a Parquet file, and the package for these is not there", mend
        ) from error
    with decoding(refuse):
        opened = parquet.ParquetFile(io.BytesIO(data))
        meta, schema = opened.metadata, opened.schema_arrow
        tests = (types.is_integer, types.is_floating, types.is_timestamp, types.is_boolean)
        plain = [f.name for f in schema if any(test(f.type) for test in tests)]
        within(8 * meta.num_rows * max(len(plain), 1), len(data), "it", refuse)
        table = opened.read(columns=plain)
        return {name: table.column(name).to_numpy() for name in plain}


# ---------------------------------------------------------------------------------- MATLAB v5


def _matlab(data: bytes, refuse: Refuse) -> dict[str, np.ndarray]:
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128], "")
    if not order:
        raise refuse("its header has no mark of the order of bytes")
    out: dict[str, np.ndarray] = {}
    room = largest(len(data))
    for kind, body in _elements(data[_MAT_START:], order, refuse):
        if kind == _COMPRESSED:
            with decoding(refuse):
                plain = zlib.decompressobj().decompress(body, room + 1)
            room -= len(plain)
            if room < 0:
                raise refuse(f"it unpacks to more than {largest(len(data))} bytes")
            kind, body = next(_elements(plain, order, refuse), (0, b""))
        if kind == _MATRIX:
            _matrix(body, order, refuse, out)
    return out


def _elements(data: bytes, order: str, refuse: Refuse) -> Iterator[tuple[int, bytes]]:
    """Type and content of the data elements of a body, short ones too."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        short = kind >> 16
        if short:
            kind, size, start, step = kind & 0xFFFF, short, at + 4, 8
        else:
            start, step = at + 8, 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if start + size > len(data) or (short and size > 4):
            raise refuse(f"an element declares {size} bytes, and {len(data) - start} are there")
        yield kind, data[start : start + size]
        at += step


def _matrix(
    body: bytes,
    order: str,
    refuse: Refuse,
    out: dict[str, np.ndarray],
    outer: str = "",
    given: str = "",
    depth: int = 0,
) -> None:
    """Put the real arrays of a matrix or struct under their names; pass other classes over."""
    parts = list(_elements(body, order, refuse))
    if len(parts) < 4 or len(parts[0][1]) < 4:
        return
    flags = int.from_bytes(parts[0][1][:4], "little" if order == "<" else "big")
    sizes = np.frombuffer(parts[1][1][: len(parts[1][1]) // 4 * 4], f"{order}i4").tolist()
    name = outer + (parts[2][1].decode("latin1") or given)
    kind, raw = parts[3]
    if flags & 0xFF in _NUMERIC and not flags & _COMPLEX:
        if kind not in _NUMBERS or len(raw) != math.prod(sizes) * int(_NUMBERS[kind][1]):
            raise refuse(f"{name!r} holds {len(raw)} bytes where {sizes} numbers are declared")
        values = np.frombuffer(raw, order + _NUMBERS[kind])
        if name in out or min(sizes) < 0:
            raise refuse(f"{name!r} is there twice, or of a negative size")
        out[name] = values.reshape(sizes, order="F")
    elif flags & 0xFF == _STRUCT and sizes == [1, 1] and depth < _DEEPEST and len(parts) > 4:
        width = max(int.from_bytes(raw, "little" if order == "<" else "big"), 1)
        keys = [parts[4][1][k : k + width] for k in range(0, len(parts[4][1]), width)]
        for key, (_, inner) in zip(keys, parts[5:], strict=False):
            field = key.split(b"\0")[0].decode("latin1")
            _matrix(inner, order, refuse, out, f"{name}/", field, depth + 1)
