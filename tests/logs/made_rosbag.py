"""Recordings of ROS 2 in MCAP files, their messages packed by hand, without the encoder of robins.

For a frame of three letters or none numbers begin 16 bytes after the four that say "little endian",
for one of four to eleven 24 bytes.
"""

import struct
from io import BytesIO

from mcap.writer import CompressionType, Writer

IMU, MAG = "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField"
FIX = "sensor_msgs/msg/NavSatFix"
NS = 10**9


def header(stamp_ns):
    """Header with the frame "abc"."""
    return b"\0\1\0\0" + struct.pack("<iII4s", *divmod(stamp_ns, NS), 4, b"abc")


def imu(stamp_ns, gyro, accel, known=(0.0, 0.0, 0.0)):
    """First numbers of the covariances: of orientation, rate, specific force."""
    q, w, f = ((x, *[0.0] * 8) for x in known)
    return header(stamp_ns) + struct.pack("<37d", 0, 0, 0, 1, *q, *gyro, *w, *accel, *f)


def mag(stamp_ns, field):
    return header(stamp_ns) + struct.pack("<12d", *field, *[0.0] * 9)


def fix(stamp_ns, place_deg, variance_enu, status=0, kind=2):
    e, n, u = variance_enu
    return header(stamp_ns) + struct.pack(
        "<bxHxxxx12dB", status, 1, *place_deg, e, 0, 0, 0, n, 0, 0, 0, u, kind
    )


def rosbag(messages, compression=CompressionType.ZSTD, finish=True, encoding="cdr"):
    """A file.

    Args:
        messages: (topic, type, bytes) in their order.
        compression: of the chunks.
        finish: whether it is closed.
        encoding: of the messages.
    """
    out, channels = BytesIO(), {}
    writer = Writer(out, compression=compression, chunk_size=4096)
    writer.start("ros2", "by hand")
    for k, (topic, kind, data) in enumerate(messages):
        if topic not in channels:
            schema = writer.register_schema(kind, "ros2msg", b"not looked at")
            channels[topic] = writer.register_channel(topic, encoding, schema)
        writer.add_message(channels[topic], k, data, k)
    if finish:
        writer.finish()
    return out.getvalue()


def drive(seconds=3):
    """A level vehicle at rest, 10 Hz, with a magnetometer and a receiver."""
    begin, out = 1_756_402_219 * NS, []
    for k in range(10 * seconds):
        now = begin + k * NS // 10
        out.append(("/imu", IMU, imu(now, (0.01, 0.02, 0.03), (0.0, 0.1, 9.8))))
        out.append(("/mag", MAG, mag(now, (2e-5, 1e-6, -4e-5))))
        if k % 10 == 0:
            out.append(("/fix", FIX, fix(now, (48.0, 11.0, 500.0), (1.0, 4.0, 9.0))))
    return out
