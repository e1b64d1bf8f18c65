"""Opening a log that may be compressed: decompressed blocks, in bounded memory, from any cut.

A compressed file that merely ends early gives every byte before the cut. One that is damaged is
refused whole: its checksum comes after the data, so nothing before it can be trusted.

`write_lines` writes a log under another name first, so that no half file bears the final one.
"""

from __future__ import annotations

import gzip
import lzma
import os
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from robins.foreign import FREE, decoding, within
from robins.logs.findings import LogError

_BLOCK = 1 << 20
_XZ, _GZIP = b"\xfd7zXZ\x00", b"\x1f\x8b"
_FOREIGN = {
    b"PK\x03\x04": ("a zip archive", "unpack it first"),
    b"BZh": ("a bzip2 file", "unpack it first"),
    b"\x28\xb5\x2f\xfd": ("a zstd file", "unpack it first"),
    b"ULog": ("a PX4 ULog", "leave the format to be recognised"),
    b"#ROSBAG": ("a ROS bag", "export the IMU and GNSS topics to CSV"),
    b"SQLite": ("an SQLite file (a ROS 2 bag?)", "convert it to MCAP: ros2 bag convert"),
    b"\x89MCAP": ("an MCAP file", "leave the format to be recognised"),
    b"\x89HDF": ("an HDF5 or MATLAB v7.3 file", "export the columns to CSV"),
    b"MATLAB": ("a MATLAB file", "export the columns to CSV"),
}


class _Gunzip:
    """zlib's decompressor with the interface of `lzma.LZMADecompressor`."""

    def __init__(self):
        self._inner = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
        self._full = False  # the last output filled its limit, so more may be waiting

    def decompress(self, data: bytes, max_length: int) -> bytes:
        out = self._inner.decompress(self._inner.unconsumed_tail + data, max_length)
        self._full = len(out) == max_length
        return out

    @property
    def eof(self) -> bool:
        return self._inner.eof

    @property
    def needs_input(self) -> bool:
        return not (self._full or self._inner.unconsumed_tail)

    @property
    def unused_data(self) -> bytes:
        return self._inner.unused_data


class Source:
    """The bytes of a file, decompressed if it is .xz or .gz by content, in blocks.

    Iterate once. Afterwards `cut` tells whether a compressed stream ended before its end mark.

    Raises:
        LogError: the file cannot be opened or read, is damaged, or (unless `binary`) is of a kind
            that holds no text.
    """

    def __init__(self, path: str | os.PathLike[str], binary: bool = False):
        self.path = Path(path)
        self.binary = binary
        self.cut = False

    def __iter__(self) -> Iterator[bytes]:
        try:
            with self.path.open("rb") as file:
                head = file.read(8)
                file.seek(0)
                for magic, (what, mend) in _FOREIGN.items():
                    if head.startswith(magic) and not self.binary:
                        raise LogError(str(self.path), f"is {what}, not a text log", mend)
                if head.startswith((_XZ, _GZIP)):
                    yield from self._expand(file, head.startswith(_XZ))
                else:
                    while block := file.read(_BLOCK):
                        yield block
        except OSError as error:
            why = error.strerror or str(error)
            raise LogError(
                str(self.path), f"cannot be read: {why}", "check path and permissions"
            ) from error

    def _expand(self, file, xz: bool) -> Iterator[bytes]:
        new = partial(lzma.LZMADecompressor, memlimit=2 * FREE) if xz else _Gunzip
        decoder = new()
        between = False  # after one stream's end mark, before another stream
        packed = plain = 0

        def decompress(data: bytes) -> bytes:
            nonlocal plain
            with decoding(self._damaged):
                out = decoder.decompress(data, _BLOCK)
            plain += len(out)
            within(plain, packed, "it", self._damaged)
            return out

        while raw := file.read(_BLOCK):
            packed += len(raw)
            while raw:
                if between and not (raw := raw.lstrip(b"\0")):  # padding
                    break
                between = False
                out = decompress(raw)
                if out:
                    yield out
                while not (decoder.eof or decoder.needs_input):
                    yield decompress(b"")
                raw = decoder.unused_data if decoder.eof else b""
                if decoder.eof:
                    decoder, between = new(), True
        self.cut = not between

    def _damaged(self, why: str) -> LogError:
        return LogError(
            str(self.path),
            f"is damaged: the compressed stream does not decode ({why})",
            "fetch it again; nothing of it was used, for no number in it can be trusted",
        )


def beginning(path: str | os.PathLike[str], size: int = 256) -> bytes:
    """The first bytes of a file, decompressed.

    Raises:
        LogError: as `Source`.
    """
    start = b""
    for block in Source(path, binary=True):
        start += block[:size]
        if len(start) >= size:
            break
    return start[:size]


def whole(path: str | os.PathLike[str], limit: int) -> tuple[bytes, bool]:
    """All bytes of a file, decompressed, and whether a compressed stream ended early.

    Raises:
        LogError: as `Source`; or there are more bytes than the limit.
    """
    source, parts, size = Source(path, binary=True), [], 0
    for block in source:
        parts.append(block)
        size += len(block)
        if size > limit:
            held = f"holds more than {limit >> 20} MiB"
            raise LogError(str(path), held, "cut the recording into parts")
    return b"".join(parts), source.cut


_OPENERS: dict[str, Any] = {".xz": lzma.open, ".gz": gzip.open}


def write_lines(path: str | os.PathLike[str], blocks: Iterable[str | bytes]) -> None:
    """Write text or bytes, compressed if the name ends in .xz or .gz.

    An earlier file stays until the end.

    Raises:
        LogError: the file cannot be written; no part of it is left behind.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # a device must not be replaced by a file
            _write(path, path.suffix, blocks)
        else:
            _write_and_rename(path, blocks)
    except OSError as error:
        why = error.strerror or str(error)
        raise LogError(
            str(path), f"cannot be written: {why}", "check the folder, its permissions and the disk"
        ) from error


def _write(path: str | Path, suffix: str, blocks: Iterable[str | bytes]) -> None:
    with _OPENERS.get(suffix, open)(path, "wb") as file:
        for block in blocks:
            file.write(block.encode() if isinstance(block, str) else block)


def _write_and_rename(path: Path, blocks: Iterable[str | bytes]) -> None:
    handle, temporary = tempfile.mkstemp(prefix=".", dir=path.parent)
    os.close(handle)
    try:
        _write(temporary, path.suffix, blocks)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
