"""All samples of a run in bounded memory: minimum and maximum of each signal in buckets of time.

A bucket holds `per` consecutive samples. When all buckets are full, pairs are merged, so there are
`BUCKETS / 2` to `BUCKETS` of them however long the run is, and a single spike stays visible as an
edge of its bucket. Missing values (NaN) are ignored; a bucket without any value is NaN.

    history: run u32 | MARK u32 | buckets u32 | signals u32 | per u32 | samples u32
             | first time f64[buckets] | last time f64[buckets]
             | least f64[signals, buckets] | greatest f64[signals, buckets]

Little endian, by rows. `MARK` is in place of the sequence number of a sample, and no sample has it.
"""

from __future__ import annotations

import struct

import numpy as np

from robins.bench.live.feed import MARK, SAMPLE_HEAD

BUCKETS = 4096
BLOCK = 128  # samples added at once: a NumPy call costs as much as ten values
HISTORY_HEAD = struct.Struct("<6I")


class SampleHistory:
    """Minimum and maximum of the samples of a run, in buckets; see above.

    Attributes:
        samples: their number.
        per: samples in a bucket.
    """

    def __init__(self, signals: int) -> None:
        self.samples = 0
        self.per = 1
        self._first, self._last = np.full((2, BUCKETS), np.nan)
        self._least, self._most = np.full((2, BUCKETS, signals), np.nan)
        self._row = SAMPLE_HEAD.size + 8 * signals  # bytes
        self._waiting = bytearray()

    def add(self, samples: bytes) -> None:
        """Add one or more concatenated samples, as `feed.pack_sample` makes them."""
        self._waiting += samples
        if len(self._waiting) >= BLOCK * self._row:
            self._take_in()

    def pack(self, run: int) -> bytes:
        """Bytes of the history in the format above; empty if there are no samples."""
        self._take_in()
        n, signals = -(-self.samples // self.per), self._least.shape[1]
        if not n:
            return b""
        head = HISTORY_HEAD.pack(run & 0xFFFFFFFF, MARK, n, signals, self.per, self.samples)
        columns = (self._first[:n], self._last[:n], self._least[:n].T, self._most[:n].T)
        return head + b"".join(column.astype("<f8").tobytes() for column in columns)

    @classmethod
    def unpack(cls, packed: bytes) -> SampleHistory:
        """Restore a packed history."""
        _, _, n, signals, per, samples = HISTORY_HEAD.unpack_from(packed)
        made = cls(signals)
        made.per, made.samples = per, samples
        times, values = np.split(np.frombuffer(packed, "<f8", offset=HISTORY_HEAD.size), [2 * n])
        made._first[:n], made._last[:n] = times.reshape(2, n)
        made._least[:n], made._most[:n] = values.reshape(2, signals, n).transpose(0, 2, 1)
        return made

    def _take_in(self) -> None:
        if not self._waiting:
            return
        rows = np.frombuffer(bytes(self._waiting), "<f8").reshape(-1, self._row // 8)
        self._waiting.clear()
        time, values = rows[:, 1], rows[:, SAMPLE_HEAD.size // 8 :]
        values = np.where(np.isfinite(values), values, np.nan)
        numbers = self.samples + np.arange(len(rows))
        while numbers[-1] >= BUCKETS * self.per:
            self._halve()
        self.samples += len(rows)
        bucket, begins, many = np.unique(numbers // self.per, return_index=True, return_counts=True)
        # The first of these buckets may already have samples; an empty one is NaN.
        self._first[bucket] = np.fmin(self._first[bucket], time[begins])
        self._last[bucket] = time[begins + many - 1]
        for kept, of in ((self._least, np.fmin), (self._most, np.fmax)):
            kept[bucket] = of(kept[bucket], of.reduceat(values, begins, axis=0))

    def _halve(self) -> None:
        """Merge the buckets in pairs."""
        half, self.per = BUCKETS // 2, 2 * self.per
        for kept, of in (
            (self._first, np.fmin),
            (self._last, np.fmax),
            (self._least, np.fmin),
            (self._most, np.fmax),
        ):
            kept[:half] = of(kept[0::2], kept[1::2])
            kept[half:] = np.nan
