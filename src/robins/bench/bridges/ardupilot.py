"""Physics server of ArduPilot's SITL: receives servo outputs, returns the motion as JSON.

Over UDP: ArduPilot sends to port 9002, and we answer to the sender's address. Its packets, little
endian, have 16 channels or, with its parameter SERVO_32_ENABLE, 32:

    magic u16 (18458; 29569 of 32) | frame_rate u16 [Hz] | frame_count u32 | pwm u16, u16 ... [us]

ArduPilot waits for an answer to each packet, so the two are in lock-step. If none comes for some
seconds it sends the packet again with the same count, and we repeat the answer: nothing is
computed twice. A jump of the count means lost packets. A smaller count, or another port, means
that ArduPilot was restarted: the physics then has to restart too.

UDP has no connection, so any host that reaches the port can send. The first sender of a packet is
the ArduPilot; `admits` is the rule by which another address takes its place. Datagrams of all
others are counted as `strangers` and get no answer.

(ArduPilot, libraries/SITL/examples/JSON/readme.md.) ArduPilot looks for the names of fields as
text: no blank may follow a colon, "velocity" has to come before "velocity_wind", and each answer
begins and ends with a newline.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any, NamedTuple

import numpy as np

from robins.bench.bridges.errors import BridgeClosed, BridgeError, finite, vector
from robins.bench.closing import Closing

PORT = 9002
MAGIC = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}
RANGEFINDERS = 6  # that ArduPilot has fields for
_WAITING = 64  # datagrams buffered while an answer is computed
SILENT_S = 1.0  # silence of the bound address before another may replace it
Vector = Sequence[float] | np.ndarray
Address = tuple[str, int]


class Servos(NamedTuple):
    """Packet of servo outputs from ArduPilot."""

    frame: int  # number of the packet since ArduPilot started
    rate_hz: int  # rate that ArduPilot requests; the physics may use another
    pwm_us: tuple[int, ...]  # 16 or 32 pulses, 1000 to 2000; 0: this output does nothing
    restarted: bool = False  # ArduPilot was restarted: start at time zero


@dataclass(frozen=True, kw_only=True)
class BodyState:
    """Motion of the vehicle as sent to ArduPilot; None: no such sensor.

    Attributes:
        time_s: of the physics, since its start.
        f_b_m_s2: specific force, FRD: (0, 0, -9.8) at rest and level.
        omega_ib_b_rad_s: rate against inertial, FRD; ArduPilot knows no rotation of the Earth.
        position_n_m: north, east, down of ArduPilot's origin.
        v_n_m_s: north, east, down.
        q_nb: FRD to NED, scalar first.
        airspeed_m_s: of the pitot tube.
        wind_n_m_s: velocity of the air over ground; north, east, down.
        apparent_wind: direction it comes from [rad], clockwise from ahead; speed [m/s].
        rangefinders_m: 6 at most.
        battery: voltage [V], current [A].
    """

    time_s: float
    f_b_m_s2: Vector
    omega_ib_b_rad_s: Vector
    position_n_m: Vector
    v_n_m_s: Vector
    q_nb: Vector
    airspeed_m_s: float | None = None
    wind_n_m_s: Vector | None = None
    apparent_wind: tuple[float, float] | None = None
    rangefinders_m: Sequence[float] = ()
    battery: tuple[float, float] | None = None


def decode(datagram: bytes) -> Servos:
    """Decode a packet of servo outputs.

    Raises:
        BridgeError: the length or the magic number is wrong.
    """
    layout = MAGIC.get(int.from_bytes(datagram[:2], "little"))
    if layout is None or len(datagram) != layout.size:
        sizes = ", ".join(f"{known} and {form.size} bytes" for known, form in MAGIC.items())
        raise BridgeError(
            f"a packet of {len(datagram)} bytes that begins with {datagram[:2].hex(' ')} is none "
            f"of ArduPilot's servo outputs, whose magic numbers and lengths are {sizes}"
        )
    _, rate_hz, frame, *pwm_us = layout.unpack(datagram)
    return Servos(frame, rate_hz, tuple(pwm_us))


def encode(state: BodyState) -> bytes:
    """JSON line of a motion, newlines at both ends included.

    Raises:
        BridgeError: a number is NaN or infinite, or there are too few or too many.
    """
    name = "JSON"
    fields: dict[str, Any] = {
        "timestamp": finite("time_s", state.time_s, name),
        "imu": {
            "gyro": vector("omega_ib_b_rad_s", state.omega_ib_b_rad_s, name),
            "accel_body": vector("f_b_m_s2", state.f_b_m_s2, name),
        },
        "position": vector("position_n_m", state.position_n_m, name),
        "quaternion": vector("q_nb", state.q_nb, name, 4),
        "velocity": vector("v_n_m_s", state.v_n_m_s, name),
    }
    if state.airspeed_m_s is not None:
        fields["airspeed"] = finite("airspeed_m_s", state.airspeed_m_s, name)
    if state.wind_n_m_s is not None:
        fields["velocity_wind"] = vector("wind_n_m_s", state.wind_n_m_s, name)
    if state.apparent_wind is not None:
        both = vector("apparent_wind", state.apparent_wind, name, 2)
        fields["windvane"] = dict(zip(("direction", "speed"), both, strict=True))
    if len(state.rangefinders_m) > RANGEFINDERS:
        raise BridgeError(f"rangefinders_m has {RANGEFINDERS} at most", name)
    for number, range_m in enumerate(state.rangefinders_m, 1):
        fields[f"rng_{number}"] = finite("rangefinders_m", range_m, name)
    if state.battery is not None:
        both = vector("battery", state.battery, name, 2)
        fields["battery"] = dict(zip(("voltage", "current"), both, strict=True))
    return b"\n" + json.dumps(fields, separators=(",", ":")).encode() + b"\n"


@dataclass
class ArduPilotCounts:
    """Counts of datagrams since the socket was opened."""

    packets: int = 0  # of servo outputs, repeated ones included
    lost: int = 0  # from jumps of the count
    repeated: int = 0  # sent again by ArduPilot for lack of an answer
    restarts: int = 0
    wrong: int = 0  # datagrams that are no servo outputs
    strangers: int = 0  # datagrams of an address that is not that of the autopilot


class ArduPilotPhysics(Closing):
    """UDP socket that ArduPilot sends to, as a context manager. Not thread-safe.

    Attributes:
        port: to which ArduPilot has to send.
        counts: of the datagrams received.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT, peer: str = ""):
        """Open the socket.

        Args:
            host: address of this machine to listen at.
            port: 9002, and 10 more for each further instance of ArduPilot; 0: any that is free.
            peer: numeric address of the machine of ArduPilot; packets of others are not taken.
                Without it the first sender is bound, and one of another machine stays bound to its
                port until this end is closed.

        Raises:
            BridgeClosed: the port is not available.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise BridgeClosed(
                f"cannot listen: {error.strerror or error}",
                f"{host}:{port}",
                "end the program that listens there, or start ArduPilot with another instance",
            ) from None
        self.port: int = self._socket.getsockname()[1]
        self.counts = ArduPilotCounts()
        self._last: int | None = None  # number of the last packet returned by `receive`
        self._peer: Address | None = None  # who sent it
        self._declared, self._active = peer, 0.0  # time of the last packet or answer
        self._answer = b""  # to it; empty: none yet
        self._waiting: deque[tuple[bytes, Address]] = deque()

    def close(self) -> None:
        """Stop listening. May be repeated."""
        self._socket.close()

    def admits(self, sender: Address) -> bool:
        """True if datagrams from this address are accepted.

        The bound address always is. Another is accepted if no address is bound yet; or if it is on
        the same machine, that machine is this one (loopback) or the declared peer, and the bound
        address has been silent for `SILENT_S` since its last packet and our last answer: a
        restarted ArduPilot sends from another port, and repeats its packet until it is answered.
        """
        if sender == self._peer:
            return True
        if self._declared and sender[0] != self._declared:
            return False
        if self._peer is None:
            return True
        known = bool(self._declared) or ip_address(sender[0]).is_loopback
        silent = time.monotonic() - self._active >= SILENT_S
        return sender[0] == self._peer[0] and known and silent

    def receive(self, timeout_s: float) -> Servos | None:
        """Next packet that requests a step; None: none came within the time-out.

        A repeated packet that was already answered is answered again and not returned.

        Raises:
            BridgeClosed: this end was closed.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            left = max(deadline - time.monotonic(), 0.0)
            arrived = self._waiting.popleft() if self._waiting else self._take(left)
            if arrived is None:
                return None
            if (servos := self._classify(*arrived)) is not None:
                return servos

    def reply(self, state: BodyState) -> None:
        """Answer the last packet with the motion after its step.

        Raises:
            BridgeError: a number is NaN or infinite, or there are too few or too many.
            BridgeClosed: no request is waiting, or this end was closed.
        """
        if self._peer is None:
            raise BridgeClosed(
                "no packet of ArduPilot came yet", f"port {self.port}", "call receive() first"
            )
        answer = encode(state)
        # If we were slow, ArduPilot has repeated its request meanwhile. It takes the answers one
        # for one, so each beyond the first would leave it a step behind.
        while len(self._waiting) < _WAITING and (arrived := self._take(0.0)) is not None:
            self._waiting.append(arrived)
        asked = self._waiting
        self._waiting = deque(one for one in asked if not self._repeats(*one))
        self.counts.packets += len(asked) - len(self._waiting)
        self.counts.repeated += len(asked) - len(self._waiting)
        self._answer = answer
        self._send(self._peer)

    def _repeats(self, datagram: bytes, sender: Address) -> bool:
        try:
            return decode(datagram).frame == self._last and sender == self._peer
        except BridgeError:
            return False

    def _classify(self, datagram: bytes, sender: Address) -> Servos | None:
        """Packet that requests a step; None: it was not one, or its answer was repeated."""
        try:
            servos = decode(datagram)
        except BridgeError:
            self.counts.wrong += 1
            return None
        if not self.admits(sender):  # the bound address was active after this was received
            self.counts.strangers += 1
            return None
        self.counts.packets += 1
        self._active = time.monotonic()
        last, peer = self._last, self._peer
        if (servos.frame, sender) == (last, peer):
            self.counts.repeated += 1
            if self._answer:
                self._send(sender)
                return None
            return servos
        self._last, self._peer, self._answer = servos.frame, sender, b""
        if last is None:
            return servos
        if servos.frame < last or sender != peer:
            self.counts.restarts += 1
            return servos._replace(restarted=True)
        self.counts.lost += servos.frame - last - 1
        return servos

    def _send(self, peer: Address) -> None:
        self._active = time.monotonic()
        try:
            self._socket.sendto(self._answer, peer)
        except OSError as error:
            raise BridgeClosed(f"cannot answer: {error}", f"port {self.port}") from None

    def _take(self, timeout_s: float) -> tuple[bytes, Address] | None:
        """Next datagram of an admitted address; None: none came within the time-out."""
        deadline = time.monotonic() + timeout_s
        try:
            while True:
                self._socket.settimeout(max(deadline - time.monotonic(), 0.0))
                datagram, sender = self._socket.recvfrom(65536)
                if self.admits(sender):
                    return datagram, sender
                self.counts.strangers += 1
        except (TimeoutError, BlockingIOError):
            return None
        except OSError as error:
            raise BridgeClosed(f"cannot receive: {error}", f"port {self.port}") from None
