"""The other side of ROS topics: Zenoh and CDR by hand, without robins and without rosbags.

    python ros_peer.py CONNECT MODE

It listens on imu/data and answers each sample on imu/back, as Imu too: the same stamp, rates
doubled, forces negated. A sample of time 0 ends it.
"""

import json
import struct
import sys
import threading

import zenoh


def imu_payload(sec, nanosec, frame, numbers):
    """CDR of sensor_msgs/msg/Imu: two u32, a string with its zero, then 37 f64, aligned to 8."""
    text = frame.encode() + b"\0"
    body = struct.pack("<iII", sec, nanosec, len(text)) + text
    body += bytes(-len(body) % 8)
    return b"\0\1\0\0" + body + struct.pack("<37d", *numbers)


def imu_read(payload):
    """Stamp, name of the frame and 37 numbers."""
    assert payload[:4] == b"\0\1\0\0"
    body = payload[4:]
    sec, nanosec, length = struct.unpack_from("<iII", body)
    frame = body[12 : 12 + length - 1].decode()
    start = 12 + length + -(12 + length) % 8
    assert len(body) == start + 37 * 8
    return sec, nanosec, frame, list(struct.unpack_from("<37d", body, start))


def attached(sample):
    """Sequence and gid of an attachment of rmw_zenoh; of other samples None."""
    if sample.attachment is None:
        return None
    data = sample.attachment.to_bytes()
    sequence, _, length = struct.unpack_from("<qqB", data)
    assert (length, len(data)) == (16, 33)
    return sequence, data[17:]


def main(endpoint, key, back):
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    over = threading.Event()
    with zenoh.open(config) as session:
        publisher = session.declare_publisher(back)

        def answer(sample):
            sec, nanosec, frame, n = imu_read(sample.payload.to_bytes())
            if sec == 0:
                over.set()
                return
            told = attached(sample)
            sequence = 0 if told is None else told[0]
            rates, forces = [2.0 * x for x in n[13:16]], [-x for x in n[25:28]]
            numbers = [*n[:13], *rates, *n[16:25], *forces, *n[28:37]]
            publisher.put(imu_payload(sec, nanosec, f"{frame}/{sequence}", numbers))

        subscriber = session.declare_subscriber(key, answer)
        over.wait(30.0)
        subscriber.undeclare()


if __name__ == "__main__":
    main(*sys.argv[1:])
