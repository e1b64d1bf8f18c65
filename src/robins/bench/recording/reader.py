"""Reader of the record of a run, up to the last complete frame."""

from __future__ import annotations

import contextlib
import io
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.well_known import MessageEncoding

from robins.bench.recording import layout
from robins.bench.wire.frames import VERSION
from robins.errors import RobinsError
from robins.foreign import decoding

LONGEST = 1 << 24  # bytes of a record; a larger length means damage, and no memory is allocated
_ABOUT = {"wire", "header", "check"}
_Place = tuple[str, Literal["to", "from"]]
_EVENTS: _Place = ("", "from")  # no link has this name
_DIRECTIONS: dict[str, Literal["to", "from"]] = {"to": "to", "from": "from"}


class Record(NamedTuple):
    """A record that was read: header, entries, events, and whether it is complete."""

    header: dict[str, Any]
    entries: Sequence[layout.Entry] | Entries  # in the order in which they were written
    events: list[layout.Event]
    complete: bool  # closed, and every checksum of the file holds
    why: str  # reason why it is not whole; else empty


class Entries:
    """Entries of a file up to its first damage, read again at each iteration."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __iter__(self) -> Iterator[layout.Entry]:
        with _opened(self._path) as reader:
            _header(str(self._path), reader)
            for _ in reader.records():
                yield from reader.entries
                reader.entries.clear()


class _Damage(RobinsError):
    """Reason why the reading of a record stops before its end."""


def read_record(path: str | Path) -> Record:
    """Read a record, or as much of it as is intact.

    Of a truncated or damaged file, the entries before the damage are read; `why` has the reason.

    Raises:
        RecordingError: there is no such file, it is not a record of the bench, it is of another
            version of the wire, or it ends within the header of the run.
    """
    return _read(Path(path), lambda reader: reader.entries)


def open_record(path: str | Path) -> Record:
    """Check a record and read all but its entries, which are read when they are iterated.

    Raises:
        RecordingError: as `read_record`.
    """
    return _read(Path(path), lambda reader: Entries(Path(path)))


def _read(
    path: Path, entries: Callable[[_RecordReader], Sequence[layout.Entry] | Entries]
) -> Record:
    with _opened(path) as reader:
        header, kept = _header(str(path), reader), entries(reader)
        for _ in reader.records():
            if kept is not reader.entries:
                reader.entries.clear()
        return Record(header, kept, reader.events, not reader.why, reader.why)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_RecordReader]:
    """Open a file as a reader of its records.

    Raises:
        RecordingError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            yield _RecordReader(file)
    except OSError as error:
        raise layout.RecordingError(f"'{path}' cannot be read: {error.strerror or error}") from None


def _header(path: str, reader: _RecordReader) -> dict[str, Any]:
    """The header of the run.

    Raises:
        RecordingError: it is not there.
    """
    if (magic := reader.take(len(layout.MAGIC))) != layout.MAGIC:
        if layout.MAGIC.startswith(magic):
            raise layout.RecordingError(f"'{path}' ends at byte {len(magic)}: nothing was recorded")
        raise layout.RecordingError(f"'{path}' is no MCAP file: give a record that the bench wrote")
    try:
        opcode, body = reader.record()
        with decoding(_Damage):
            profile = mcap.Header.read(_stream(body)).profile if opcode == Opcode.HEADER else ""
    except _Damage as error:
        raise layout.RecordingError(f"'{path}' {error}, before the header of the run") from None
    if profile != layout.PROFILE:
        raise layout.RecordingError(
            f"'{path}' is an MCAP file of the profile '{profile}', not one that the bench wrote "
            f"('{layout.PROFILE}')"
        )
    try:
        opcode, body = reader.record()
        with decoding(_Damage):
            about = mcap.Metadata.read(_stream(body)) if opcode == Opcode.METADATA else None
    except _Damage as error:
        raise layout.RecordingError(f"'{path}' {error}, within the header of the run") from None
    if about is None or about.name != layout.METADATA or set(about.metadata) != _ABOUT:
        raise layout.RecordingError(f"'{path}' is damaged: no header of the run where it should be")
    wire, text = about.metadata["wire"], about.metadata["header"]
    if layout.check_of(wire + text) != about.metadata["check"]:
        raise layout.RecordingError(f"'{path}' is damaged: the header of the run fails its check")
    if wire != str(VERSION):
        raise layout.RecordingError(
            f"'{path}' has version {wire} of the wire, this is version {VERSION}: read it with the "
            "robins that wrote it"
        )
    with decoding(lambda why: layout.RecordingError(f"'{path}' is damaged: {why}")):
        header = json.loads(text)
    if not isinstance(header, dict):
        raise layout.RecordingError(f"'{path}' is damaged: the header of the run is no table")
    return header


class _RecordReader:
    """Reader of an MCAP file, record by record."""

    def __init__(self, file: BinaryIO) -> None:
        self.entries: list[layout.Entry] = []
        self.events: list[layout.Event] = []
        self._file = file
        self._at = self._check = self._before = 0
        self._topics: dict[int, _Place | None] = {}  # None: of messages for other tools
        self._count = 0  # messages so far; they are numbered
        self.why = ""  # reason why reading stopped early

    def take(self, size: int) -> bytes:
        """Read `size` bytes, or fewer at the end of the file."""
        data = self._file.read(size)
        self._at += len(data)
        self._check = zlib.crc32(data, self._check)
        return data

    def record(self) -> tuple[int, bytes]:
        """The next record.

        Raises:
            _Damage: it is incomplete; the messages of a truncated chunk are taken.
        """
        at, self._before = self._at, self._check
        head = self.take(layout.RECORD.size)
        opcode, size = layout.RECORD.unpack(head) if len(head) == layout.RECORD.size else (0, 0)
        if size > LONGEST:
            raise _Damage(f"is damaged at byte {at}: a record of {size} bytes")
        body = self.take(size)
        if len(head) < layout.RECORD.size or len(body) < size:
            if opcode == Opcode.CHUNK:
                self._chunk(at, head + body)
            raise _Damage(f"ends at byte {self._at} without having been closed")
        return opcode, body

    def records(self) -> Iterator[None]:
        """Read the records one by one, up to the first damage, which `why` describes."""
        try:
            while self.step():
                yield
        except _Damage as damage:
            self.why = str(damage)
        yield

    def step(self) -> bool:
        """Read the next record; true if there is more to come.

        Raises:
            _Damage: the file ends, or is damaged there.
        """
        at = self._at
        opcode, body = self.record()
        if opcode == Opcode.CHUNK:
            self._chunk(at, layout.RECORD.pack(opcode, len(body)) + body)
        elif opcode == Opcode.DATA_END:
            self._end(at, body)
        elif opcode not in (Opcode.SCHEMA, Opcode.MESSAGE_INDEX):
            raise _Damage(f"is damaged at byte {at}: a record of kind {opcode}")
        return opcode != Opcode.DATA_END

    def _chunk(self, at: int, data: bytes) -> None:
        """Read the messages of a chunk, which may be truncated."""
        if len(data) < layout.CHUNK.size:
            if (
                at + len(data) == self._at
                and layout.RECORD.unpack_from(data)[1] > len(data) - layout.RECORD.size
            ):
                return
            raise _Damage(f"is damaged at byte {at}: a chunk without a head")
        _, size, _, _, plain, check, packed, inside = layout.CHUNK.unpack_from(data)
        if (
            packed != 0
            or plain != inside
            or layout.CHUNK.size - layout.RECORD.size + inside != size
        ):
            raise _Damage(f"is damaged at byte {at}: the sizes of a chunk do not agree")
        body = data[layout.CHUNK.size :]
        if len(body) == inside and zlib.crc32(body) != check:
            raise _Damage(f"is damaged between the bytes {at} and {at + len(data)}")
        place = 0
        while place + layout.RECORD.size <= len(body):
            opcode, length = layout.RECORD.unpack_from(body, place)
            end = place + layout.RECORD.size + length
            if end > len(body):
                break
            where = f"is damaged at byte {at + layout.CHUNK.size + place}"
            try:
                self._inner(opcode, body[place:end])
            except _Damage as error:
                raise _Damage(f"{where}: {error}") from None
            place = end

    def _inner(self, opcode: int, data: bytes) -> None:
        """Read a record within a chunk."""
        if opcode == Opcode.SCHEMA:
            return
        if opcode == Opcode.CHANNEL:
            with decoding(_Damage):
                channel = mcap.Channel.read(_stream(data[layout.RECORD.size :]))
            self._topics[channel.id] = _place(channel)
            return
        if opcode != Opcode.MESSAGE:
            raise _Damage(f"a record of kind {opcode}")
        if len(data) < layout.MESSAGE.size:
            raise _Damage(f"a message of {len(data)} bytes")
        _, _, channel, number, log_ns, _ = layout.MESSAGE.unpack_from(data)
        if number != self._count & 0xFFFFFFFF:
            raise _Damage(f"message {number} where number {self._count} should be")
        if channel not in self._topics:
            raise _Damage(f"a message of channel {channel}, which is not there")
        place, content = self._topics[channel], data[layout.MESSAGE.size :]
        if place == _EVENTS:
            with decoding(_Damage):
                fields = json.loads(content)
                event = layout.Event(log_ns, fields["kind"], fields["text"], fields["fields"])
            self.events.append(event)
        elif place is not None:
            self.entries.append(layout.Entry(log_ns, *place, content))
        self._count += 1

    def _end(self, at: int, body: bytes) -> None:
        """Verify the checksums of the data and of the summary."""
        if body != struct.pack("<I", self._before):
            raise _Damage(f"is damaged before byte {at}: the check of all fails")
        check, tail = 0, b""
        while block := self._file.read(1 << 20):
            data = tail + block
            check = zlib.crc32(data[:-12], check)
            tail = data[-12:]
            self._at += len(block)
        if tail[4:] != layout.MAGIC:
            raise _Damage(f"ends at byte {self._at} without having been closed")
        if tail[:4] != struct.pack("<I", check):
            raise _Damage(f"is damaged after byte {at}: the check of its summary fails")


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _place(channel: mcap.Channel) -> _Place | None:
    """Link and direction of a topic, or `_EVENTS`; None: its messages are for other tools."""
    if channel.topic == layout.EVENTS:
        return _EVENTS
    if channel.message_encoding in (MessageEncoding.CDR, MessageEncoding.JSON):
        return None
    empty, _, rest = channel.topic.partition("/")
    link, _, direction = rest.partition("/")
    if (
        empty
        or direction not in _DIRECTIONS
        or channel.message_encoding != f"{layout.ENCODING}{VERSION}"
    ):
        raise _Damage(f"topic '{channel.topic}' of messages '{channel.message_encoding}'")
    return link, _DIRECTIONS[direction]
