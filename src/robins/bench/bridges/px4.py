"""The simulator that PX4's SITL connects to: MAVLink 2 over TCP, in lock-step.

PX4 is the client, we listen (port 4560 plus its instance number). In lock-step its clock is the
time of our samples, so neither side can run ahead:

    1. We send HIL_SENSOR with the time of the simulation, and what else is due.
    2. PX4 sets its clock, runs once, and sends HIL_ACTUATOR_CONTROLS with the same time.
    3. We compute the next step, and so on.

While PX4 starts it takes samples and does not answer; the simulation runs on without it
("freewheeling") until its first answer (PX4 guide, "Lockstep Simulation").

The machine that connects first is bound, unless one is declared: connections of others are closed
and counted. Only one connection is served at a time.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from robins.bench.bridges.errors import BridgeClosed, BridgeError, BridgeTimeout
from robins.bench.bridges.px4_messages import Actuators, Px4Sample, Sensors, dialect, message
from robins.bench.closing import Closing
from robins.foreign import decoding

PORT = 4560
SYSTEM, COMPONENT = 1, 200  # ours; PX4 does not look at them
SEND_S = 5.0  # time-out of a send that PX4 does not read
FREEWHEEL_S = 0.004  # wait for an answer in each step while PX4 starts


@dataclass
class Px4Counts:
    """Counts of the messages received from PX4 since listening began."""

    actuators: int = 0
    heartbeats: int = 0
    late: int = 0  # answers to an earlier sample than the one awaited
    others: int = 0  # messages that we do not use
    bad: int = 0  # bytes that form no message, for example because of a wrong checksum
    strangers: int = 0  # connections of another machine, closed at once


class Px4Simulator(Closing):
    """TCP server that PX4 connects to, as a context manager. Not thread-safe.

    Attributes:
        port: to which PX4 has to connect.
        counts: of the messages received.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT, peer: str = ""):
        """Listen.

        Args:
            host: address of this machine to listen at.
            port: 4560 plus the number of PX4's instance; 0: any that is free.
            peer: numeric address of the machine of PX4; without it that of the first connection.

        Raises:
            MissingPackage: pymavlink is not installed.
            BridgeClosed: the port is not available.
        """
        self._mavlink = dialect()
        try:
            self._server = socket.create_server((host, port))
        except OSError as error:
            raise BridgeClosed(
                f"cannot listen: {error.strerror or error}",
                f"{host}:{port}",
                "end the program that listens there, or start PX4 with another instance number",
            ) from None
        self.port: int = self._server.getsockname()[1]
        self.counts = Px4Counts()
        self._where = f"PX4 at port {self.port}"
        self._peer = peer
        self._line: socket.socket | None = None
        self._mav: Any = None
        self._waiting: deque[Actuators] = deque()
        self._answers = False

    @property
    def connected(self) -> bool:
        """True if connected; a lost PX4 is noticed at the next send or receive."""
        return self._line is not None

    @property
    def freewheeling(self) -> bool:
        """True until PX4 answers a sample."""
        return not self._answers

    def close(self) -> None:
        """Disconnect and stop listening. May be repeated."""
        self.hang_up()
        self._server.close()

    def hang_up(self) -> None:
        """End the connection, if any; PX4 can connect again. May be repeated."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def accept(self, timeout_s: float) -> None:
        """End any connection, wait for PX4 to connect, and greet it.

        Raises:
            BridgeTimeout: it did not connect.
            BridgeClosed: this end was closed, or PX4 disconnected at once.
        """
        self.hang_up()
        deadline = time.monotonic() + timeout_s
        try:
            while self._line is None:
                self._server.settimeout(max(deadline - time.monotonic(), 0.0))
                line, (address, *_) = self._server.accept()
                if address == (self._peer or address):
                    self._line, self._peer = line, address
                else:
                    self.counts.strangers += 1
                    line.close()
        except (TimeoutError, BlockingIOError):
            raise BridgeTimeout(
                f"PX4 did not connect within {timeout_s:g} s", self._where, "start PX4's SITL"
            ) from None
        except OSError as error:
            raise BridgeClosed(f"cannot wait for PX4: {error}", self._where) from None
        self._line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._mav = self._mavlink.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._mav.robust_parsing = True
        self._waiting.clear()
        self._answers = False
        m = self._mavlink
        kinds = (m.MAV_TYPE_GENERIC, m.MAV_AUTOPILOT_INVALID, 0, 0, m.MAV_STATE_ACTIVE)
        self._put(m.MAVLink_heartbeat_message(*kinds, 3))

    def send(self, sample: Px4Sample) -> None:
        """Send a sample of the sensors, a fix, or the true motion.

        Raises:
            BridgeError: the message cannot carry a number of the sample.
            BridgeClosed: PX4 is not connected, or has gone.
        """
        self._put(message(sample))

    def actuators(self, timeout_s: float) -> Actuators | None:
        """Next actuator commands of PX4; None: none came within the time-out.

        Raises:
            BridgeClosed: PX4 is not connected, or has gone.
        """
        deadline = time.monotonic() + timeout_s
        while not self._waiting:
            left = deadline - time.monotonic()
            self._take(max(left, 0.0))
            if left <= 0.0 and not self._waiting:
                return None
        self._answers = True
        return self._waiting.popleft()

    def step(self, sample: Sensors, timeout_s: float = 5.0) -> Actuators | None:
        """Send a sample and wait for the answer with its time stamp; None while PX4 starts.

        A PX4 that was built without lock-step has a clock of its own: then the newest controls
        count. Send other messages that are due (`GnssFix`, `Truth`) before.

        Raises:
            BridgeError: the message cannot carry a number of the sample.
            BridgeClosed: PX4 is not connected, or has gone.
            BridgeTimeout: PX4 has answered before, but not this time.
        """
        self.send(sample)
        start, other = time.monotonic(), ""
        while True:
            limit_s = FREEWHEEL_S if self.freewheeling else timeout_s
            answer = self.actuators(start + limit_s - time.monotonic())
            if answer is None:
                break
            if not answer.lockstep:
                newest = self._waiting.pop() if self._waiting else answer
                self._waiting.clear()
                return newest
            if answer.time_us == sample.time_us:
                return answer
            self.counts.late += 1
            other = f", but one to {answer.time_us} us"
        if self.freewheeling:
            return None
        raise BridgeTimeout(
            f"no answer to the sample of {sample.time_us} us within {timeout_s:g} s{other}",
            self._where,
            "look whether PX4 runs, and whether samples come as seldom as it computes (250 Hz)",
        )

    def _put(self, packed: Any) -> None:
        line = self._connected()
        line.settimeout(SEND_S)
        # `pack` leaves the message counter to the sender.
        data = packed.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        try:
            line.sendall(data)
        except OSError as error:  # after a truncated message nothing more can be sent
            raise self._disconnected(error) from None

    def _take(self, timeout_s: float) -> None:
        """Receive for a time, and handle each message."""
        line = self._connected()
        line.settimeout(timeout_s)
        try:
            data = line.recv(65536)
        except (TimeoutError, BlockingIOError):
            return
        except OSError as error:
            raise self._disconnected(error) from None
        if not data:
            raise self._disconnected("the connection ended")
        found = []
        try:
            with decoding(lambda why: BridgeError(f"bytes of PX4 cannot be parsed: {why}")):
                found = self._mav.parse_buffer(data) or []
        except BridgeError:
            self.counts.bad += 1
        for one in found:
            self._classify(one)

    def _classify(self, one: Any) -> None:
        kind = one.get_type()
        if kind == "HIL_ACTUATOR_CONTROLS":
            self.counts.actuators += 1
            command = Actuators(one.time_usec, tuple(one.controls), one.mode, one.flags)
            self._waiting.append(command)
        elif kind == "HEARTBEAT":
            self.counts.heartbeats += 1
        elif kind == "BAD_DATA":
            self.counts.bad += 1
        else:
            self.counts.others += 1

    def _connected(self) -> socket.socket:
        if self._line is None:
            raise BridgeClosed("PX4 is not connected", self._where, "call accept()")
        return self._line

    def _disconnected(self, why: OSError | str) -> BridgeClosed:
        self.hang_up()
        return BridgeClosed(f"PX4 has gone: {why}", self._where, "accept() waits for it again")
