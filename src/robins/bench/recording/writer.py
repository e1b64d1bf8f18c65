"""Writes the record of a run: raw frames with their times of arrival, in an MCAP file.

Messages go to the disk in chunks of 512 messages, of 64 KiB or of a quarter of a second, whichever
comes first, each in one write. So a file that was cut anywhere lacks what came in the last quarter
of a second, and half a frame of what had reached the disk. Nothing but what is given goes into it:
the same entries make the same bytes. See `layout` for how they lie there.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mcap import records as mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from robins.bench.recording import layout
from robins.bench.wire.frames import VERSION, FrameError, decode_frame
from robins.bench.wire.schema import Wire

CHUNK_MESSAGES = 512
CHUNK_BYTES = 65536
CHUNK_NS = 250_000_000


class Recorder:
    """Writes a record; a context manager that closes it.

    Attributes:
        path: of the file.
        messages: entries and events so far.
        lost: of them, those that found no disk.
    """

    def __init__(
        self, path: str | Path, wire: Wire, header: Mapping[str, Any], *, overwrite: bool = False
    ) -> None:
        """Begin a record.

        Args:
            path: of the file.
            wire: the messages that go over the lines.
            header: of the run, such as its scenario, seeds and versions; becomes JSON.
            overwrite: whether a file that is there is replaced.

        Raises:
            RecordingError: the file is there, or JSON cannot hold the header.
            OSError: it cannot be written.
        """
        self.path = Path(path)
        self.messages = self.lost = 0
        text = layout.json_text(f"header of '{path}'", dict(header))
        self._channels: dict[tuple[str, str], int] = {}
        self._topics: list[mcap.Channel] = []
        self._counts: dict[int, int] = {}  # messages on the disk, by channel
        self._chunks = bytearray()  # index of those on the disk, as records
        self._chunk_count = 0
        self._span: tuple[int, int] | None = None  # of log times on the disk
        self._at = self._check = 0
        self._failed = False
        self._clean()
        try:
            # unbuffered: what has been written outlives this process
            self._file = self.path.open("wb" if overwrite else "xb", buffering=0)
        except FileExistsError:
            raise layout.RecordingError(
                f"'{path}' is there already: give another name, or say that it may be overwritten"
            ) from None
        out = RecordBuilder()
        mcap.Header(layout.PROFILE, "robins").write(out)
        start = layout.MAGIC + out.end()
        version = str(VERSION)
        about = {"wire": version, "header": text, "check": layout.check_of(version + text)}
        mcap.Metadata(layout.METADATA, about).write(out)
        self._metadata = mcap.MetadataIndex(len(start), out.count, layout.METADATA)
        self._schemas = layout.schemas(wire)
        for schema in self._schemas:
            schema.write(out)
        try:
            self._put(start + out.end())
        except OSError:
            self._file.close()
            raise

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, entry: layout.Entry, time_ns: int | None = None) -> None:
        """Take what went over a link.

        Args:
            entry: with the time it came.
            time_ns: of the header of the frame, where the caller knows it; else it is looked up,
                and bytes that are no frame have the time they came.

        Raises:
            OSError: the disk is full, or gone; said once, what comes after is counted as lost.
        """
        received_ns, link, direction, data = entry
        channel = self._channels.get((link, direction))
        if channel is None:
            topic = f"/{link}/{direction}"
            channel = self._open(
                link, direction, topic, f"{layout.ENCODING}{VERSION}", layout.FRAMES_SCHEMA
            )
        if time_ns is None:
            time_ns = _time_ns(data, received_ns)
        self._add(channel, received_ns, time_ns, data)

    def event(self, event: layout.Event) -> None:
        """Take what happened.

        Raises:
            RecordingError: JSON cannot hold its fields.
            OSError: as `write`.
        """
        told = {"kind": event.kind, "text": event.text, "fields": event.fields}
        text = layout.json_text(f"event '{event.kind}'", told)
        channel = self._channels.get(("", ""))
        if channel is None:
            channel = self._open("", "", layout.EVENTS, "json", layout.EVENTS_SCHEMA)
        self._add(channel, event.received_ns, event.received_ns, text.encode())

    def flush(self) -> None:
        """Hand to the disk what has been taken; for times in which nothing comes.

        Raises:
            OSError: as `write`.
        """
        if self._failed or not self._taken:
            return
        body, first, last = bytes(self._body), self._first, self._last
        indices, taken, size = self._indices, self._taken, len(self._body)
        self._clean()
        whole = layout.CHUNK.size + size
        head = layout.CHUNK.pack(
            Opcode.CHUNK, whole - layout.RECORD.size, first, last, size, zlib.crc32(body), 0, size
        )
        index, places = bytearray(), {}
        for channel, places_in_chunk in indices.items():
            places[channel] = self._at + whole + len(index)
            index += _index_record(channel, places_in_chunk)
        at = self._at
        try:
            self._put(head + body + index)
        except OSError:
            self.lost += taken
            raise
        out = RecordBuilder()
        mcap.ChunkIndex(
            chunk_length=whole,
            chunk_start_offset=at,
            compression="",
            compressed_size=size,
            message_end_time=last,
            message_index_length=len(index),
            message_index_offsets=places,
            message_start_time=first,
            uncompressed_size=size,
        ).write(out)
        self._chunks += out.end()
        self._chunk_count += 1
        begin, end = self._span or (first, last)
        self._span = min(begin, first), max(end, last)
        for channel, places_in_chunk in indices.items():
            more = len(places_in_chunk) // layout.INDEX.size
            self._counts[channel] = self._counts.get(channel, 0) + more

    def close(self) -> None:
        """Write the summary by which other tools find their way, and close the file.

        Raises:
            OSError: as `write`.
        """
        if self._file.closed:
            return
        try:
            self.flush()
            if not self._failed:
                self._put(self._end())
        finally:
            self._file.close()

    def _clean(self) -> None:
        """Begin a chunk."""
        self._body = bytearray()
        self._indices: dict[int, bytearray] = {}
        self._first = self._last = self._taken = 0

    def _open(self, link: str, direction: str, topic: str, encoding: str, schema: int) -> int:
        """A topic, told in the chunk in which it first is."""
        number = len(self._topics) + 1
        channel = mcap.Channel(number, topic, encoding, {}, schema)
        out = RecordBuilder()
        channel.write(out)
        self._body += out.end()
        self._topics.append(channel)
        self._channels[link, direction] = number
        return number

    def _add(self, channel: int, log_ns: int, time_ns: int, data: bytes) -> None:
        number = self.messages
        self.messages = number + 1
        if self._failed:
            self.lost += 1
            return
        body, index = self._body, self._indices.get(channel)
        if index is None:
            index = self._indices[channel] = bytearray()
        if not self._taken:
            self._first = self._last = log_ns
        elif log_ns > self._last:
            self._last = log_ns
        elif log_ns < self._first:
            self._first = log_ns
        self._taken += 1
        index += layout.INDEX.pack(log_ns, len(body))
        size = layout.MESSAGE.size - layout.RECORD.size + len(data)
        body += layout.MESSAGE.pack(5, size, channel, number & 0xFFFFFFFF, log_ns, time_ns)
        body += data
        if (
            self._last - self._first >= CHUNK_NS
            or self._taken >= CHUNK_MESSAGES
            or len(body) >= CHUNK_BYTES
        ):
            self.flush()

    def _put(self, data: bytes | bytearray) -> None:
        """Bytes to the disk, all of them."""
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) or 0 :]
        except OSError as error:
            self._failed = True
            text = f"{error.strerror}; the record ends here, and can be read so far"
            raise OSError(error.errno, text, str(self.path)) from None
        self._at += len(data)
        self._check = zlib.crc32(data, self._check)

    def _end(self) -> bytes:
        """The end of the data, the summary, and the footer."""
        out = RecordBuilder()
        mcap.DataEnd(self._check).write(out)
        start, parts, offsets = self._at + out.count, [out.end()], RecordBuilder()
        at = start
        for opcode, group in (
            (Opcode.SCHEMA, _bytes_of(*self._schemas)),
            (Opcode.CHANNEL, _bytes_of(*self._topics)),
            (Opcode.STATISTICS, _bytes_of(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunks)),
            (Opcode.METADATA_INDEX, _bytes_of(self._metadata)),
        ):
            if group:
                mcap.SummaryOffset(opcode, at, len(group)).write(offsets)
                parts.append(group)
                at += len(group)
        parts.append(offsets.end())
        foot = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
        foot += struct.pack("<I", zlib.crc32(foot, zlib.crc32(b"".join(parts[1:]))))
        return b"".join([*parts, foot, layout.MAGIC])

    def _statistics(self) -> mcap.Statistics:
        begin, end = self._span or (0, 0)
        return mcap.Statistics(
            attachment_count=0,
            channel_count=len(self._topics),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            message_end_time=end,
            message_start_time=begin,
            metadata_count=1,
            schema_count=len(self._schemas),
        )


def _bytes_of(*some: mcap.McapRecord) -> bytes:
    out = RecordBuilder()
    for one in some:
        one.write(out)
    return out.end()


def _index_record(channel: int, places: bytearray) -> bytes:
    """Where the messages of a channel are in a chunk."""
    head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(places), channel, len(places))
    return head + places


def _time_ns(data: bytes, otherwise: int) -> int:
    """Of the header of a frame."""
    if len(data) < 2 or data[0] or data[-1]:
        return otherwise
    try:
        return decode_frame(data[1:-1]).header.time_ns
    except FrameError:
        return otherwise
