"""Messages from ROS recordings: .mcap and .db3 of ROS 2, .bag of ROS 1.

Files are mapped, not loaded, so that they may be of any size; compressed ones are decompressed, up
to 1 GiB. All complete records of a truncated MCAP file are read. The others end with their index,
so a truncated one is refused, with the command that repairs it.
"""

from __future__ import annotations

import bz2
import contextlib
import io
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, cast

from robins.foreign import decoding, largest, unpacked, within
from robins.logs.findings import (
    Findings,
    LogError,
    damaged,
    extra_package,
    finding_reporter,
    report_cut_end,
)
from robins.logs.opening import UNZSTD, Bytes, map_file

if TYPE_CHECKING:
    from mcap.records import McapRecord
    from rosbags.interfaces.typing import RPath

MCAP, SQLITE, BAG = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V2.0\n"
_RECORD, _FOOTER = struct.Struct("<BQ"), 2  # opcode and length of a record; the last one's opcode
_ZSTD = b"\x28\xb5\x2f\xfd"
_FOR_THESE = "the package for these"
mcap_package = partial(extra_package, what="an MCAP file", package=_FOR_THESE)


Raw: TypeAlias = tuple[str, str, bytes, bool]
"""Type of a message as named in ROS 2, topic, bytes, and True if serialised by ROS 1."""


def raw_messages(path: Path, wanted: Collection[str], findings: Findings) -> Iterator[Raw]:
    """Messages of the wanted types, and one without bytes for each topic of any type.

    Args:
        path: a file, plain or compressed.
        wanted: names of types, as in ROS 2.
        findings: receives omissions.

    Raises:
        LogError: a package is not installed; the file is damaged or no ROS recording.
    """
    data = map_file(path, findings)
    read = {MCAP: _from_mcap, SQLITE: _from_db3, BAG: _from_bag}
    for magic, found in read.items():
        if data[: len(magic)] == magic:
            yield from found(path, data, wanted, findings)
            return
    if data[: len(_ZSTD)] == _ZSTD:
        raise LogError(str(path), "is packed by zstd as a whole", f"unpack it: {UNZSTD}")
    raise LogError(str(path), "is no recording of ROS", "leave the format to be recognised")


def _plain(data: bytes, refuse: Callable[[str], LogError]) -> bytes:
    """A ROS 2 message, decompressed if it was compressed by itself."""
    if not data.startswith(_ZSTD):
        return data
    import zstandard

    with decoding(refuse):
        size = zstandard.frame_content_size(data)
    if size < 0:
        raise refuse("a packed message does not state its size")
    within(size, len(data), "a message", refuse)
    return unpacked(data, "zstd", size, refuse)


# -------------------------------------------------------------------------------------------- MCAP


def _from_mcap(
    path: Path, data: Bytes, wanted: Collection[str], findings: Findings
) -> Iterator[Raw]:
    file, refuse = str(path), damaged(str(path))
    sound, closed = _sound(data)
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}  # type and topic
    one: Any
    for one in _records(file, data, sound, refuse):
        record = type(one).__name__  # by name, as the package is not imported here
        if record == "Schema":
            schemas[one.id] = one.name
        elif record == "Channel":
            name = schemas.get(one.schema_id, "")
            if one.schema_id and not name:
                raise refuse(f"topic {one.topic} has schema {one.schema_id}, which is not there")
            kind = name if one.message_encoding == "cdr" else f"{name} in {one.message_encoding}"
            channels[one.id] = (kind, one.topic)
            yield kind, one.topic, b"", False
        elif record == "Message":
            if one.channel_id not in channels:
                raise refuse(f"a message of channel {one.channel_id}, which is not there")
            kind, topic = channels[one.channel_id]
            if kind in wanted:
                yield kind, topic, _plain(one.data, refuse), False
    if not closed:
        report_cut_end(findings, file, len(data))


def _sound(data: Bytes) -> tuple[int, bool]:
    """End of the unbroken sequence of records, and True if the last one closes the file."""
    at = len(MCAP)
    while at + _RECORD.size <= len(data):
        opcode, size = _RECORD.unpack_from(data, at)
        if opcode == 0 or at + _RECORD.size + size > len(data):
            break
        at += _RECORD.size + size
        if opcode == _FOOTER:
            return at + len(MCAP), data[at : at + len(MCAP)] == MCAP
    return min(at, len(data)), False


def _records(
    file: str, data: Bytes, sound: int, refuse: Callable[[str], LogError]
) -> Iterator[McapRecord]:
    """All records of a file, including those in chunks, decoded by the package.

    Raises:
        LogError: the package is not installed, or a record is damaged.
    """
    with mcap_package(file):
        from mcap.exceptions import EndOfFile
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk
    plain = at = 0

    def read(size: int) -> bytes:  # no byte after the last complete record
        nonlocal at
        part = data[at : min(at + size, sound)]
        at += len(part)
        return part

    stream = cast("BinaryIO", SimpleNamespace(read=read))
    records = StreamReader(stream, emit_chunks=True, validate_crcs=True).records
    while True:
        try:
            with decoding(refuse):
                one = next(records, None)
        except LogError as error:
            if isinstance(error.__cause__, EndOfFile) and at >= min(sound, len(data)):
                return  # after the last complete record: the file is not closed
            raise
        if one is None:
            return
        if not isinstance(one, Chunk):
            yield one
            continue
        plain += one.uncompressed_size
        within(plain, len(data), "its chunks", refuse)
        content = unpacked(one.data, one.compression, one.uncompressed_size, refuse)
        with decoding(refuse):
            inner = breakup_chunk(replace(one, data=content, compression=""), validate_crc=True)
        yield from inner


# ------------------------------------------------------------------------------------------ SQLite


def _from_db3(
    path: Path, data: Bytes, wanted: Collection[str], findings: Findings
) -> Iterator[Raw]:
    file, refuse = str(path), damaged(str(path))
    waiting = path.with_name(path.name + "-wal")
    if waiting.exists() and waiting.stat().st_size:
        finding_reporter(findings, "warning", "ends_early", file, value=waiting.stat().st_size)(
            f"its last messages are still in {waiting.name}, for the recorder was not closed; they "
            f"are not read. Close it: sqlite3 {path.name} 'PRAGMA wal_checkpoint'."
        )
    with contextlib.closing(_database(path, data, refuse)) as base:
        with decoding(refuse):
            kinds = dict(base.execute("SELECT name, type FROM sqlite_master"))
            if not kinds.get("topics") == kinds.get("messages") == "table":
                cause = f"is an SQLite file, but no recording of ROS 2: it holds {', '.join(kinds)}"
                raise LogError(file, cause, "export its columns to CSV")
            topics = base.execute("SELECT id, name, type, serialization_format FROM topics")
            named = {
                key: (kind if form == "cdr" else f"{kind} in {form}", str(topic))
                for key, topic, kind, form in topics
            }
            read = [key for key, (kind, _) in named.items() if kind in wanted]
            marks = ",".join("?" * len(read))
            rows = base.execute(
                f"SELECT topic_id, data FROM messages WHERE topic_id IN ({marks}) "
                "ORDER BY timestamp, id",
                read,
            )
        yield from ((str(kind), topic, b"", False) for kind, topic in named.values())
        while True:
            with decoding(refuse):
                row = next(rows, None)
            if row is None:
                return
            if not isinstance(row[1], bytes):
                raise refuse(f"a message of {named[row[0]][1]} is no bytes")
            yield *named[row[0]], _plain(row[1], refuse), False


def _database(path: Path, data: Bytes, refuse: Callable[[str], LogError]) -> sqlite3.Connection:
    """Open the database read-only, without trust in its schema."""
    with decoding(refuse):
        if isinstance(data, bytes):
            base = sqlite3.connect(":memory:")
            base.deserialize(data)
        else:
            base = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(len(data), 1 << 16), (1 << 31) - 1))
        base.execute("PRAGMA query_only = ON")
        base.execute("PRAGMA trusted_schema = OFF")
        return base


# ------------------------------------------------------------------------------------------- ROS 1


def _from_bag(
    path: Path, data: Bytes, wanted: Collection[str], findings: Findings
) -> Iterator[Raw]:
    file = str(path)
    with extra_package(file, "a bag of ROS 1", _FOR_THESE):
        from rosbags.rosbag1 import Reader

    def refuse(why: str) -> LogError:
        fix = "fetch it again, or restore its index: rosbag reindex FILE"
        return LogError(file, f"is damaged or was not closed ({why})", fix)

    # the reader accepts any stream: a map gives no more bytes than there are
    stream = io.BytesIO(data) if isinstance(data, bytes) else data
    place = SimpleNamespace(exists=lambda: True, open=lambda mode: stream)
    with decoding(refuse), Reader(cast("RPath", place)) as reader:
        for at, chunk in reader.chunks.items():
            reader.chunks[at] = chunk._replace(decompressor=_bounded)
        yield from ((c.msgtype, c.topic, b"", True) for c in reader.connections)
        chosen = [c for c in reader.connections if c.msgtype in wanted]
        for one, _, message in reader.messages(chosen) if chosen else ():
            yield one.msgtype, one.topic, message, True


def _bounded(packed: bytes) -> bytes:
    """Decompressed content of a chunk, of bounded size."""
    from lz4.frame import LZ4FrameDecompressor

    kinds = {b"BZ": bz2.BZ2Decompressor, b"\x04\x22": LZ4FrameDecompressor}
    if kind := kinds.get(packed[:2]):
        return kind().decompress(packed, largest(len(packed)))
    return packed
