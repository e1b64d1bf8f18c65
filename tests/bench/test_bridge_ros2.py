"""Topics of ROS 2 over Zenoh: keys, and another process at the other end, with CDR by hand."""

import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zenoh", reason="needs eclipse-zenoh, of the extra 'ros'")
pytest.importorskip("rosbags.typesys", reason="needs rosbags, of the extra 'ros'")

from robins import ros
from robins.bench.bridges import BridgeClosed, BridgeError
from robins.bench.bridges.ros2 import Ros2Topics, attachment, hash_of, topic_key

KEY = {
    "ros2dds": "imu/{}",
    "rmw_zenoh": "3/imu/{}/sensor_msgs::msg::dds_::Imu_/"
    "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
}


def imu(f_b=(0.5, 0.25, -9.75), q_nb=None):
    rate = np.array([0.1, -0.2, 0.3])
    return ros.imu(rate, np.array(f_b), q_nb, body="FRD", nav="NED")


# -------------------------------------------------------------------------------------- keys


@pytest.mark.parametrize("convention", KEY)
def test_keys(convention):
    assert topic_key("/imu/data", ros.Imu, convention, domain=3) == KEY[convention].format("data")


def test_keys_of_other_messages_and_distributions():
    key = topic_key("/odom", ros.Odometry, "rmw_zenoh", distro="humble")
    assert key == "0/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported"
    assert topic_key("/fix", ros.NavSatFix, "rmw_zenoh").startswith(
        "0/fix/sensor_msgs::msg::dds_::NavSatFix_/"
    )
    for topic in ("imu", "/", "/imu/", "/imu//data", "/1st", "/imu/*"):
        with pytest.raises(BridgeError, match="is no full name of a topic"):
            topic_key(topic, ros.Imu, "ros2dds")
    with pytest.raises(BridgeError, match=r"no distribution 'jazy' of ROS 2; there are .*jazzy"):
        hash_of(ros.Imu, "jazy")


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


def until_heard(talker, topic, listener, answers, time_ns):
    """Publish until something arrives; what is sent before the other side subscribes is lost."""
    end = time.monotonic() + 20.0
    talker.publish(topic, imu(), time_ns)
    while listener.take(answers, 0.05) is None:
        assert time.monotonic() < end, "nobody subscribed"
        talker.publish(topic, imu(), time_ns)


@pytest.mark.parametrize("convention", KEY)
def test_two_processes_talk(endpoint, start, convention):
    with Ros2Topics(convention=convention, listen=[endpoint], domain=3) as topics:
        topics.subscribe("/imu/back", ros.Imu)
        for flight in range(2):  # the other side goes and comes back
            process = start(endpoint, convention)
            until_heard(topics, "/imu/data", topics, "/imu/back", 1_000_000_000)
            while topics.take("/imu/back", 0.2):
                pass
            for k in range(2, 152):
                q_nb = np.array([np.cos(0.1 * flight), 0.0, 0.0, np.sin(0.1 * flight)])
                sent = imu(np.array([k, 0.5, -k]) / 8.0, q_nb)
                topics.publish("/imu/data", sent, k * 1_000_000_000 + k, "base_link")
                got = topics.take("/imu/back", 10.0)
                assert got.time_ns == k * 1_000_000_000 + k
                back = got.message
                np.testing.assert_array_equal(
                    back.linear_acceleration, np.negative(sent.linear_acceleration)
                )
                np.testing.assert_array_equal(
                    back.angular_velocity, np.multiply(2.0, sent.angular_velocity)
                )
                np.testing.assert_array_equal(back.orientation, sent.orientation)
                name, _, sequence = got.frame_id.partition("/")
                assert name == "base_link"
                assert (int(sequence) > 0) == (convention == "rmw_zenoh")
            topics.publish("/imu/data", imu(), 0)
            assert process.wait(10.0) == 0
        assert (topics.bad, topics.dropped) == (0, 0)


def test_bytes_that_are_no_message_are_counted(endpoint):
    with (
        Ros2Topics(convention="ros2dds", listen=[endpoint]) as ours,
        Ros2Topics(convention="ros2dds", connect=[endpoint]) as theirs,
    ):
        ours.subscribe("/imu", ros.Imu)
        until_heard(theirs, "/imu", ours, "/imu", 5)
        theirs._session.put("imu", b"\0\1\0\0nothing")
        theirs.publish("/imu", imu(), 6)
        seen = [ours.take("/imu", 5.0).time_ns]
        while seen[-1] != 6:
            seen.append(ours.take("/imu", 5.0).time_ns)
        assert ours.bad == 1
        assert ours.take("/imu", 0.0) is None
        for k in range(150):
            theirs.publish("/imu", imu(), k)
        end = time.monotonic() + 10.0
        while ours.dropped < 50:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert ours.take("/imu", 5.0).time_ns == 50


def test_errors_say_what_to_do(endpoint):
    with Ros2Topics(convention="ros2dds", listen=[endpoint]) as topics:
        with pytest.raises(BridgeError, match=r"no subscription to /imu; call subscribe\(\) first"):
            topics.take("/imu", 0.0)
        topics.publish("/imu", imu(), 0)
        with pytest.raises(BridgeError, match=r"/imu has sensor_msgs/msg/Imu, not nav_msgs"):
            topics.subscribe("/imu", ros.Odometry)
        with pytest.raises(BridgeClosed, match=f"{endpoint}: Zenoh cannot open a session"):
            Ros2Topics(convention="ros2dds", listen=[endpoint])
