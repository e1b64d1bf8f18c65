"""Recordings of the lines: write, read, replay to a part, compare.

- `layout`: entries in an MCAP file. `writer`, `reader`: to the disk and back.
- `topics`: messages for other tools, next to the frames; a row per topic.
- `replay`: a part runs again on a record. `differences`: two runs, field by field.
"""

from robins.bench.recording.differences import FieldDifference
from robins.bench.recording.layout import Entry, Event, RecordingError
from robins.bench.recording.reader import Record, open_record, read_record
from robins.bench.recording.replay import Replayed, ReplayError
from robins.bench.recording.topics import Topic
from robins.bench.recording.writer import Recorder

__all__ = [
    "Entry",
    "Event",
    "FieldDifference",
    "Record",
    "Recorder",
    "RecordingError",
    "ReplayError",
    "Replayed",
    "Topic",
    "open_record",
    "read_record",
]
