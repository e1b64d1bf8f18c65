"""Topics that other tools decode: their numbers by other decoders, and what a record keeps."""

import contextlib
import json
import math
import signal
import struct
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

from robins.bench import wire
from robins.bench.recording import Entry, Event, Recorder, RecordingError, Topic, read_record
from robins.bench.recording.topics import (
    JSON,
    Topics,
    as_json,
    completed,
    imu,
    magnetic_field,
    nav_sat_fix,
    odometry,
)
from robins.bench.rigs.satellite.messages import SENDS, WIRE
from robins.bench.wire import Header, Wire
from robins.bench.wire.fields import f64, message
from robins.cli import main

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
FIELD, ODOMETRY = "sensor_msgs/msg/MagneticField", "nav_msgs/msg/Odometry"
STEP_NS = 100_000_000
NS = 10**9


def rate(v):
    """A made-up sensor, whose axes are forward, right, down; the turn of a step of 0.1 s."""
    covariance = np.diag([1.0, 2.0, 3.0])
    return imu(v["theta_b"] / 0.1, omega_covariance=covariance, body="FRD")


def pose(v):
    return odometry(q_nb=v["q_ib"], omega_b=v["omega_b"], child_frame_id="craft")


def place(v):
    """Four numbers stand for a place and its deviation."""
    *place, sigma = v["momentum"]
    return nav_sat_fix(*place, covariance=np.eye(3) * sigma**2)


ROWS = (
    Topic("gyro", "/imu", IMU, rate, "sensor"),
    Topic("gyro", "/field", FIELD, lambda v: magnetic_field(v["theta_b"], body="RFU"), "sensor"),
    Topic("motion", "/odometry", ODOMETRY, pose, "inertial"),
    Topic("wheels", "/fix", FIX, place, "antenna"),
    Topic("estimate", "/estimate", JSON, as_json, "craft"),
)


def entry(k: int, link: str, name: str, values: dict, direction="from", time_ns=None) -> Entry:
    at = (k + 1) * STEP_NS if time_ns is None else time_ns
    head = Header(WIRE.numbers[name], 7, k, at)
    frame = wire.encode_frame(head, WIRE.encode(name, values))
    return Entry(k * STEP_NS + 11, link, direction, frame)


def flipped(frame: bytes) -> bytes:
    return frame[:-9] + bytes([frame[-9] ^ 128]) + frame[-8:]


def run(count: int = 40) -> list[Entry | Event]:
    """Some steps of made-up parts, with what is no sound frame in between."""
    rng, out = np.random.default_rng(2), []
    for k in range(count):
        theta = rng.normal(size=3)
        theta[k % 3] = math.nan if k % 5 == 0 else theta[k % 3]
        sample = entry(k, "gyro", "gyro", {"theta_b": theta})
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        motion = {"q_ib": q, "omega_b": rng.normal(size=3)}
        told = {
            "q_ib": q,
            "gyro_bias": rng.normal(size=3),
            "sigma": np.full(6, math.nan if k % 2 else 0.5),
            "flags": k % 64,
        }
        out += [
            entry(k, "plant", "motion", motion),
            sample,
            sample._replace(link="adm", direction="to"),  # the same frame, forwarded
            sample._replace(data=flipped(sample.data)),
            sample._replace(data=b"\0"),
            entry(k, "gyro", "gyro", {"theta_b": [1e308, 0.0, 0.0]}),  # refused by everybody
            entry(k, "actuators", "wheels", {"momentum": rng.normal(size=4)}),
            entry(k, "adm", "estimate", told),
            Event(k * STEP_NS + 12, "note", "", {"k": k}),
        ]
    return out


def write(recorder: Recorder, some: list[Entry | Event]) -> None:
    for one in some:
        if isinstance(one, Event):
            recorder.event(one)
        else:
            recorder.write(one)


def record(path: Path, some: list[Entry | Event], rows=ROWS) -> bytes:
    with Recorder(path, WIRE, {"run": 7}, topics=rows) as recorder:
        write(recorder, some)
        assert recorder.failed == 0
    return path.read_bytes()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[list[Entry | Event], bytes]:
    some = run()
    return some, record(tmp_path_factory.mktemp("made") / "a.mcap", some)


def sent(some: list[Entry | Event], link: str) -> list[tuple[Entry, Header, dict]]:
    """Sound messages that a link sent, as the wire decodes them."""
    out = []
    for one in some:
        if isinstance(one, Event) or (one.link, one.direction) != (link, "from"):
            continue
        for frame in wire.Receiver().feed(one.data):
            name = WIRE.message(frame.header.type).name
            if not WIRE.unsound(name, frame.payload):
                out.append((one, frame.header, WIRE.decode(name, frame.payload)))
    return out


def of_topic(content: bytes, topic: str) -> list:
    reader = make_reader(BytesIO(content), validate_crcs=True)
    return list(reader.iter_messages(topic, log_time_order=False))


# ----------------------------------------------------------------------- what other tools decode


def check_times(found: list, expected: list[tuple[Entry, Header, dict]]) -> None:
    assert len(found) == len(expected) == 40
    for (_, _, m), (one, head, _) in zip(found, expected, strict=True):
        assert (m.log_time, m.publish_time) == (one.received_ns, head.time_ns)


def test_a_sample_by_its_bytes(made):
    """Offsets counted by hand: 4 + 8 of time, 4 + 7 of the frame's name, 5 to a multiple of 8."""
    some, content = made
    found, expected = of_topic(content, "/imu"), sent(some, "gyro")
    check_times(found, expected)
    for (schema, channel, m), (_, head, values) in zip(found, expected, strict=True):
        assert (schema.name, schema.encoding, channel.message_encoding) == (IMU, "ros2msg", "cdr")
        assert struct.unpack_from("<iI", m.data, 4) == divmod(head.time_ns, NS)
        assert m.data[12:23] == b"\7\0\0\0sensor\0"
        numbers = struct.unpack_from("<37d", m.data, 28)
        assert len(m.data) == 28 + 37 * 8
        x, y, z = values["theta_b"] / 0.1
        np.testing.assert_array_equal(numbers[13:16], [x, -y, -z])
        assert numbers[16:25] == (1, 0, 0, 0, 2, 0, 0, 0, 3)
        assert numbers[4] == numbers[28] == -1.0  # neither attitude nor specific force
    assert any(np.isnan(v["theta_b"]).any() for _, _, v in expected)


def decode_rosbags(found: list) -> list:
    typesys = pytest.importorskip("rosbags.typesys", reason="the cross-check needs rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    return [store.deserialize_cdr(m.data, schema.name) for schema, _, m in found]


def decode_mcap_ros2(found: list) -> list:
    """Decode by the definitions in the file alone."""
    decoders = pytest.importorskip("mcap_ros2.decoder", reason="needs mcap-ros2-support")
    factory = decoders.DecoderFactory()
    out = []
    for schema, channel, m in found:
        decode = factory.decoder_for(channel.message_encoding, schema)
        assert decode is not None
        out.append(decode(m.data))
    return out


def parts(value, names: str) -> list[float]:
    return [getattr(value, name) for name in names]


@pytest.mark.parametrize("decoded", [decode_rosbags, decode_mcap_ros2])
def test_other_decoders_find_the_numbers(made, decoded):
    some, content = made
    equal = np.testing.assert_array_equal

    expected = sent(some, "gyro")
    for m, (_, head, values) in zip(decoded(of_topic(content, "/imu")), expected, strict=True):
        assert (m.header.stamp.sec, m.header.stamp.nanosec) == divmod(head.time_ns, NS)
        assert m.header.frame_id == "sensor"
        x, y, z = values["theta_b"] / 0.1
        equal(parts(m.angular_velocity, "xyz"), [x, -y, -z])
        equal(m.angular_velocity_covariance, [1, 0, 0, 0, 2, 0, 0, 0, 3])
        assert m.orientation_covariance[0] == m.linear_acceleration_covariance[0] == -1.0
        equal(parts(m.orientation, "wxyz"), [1, 0, 0, 0])
    for m, (_, _, values) in zip(decoded(of_topic(content, "/field")), expected, strict=True):
        x, y, z = values["theta_b"]
        equal(parts(m.magnetic_field, "xyz"), [y, -x, z])
        equal(m.magnetic_field_covariance, np.zeros(9))

    found, expected = of_topic(content, "/odometry"), sent(some, "plant")
    check_times(found, expected)
    for m, (_, _, values) in zip(decoded(found), expected, strict=True):
        assert (m.header.frame_id, m.child_frame_id) == ("inertial", "craft")
        equal(parts(m.pose.pose.orientation, "wxyz"), values["q_ib"])
        equal(parts(m.twist.twist.angular, "xyz"), values["omega_b"])
        assert np.isnan(parts(m.pose.pose.position, "xyz")).all()
        assert np.isnan(parts(m.twist.twist.linear, "xyz")).all()
        equal(m.pose.covariance, np.zeros(36))
        equal(m.twist.covariance, np.zeros(36))

    found, expected = of_topic(content, "/fix"), sent(some, "actuators")
    check_times(found, expected)
    for m, (_, _, values) in zip(decoded(found), expected, strict=True):
        lat, lon, alt, sigma = values["momentum"]
        np.testing.assert_allclose([m.latitude, m.longitude], np.degrees([lat, lon]), rtol=1e-15)
        assert (m.altitude, m.status.status, m.status.service) == (alt, 0, 0)
        equal(m.position_covariance, np.ravel(np.eye(3) * sigma**2))
        assert m.position_covariance_type == 2


def test_json_has_the_fields_and_their_units(made):
    some, content = made
    found, expected = of_topic(content, "/estimate"), sent(some, "adm")
    check_times(found, expected)
    schema, channel, _ = found[0]
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    fields = json.loads(schema.data)["properties"]
    for f in WIRE.message("estimate").fields:
        about = fields[f.name]
        assert about["unit"] == f.unit
        assert f.text in about["description"]
        assert ("null" in about["description"]) == f.missing
        # one type a field, for viewers take no lists of types
        assert about["type"] == ("array" if f.length > 1 else "integer")
        assert about.get("minItems", 1) == about.get("maxItems", 1) == f.length
    assert fields["sigma"]["items"] == {"type": "number"}
    assert fields["sigma"]["unit"] == "rad, rad/s"
    for (_, _, m), (_, head, values) in zip(found, expected, strict=True):
        told = json.loads(m.data)
        assert set(told) == set(fields)
        assert told["frame_id"] == "craft"
        assert told["timestamp"] == {"sec": head.time_ns // NS, "nsec": head.time_ns % NS}
        assert told["flags"] == values["flags"]
        assert told["q_ib"] == values["q_ib"].tolist()
        assert told["gyro_bias"] == values["gyro_bias"].tolist()
        assert told["sigma"] == ([None] * 6 if values["flags"] % 2 else [0.5] * 6)


# ------------------------------------------------------------------------------ what a record keeps


def test_frames_and_events_come_back_without_the_topics(made, tmp_path):
    some, content = made
    (tmp_path / "a.mcap").write_bytes(content)
    back = read_record(tmp_path / "a.mcap")
    assert back.complete
    assert back.entries == [one for one in some if isinstance(one, Entry)]
    assert back.events == [one for one in some if isinstance(one, Event)]
    plain = record(tmp_path / "plain.mcap", some, rows=())
    assert read_record(tmp_path / "plain.mcap") == back
    statistics = make_reader(BytesIO(content)).get_summary().statistics
    assert statistics.message_count == len(some) + 5 * 40
    assert len(plain) < len(content)


def test_the_same_entries_make_the_same_bytes(made, tmp_path):
    some, content = made
    assert record(tmp_path / "a.mcap", some) == content


def test_a_record_cut_anywhere_gives_what_comes_before(made, tmp_path):
    some, content = made
    entries, path = [one for one in some if isinstance(one, Entry)], tmp_path / "cut.mcap"
    kept = []
    for cut in range(2000, len(content), 997):
        path.write_bytes(content[:cut])
        back = read_record(path)
        assert back.entries == entries[: len(back.entries)]
        assert not back.complete
        kept.append(len(back.entries))
    assert kept == sorted(kept)
    assert kept[0] < 20
    assert kept[-1] == len(entries)


CHILD = """
import os, signal, sys
from test_topics import ROWS, run, write
from robins.bench.recording import Recorder
from robins.bench.rigs.satellite.messages import WIRE

recorder = Recorder(sys.argv[1], WIRE, {"run": 7}, topics=ROWS)
write(recorder, run(300))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_recorder_leaves_topics_that_can_be_decoded(tmp_path):
    path, some = tmp_path / "a.mcap", run(300)
    command = [sys.executable, "-c", CHILD, str(path)]
    environment = {"PYTHONPATH": ":".join([str(Path(__file__).parent), *sys.path])}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == -signal.SIGKILL, result.stderr
    back = read_record(path)
    entries = [one for one in some if isinstance(one, Entry)]
    assert not back.complete
    assert back.entries == entries[: len(back.entries)]
    steps = len(back.entries) / 8
    assert 300 - 6 < steps <= 300  # a step takes 0.1 s, and a quarter of a second may be lost
    found, reader = [], NonSeekingReader(BytesIO(path.read_bytes()))
    with contextlib.suppress(EndOfFile):  # the file was not closed
        for one in reader.iter_messages("/imu", log_time_order=False):
            found.append(one)
    complete = sent(some, "gyro")[: len(found)]
    assert len(found) in (math.floor(steps), math.ceil(steps))
    for (_, _, m), (_, head, _) in zip(found, complete, strict=True):
        assert (m.publish_time, len(m.data)) == (head.time_ns, 28 + 37 * 8)


def test_a_record_with_topics_is_heard_again(tmp_path, capsys):
    old = Path(__file__).parent / "records" / "adm.mcap"
    then, path = read_record(old), tmp_path / "topics.mcap"
    with Recorder(path, WIRE, then.header, topics=ROWS) as recorder:
        write(recorder, [*then.entries, *then.events])
    assert len(of_topic(path.read_bytes(), "/estimate")) == 80
    command = ["bench", "replay", str(path), "--node", "adm"]
    assert main([*command, "--diff", str(old)]) == 0
    assert "Same: 'adm' says the same" in capsys.readouterr().out
    assert read_record(path).entries == then.entries  # so a part hears the same


def test_each_message_without_a_row_has_one_of_json():
    rows = completed(ROWS[:2], WIRE, SENDS)
    assert rows[:2] == list(ROWS[:2])
    sent = [(part, name) for part, some in SENDS.items() for name in some]
    named = {row.message for row in ROWS[:2]}
    rest = [f"/{part}/{name}" for part, name in sent if name not in named]
    assert [row.topic for row in rows[2:]] == rest
    assert {row.type for row in rows[2:]} == {JSON}
    Topics(WIRE, rows)  # each fits
    odd = Wire(("2nd part", "b"), (message(16, "from", ".", f64("x", 1, "1", "x", 1.0)),))
    (one,) = completed((), odd, {"2nd part": ("from",), "b": ()})
    assert one.topic == "/_2nd_part/from_"
    Topics(odd, [one])


# --------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (Topic("gyr", "/imu", IMU, rate), "topic '/imu': no message 'gyr'; give one of hello"),
        (Topic("gyro", "/imu", "Imu", rate), "no type 'Imu'; give one of sensor_msgs/msg/Imu"),
        (Topic("gyro", "imu", IMU, rate), "topic 'imu': this is no name of a topic"),
        (Topic("gyro", "/events", IMU, rate), "the topic has other messages; give another name"),
        (Topic("gyro", "/adm/to", IMU, rate), "the topic has other messages"),
        (Topic("gyro", "/fix", IMU, rate), "the topic has other messages"),
        (Topic("gyro", "/imu", IMU, pose), "KeyError: 'q_ib'.; give one of the fields theta_b"),
        (Topic("gyro", "/imu", FIELD, rate), "its function makes Imu, not sensor_msgs/msg/Magn"),
        (Topic("gyro", "/imu", JSON, rate), "its function makes Imu, not json"),
        (Topic("gyro", "/imu", JSON, dict), "TypeError: Object of type ndarray is not JSON"),
        (Topic("wheels", "/a", FIELD, lambda v: magnetic_field(v["momentum"][:2])), "IndexError"),
    ],
)
def test_rows_that_do_not_fit_are_refused_at_once(row, words, tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(RecordingError, match=words):
        Recorder(path, WIRE, {}, topics=[ROWS[3], row])
    assert not path.exists()


def test_a_function_that_fails_costs_its_message_alone(tmp_path):
    def fails(v):
        if v["theta_b"][0] > 0.5:
            raise ValueError("too much")
        return rate(v)

    some = [entry(k, "gyro", "gyro", {"theta_b": [0.1 * k, 0.0, 0.0]}) for k in range(10)]
    # a sound frame of a time that ROS cannot say
    some.append(entry(10, "gyro", "gyro", {"theta_b": [0.0] * 3}, time_ns=2**31 * NS))
    path = tmp_path / "a.mcap"
    with Recorder(path, WIRE, {}, topics=[Topic("gyro", "/imu", IMU, fails)]) as recorder:
        write(recorder, some)
        assert recorder.failed == 4 + 1
    assert len(of_topic(path.read_bytes(), "/imu")) == 6
    assert read_record(path).entries == some
