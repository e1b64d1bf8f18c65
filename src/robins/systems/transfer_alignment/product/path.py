"""Conversion of a slave's increments and a master's records to filter steps, chunk by chunk.

A replay is one chunk, a live object chunks of one; any chunks give the same bits. Taken from the
future are an increment after an epoch, which shows whether a long interval is a gap, and the gyros
about the time at which a record was valid.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.earth import earth_rate_n, transport_rate_n
from robins.ins.blocks import due_epochs, epochs_between, gained_between, mean_rate, usual_width
from robins.ins.frames import turned
from robins.ins.increments import Increments, IncrementStream
from robins.ins.mechanise import Nav, unpacked
from robins.systems.parts import ImuBlock
from robins.systems.replaying import imu_blocks
from robins.systems.transfer_alignment.product.model import Installation, RecordDelay
from robins.systems.transfer_alignment.product.parameters import PairReplay
from robins.systems.transfer_alignment.product.study import installation_of

# Row of a record: time [s], attitude (4,), velocity (3,) [m/s], latitude, longitude [rad], height
# [m], angular rate omega_ib (3,) [rad/s] of the master; NaN where missing.
WIDTH = 14
_NAV, _RATE = slice(1, 11), slice(11, 14)

PairSteps = tuple[ImuBlock, Nav, RecordDelay]
"""Of E epochs, leading axis E: increments; records, NaN where missing or without one; their lag."""


class PairPath:
    """Converter of increments and records to steps of the filter (see the module).

    Attributes:
        imu: increments of samples that come in chunks; their clock begins with the first one.
        records: (M, 14) rows of `WIDTH`, by time.
    """

    def __init__(self, parameters: PairReplay, usual_s: float):
        """Create a converter without samples, for a slave with this sampling interval [s]."""
        self._parameters, self._usual_s = parameters, usual_s
        self._delay_s, self._half_s = parameters.master.delay, max(0.01, usual_s)
        self.imu = IncrementStream(usual_s)
        self._rows, self._begin_s = np.zeros((0, 8)), math.nan
        self.records, self._ended = np.zeros((0, WIDTH)), False

    def push(self, rows: np.ndarray) -> None:
        """Add increments (K, 8), as `IncrementStream.push` returns them."""
        if not len(self._rows) and len(rows):
            self._begin_s = float(rows[0, 0] - rows[0, 1])
        self._rows = np.concatenate([self._rows, rows])

    def push_records(self, rows: np.ndarray) -> None:
        """Add records (K, 14), in any order of time."""
        both = np.concatenate([self.records, rows])
        self.records = both[np.argsort(both[:, 0], kind="stable")]

    def end(self) -> None:
        """Declare the increments complete: the rest becomes steps, up to the last increment."""
        self._ended = True

    @property
    def known_s(self) -> float:
        """Time [s] up to which steps can be made."""
        if self._ended:
            return float(self._rows[-1, 0])
        if len(self._rows) < 2:
            return -math.inf
        last, end = self._rows[-2:, 0].tolist()
        return min(last, end - self._half_s + self._delay_s)

    def start(self) -> tuple[float, Nav] | None:
        """Begin [s] and state of the slave, from the first complete record.

        The filter begins when the record was valid; this record and those before it are dropped.
        None: no record is complete and valid in the time of the increments.
        """
        if not len(self._rows):
            return None
        valid_s = self.records[:, 0] - self._delay_s
        within = (valid_s >= self._begin_s - 1e-9) & (self.records[:, 0] <= self.known_s + 1e-9)
        complete = within & np.all(np.isfinite(self.records[:, _NAV]), axis=1)
        if not np.any(complete):
            return None
        k = int(np.flatnonzero(complete)[0])
        at_s = np.maximum(valid_s[k : k + 1], self._begin_s)
        rate = self._master_rate(at_s, self.records[k : k + 1, _RATE])[0]
        master = jax.tree.map(jnp.asarray, unpacked(self.records[k, _NAV]))
        self.records = self.records[k + 1 :]
        return float(at_s[0]), _slave_of(master, installation_of(self._parameters), rate)

    def due(self, time_s: float, wanted_s: float) -> list[tuple[float, float]]:
        """Epochs after a given one that can become steps, as of `due_epochs`."""
        known_s, longest_s = self.known_s, self._parameters.recording.longest_block
        if known_s <= time_s:
            return []
        at_s = self.records[:, 0]
        if not self._ended:
            return due_epochs(known_s, time_s, wanted_s, at_s, longest_s)
        edges = epochs_between(wanted_s, known_s, at_s, longest_s, even=False)
        return [(edge_s, wanted_s) for edge_s in edges[edges > time_s].tolist()]

    def steps(self, begin_s: float, epochs: np.ndarray) -> PairSteps:
        """Steps from an epoch to later ones (E,) [s] from `due`."""
        at = np.searchsorted(self.records[:, 0], epochs - 1e-9)
        known = np.append(self.records, np.full((1, WIDTH), np.nan), axis=0)[at]
        there = np.abs(known[:, 0] - epochs) <= 1e-9
        known[~there] = np.nan
        lag = self._lag(epochs - self._delay_s, epochs, known[:, _RATE])
        return self._blocks(self._rows, begin_s, epochs), unpacked(known[:, _NAV]), lag

    def late(self, record: np.ndarray, epoch_s: float) -> PairSteps:
        """Step (1,) without duration at the last epoch, for a record (14,) from before it."""
        dt = np.zeros((1, usual_width(self._parameters.recording.longest_block, self._usual_s)))
        none = Increments(dt, np.zeros((*dt.shape, 3)), np.zeros((*dt.shape, 3)))
        lag = self._lag(record[:1] - self._delay_s, np.array([epoch_s]), record[None, _RATE])
        return ImuBlock(none, np.ones(1)), unpacked(record[None, _NAV]), lag

    def since(self, begin_s: float) -> ImuBlock:
        """Block (1, K) from an epoch to the newest sample, whose last increment is provisional."""
        rows = self._rows[self._rows[:, 0] > begin_s - 2.0 * self._usual_s]
        rows = np.concatenate([rows, self.imu.newest])
        return self._blocks(rows, begin_s, rows[-1:, 0])

    def forget(self, oldest_s: float) -> None:
        """Drop increments and records that no record valid at a time or later needs."""
        oldest_s -= self._delay_s + 2.0 * self._half_s
        if len(self._rows) and self._rows[0, 0] < oldest_s - 1.0:
            self._rows = self._rows[self._rows[:, 0] > oldest_s]
        self.records = self.records[self.records[:, 0] > oldest_s]

    @property
    def increments(self) -> Increments:
        """Increments that are kept."""
        return _columns(self._rows)

    def _blocks(self, rows: np.ndarray, begin_s: float, epochs: np.ndarray) -> ImuBlock:
        recording = self._parameters.recording
        return imu_blocks(_columns(rows), rows[:, 0], begin_s, epochs, recording, self._usual_s)

    def _lag(self, valid_s: np.ndarray, epoch_s: np.ndarray, rate: np.ndarray) -> RecordDelay:
        """Lag (E,) of records valid at these times and used at these epochs."""
        valid_s = np.maximum(valid_s, self._begin_s)
        turn, gained = gained_between(self.increments, self._rows[:, 0], valid_s, epoch_s)
        return RecordDelay(epoch_s - valid_s, turn, gained, self._master_rate(valid_s, rate))

    def _master_rate(self, at_s: np.ndarray, reported: np.ndarray) -> np.ndarray:
        """Angular rate (E, 3) [rad/s] of the master: reported, or by the slave's gyros if NaN.

        A mean over 10 ms, or a sample, to either side, rotated by the nominal mounting: with a
        lever arm of metres, biases and mounting error are negligible. Towards an end of the samples
        both sides become shorter, so that the mean stays centred.
        """
        end_s = float(self._rows[-1, 0]) if self._ended else math.inf
        half = np.minimum(self._half_s, np.minimum(at_s - self._begin_s, end_s - at_s))
        half = np.maximum(half, 0.5 * self._usual_s)
        begin, end = (np.clip(at_s + k * half, self._begin_s, end_s) for k in (-1.0, 1.0))
        of_slave = mean_rate(self.increments, self._rows[:, 0], begin, end)
        nominal = SciRotation.from_euler("ZYX", self._parameters.mounting.nominal[::-1])
        return np.where(np.isfinite(reported), reported, turned(nominal.as_matrix(), of_slave))


def _columns(rows: np.ndarray) -> Increments:
    return Increments(rows[:, 1], rows[:, 2:5], rows[:, 5:8])


@jax.jit
def _slave_of(master: Nav, at: Installation, omega_b) -> Nav:
    """State of the slave from a master record: nominal mounting, lever arm, no flexure."""
    q_nm, v_n, place = master
    arm_n = q_nm.apply(at.lever_m)
    omega_in = earth_rate_n(place.lat) + transport_rate_n(place.lat, place.alt, v_n)
    swing = q_nm.apply(jnp.cross(omega_b, at.lever_m)) - jnp.cross(omega_in, arm_n)
    return Nav(q_nm @ at.q_ms, v_n + swing, place.retract(arm_n))
