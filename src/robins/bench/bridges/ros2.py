"""Topics of ROS 2 over Zenoh, without ROS: publish and subscribe.

ROS 2 is reached through one of two programs on its side, each with its own key convention:

- "ros2dds": zenoh-bridge-ros2dds, next to ROS 2 over DDS. The key is the topic without its first
  slash, "imu/data"; the payload is CDR.
- "rmw_zenoh": ROS 2 with rmw_zenoh_cpp. The key is "<domain>/<topic>/<type>/<hash>", such as
  "0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a..."; the payload is CDR. Each sample has an
  attachment, little endian: sequence i64 | time i64 [ns] | length of the gid u8 | gid u8 x 16.

(zenoh-plugin-ros2dds, README; rmw_zenoh, docs/design.md; the hash is that of REP 2016.) No
liveliness token is declared, so tools that list topics do not show ours.

Messages are those of `robins.ros`, in the frames of ROS; its functions `imu`, `nav_sat_fix` and
`odometry` make them of what robins has. Only the hash of a type needs rosbags.

A session discovers no peers by itself: it connects to and listens at the endpoints given, such as
"tcp/127.0.0.1:7447".
"""

from __future__ import annotations

import contextlib
import functools
import json
import queue
import re
import struct
import time
import uuid
from collections.abc import Sequence
from typing import Any, Literal

from robins.bench.bridges.errors import BridgeClosed, BridgeError, needed
from robins.bench.closing import Closing
from robins.ros import Message, RosError, Stamped, decode, encode, name_of

DISTRO = "jazzy"  # distribution of ROS 2 whose definitions are hashed
Convention = Literal["ros2dds", "rmw_zenoh"]
KEPT = 100  # samples of a topic that wait to be taken; then the oldest are dropped
_ATTACHMENT = struct.Struct("<qqB16s")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@functools.cache
def hash_of(kind: type[Message], distro: str = DISTRO) -> str:
    """The hash of a type (REP 2016) in a distribution of ROS 2.

    Raises:
        BridgeError: rosbags does not know the distribution.
        MissingPackage: rosbags is not installed.
    """
    known = needed("rosbags.typesys", "ros")
    try:
        store = known.get_typestore(known.Stores(f"ros2_{distro}"))
    except ValueError:
        names = [s.value.removeprefix("ros2_") for s in known.Stores if "ros2" in s.value]
        raise BridgeError(
            f"no distribution '{distro}' of ROS 2", fix=f"there are {', '.join(names)}"
        ) from None
    return str(store.hash_rihs01(name_of(kind)))


@functools.cache
def topic_key(
    topic: str,
    kind: type[Message],
    convention: Convention,
    domain: int = 0,
    distro: str = DISTRO,
) -> str:
    """Zenoh key of a topic.

    Args:
        topic: fully qualified, such as "/imu/data".
        kind: its message type.
        convention: of the program on the side of ROS.
        domain: ROS_DOMAIN_ID, for rmw_zenoh.
        distro: of ROS, for rmw_zenoh, whose keys have a hash of the definition since Iron.

    Raises:
        BridgeError: the topic is not of that form, or there is no such distribution.
        MissingPackage: rosbags is not installed.
    """
    if not _TOPIC.fullmatch(topic):
        raise BridgeError(f"'{topic}' is no full name of a topic", fix="write such as /imu/data")
    if convention == "ros2dds":
        return topic[1:]
    package, _, message = name_of(kind).split("/")
    type_hash = "TypeHashNotSupported" if distro == "humble" else hash_of(kind, distro)
    return f"{domain}{topic}/{package}::msg::dds_::{message}_/{type_hash}"


def attachment(sequence: int, time_ns: int, gid: bytes) -> bytes:
    """Attachment of rmw_zenoh to a sample; gid: 16 bytes that name the publisher."""
    return _ATTACHMENT.pack(sequence, time_ns, len(gid), gid)


class Ros2Topics(Closing):
    """Zenoh session with publishers and subscribers of ROS topics, as a context manager.

    Attributes:
        bad: samples that could not be decoded as their topic's type.
        dropped: samples discarded because they were not taken in time.
    """

    def __init__(
        self,
        *,
        convention: Convention,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        mode: Literal["peer", "client"] = "peer",
        domain: int = 0,
        distro: str = DISTRO,
    ):
        """Open the session.

        Args:
            convention: of the program on the side of ROS.
            connect: endpoints to connect to. A peer retries until they exist, a client does not.
            listen: endpoints to listen at.
            mode: "client" where a router stands between, which then forwards everything.
            domain: ROS_DOMAIN_ID, for rmw_zenoh.
            distro: of ROS, for rmw_zenoh.

        Raises:
            BridgeClosed: an endpoint cannot be listened at, or a client's router is not there.
            MissingPackage: eclipse-zenoh is not installed.
        """
        zenoh = needed("zenoh", "ros")
        config = zenoh.Config()
        settings = {
            "mode": mode,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "connect/endpoints": list(connect),
            "listen/endpoints": list(listen),
        }
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            where = ", ".join((*listen, *connect))
            raise BridgeClosed(
                f"Zenoh cannot open a session: {error}", where, "start the program on that side"
            ) from None
        self.bad = self.dropped = 0
        self._convention: Convention = convention
        self._domain, self._distro = domain, distro
        self._publishers: dict[str, Any] = {}
        self._subscribers: dict[str, Any] = {}
        self._arrived: dict[str, queue.Queue[bytes]] = {}
        self._kinds: dict[str, type[Message]] = {}
        self._sequence = 0
        self._gid = uuid.uuid4().bytes

    def close(self) -> None:
        """Close the session with all its publishers and subscribers. May be repeated."""
        self._session.close()

    def publish(self, topic: str, message: Message, time_ns: int, frame_id: str = "") -> None:
        """Send a message, with the time and frame of its header; later subscribers miss it.

        Raises:
            BridgeError: the topic has no full name, or had another type before.
            RosError: as `robins.ros.encode`.
        """
        key = self._key(topic, type(message))
        data = encode(message, time_ns, frame_id)
        if key not in self._publishers:
            self._publishers[key] = self._session.declare_publisher(key)
        attached = None
        if self._convention == "rmw_zenoh":
            self._sequence += 1
            attached = attachment(self._sequence, time.time_ns(), self._gid)
        self._publishers[key].put(data, attachment=attached)

    def subscribe(self, topic: str, kind: type[Message]) -> None:
        """Subscribe to a topic; its last 100 samples wait to be taken.

        Raises:
            BridgeError: the topic has no full name, or had another type before.
        """
        key = self._key(topic, kind)
        if topic in self._arrived:
            return
        waiting = self._arrived[topic] = queue.Queue[bytes]()

        def keep(sample: Any) -> None:  # in a thread of Zenoh
            while waiting.qsize() >= KEPT:
                with contextlib.suppress(queue.Empty):
                    waiting.get_nowait()
                    self.dropped += 1
            waiting.put(sample.payload.to_bytes())

        self._subscribers[key] = self._session.declare_subscriber(key, keep)

    def take(self, topic: str, timeout_s: float) -> Stamped | None:
        """Take the oldest message that waits on a topic; None: none came within the time-out.

        Raises:
            BridgeError: there is no subscription to the topic.
        """
        waiting = self._arrived.get(topic)
        if waiting is None:
            raise BridgeError(f"no subscription to {topic}", fix="call subscribe() first")
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                data = waiting.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return None
            try:
                return decode(self._kinds[topic], data)
            except RosError:
                self.bad += 1

    def _key(self, topic: str, kind: type[Message]) -> str:
        key = topic_key(topic, kind, self._convention, self._domain, self._distro)
        if self._kinds.setdefault(topic, kind) is not kind:
            had = name_of(self._kinds[topic])
            raise BridgeError(f"{topic} has {had}, not {name_of(kind)}")
        return key
