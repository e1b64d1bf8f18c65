"""Writer of the record of a run: raw frames with their times of arrival, in an MCAP file.

Messages go to the disk in chunks of 512 messages, of 64 KiB or of a quarter of a second, whichever
comes first, each in one write. So the file of a killed run lacks at most the traffic of the last
quarter of a second, and may end in a truncated frame. Nothing but the input goes into it: the same
entries make the same bytes. See `layout` for the format.

The writer is that of the package `mcap`; only the end of a chunk and the write to disk are
controlled here. By itself `mcap` ends a chunk by size alone: of 3030 frames at 300 Hz, killed by
SIGKILL, its default chunks of 1 MiB left none, and those of 64 KiB lost 2.1 s, where this loses
0.2 s. It takes 8.6 us a message (116 000 a second); a writer of our own took 2.2 us. A bench of
seven parts passes 31 messages a step, so a step costs 0.2 ms more, mostly while the parts compute.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from io import FileIO
from pathlib import Path
from typing import Any

from mcap.records import Schema
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer

from robins.bench.closing import Closing
from robins.bench.recording import layout
from robins.bench.recording.topics import Topic, Topics
from robins.bench.wire.frames import VERSION, FrameError, decode_frame
from robins.bench.wire.schema import Wire

CHUNK_MESSAGES = 512
CHUNK_BYTES = 65536
CHUNK_NS = 250_000_000


class Recorder(Closing):
    """Writer of a record; a context manager that closes it.

    Attributes:
        path: of the file.
        messages: number taken so far: entries, events, and messages for other tools.
        lost: number of them that could not be written to disk.
    """

    def __init__(
        self,
        path: str | Path,
        wire: Wire,
        header: Mapping[str, Any],
        *,
        topics: Iterable[Topic] = (),
        overwrite: bool = False,
    ) -> None:
        """Start a record.

        Args:
            path: of the file.
            wire: the messages that go over the lines.
            header: of the run, such as its scenario, seeds and versions; stored as JSON.
            topics: rows that convert the frames that parts send for other tools.
            overwrite: whether to replace an existing file.

        Raises:
            RecordingError: the file is there, JSON cannot hold the header, or a row of the topics
                does not fit the messages.
            OSError: it cannot be written.
        """
        self.path = Path(path)
        self.messages = self.lost = 0
        self._decoded, self._kinds = Topics(wire, topics), layout.schemas(wire)
        text = layout.json_text(f"header of '{path}'", dict(header))
        self._links: dict[tuple[str, str], int] = {}  # numbers of channels
        self._topics: dict[str, int] = {}  # likewise, of all topics
        self._schemas: dict[tuple[str, str], int] = {}
        self._failed = False
        self._start_chunk()
        try:
            self._disk = _Disk(self.path, "w" if overwrite else "x")
        except FileExistsError:
            raise layout.RecordingError(
                f"'{path}' is there already: give another name, or say that it may be overwritten"
            ) from None
        sink: Any = self._disk
        self._mcap = Writer(sink, sys.maxsize, CompressionType.NONE, enable_data_crcs=True)
        version = str(VERSION)
        about = {"wire": version, "header": text, "check": layout.check_of(version + text)}
        self._mcap.start(layout.PROFILE, "robins")
        self._mcap.add_metadata(layout.METADATA, about)
        try:
            self._disk.flush()
        except OSError:
            self._disk.close()
            raise

    def write(self, entry: layout.Entry, time_ns: int | None = None) -> None:
        """Record an entry: a frame or bytes that went over a link.

        Args:
            entry: with its time of arrival.
            time_ns: of the header of the frame, if the caller knows it; else it is decoded, and
                bytes that form no frame get the time of arrival.

        Raises:
            OSError: the disk is full, or gone; raised once, later entries are counted as lost.
        """
        received_ns, link, direction, data = entry
        channel = self._links.get((link, direction))
        if channel is None:
            encoding, schema = f"{layout.ENCODING}{VERSION}", self._kinds[0]
            channel = self._channel(f"/{link}/{direction}", encoding, schema)
            self._links[link, direction] = channel
        if time_ns is None:
            time_ns = _time_ns(data, received_ns)
        self._add(channel, received_ns, time_ns, data)
        for made in self._decoded.of(entry):
            channel = self._channel(made.topic, made.encoding, made.schema)
            self._add(channel, received_ns, made.time_ns, made.data)

    def event(self, event: layout.Event) -> None:
        """Record an event.

        Raises:
            RecordingError: JSON cannot hold its fields.
            OSError: as `write`.
        """
        content = {"kind": event.kind, "text": event.text, "fields": event.fields}
        text = layout.json_text(f"event '{event.kind}'", content)
        channel = self._channel(layout.EVENTS, MessageEncoding.JSON, self._kinds[1])
        self._add(channel, event.received_ns, event.received_ns, text.encode())

    @property
    def failed(self) -> int:
        """Messages for other tools that a row's function could not make; they are left out."""
        return self._decoded.failed

    def flush(self) -> None:
        """Write the open chunk to disk; for times without traffic.

        Raises:
            OSError: as `write`.
        """
        if self._failed or not self._taken:
            return
        taken = self._taken
        self._start_chunk()
        try:
            self._mcap.flush()
        except OSError:
            self._failed = True
            self.lost += taken
            raise

    def close(self) -> None:
        """Write the summary, which other tools use as an index, and close the file.

        Raises:
            OSError: as `write`.
        """
        if self._disk.closed:
            return
        try:
            self.flush()
            if not self._failed:
                self._mcap.finish()
                self._disk.flush()
        finally:
            self._disk.close()

    def _start_chunk(self) -> None:
        """Start a chunk."""
        self._first = self._last = self._taken = self._size = 0

    def _channel(self, topic: str, encoding: str, schema: Schema) -> int:
        """Number of a topic, which is declared in the chunk in which it first occurs."""
        channel = self._topics.get(topic)
        if channel is None:
            key = schema.name, schema.encoding
            if key not in self._schemas:
                self._schemas[key] = self._mcap.register_schema(*key, schema.data)
            channel = self._mcap.register_channel(topic, encoding, self._schemas[key])
            self._topics[topic] = channel
        return channel

    def _add(self, channel: int, log_ns: int, time_ns: int, data: bytes) -> None:
        number = self.messages
        self.messages = number + 1
        if self._failed:
            self.lost += 1
            return
        self._mcap.add_message(channel, log_ns, data, time_ns, number & 0xFFFFFFFF)
        if not self._taken:
            self._first = self._last = log_ns
        elif log_ns > self._last:
            self._last = log_ns
        elif log_ns < self._first:
            self._first = log_ns
        self._taken += 1
        self._size += layout.MESSAGE.size + len(data)
        if (
            self._last - self._first >= CHUNK_NS
            or self._taken >= CHUNK_MESSAGES
            or self._size >= CHUNK_BYTES
        ):
            self.flush()


class _Disk:
    """File that writes its buffer to disk in one write, when it is flushed."""

    def __init__(self, path: Path, mode: str):
        self._file = FileIO(path, mode)  # unbuffered: what has been written outlives this process
        self._waiting = bytearray()
        self._at = 0

    @property
    def closed(self) -> bool:
        return self._file.closed

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._at + len(self._waiting)

    def flush(self) -> None:
        left = memoryview(bytes(self._waiting))
        self._waiting.clear()
        self._at += len(left)
        try:
            while left:
                left = left[self._file.write(left) or 0 :]
        except OSError as error:
            text = f"{error.strerror}; the record ends here, and can be read so far"
            raise OSError(error.errno, text, self._file.name) from None

    def close(self) -> None:
        self._file.close()


def _time_ns(data: bytes, otherwise: int) -> int:
    """Time in the header of a frame [ns]; ``otherwise`` for bytes that are not a frame."""
    if len(data) < 2 or data[0] or data[-1]:
        return otherwise
    try:
        return decode_frame(data[1:-1]).header.time_ns
    except FrameError:
        return otherwise
