"""Records: what comes back, what other tools see, files cut anywhere or damaged, disks full."""

import json
import signal
import struct
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from fuzz_receiver import crc32c
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, MessageIndex
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from robins.bench import wire
from robins.bench.recording import Entry, Event, Recorder, RecordingError, read_record
from robins.bench.recording.layout import CHUNK, check_of
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Header
from robins.bench.wire.frames import VERSION

HEADER = {"scenario": "title = 'é'\n", "seeds": [1, 2], "versions": {"robins": "0.1"}}
MS = 10**6


def frame(k: int, rng: np.random.Generator) -> bytes:
    payload = WIRE.encode("gyro", {"theta_b": rng.normal(size=3)})
    return wire.encode_frame(Header(18, 7, k, k * MS + 5), payload)


def messages(count: int) -> list[Entry | Event]:
    """A bit of everything, in an order in which times go back too."""
    rng, out = np.random.default_rng(3), []
    for k in range(count):
        if k % 10 == 4:
            out.append(
                Event(k * MS, "fault", f"frame {k} ü", {"link": "gyro", "x": [k, 0.5, None]})
            )
        elif k % 7 == 3:
            out.append(Entry((k + 5) * MS, "adm", "from", rng.bytes(20)))
        else:
            link, way = ("gyro", "from") if k % 3 else ("adm", "to")
            back = 2 * MS + 3 if k % 2 else 0
            out.append(Entry((k + 5) * MS - back, link, way, frame(k, rng)))
    return out


def put(recorder: Recorder, some: list[Entry | Event]) -> None:
    for one in some:
        if isinstance(one, Event):
            recorder.event(one)
        else:
            recorder.write(one)


def record(path: Path, some: list[Entry | Event], **more) -> bytes:
    with Recorder(path, WIRE, HEADER, **more) as recorder:
        put(recorder, some)
    return path.read_bytes()


def split(some: list[Entry | Event]) -> tuple[list[Entry], list[Event]]:
    return [m for m in some if isinstance(m, Entry)], [m for m in some if isinstance(m, Event)]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[list[Entry | Event], bytes]:
    """Some messages, of 2.4 chunks by their times, and the file of them."""
    some = [*messages(600), Entry(600 * MS, "star", "from", b"")]
    return some, record(tmp_path_factory.mktemp("made") / "a.mcap", some)


# ---------------------------------------------------------------------------------- what comes back


def test_what_was_written_comes_back(made, tmp_path):
    some, content = made
    (tmp_path / "a.mcap").write_bytes(content)
    back = read_record(tmp_path / "a.mcap")
    assert back == (HEADER, *split(some), True, "")


def test_an_empty_record(tmp_path):
    assert record(tmp_path / "a.mcap", []) == record(tmp_path / "b.mcap", [])
    assert read_record(str(tmp_path / "a.mcap")) == (HEADER, [], [], True, "")
    with (tmp_path / "a.mcap").open("rb") as file:
        assert list(make_reader(file).iter_messages()) == []


def test_the_same_entries_make_the_same_bytes(made, tmp_path):
    some, content = made
    assert record(tmp_path / "a.mcap", some) == content
    with Recorder(tmp_path / "b.mcap", WIRE, dict(reversed(HEADER.items()))) as recorder:
        for one in some:
            if isinstance(one, Event):
                recorder.event(one)
            else:  # a caller who knows the time need not have it looked up
                good = wire.Receiver().feed(one.data)
                recorder.write(one, good[0].header.time_ns if good else one.received_ns)
    assert (tmp_path / "b.mcap").read_bytes() == content


def test_what_is_written_in_a_block_that_fails_is_kept(tmp_path):
    some = messages(9)
    recorder = Recorder(tmp_path / "a.mcap", WIRE, HEADER)

    def fail():
        with recorder:
            put(recorder, some)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert read_record(tmp_path / "a.mcap") == (HEADER, *split(some), True, "")
    recorder.close()  # once more does no harm


def test_flush_hands_over_what_there_is(tmp_path):
    some, path = messages(9), tmp_path / "a.mcap"
    recorder = Recorder(path, WIRE, HEADER)
    put(recorder, some)
    assert read_record(path).entries == []
    recorder.flush()
    recorder.flush()
    here = read_record(path)
    assert here[1:4] == (*split(some), False)
    assert here.why == f"ends at byte {path.stat().st_size} without having been closed"
    recorder.close()
    assert read_record(path).complete


# -------------------------------------------------------------------------------- other tools


def test_the_readers_of_mcap_open_it(made, tmp_path):
    some, content = made
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    expected = []
    for k, one in enumerate(some):
        if isinstance(one, Event):
            told = {"kind": one.kind, "text": one.text, "fields": one.fields}
            expected.append(("/events", "json", "jsonschema", k, one.received_ns, told))
            continue
        good = wire.Receiver().feed(one.data)
        time = good[0].header.time_ns if good else one.received_ns
        topic = f"/{one.link}/{one.direction}"
        expected.append((topic, "robins-wire-1", "text/markdown", k, time, one.data))
    for reader in (make_reader, NonSeekingReader):
        with path.open("rb") as file:
            found = list(reader(file, validate_crcs=True).iter_messages(log_time_order=False))
        assert [m.log_time for _, _, m in found] == [one.received_ns for one in some]
        assert [
            (
                channel.topic,
                channel.message_encoding,
                schema.encoding,
                m.sequence,
                m.publish_time,
                json.loads(m.data) if channel.topic == "/events" else m.data,
            )
            for schema, channel, m in found
        ] == expected
    assert found[0][0].data.decode() == WIRE.markdown()


def test_the_summary_leads_to_what_is_asked(made, tmp_path):
    some, content = made
    entries, events = split(some)
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        (about,) = reader.iter_metadata()
        assert json.loads(about.metadata["header"]) == HEADER
        summary = reader.get_summary()
        statistics = summary.statistics
        assert statistics.message_count == len(some)
        assert statistics.chunk_count == len(summary.chunk_indexes) == 3
        times = [one.received_ns for one in some]
        assert statistics.message_start_time == min(times)
        assert statistics.message_end_time == max(times)
        by_topic = {
            c.topic: statistics.channel_message_counts[i] for i, c in summary.channels.items()
        }
        assert by_topic["/events"] == len(events)
        assert sum(by_topic.values()) == len(some)
        some_times = list(
            reader.iter_messages("/adm/to", starting_at=300 * MS, ending_before=400 * MS)
        )
        assert [m.data for _, _, m in some_times] == [
            one.data
            for one in entries
            if one[1:3] == ("adm", "to") and 300 * MS <= one.received_ns < 400 * MS
        ]
        assert some_times
    # each index points to a message of its channel and time
    checked, chunk = 0, b""
    for one in StreamReader(BytesIO(content), emit_chunks=True).records:
        chunk = one.data if isinstance(one, Chunk) else chunk
        if isinstance(one, MessageIndex):
            for time, at in one.records:
                assert chunk[at] == 5
                assert struct.unpack_from("<H4xQ", chunk, at + 9) == (one.channel_id, time)
                checked += 1
    assert checked == len(some)
    for index in summary.chunk_indexes:
        for channel, at in index.message_index_offsets.items():
            assert struct.unpack_from("<B8xH", content, at) == (7, channel)


# ------------------------------------------------------------------------- cut, damaged, killed


def ends(content: bytes, some: list[Entry | Event]) -> list[int]:
    """Ends of the bytes of each message in the file, found by looking for them."""
    out, at = [], 0
    for one in some:
        event = isinstance(one, Event)
        data = b'"text": ' + json.dumps(one.text).encode() + b"}" if event else one.data
        at = content.index(data, at) + len(data)
        out.append(at)
    return out


def is_beginning(entries: list[Entry], events: list[Event], some: list[Entry | Event]) -> bool:
    """Test for the first of some items, in their order."""
    return (entries, events) == split(some[: len(entries) + len(events)])


def test_a_file_cut_anywhere_gives_what_comes_before(tmp_path):
    some = messages(300)
    content = record(tmp_path / "whole.mcap", some)
    path, end = tmp_path / "cut.mcap", np.array(ends(content, some))
    begin = content.index(WIRE.markdown().encode()) - 30  # of the schemas; the header is before
    footer = content.rindex(bytes([2, 20, 0, 0, 0, 0, 0, 0, 0]))
    drawn = np.random.default_rng(0).integers(0, len(content), 300)
    places = {*range(0, begin, 7), *range(footer, len(content)), *drawn}
    places |= {int(e) + d for e in end[:: len(end) // 40] for d in (-1, 0, 1)}
    read, refused = 0, []
    for cut in sorted(places):
        path.write_bytes(content[:cut])
        try:
            back = read_record(path)
        except RecordingError as error:
            refused.append((cut, str(error)))
            continue
        assert (back.header, back.complete) == (HEADER, False)
        assert back.why == f"ends at byte {cut} without having been closed"
        assert len(back.entries) + len(back.events) == np.sum(end <= cut)
        assert is_beginning(back.entries, back.events, some)
        read += 1
    assert read > 300
    assert all(cut < begin and str(path) in text for cut, text in refused)
    path.write_bytes(content + b"\0")
    assert read_record(path)[1:4] == (*split(some), False)


def test_a_flipped_bit_gives_what_comes_before_it(tmp_path):
    some = messages(300)
    content = record(tmp_path / "whole.mcap", some)
    path, end = tmp_path / "flipped.mcap", np.array(ends(content, some))
    rng = np.random.default_rng(1)
    begin = content.index(WIRE.markdown().encode()) - 50  # of the schemas; the header is before
    places = np.r_[0:begin, rng.integers(begin, len(content), 400)]
    refused = []
    for at in places:
        data = bytearray(content)
        data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            back = read_record(path)
        except RecordingError as error:
            refused.append((at, str(error)))
            continue
        assert (back.header, back.complete) == (HEADER, False)
        assert back.why
        assert is_beginning(back.entries, back.events, some)
        kept = len(back.entries) + len(back.events)
        assert kept >= np.sum(end <= at) - 256  # no more than the chunk that was hit is lost
    assert len(refused) > 100
    assert all(at < begin and str(path) in text for at, text in refused)


def heads(content: bytes) -> list[int]:
    """Beginnings of the chunks of a file."""
    summary = make_reader(BytesIO(content)).get_summary()
    return [index.chunk_start_offset for index in summary.chunk_indexes]


def test_heads_of_chunks_that_are_flipped_hide_no_other_damage(tmp_path):
    """A head that says another size must not keep the check of its chunk from being made."""
    some = messages(300)
    content, path = record(tmp_path / "whole.mcap", some), tmp_path / "flipped.mcap"
    first, last = heads(content)
    time = content.index(some[100].received_ns.to_bytes(8, "little"))
    assert first < time < last
    damaged = 0
    for at in range(first, first + CHUNK.size):
        for bit in range(8):
            data = bytearray(content)
            data[at] ^= 1 << bit
            data[time] ^= 1
            path.write_bytes(data)
            back = read_record(path)
            assert (back.header, back.complete) == (HEADER, False)
            assert is_beginning(back.entries, back.events, some)
            damaged += "is damaged" in back.why
    assert damaged > 0.8 * 8 * CHUNK.size


def test_a_chunk_that_is_not_there_is_missed(tmp_path):
    some = messages(600)
    content, path = record(tmp_path / "whole.mcap", some), tmp_path / "cut.mcap"
    first, second, third = heads(content)
    path.write_bytes(content[:second] + content[third:])
    back = read_record(path)
    kept = len(back.entries) + len(back.events)
    assert back.why.endswith(f"where number {kept} should be")
    assert is_beginning(back.entries, back.events, some)
    assert 200 < kept < 300
    assert first < second


CHILD = """
import os, resource, signal, sys
from robins.bench.recording.layout import CHUNK
from robins.bench.recording import Entry, Recorder
from robins.bench.wire.schema import BARE

path, way = sys.argv[1:]
recorder = Recorder(path, BARE, {"run": 1})
if way == "full":
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
told = 0
for k in range(2000):
    try:
        recorder.write(Entry(k * 1_000_000, "gyro", "from", b"\\1" * 49))
    except OSError as error:
        told += 1
        print(error)
if way == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
recorder.close()
print(told, recorder.messages, recorder.lost)
"""


def run_child(path: Path, way: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", CHILD, str(path), way]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_a_killed_recorder_loses_a_quarter_of_a_second(tmp_path):
    path = tmp_path / "a.mcap"
    assert run_child(path, "killed").returncode == -signal.SIGKILL
    back = read_record(path)
    assert not back.complete
    assert 2000 - 251 <= len(back.entries) < 2000
    assert [one.received_ns for one in back.entries] == [k * MS for k in range(len(back.entries))]


def test_a_full_disk_is_said_once(tmp_path):
    path = tmp_path / "a.mcap"
    result = run_child(path, "full")
    assert result.returncode == 0, result.stderr
    text, counts = result.stdout.splitlines()
    assert "File too large; the record ends here, and can be read so far" in text
    assert str(path) in text
    told, count, lost = map(int, counts.split())
    assert (told, count) == (1, 2000)
    assert path.stat().st_size == 60_000  # up to the last byte there was room for
    back = read_record(path)
    assert not back.complete
    assert len(back.entries) >= count - lost  # half a chunk may be there too
    assert len(back.entries) > 500
    assert [one.received_ns for one in back.entries] == [k * MS for k in range(len(back.entries))]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_disk_that_is_full_from_the_start():
    with pytest.raises(OSError, match=r"No space left on device; the record ends.*/dev/full"):
        Recorder("/dev/full", WIRE, HEADER, overwrite=True)


# ------------------------------------------------------------------------------------ refusals


def test_records_that_cannot_be_begun(tmp_path):
    path = tmp_path / "a.mcap"
    record(path, [])
    with pytest.raises(RecordingError, match=r"a\.mcap' is there already: give another name"):
        Recorder(path, WIRE, HEADER)
    assert read_record(path).complete
    assert record(path, messages(3), overwrite=True)
    assert len(read_record(path).entries) == 3
    with pytest.raises(RecordingError, match=r"header of .*: JSON cannot hold it"):
        Recorder(tmp_path / "b.mcap", WIRE, {"x": np.zeros(3)})
    assert not (tmp_path / "b.mcap").exists()
    with pytest.raises(OSError, match=r"no/a\.mcap"):
        Recorder(tmp_path / "no" / "a.mcap", WIRE, HEADER)
    with (
        Recorder(tmp_path / "c.mcap", WIRE, HEADER) as recorder,
        pytest.raises(RecordingError, match="event 'fault': JSON cannot hold it"),
    ):
        recorder.event(Event(0, "fault", "", {"x": float("nan")}))
    assert read_record(tmp_path / "c.mcap") == (HEADER, [], [], True, "")


def foreign(path: Path, profile: str, about: dict[str, str] | None) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile)
        if about is not None:
            writer.add_metadata("robins", about)
        writer.finish()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "ends at byte 0: nothing was recorded"),
        (b"\x89MCA", "ends at byte 4: nothing was recorded"),
        (b"time,gyro\n1,2\n", "is no MCAP file: give a record that the bench wrote"),
        (bytes(100), "is no MCAP file"),
        (b"\x89MCAP0\r\n" + bytes(100), "is an MCAP file of the profile '', not one"),
        (b"\x89MCAP0\r\n" + b"\xff" * 100, "is damaged at byte 8: a record of .* bytes"),
    ],
)
def test_files_that_are_no_records(tmp_path, content, words):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=rf"a\.mcap'.*{words}"):
        read_record(path)


@pytest.mark.parametrize(
    ("header", "words"),
    [("[" * 5000, "is damaged: RecursionError"), ("[1]", "the header of the run is no table")],
)
def test_a_header_of_others_whose_check_fits(tmp_path, header, words):
    path, number = tmp_path / "a.mcap", str(VERSION)
    about = {"wire": number, "header": header, "check": check_of(number + header)}
    foreign(path, "robins-bench", about)
    with pytest.raises(RecordingError, match=words):
        read_record(path)


def test_records_of_others(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(RecordingError, match=r"a\.mcap' cannot be read: No such file"):
        read_record(path)
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        read_record(tmp_path)
    foreign(path, "ros2", {})
    with pytest.raises(RecordingError, match=r"of the profile 'ros2', not one .* \('robins-bench'"):
        read_record(path)
    foreign(path, "robins-bench", None)
    with pytest.raises(RecordingError, match="no header of the run where it should be"):
        read_record(path)
    check = f"{crc32c(b'2{}'):08x}"
    foreign(path, "robins-bench", {"wire": "2", "header": "{}", "check": check})
    with pytest.raises(RecordingError, match=r"version 2 of the wire, this is version 1: read it"):
        read_record(path)
    foreign(path, "robins-bench", {"wire": "1", "header": "{}", "check": check})
    with pytest.raises(RecordingError, match="the header of the run fails its check"):
        read_record(path)


def test_a_huge_file_of_nothing_takes_no_memory(tmp_path):
    some, path = messages(20), tmp_path / "a.mcap"
    recorder = Recorder(path, WIRE, HEADER)
    put(recorder, some)
    recorder.flush()
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.truncate(10 * 10**9)
    back = read_record(path)
    assert back[1:4] == (*split(some), False)
    assert back.why == f"is damaged at byte {size}: a record of kind 0"
    recorder.close()
