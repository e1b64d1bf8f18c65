"""Topics of ROS 2: CDR by hand, frames by matrices, and another process at the other end."""

import math
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

pytest.importorskip("zenoh", reason="needs eclipse-zenoh, of the extra 'ros'")
rosbags = pytest.importorskip("rosbags.typesys", reason="needs rosbags, of the extra 'ros'")

from ros_peer import imu_payload, imu_read  # noqa: E402

from robins.bench.bridges import BridgeClosed, BridgeError  # noqa: E402
from robins.bench.bridges.ros2 import Ros2Topics, attachment, topic_key  # noqa: E402
from robins.bench.bridges.ros2_messages import (  # noqa: E402
    ImuSample,
    NavSatFix,
    Odometry,
    decode,
    encode,
    typestore,
)

T = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # ENU of NED, and back
D = np.diag([1.0, -1.0, -1.0])  # FLU of FRD, and back
KEY = {
    "ros2dds": "imu/{}",
    "rmw_zenoh": "3/imu/{}/sensor_msgs::msg::dds_::Imu_/"
    "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
}


def attitude(roll=0.3, pitch=-0.4, heading=2.0):
    return Rotation.from_euler("ZYX", [heading, pitch, roll])


def covariance(seed, size=3):
    root = np.random.default_rng(seed).normal(size=(size, size))
    return root @ root.T


def imu(time_ns=1_700_000_000_123_456_789, **more):
    given = {
        "omega_ib_b_rad_s": np.array([0.1, -0.2, 0.3]),
        "f_b_m_s2": np.array([0.5, 0.25, -9.75]),
    }
    return ImuSample(time_ns=time_ns, **{**given, **more})


def same(a, b):
    """Equal records; quaternions up to sign and rounding."""
    for name in a.__dataclass_fields__:
        mine, yours = getattr(a, name), getattr(b, name)
        if name == "q_nb" and mine is not None:
            assert abs(mine @ yours) == pytest.approx(1.0, abs=1e-14)
        elif isinstance(mine, np.ndarray):
            np.testing.assert_allclose(mine, yours, atol=1e-14, rtol=1e-14, err_msg=name)
        elif isinstance(mine, float):
            assert mine == pytest.approx(yours, rel=1e-15), name
        else:
            assert mine == yours, name


# ------------------------------------------------------------------------------------- bytes


def test_an_imu_byte_for_byte():
    turn, P = attitude(), covariance(1)
    q_nb = turn.as_quat(scalar_first=True)
    data = encode(imu(q_nb=q_nb, attitude_covariance=P, omega_covariance=2.0 * P, frame="box"))
    sec, nanosec, frame, n = imu_read(data)
    assert (sec, nanosec, frame) == (1_700_000_000, 123_456_789, "box")
    ros = Rotation.from_quat(n[:4])  # scalar last, FLU to ENU
    np.testing.assert_allclose(ros.as_matrix(), T @ turn.as_matrix() @ D, atol=1e-14)
    np.testing.assert_allclose(n[4:13], (T @ P @ T.T).ravel(), rtol=1e-14)
    assert n[13:16] == [0.1, 0.2, -0.3]
    np.testing.assert_allclose(n[16:25], (D @ (2.0 * P) @ D).ravel(), rtol=1e-14)
    assert n[25:28] == [0.5, -0.25, 9.75]  # REP 145: gravity is felt upwards
    assert n[28:37] == [0.0] * 9  # not known
    assert data == imu_payload(sec, nanosec, "box", n)


def test_an_imu_without_an_attitude_says_so():
    n = imu_read(encode(imu()))[3]
    assert n[4] == -1.0
    assert decode(ImuSample, encode(imu())).q_nb is None


def test_a_fix_byte_for_byte():
    P = covariance(2)
    data = encode(
        NavSatFix(
            time_ns=5_000_000_007,
            lat_rad=math.radians(-33.5),
            lon_rad=math.radians(151.25),
            alt_m=58.5,
            covariance_n_m2=P,
            valid=False,
            frame="gps",
        )
    )
    # stamp; "gps" with its zero; status i8 and, aligned to 2, service u16; aligned to 8.
    head = struct.pack("<iII4sbxH", 5, 7, 4, b"gps\0", -1, 1)
    body = data[4:]
    assert body[:20] == head
    lat, lon, alt, *flat, kind = struct.unpack("<12dB", body[24 : 24 + 97])
    assert (lat, lon, alt, kind) == (pytest.approx(-33.5), pytest.approx(151.25), 58.5, 3)
    np.testing.assert_allclose(flat, (T @ P @ T.T).ravel(), rtol=1e-14)


def test_an_odometry_byte_for_byte():
    turn, P, Q = attitude(), covariance(3, 6), covariance(4, 6)
    v_n = np.array([3.0, -4.0, 0.5])
    record = Odometry(
        time_ns=1_000_000_000,
        position_n_m=np.array([10.0, 20.0, -30.0]),
        q_nb=turn.as_quat(scalar_first=True),
        v_n_m_s=v_n,
        omega_nb_b_rad_s=np.array([0.1, 0.2, 0.3]),
        pose_covariance=P,
        twist_covariance=Q,
        frame="map",
        child="hull",
    )
    body = encode(record)[4:]
    assert body[:28] == struct.pack("<iII4sI5s3x", 1, 0, 4, b"map\0", 5, b"hull\0")
    n = struct.unpack("<85d", body[32:])  # 7 of the pose, 36, 6 of the twist, 36
    assert n[:3] == (20.0, 10.0, 30.0)
    ros = Rotation.from_quat(n[3:7])
    np.testing.assert_allclose(ros.as_matrix(), T @ turn.as_matrix() @ D, atol=1e-14)
    TT, DD = np.kron(np.eye(2), T), np.kron(np.eye(2), D)
    np.testing.assert_allclose(n[7:43], (TT @ P @ TT.T).ravel(), rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(n[49:], (DD @ Q @ DD.T).ravel(), rtol=1e-13, atol=1e-14)
    # The twist is in the body: turned by the attitude of the message it is the velocity ENU.
    np.testing.assert_allclose(ros.apply(n[43:46]), T @ v_n, atol=1e-13)
    np.testing.assert_array_equal(n[46:49], [0.1, -0.2, -0.3])


ANGLE = st.floats(-3.0, 3.0)
NUMBERS = st.lists(st.floats(-1e4, 1e4), min_size=9, max_size=9)


@given(NUMBERS, ANGLE, ANGLE, st.integers(0, 2**31 * 10**9 - 1))
def test_what_is_sent_is_what_is_read(numbers, roll, heading, time_ns):
    a, b, c = np.array(numbers).reshape(3, 3)
    q_nb = attitude(roll, 0.5, heading).as_quat(scalar_first=True)
    for record in (
        imu(time_ns, omega_ib_b_rad_s=a, f_b_m_s2=b, q_nb=q_nb, f_covariance=covariance(5)),
        NavSatFix(time_ns=time_ns, lat_rad=roll / 2.0, lon_rad=heading, alt_m=float(a[0])),
    ):
        same(decode(type(record), encode(record)), record)
    sent = Odometry(time_ns=time_ns, position_n_m=a, q_nb=q_nb, v_n_m_s=b, omega_nb_b_rad_s=c)
    got = decode(Odometry, encode(sent))
    np.testing.assert_allclose(got.v_n_m_s, b, atol=1e-10)
    np.testing.assert_array_equal(got.position_n_m, a)
    np.testing.assert_array_equal(got.omega_nb_b_rad_s, c)
    assert got.pose_covariance is None


@pytest.mark.parametrize("cut", [0, 3, 4, 20, 200])
def test_damaged_bytes_are_refused(cut):
    with pytest.raises(BridgeError, match=f"{cut} bytes are no sensor_msgs/msg/Imu"):
        decode(ImuSample, encode(imu())[:cut])


# -------------------------------------------------------------------------------------- keys


@pytest.mark.parametrize("convention", KEY)
def test_keys(convention):
    assert topic_key("/imu/data", ImuSample, convention, domain=3) == KEY[convention].format("data")


def test_keys_of_other_messages_and_distributions():
    key = topic_key("/odom", Odometry, "rmw_zenoh", distro="humble")
    assert key == "0/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported"
    assert topic_key("/fix", NavSatFix, "rmw_zenoh").startswith(
        "0/fix/sensor_msgs::msg::dds_::NavSatFix_/"
    )
    for topic in ("imu", "/", "/imu/", "/imu//data", "/1st", "/imu/*"):
        with pytest.raises(BridgeError, match="is no full name of a topic"):
            topic_key(topic, ImuSample, "ros2dds")
    with pytest.raises(BridgeError, match=r"no distribution 'jazy' of ROS 2; there are .*jazzy"):
        typestore("jazy")


def test_an_attachment_is_what_the_library_of_zenoh_serialises():
    from zenoh import ext

    gid = bytes(range(16))
    theirs = ext.z_serialize((ext.Int64(7), ext.Int64(-5), gid)).to_bytes()
    assert attachment(7, -5, gid) == theirs


# ----------------------------------------------------------------------------- two processes


@pytest.fixture
def endpoint():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    return f"tcp/127.0.0.1:{port}"


@pytest.fixture
def start():
    started = []

    def one(endpoint, convention):
        keys = [KEY[convention].format(end) for end in ("data", "back")]
        script = Path(__file__).with_name("ros_peer.py")
        started.append(subprocess.Popen([sys.executable, "-W", "error", script, endpoint, *keys]))
        return started[-1]

    yield one
    for process in started:
        process.kill()
        process.wait()


def until_heard(topics, topic, record):
    """The other side needs a moment to subscribe; what is sent before is not kept."""
    end = time.monotonic() + 20.0
    topics.publish(topic, record)
    while not topics.heard(topic):
        assert time.monotonic() < end, "nobody subscribed"
        time.sleep(0.01)


@pytest.mark.parametrize("convention", KEY)
def test_two_processes_talk(endpoint, start, convention):
    with Ros2Topics(convention=convention, listen=[endpoint], domain=3) as topics:
        topics.subscribe("/imu/back", ImuSample)
        for flight in range(2):  # the other side goes and comes back
            process = start(endpoint, convention)
            until_heard(topics, "/imu/data", imu(1_000_000_000))
            while topics.take("/imu/back", 0.2):
                pass
            q_nb = attitude(heading=0.1 * flight).as_quat(scalar_first=True)
            for k in range(2, 152):
                sent = imu(k * 1_000_000_000 + k, q_nb=q_nb, f_b_m_s2=np.array([k, 0.5, -k]) / 8.0)
                topics.publish("/imu/data", sent)
                got = topics.take("/imu/back", 10.0)
                assert got.time_ns == sent.time_ns
                np.testing.assert_array_equal(got.f_b_m_s2, -sent.f_b_m_s2)
                np.testing.assert_array_equal(got.omega_ib_b_rad_s, 2.0 * sent.omega_ib_b_rad_s)
                assert abs(got.q_nb @ q_nb) == pytest.approx(1.0, abs=1e-14)
                name, _, sequence = got.frame.partition("/")
                assert name == "base_link"
                assert (int(sequence) > 0) == (convention == "rmw_zenoh")
            topics.publish("/imu/data", imu(0))
            assert process.wait(10.0) == 0
        assert (topics.bad, topics.dropped) == (0, 0)


def test_bytes_that_are_no_message_are_counted(endpoint):
    with (
        Ros2Topics(convention="ros2dds", listen=[endpoint]) as ours,
        Ros2Topics(convention="ros2dds", connect=[endpoint]) as theirs,
    ):
        ours.subscribe("/imu", ImuSample)
        until_heard(theirs, "/imu", imu(5))
        theirs._session.put("imu", b"\0\1\0\0nothing")
        theirs.publish("/imu", imu(6))
        seen = [ours.take("/imu", 5.0).time_ns]
        while seen[-1] != 6:
            seen.append(ours.take("/imu", 5.0).time_ns)
        assert ours.bad == 1
        assert ours.take("/imu", 0.0) is None
        for k in range(150):
            theirs.publish("/imu", imu(k))
        end = time.monotonic() + 10.0
        while ours.dropped < 50:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert ours.take("/imu", 5.0).time_ns == 50


def test_errors_say_what_to_do(endpoint):
    with Ros2Topics(convention="ros2dds", listen=[endpoint]) as topics:
        with pytest.raises(BridgeError, match=r"no subscription to /imu; call subscribe\(\) first"):
            topics.take("/imu", 0.0)
        topics.publish("/imu", imu())
        with pytest.raises(BridgeError, match=r"/imu has sensor_msgs/msg/Imu, not nav_msgs"):
            topics.subscribe("/imu", Odometry)
        with pytest.raises(BridgeClosed, match=f"{endpoint}: Zenoh cannot open a session"):
            Ros2Topics(convention="ros2dds", listen=[endpoint])
