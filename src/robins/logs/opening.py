"""Reading of logs that may be compressed or truncated, in blocks of bounded memory.

A truncated compressed file gives every byte before the cut. A damaged one is refused as a whole:
its checksum follows the data, so nothing before it can be trusted.

`write_lines` writes a log under a temporary name first, so that no partial file has the final one.
"""

from __future__ import annotations

import gzip
import lzma
import mmap
import os
import re
import secrets
import zlib
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from robins.foreign import FREE, decoding, within
from robins.logs.findings import (
    FETCH_AGAIN,
    AnyPath,
    Findings,
    LogError,
    finding_reporter,
    os_errors,
)

Bytes: TypeAlias = bytes | mmap.mmap
_BLOCK, _ABOUT, _LARGEST = 1 << 20, 1 << 22, 1 << 30
RECORDING = re.compile(r".+\.(mcap|db3|bag)(\.(xz|gz|zstd))?")
_LISTED = re.compile(r"^\s*-\s+(\S+\.(?:mcap|db3)(?:\.zstd)?)\s*$", re.MULTILINE)
_NUMBER = re.compile(r"_(\d+)\.(?:mcap|db3|bag)")
_XZ, _GZIP = b"\xfd7zXZ\x00", b"\x1f\x8b"
UNZSTD = "zstd -d FILE, and give the file that it writes"
_NATIVE = "leave the format to be recognised"
_CSV, _UNPACK = "export the columns to CSV", "unpack it first"
_RTKLIB = "solve its positions with RTKLIB (convbin, rnx2rtkp) and give the .pos"
_FOREIGN: tuple[tuple[int, bytes, str, str], ...] = (  # position, bytes there, kind, how to read it
    (0, b"PK\x03\x04", "a zip archive", _UNPACK),
    (0, _GZIP, "a gzip file in another compressed file", _UNPACK),
    (0, _XZ, "an xz file in another compressed file", _UNPACK),
    (0, b"BZh", "a bzip2 file", _UNPACK),
    (0, b"\x28\xb5\x2f\xfd", "a zstd file", f"unpack it: {UNZSTD}"),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7z archive", _UNPACK),
    (0, b"Rar!", "a RAR archive", _UNPACK),
    (257, b"ustar", "a tar archive", _UNPACK),
    (0, b"ULog", "a PX4 ULog", _NATIVE),
    (0, b"#ROSBAG V2.0", "a ROS bag", _NATIVE),
    (0, b"#ROSBAG", "a ROS bag of an old version", "convert it with rosbag fix"),
    (0, b"SQLite", "an SQLite file (a ROS 2 bag?)", _NATIVE),
    (0, b"\x89MCAP", "an MCAP file", _NATIVE),
    (0, b"\xb5\x62", "a UBX file of u-blox", _NATIVE),
    (0, b"\xa3\x95", "an ArduPilot dataflash log", _NATIVE),
    (0, b"\x89HDF", "an HDF5 or MATLAB v7.3 file", _CSV),
    (0, b"MATLAB", "a MATLAB file", _CSV),
    (0, b"CDF\x01", "a NetCDF file", _CSV),
    (0, b"PAR1", "a Parquet file", "export it: pandas.read_parquet(FILE).to_csv(...)"),
    (0, b"ARROW1", "an Arrow or Feather file", "export it: pandas.read_feather(FILE).to_csv(...)"),
    (0, b"TDSm", "a TDMS file of LabVIEW", "export the channels to CSV, e.g. by npTDMS"),
    (0, b"MDF ", "an MDF file of measurements (MF4)", "export the signals to CSV, e.g. by asammdf"),
    (0, b"\xd4\xc3\xb2\xa1", "a pcap of network packets", "extract its stream with Wireshark"),
    (0, b"\x0a\x0d\x0d\x0a", "a pcapng of network packets", "extract its stream with Wireshark"),
    (0, b"$@", "Septentrio SBF", "convert it with bin2asc or sbf2rin of RxTools"),
    (0, b"\xaa\x44\x12", "a NovAtel OEM4/6 log", "convert it to ASCII with NovAtel Convert"),
    (0, b"\xaa\x44\xb5", "a NovAtel OEM7 log", "convert it to ASCII with NovAtel Convert"),
    (60, b"RINEX VERSION", "RINEX observations", _RTKLIB),
    (0, b"\xd3\x00", "RTCM 3 corrections", _RTKLIB),
    (0, b"\xfa\xff", "an Xsens MTB log", "export it to text with MT Manager"),
    (0, b"\xfa", "VectorNav binary output", "export it to CSV with VectorNav Control Center"),
    (16, b"BUILD", "a DJI .DAT log", "convert it to CSV with DatCon"),
    (242, b"DJI_LOG_V3", "a DJI .DAT log", "convert it to CSV with DatCon"),
    (4, b"ftyp", "an MP4 film", "extract its telemetry (GoPro: gopro2json) to CSV"),
    (0, b"\xff\xd8\xff", "a JPEG picture", "give the log"),
    (0, b"\x89PNG", "a PNG picture", "give the log"),
    (0, b"%PDF", "a PDF document", "give the log"),
    (0, b"\x7fELF", "a program (ELF)", "give the log"),
)


def foreign(start: bytes) -> tuple[str, str] | None:
    """Kind of a file that is no text, from its first bytes, and how to read it; None for text."""
    found = ((what, fix) for at, magic, what, fix in _FOREIGN if start.startswith(magic, at))
    return next(found, None)


class _Gunzip:
    """zlib's decompressor with the interface of `lzma.LZMADecompressor`."""

    def __init__(self):
        self._inner = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
        self._full = False  # the last output reached its limit, so more may be pending

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


def parts_of(path: AnyPath) -> list[Path]:
    """Files of a recording in order: the file itself, or those of a ROS folder.

    A folder lists them in its ``metadata.yaml``, or has one file, or files numbered _0, _1, ...

    Raises:
        LogError: the folder has no such files, or one of them is missing.
    """
    folder = Path(path)
    if not folder.is_dir():
        return [folder]
    there = {p.name for p in folder.iterdir() if RECORDING.fullmatch(p.name) and p.is_file()}
    try:
        about = (folder / "metadata.yaml").read_bytes()[:_ABOUT].decode("utf-8", "replace")
    except OSError:
        about = ""
    names = [Path(name).name for name in _LISTED.findall(about)]
    if lacking := [name for name in names if name not in there]:
        cause = f"lacks {', '.join(lacking)}, which its metadata.yaml names"
        raise LogError(str(folder), cause, "copy the whole folder again")
    if not names:
        numbers = {name: int((_NUMBER.search(name) or [0, -1])[1]) for name in there}
        names = sorted(there, key=lambda name: numbers[name])
        if not names or (len(names) > 1 and [*map(numbers.get, names)] != [*range(len(names))]):
            cause = f"is a folder with {len(names)} recordings of ROS, not one"
            raise LogError(str(folder), cause, "give a file of it, or the folder of one recording")
    return [folder / name for name in names]


class Source:
    """The bytes of a file, decompressed if it is .xz or .gz by content, in blocks.

    Iterate once. Afterwards `cut` is True if a compressed stream ended before its end mark.

    Raises:
        LogError: the file cannot be opened or read, is damaged, or (unless `binary`) is of a kind
            that holds no text.
    """

    def __init__(self, path: AnyPath, binary: bool = False):
        self.path = parts_of(path)[0]
        self.binary = binary
        self.cut = False

    def __iter__(self) -> Iterator[bytes]:
        with os_errors(str(self.path)), self.path.open("rb") as file:
            head = file.read(8)
            file.seek(0)
            packed, plain = head.startswith((_XZ, _GZIP)), iter(partial(file.read, _BLOCK), b"")
            blocks = self._expand(file, head.startswith(_XZ)) if packed else plain
            for count, block in enumerate(blocks):
                if not (count or self.binary) and (found := foreign(block)):
                    raise LogError(str(self.path), f"is {found[0]}, not a text log", found[1])
                yield block

    def _expand(self, file, xz: bool) -> Iterator[bytes]:
        new = partial(lzma.LZMADecompressor, memlimit=2 * FREE) if xz else _Gunzip
        decoder = new()
        between = False  # between the end mark of a stream and the next stream
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
        cause = f"is damaged: the compressed stream does not decode ({why})"
        return LogError(str(self.path), cause, FETCH_AGAIN)


def read_beginning(path: AnyPath, size: int = 256) -> bytes:
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


def map_file(path: AnyPath, findings: Findings) -> Bytes:
    """All bytes of a file; a compressed stream that ended early is reported.

    A plain file is mapped, so that it may be larger than memory; a compressed one is decompressed.

    Raises:
        LogError: as `Source`; or the decompressed size exceeds 1 GiB.
    """
    read_beginning(path, 1)  # raises if it cannot be read
    with Path(path).open("rb") as file:
        if file.read(6).startswith((_XZ, _GZIP)):
            data, cut = read_whole(path, _LARGEST)
            if cut:
                finding_reporter(findings, "warning", "ends_early", str(path), value=len(data))(
                    "its compressed stream has no end: the copy was interrupted. All before it was "
                    "read."
                )
            return data
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if file.tell() else b""


def read_whole(path: AnyPath, limit: int) -> tuple[bytes, bool]:
    """All bytes of a file, decompressed, and True if a compressed stream ended early.

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


def write_lines(path: AnyPath, blocks: Iterable[str | bytes]) -> None:
    """Write text or bytes, compressed if the name ends in .xz or .gz.

    An existing file is replaced at the end.

    Raises:
        LogError: the file cannot be written; no part of it is left behind.
    """
    path = Path(path)
    with os_errors(str(path), "written", "check the folder, its permissions and the disk"):
        if path.exists() and not path.is_file():  # a device must not be replaced by a file
            _write(path, path.suffix, blocks)
        else:
            _write_and_rename(path, blocks)


def _write(path: Path, suffix: str, blocks: Iterable[str | bytes]) -> None:
    with _OPENERS.get(suffix, open)(path, "wb") as file:
        for block in blocks:
            file.write(block.encode() if isinstance(block, str) else block)


def _write_and_rename(path: Path, blocks: Iterable[str | bytes]) -> None:
    temporary = path.with_name(f".{secrets.token_hex(8)}")  # with default permissions
    temporary.touch(exist_ok=False)
    try:
        _write(temporary, path.suffix, blocks)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink()
        raise
