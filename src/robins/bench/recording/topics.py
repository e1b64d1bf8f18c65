"""Messages of the wire as topics that other tools decode: a table with a row per topic.

A row names a message, its type of ROS 2 or JSON, the function that converts it, and its frame:

    Topic("sample", "/imu", "sensor_msgs/msg/Imu", lambda v: imu(v["omega_b"], body="FRD"), "imu")
    Topic("mode", "/mode", JSON, as_json)

A `Recorder` with rows writes the converted messages next to each valid frame that a part sends.
The header has the time of the frame, zero at the start of the run, or the stamp of the message that
the row names: GPS time becomes UTC, as in ROS; a stamp with another origin stays. ROS messages use
the axes that `robins.ros.convert` names; JSON has the fields and units of the wire.
The functions of that module are re-exported here, for the rows.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from robins.bench.recording.layout import EVENTS, Entry, RecordingError
from robins.bench.wire.fields import Message, Values
from robins.bench.wire.frames import FrameError, decode_frame
from robins.bench.wire.schema import Wire
from robins.gps_time import dated, utc_of
from robins.ros import TYPES, definition, encode
from robins.ros import Message as RosMessage
from robins.ros import imu as imu
from robins.ros import magnetic_field as magnetic_field
from robins.ros import nav_sat_fix as nav_sat_fix
from robins.ros import odometry as odometry

JSON = "json"
_FAILS = (LookupError, TypeError, ValueError, ArithmeticError)


class Topic(NamedTuple):
    """Conversion of a message of the wire to a message of a topic."""

    message: str  # of the wire
    topic: str  # begins with a slash
    type: str  # of ROS, one of `robins.ros.TYPES`, or `JSON`
    make: Callable[[Values], RosMessage | dict[str, Any]]  # from decoded values
    frame_id: str = ""
    stamp: str = ""  # field of the message that has its time [ns]; "": that of the frame


class ConvertedMessage(NamedTuple):
    """A message of a topic."""

    topic: str
    encoding: str
    schema: Schema
    time_ns: int
    data: bytes


def as_json(values: Values) -> dict[str, Any]:
    """Fields of a message in the types of JSON: lists, and null where a number is not finite."""

    def plain(x: Any) -> Any:
        if isinstance(x, list):
            return [plain(one) for one in x]
        return x if isinstance(x, int) or math.isfinite(x) else None

    return {name: plain(np.asarray(value).tolist()) for name, value in values.items()}


def completed(rows: Iterable[Topic], wire: Wire, sends: Mapping[str, Iterable[str]]) -> list[Topic]:
    """Rows, plus one of JSON for each message of a part that no row names.

    Its topic is ``/part/message``, with underscores for characters that a topic cannot have.

    Args:
        rows: of the table.
        wire: the messages.
        sends: messages by part.
    """
    made = list(rows)
    named, taken = {row.message for row in made}, {row.topic for row in made}
    for part, sent in sends.items():
        for name in (one for one in sent if one not in named):
            topic = "".join(f"/{re.sub(r'[^a-zA-Z0-9_]', '_', word)}" for word in (part, name))
            topic = re.sub("/(?=[0-9])", "/_", topic)
            while topic in taken or topic.endswith(("/to", "/from")):
                topic += "_"
            taken.add(topic)
            made.append(Topic(wire.message(name).name, topic, JSON, as_json))
    return made


class Topics:
    """Converter of the frames that parts send, by the rows of a table.

    Attributes:
        failed: number of messages that a row's function could not make; they are left out.
    """

    def __init__(self, wire: Wire, rows: Iterable[Topic]):
        """Check the rows on messages of zeros.

        Args:
            wire: the messages.
            rows: of the table.

        Raises:
            RecordingError: a row names an unknown message or type or an impossible topic, or its
                function does not make the type of the row.
        """
        self.failed, self._wire = 0, wire
        self._by_number: dict[int, list[tuple[Topic, Schema]]] = {}
        taken = {EVENTS}
        for row in rows:
            if row.message not in wire.numbers:
                there = ", ".join(wire.numbers)
                raise _type_error(row, f"no message '{row.message}'", f"one of {there}")
            if row.type != JSON and row.type not in TYPES:
                raise _type_error(
                    row, f"no type '{row.type}'", f"one of {', '.join([*TYPES, JSON])}"
                )
            if not re.fullmatch(r"(/[A-Za-z_]\w*)+", row.topic):
                raise _type_error(row, "this is no name of a topic", "one such as /sensor/imu")
            if row.topic in taken or re.fullmatch("/[^/]+/(to|from)", row.topic):
                raise _type_error(row, "the topic has other messages", "another name")
            taken.add(row.topic)
            _try(wire, row)
            number = wire.numbers[row.message]
            self._by_number.setdefault(number, []).append((row, _schema(row, wire.message(number))))

    def of(self, entry: Entry) -> list[ConvertedMessage]:
        """Messages that the rows make of an entry; none if it is not a valid frame."""
        if not self._by_number or entry.direction != "from" or len(entry.data) < 2:
            return []
        try:
            head, payload = decode_frame(entry.data[1:-1])
        except FrameError:
            return []
        rows = self._by_number.get(head.type)
        if not rows or self._wire.unsound(rows[0][0].message, payload):
            return []
        values, made = self._wire.decode(rows[0][0].message, payload), []
        for row, schema in rows:
            try:
                data = _bytes_of(row, row.make(values), _stamp(row, values, head.time_ns))
            except _FAILS:  # a failed conversion must not end the run; the frame itself is kept
                self.failed += 1
                continue
            encoding = MessageEncoding.JSON if row.type == JSON else MessageEncoding.CDR
            made.append(ConvertedMessage(row.topic, encoding, schema, head.time_ns, data))
        return made


def _type_error(row: Topic, what: str, fix: str) -> RecordingError:
    return RecordingError(what, f"topic '{row.topic}'", f"give {fix}")


def _stamp(row: Topic, values: Values, time_ns: int) -> int:
    """The time of the header [ns]."""
    if not row.stamp:
        return time_ns
    stamp = int(values[row.stamp])
    return int(utc_of(np.asarray(stamp)).astype(np.int64)) if dated(stamp) else stamp


def _try(wire: Wire, row: Topic) -> None:
    """Check that the function of a row makes the type of the row.

    Raises:
        RecordingError: it does not.
    """
    values = wire.decode(row.message, bytes(wire.size_of(row.message)))
    try:
        made = row.make(values)
        fits = isinstance(made, TYPES.get(row.type, dict))
        if fits:
            _bytes_of(row, made, _stamp(row, values, 0))
    except _FAILS as error:
        why = f"its function fails ({type(error).__name__}: {error})"
        raise _type_error(row, why, f"one of the fields {', '.join(values)}") from None
    if not fits:
        why = f"its function makes {type(made).__name__}, not {row.type}"
        raise _type_error(row, why, "one that makes this type")


def _bytes_of(row: Topic, made: Any, time_ns: int) -> bytes:
    if row.type != JSON:
        return encode(made, time_ns, row.frame_id)
    sec, nsec = divmod(time_ns, 1_000_000_000)
    head = {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": row.frame_id}
    return json.dumps(head | made, allow_nan=False).encode()


def _schema(row: Topic, of: Message) -> Schema:
    """MCAP schema of the messages of a topic."""
    if row.type != JSON:
        text = definition(TYPES[row.type])
        return Schema(0, text.encode(), SchemaEncoding.ROS2, row.type)
    integer = {"type": "integer"}
    fields: dict[str, Any] = {
        "timestamp": {
            "type": "object",
            "properties": {"sec": integer, "nsec": integer},
        },
        "frame_id": {"type": "string"},
    }
    for f in of.fields:
        # Foxglove accepts one type per field, so null is described in words
        one = {"type": "number" if f.kind == "f64" else "integer"}
        many = {"type": "array", "items": one, "minItems": f.length, "maxItems": f.length}
        unit = "" if f.unit == "1" else f" [{f.unit}]"
        missing = "; null: not known" if f.missing else ""
        about = {"description": f"{f.text}{unit}{missing}", "unit": f.unit}
        fields[f.name] = (one if f.length == 1 else many) | about
    text = json.dumps({"type": "object", "description": of.text, "properties": fields})
    return Schema(0, text.encode(), SchemaEncoding.JSONSchema, f"robins.{of.name}")
