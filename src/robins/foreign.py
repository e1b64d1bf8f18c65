"""Files that others wrote: their decoders behind one wrapper, and no size believed.

Decoders of other packages raise what they like on damaged bytes. `decoding` stands tightly around
each call of one and turns every exception into the error of the room that reads; what robins does
with the result stands outside of it, so that a fault of robins is not taken for a damaged file.

A size that a file declares is compared with the bytes that are there before memory is asked for. An
unpacked size may be `FREE` and `RATIO` times the packed one: measured logs pack 2 to 30 times, and
what packs better than `RATIO` holds no measurements.
"""

from __future__ import annotations

import contextlib
import io
import math
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterator

import numpy as np

from robins.errors import RobinsError

FREE = 64 << 20  # bytes
RATIO = 200

Refuse = Callable[[str], RobinsError]
"""Makes the error of a room from the reason."""


def largest(present: int) -> int:
    """Most bytes that so many packed ones may unpack to."""
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
            raise refuse(first) from error  # a fault of syntax, in words for people
        raise refuse(f"{kind}: {first}" if first else kind) from error


def within(declared: int, present: int, what: str, refuse: Refuse) -> None:
    """Refuse a declared size that the bytes present cannot unpack to.

    Raises:
        RobinsError: as `refuse` makes it.
    """
    if declared > largest(present):
        raise refuse(
            f"{what} would take {declared} bytes, and {present} are there, of which at most "
            f"{RATIO} times as many and {FREE >> 20} MiB may be unpacked"
        )


def unpacked(packed: bytes, compression: str, size: int, refuse: Refuse) -> bytes:
    """Content of a packed block of exactly the size that is declared for it.

    Args:
        packed: the block.
        compression: "zstd", "lz4", or "" where it is plain.
        size: declared; `within` has been asked.
        refuse: makes the error.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, or of another size.
    """
    if compression in ("zstd", "lz4"):
        # no more than the declared size is asked of the decoders, whose own headers declare another
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
        names: those wanted, as far as they are there; None: all.

    Raises:
        RobinsError: as `refuse` makes it: it is damaged, declares more than it holds, is packed as
            NumPy does not pack, or holds objects.
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
    """Content of a member, as long as it is declared, compared with its checksum."""
    with (
        decoding(lambda why: refuse(f"{member.filename!r} is damaged: {why}")),
        archive.open(member) as file,
    ):
        return file.read(member.file_size)


def array_of(raw: bytes, name: str, refuse: Refuse) -> np.ndarray:
    """Array of the bytes of a ``.npy`` file.

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
    # of a shape that NumPy itself does not take
    with decoding(lambda why: refuse(f"{name!r} is no array of NumPy: {why}")):
        flat = np.frombuffer(raw, dtype, offset=file.tell())
        return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")
