"""A stand-in for PX4, made from MAVLink's definition: frames by hand, and pymavlink's parser."""

import contextlib
import socket
import struct
import threading

import pytest

mavlink = pytest.importorskip(
    "pymavlink.dialects.v20.common", reason="needs pymavlink, of the extra 'autopilot'"
)

# ----------------------------------------------------- MAVLink by hand (mavlink.io, serialization)


def x25(data, crc=0xFFFF):
    """CRC-16/MCRF4XX, bit by bit."""
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8408 if crc & 1 else crc >> 1
    return crc


def extra(name, fields):
    """CRC_EXTRA: of the name and the fields in the order in which they are sent."""
    crc = x25(f"{name} ".encode())
    for kind, field, count in fields:
        crc = x25(f"{kind} {field} ".encode() + (bytes([count]) if count else b""), crc)
    return (crc & 0xFF) ^ (crc >> 8)


def frame(number, payload, crc_extra, sequence, system=1, component=200):
    """A frame of MAVLink 2: zeros at the end of the payload are not sent."""
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    head = bytes([len(payload), 0, 0, sequence, system, component]) + number.to_bytes(3, "little")
    check = x25(head + payload + bytes([crc_extra]))
    return b"\xfd" + head + payload + check.to_bytes(2, "little")


SENSOR = extra(
    "HIL_SENSOR",
    [("uint64_t", "time_usec", 0)]
    + [("float", f"{axis}{kind}", 0) for kind in ("acc", "gyro", "mag") for axis in "xyz"]
    + [("float", f, 0) for f in ("abs_pressure", "diff_pressure", "pressure_alt", "temperature")]
    + [("uint32_t", "fields_updated", 0)],  # `id` is an extension, which CRC_EXTRA leaves out
)
CONTROLS = extra(
    "HIL_ACTUATOR_CONTROLS",
    [
        ("uint64_t", "time_usec", 0),
        ("uint64_t", "flags", 0),
        ("float", "controls", 16),
        ("uint8_t", "mode", 0),
    ],
)


def controls_frame(time_us, values, mode=129, flags=1, sequence=0):
    sixteen = [*values, *[0.0] * (16 - len(values))]
    payload = struct.pack("<QQ16fB", time_us, flags, *sixteen, mode)
    return frame(93, payload, CONTROLS, sequence, component=1)


# --------------------------------------------------------------------------- stand-in for PX4


class Peer:
    """The client that PX4 is, its bytes parsed by pymavlink."""

    def __init__(self, port):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=10.0)
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.heard = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def put(self, data):
        self.socket.sendall(data)

    def every(self):
        """Each message until the line ends."""
        with contextlib.suppress(ConnectionError):
            while data := self.socket.recv(4096):
                yield from self.mav.parse_buffer(data) or []

    def next(self, kind):
        """The next message of a kind; None when the line ended."""
        while True:
            for at, one in enumerate(self.heard):
                if one.get_type() == kind:
                    del self.heard[: at + 1]
                    return one
            data = self.socket.recv(4096)
            if not data:
                return None
            self.heard += self.mav.parse_buffer(data) or []


@contextlib.contextmanager
def thread(target, *args):
    one = threading.Thread(target=target, args=args, daemon=True)
    one.start()
    yield
    one.join(10.0)
    assert not one.is_alive()
