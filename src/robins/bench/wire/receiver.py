"""Extraction of frames from a stream of bytes in any pieces, damaged or not."""

from __future__ import annotations

from dataclasses import dataclass

from robins.bench.wire.frames import EDGE, LEAST, MOST_PAYLOAD, Frame, FrameError, decode_frame

# COBS adds a byte for each 254 and one more.
LONGEST = LEAST + MOST_PAYLOAD + (LEAST + MOST_PAYLOAD) // 254 + 1


@dataclass
class Counts:
    """Counts of frames at a receiver."""

    frames: int = 0  # valid ones
    cobs: int = 0  # invalid stuffing
    short: int = 0
    long: int = 0  # longer than any frame, dropped while received
    crc: int = 0  # check wrong
    version: int = 0
    header: int = 0

    @property
    def wrong(self) -> int:
        """Runs of bytes between zeros that form no frame."""
        return self.cobs + self.short + self.long + self.crc + self.version + self.header


class Receiver:
    """Decoder of bytes to frames; after an error it counts, and skips to the next zero.

    Its output depends on the bytes alone, not on how they are split, and it never holds more than
    the longest frame.

    Attributes:
        counts: so far.
    """

    def __init__(self) -> None:
        self.counts = Counts()
        self._held = bytearray()
        self._too_long = False

    def feed(self, data: bytes) -> list[Frame]:
        """Process bytes; return the frames that end in them."""
        found: list[Frame] = []
        *ended, rest = bytes(data).split(EDGE)
        for piece in ended:
            self._hold(piece)
            if self._too_long:
                self.counts.long += 1
            elif self._held:  # two zeros in a row are the edges of neighbours
                self._take(bytes(self._held), found)
            self._held.clear()
            self._too_long = False
        self._hold(rest)
        return found

    @property
    def held(self) -> int:
        """Bytes of a frame that has not ended yet."""
        return len(self._held)

    def _hold(self, piece: bytes) -> None:
        if self._too_long or len(self._held) + len(piece) > LONGEST:
            self._too_long = True
            self._held.clear()
        else:
            self._held += piece

    def _take(self, stuffed: bytes, found: list[Frame]) -> None:
        try:
            frame = decode_frame(stuffed)
        except FrameError as error:
            setattr(self.counts, error.why, getattr(self.counts, error.why) + 1)
            return
        self.counts.frames += 1
        found.append(frame)


class Sequence:
    """Sequence numbers of one link and direction: counts of lost, repeated and late frames.

    Attributes:
        lost: numbers that have not come and are not expected any more.
        repeated: frames whose number had come before.
        late: frames that came after one of a higher number; they no longer count as lost.
        jumps: times that the sender restarted its count, or skipped more numbers than frames can
            have been lost.
    """

    REMEMBERED = 1024

    def __init__(self) -> None:
        self.lost = self.repeated = self.late = self.jumps = 0
        self._next: int | None = None
        self._missing: dict[int, None] = {}
        self._now_ns: int | None = None
        self._of_now: set[int] = set()

    def take(self, number: int, now_ns: int | None = None, most: int = 2**31) -> bool:
        """Count a frame; true if it is new and in order, and so usable.

        Args:
            number: sequence number of the frame.
            now_ns: time of the run, if the frame is stamped with it; None: it may be an old frame.
                A current frame with an old number that has not come at this time is not repeated:
                its sender has restarted its count.
            most: frames that can have been lost before it; a number further ahead is a jump.
        """
        if self._next is None:
            self._next = number
        again = now_ns is None or self._came(number, now_ns)
        ahead = (number - self._next) % 2**32
        if ahead <= min(most, 2**31 - 1):
            for k in range(min(ahead, self.REMEMBERED)):
                self._missing[(number - 1 - k) % 2**32] = None
            while len(self._missing) > self.REMEMBERED:
                self._missing.pop(next(iter(self._missing)))
            self.lost += ahead
            self._next = (number + 1) % 2**32
            return True
        if number in self._missing:
            del self._missing[number]
            self.lost -= 1
            self.late += 1
        elif again and ahead >= 2**31:
            self.repeated += 1
        else:
            self.jumps += 1
            self._missing.clear()
            self._next = (number + 1) % 2**32
            return True
        return False

    def _came(self, number: int, now_ns: int) -> bool:
        """True if a number has already come at this time; remembers up to `REMEMBERED` numbers."""
        if now_ns != self._now_ns:
            self._now_ns, self._of_now = now_ns, set()
        if number in self._of_now:
            return True
        if len(self._of_now) < self.REMEMBERED:
            self._of_now.add(number)
        return False
