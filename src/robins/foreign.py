"""Decoding of files from other programs: any exception becomes one error, and sizes are checked.

Decoders of other packages raise arbitrary exceptions on damaged bytes. `decoding` encloses each
call of one and turns every exception into the error of the reading room; code of robins that uses
the result stays outside of it, so that a bug of robins is not taken for a damaged file.

A declared size is compared with the bytes present before memory is allocated. An unpacked size may
be up to `FREE` plus `RATIO` times the packed one: real logs compress 2 to 30 times, and data that
compress better than `RATIO` are not measurements.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from robins.errors import RobinsError

if TYPE_CHECKING:
    import h5py

FREE = 64 << 20  # bytes
RATIO = 200
_MAT_START = 128  # bytes of the header of MATLAB v5
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_NUMBERS |= {12: "i8", 13: "u8"}  # types of its elements
_MATRIX, _COMPRESSED = 14, 15
_STRUCT, _NUMERIC = 2, range(6, 16)  # classes of matrices
_COMPLEX, _DEEPEST = 0x800, 8

Refuse = Callable[[str], RobinsError]
"""Makes the error of a room from the reason."""


def largest(present: int) -> int:
    """Largest number of bytes to which `present` packed bytes may unpack."""
    return FREE + RATIO * present


@contextlib.contextmanager
def decoding(refuse: Refuse) -> Iterator[None]:
    """Turn any exception of a foreign decoder into the error of this room.

    Args:
        refuse: makes the error, which names the file and the place, from the reason.

    Raises:
        RobinsError: as `refuse` makes it, or as it was raised.
    """
    try:
        yield
    except RobinsError:
        raise
    except Exception as error:
        first = (str(error).strip().splitlines() or [""])[0]
        kind = type(error).__name__
        if first and type(error).__module__ in ("tomllib", "json.decoder"):
            raise refuse(first) from error  # a syntax error, in plain words
        raise refuse(f"{kind}: {first}" if first else kind) from error


def within(declared: int, present: int, what: str, refuse: Refuse) -> None:
    """Refuse a declared size to which the bytes present cannot unpack.

    Raises:
        RobinsError: as `refuse` makes it.
    """
    if declared > largest(present):
        raise refuse(
            f"{what} would take {declared} bytes, and {present} are there, of which at most "
            f"{RATIO} times as many and {FREE >> 20} MiB may be unpacked"
        )


def unpacked(packed: bytes, compression: str, size: int, refuse: Refuse) -> bytes:
    """Unpack a block of exactly the declared size.

    Args:
        packed: the block.
        compression: "zstd", "lz4", or "" if it is not compressed.
        size: declared, and checked by `within`.
        refuse: makes the error.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, or of another size.
    """
    if compression in ("zstd", "lz4"):
        # the output is limited to the declared size, since the block's own header may differ
        with decoding(refuse):
            if compression == "zstd":
                import zstandard

                decoder = zstandard.ZstdDecompressor(max_window_size=2 * FREE)
                plain = decoder.stream_reader(packed).read(size + 1)
            else:
                import lz4.frame

                plain = lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1)
    elif compression == "":
        plain = packed
    else:
        raise refuse(f"packed by {compression!r}, which is not known")
    if len(plain) != size:
        raise refuse(f"unpacks to {min(len(plain), size + 1)} bytes or more, declared are {size}")
    return plain


def archive_of(content: bytes, refuse: Refuse) -> zipfile.ZipFile:
    """Index of a zip archive; nothing is unpacked."""
    with decoding(refuse):
        return zipfile.ZipFile(io.BytesIO(content))


def arrays_of(
    content: bytes, refuse: Refuse, names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Arrays of a NumPy archive (``.npz``) by name, each checked against its checksum.

    Args:
        content: of the file.
        refuse: makes the error.
        names: arrays wanted, as far as present; None: all.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, declares more than it holds, is compressed
            in a way that NumPy does not use, or holds objects.
    """
    archive = archive_of(content, refuse)
    arrays: dict[str, np.ndarray] = {}
    declared = 0
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if names is not None and name not in names:
            continue
        declared += member.file_size
        within(declared, len(content), f"up to {name!r} it", refuse)
        if name in arrays or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise refuse(f"{name!r} is there twice, or packed as NumPy does not pack")
        arrays[name] = array_of(_member(archive, member, refuse), name, refuse)
    return arrays


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, refuse: Refuse) -> bytes:
    """Content of a member, checked against its declared length and checksum."""
    with (
        decoding(lambda why: refuse(f"{member.filename!r} is damaged: {why}")),
        archive.open(member) as file,
    ):
        return file.read(member.file_size)


def array_of(raw: bytes, name: str, refuse: Refuse) -> np.ndarray:
    """Decode the array in a ``.npy`` file.

    Raises:
        RobinsError: as `refuse` makes it: it is cut or damaged, or holds objects.
    """
    file = io.BytesIO(raw)
    with (
        decoding(lambda why: refuse(f"{name!r} is no array of NumPy: {why}")),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error")  # NumPy warns of arrays that Python 2 wrote
        version = np.lib.format.read_magic(file)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, fortran, dtype = readers[version](file)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or dtype.kind not in "biufcSU" or not dtype.itemsize:
        raise refuse(f"{name!r} is no plain array (of {dtype}): save numbers, without pickle")
    if min(shape, default=0) < 0 or size != len(raw) - file.tell():
        raise refuse(
            f"{name!r} holds {len(raw) - file.tell()} bytes where its header declares {size}: "
            f"{dtype} of shape {shape}"
        )
    # a shape that NumPy itself does not accept
    with decoding(lambda why: refuse(f"{name!r} is no array of NumPy: {why}")):
        flat = np.frombuffer(raw, dtype, offset=file.tell())
        return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")


def arrays_of_hdf5(content: bytes, refuse: Refuse) -> dict[str, np.ndarray]:
    """Numeric arrays of an HDF5 file by path, and numeric attributes of the file itself.

    Links to other files are not followed.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, or declares more than it holds.
    """
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
        within(declared, len(content), f"up to {name!r} it", refuse)
        out[name] = np.asarray(item[()])

    with decoding(refuse), h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(keep)
        stated = {name: np.asarray(file.attrs[name]) for name in file.attrs}
    return {name: one for name, one in stated.items() if one.dtype.kind in "biuf"} | out


def columns_of_parquet(content: bytes, refuse: Refuse) -> dict[str, np.ndarray]:
    """Columns of numbers and dates of a Parquet file.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, declares more than it holds, or the
            package `pyarrow` is not installed.
    """
    try:
        from pyarrow import parquet, types
    except ImportError as error:
        raise refuse("no package for Parquet is there: pip install 'robins[parquet]'") from error
    with decoding(refuse):
        opened = parquet.ParquetFile(io.BytesIO(content))
        meta, schema = opened.metadata, opened.schema_arrow
        tests = (types.is_integer, types.is_floating, types.is_timestamp, types.is_boolean)
        plain = [f.name for f in schema if any(test(f.type) for test in tests)]
        within(8 * meta.num_rows * max(len(plain), 1), len(content), "it", refuse)
        table = opened.read(columns=plain)
        return {name: table.column(name).to_numpy() for name in plain}


def arrays_of_matlab(content: bytes, refuse: Refuse) -> dict[str, np.ndarray]:
    """Real arrays of a MATLAB v5 file, those of structs as ``outer/name``.

    Elements are those of MathWorks' "MAT-File Level 5 File Format". SciPy is not used: it allocates
    the memory that a damaged cell array declares, and follows nested structs to a stack overflow.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, or unpacks to more than measurements do.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128], "")
    if not order:
        raise refuse("its header has no mark of the order of bytes")
    out: dict[str, np.ndarray] = {}
    room = largest(len(content))
    for kind, body in _elements(content[_MAT_START:], order, refuse):
        if kind == _COMPRESSED:
            with decoding(refuse):
                plain = zlib.decompressobj().decompress(body, room + 1)
            room -= len(plain)
            if room < 0:
                raise refuse(f"it unpacks to more than {largest(len(content))} bytes")
            kind, body = next(_elements(plain, order, refuse), (0, b""))
        if kind == _MATRIX:
            _matrix(body, order, refuse, out)
    return out


def _elements(data: bytes, order: str, refuse: Refuse) -> Iterator[tuple[int, bytes]]:
    """Type and content of the data elements of a body, small elements included."""
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
    """Add the real arrays of a matrix or struct to `out` by name; skip other classes."""
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
