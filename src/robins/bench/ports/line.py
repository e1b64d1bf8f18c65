"""A serial line with a baud rate: each byte arrives at its own time.

A pseudo-terminal delivers bytes at once, whatever its baud rate. This line delays them as a real
one: a byte arrives one byte time after the one before it, or after it was sent, whichever is later.
The arithmetic is in integers, of nanoseconds times baud, so no error accumulates over days.
"""

from __future__ import annotations

from collections import deque

_SECOND_NS = 1_000_000_000
BITS_PER_BYTE = 10  # a start bit, eight data bits, a stop bit


class SerialLine:
    """One direction of a serial line.

    It holds at most ``most`` bytes; new bytes beyond that are dropped, as by a transmitter whose
    buffer is full. A frame truncated in this way fails its checksum.

    Attributes:
        dropped: number of bytes dropped so far.
        backlog: number of bytes sent and not yet taken.
    """

    def __init__(self, baud: int, bits_per_byte: int = BITS_PER_BYTE, most: int = 65536) -> None:
        """Set up an empty line.

        Args:
            baud: bits a second.
            bits_per_byte: 10 for eight bits without parity and one stop bit.
            most: bytes it may hold.

        Raises:
            ValueError: a number below one.
        """
        for name, number in (("baud", baud), ("bits_per_byte", bits_per_byte), ("most", most)):
            if number < 1:
                raise ValueError(f"{name} must be at least 1, got {number}")
        self.dropped = 0
        self._baud = baud
        self._most = most
        self._byte = bits_per_byte * _SECOND_NS  # time of one byte, in ns times baud
        self.backlog = 0
        # bursts without a pause: when the first byte left begins [ns times baud], what is left
        self._bursts: deque[tuple[int, bytes]] = deque()
        self._free = 0  # arrival of the last byte [ns times baud], from 0

    def send(self, data: bytes, now_ns: int) -> None:
        """Put bytes on the line; transmission starts now, or after the bytes before."""
        room = self._most - self.backlog
        self.dropped += max(0, len(data) - room)
        if kept := bytes(data[:room]):
            begin = max(now_ns * self._baud, self._free)
            self._bursts.append((begin, kept))
            self._free = begin + len(kept) * self._byte
            self.backlog += len(kept)

    def take(self, now_ns: int) -> bytes:
        """Take the bytes that have arrived by now."""
        now = now_ns * self._baud
        out: list[bytes] = []
        while self._bursts:
            begin, left = self._bursts[0]
            through = (now - begin) // self._byte
            if through < 1:
                break
            self._bursts.popleft()
            out.append(left[:through])
            if through < len(left):
                self._bursts.appendleft((begin + through * self._byte, left[through:]))
                break
        taken = b"".join(out)
        self.backlog -= len(taken)
        return taken

    @property
    def next_ns(self) -> int | None:
        """Arrival time of the next byte [ns]; None: the line is empty."""
        if not self._bursts:
            return None
        return -(-(self._bursts[0][0] + self._byte) // self._baud)


def load(
    bytes_count: float | int, seconds: float | int, baud: int, bits_per_byte: int = BITS_PER_BYTE
) -> float:
    """Utilisation of a line by a number of bytes in a time; above 1 the backlog grows for ever.

    Raises:
        ValueError: no time, or no baud.
    """
    if not (seconds > 0.0 and baud > 0):
        raise ValueError(f"seconds and baud must be above 0, got {seconds} and {baud}")
    return bytes_count * bits_per_byte / (seconds * baud)
