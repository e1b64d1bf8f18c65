"""A stand-in for ArduPilot's SITL: its packets by hand, and the socket that it has."""

import socket
import struct


def packet(count, pwm=(), rate=400, magic=18458):
    channels = {18458: 16, 29569: 32}[magic]
    pulses = [*pwm, *[0] * (channels - len(pwm))]
    return struct.pack(f"<HHI{channels}H", magic, rate, count, *pulses)


class Peer:
    """The socket that ArduPilot has."""

    def __init__(self, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(10.0)
        self.to = ("127.0.0.1", port)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def put(self, *datagrams):
        for one in datagrams:
            self.socket.sendto(one, self.to)

    def line(self, timeout=10.0):
        """The next answer; None: there is none."""
        self.socket.settimeout(timeout)
        try:
            data = self.socket.recv(65536)
        except (TimeoutError, BlockingIOError):
            return None
        assert data[:1] == data[-1:] == b"\n"
        return data.decode("ascii").strip("\n")
