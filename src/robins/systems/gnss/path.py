"""Conversion of odometry and pseudoranges to filter steps, chunk by chunk.

A replay is one chunk, a live object chunks of one; any chunks of the same records give the same
bits. Each time of the receiver is an epoch, and each satellite has a column, free again when
another one needs it. Only the latency of the odometry is taken from the future: an epoch becomes a
step when the odometry has reached it, or has passed it by a wait that is asked for. Where no epoch
comes, steps of one second without pseudoranges follow the odometry, `timeout_s` behind it.
"""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Mapping

import jax
import numpy as np

from robins.program.evaluated import evaluated
from robins.systems.gnss.filters import GnssWorld
from robins.systems.gnss.model import (
    LENGTH,
    RANGES,
    LocalFrame,
    MotionStep,
    Sky,
    delay_law,
    first_fix,
)
from robins.systems.gnss.parameters import GnssAssumptions

LEAST = 4  # satellites of the first fix
BRIDGE_NS = 1_000_000_000  # longest step: a mean speed and turn rate must describe it
_EARTH_M = 6.2e6, 6.6e6  # from its centre, least and most of a first fix
_FAR_M = 2.6e7  # where a satellite is read that is not measured
_fix = jax.jit(first_fix)


class GnssPath:
    """Converter of odometry and pseudoranges to steps of the filter (see the module).

    Attributes:
        satellites: name in each column, "" where there was none yet.
        member: (N, K) one where a column is of a system other than the first.
        begin_ns: time of the first epoch; None before it.
        time_ns: of the last epoch; likewise.
        way_m: along the road since the first epoch.
        fix: (4 + K,) of `first_fix`, of the first epoch.
        dropped: pseudoranges without a column, because all of their system were in use.
        without_fix: epochs with satellites enough whose first fix is not a place on the Earth.
    """

    def __init__(
        self,
        believed: GnssAssumptions,
        channels: Mapping[str, int],
        wait_s: float = 0.0,
        timeout_s: float = math.inf,
    ):
        """Create a converter without records.

        Args:
            believed: of wheels, delays and clocks.
            channels: columns of each satellite system, by the first letter of its satellites.
            wait_s: time by which the odometry must be past an epoch, for earlier epochs that come
                later.
            timeout_s: time by which a step without an epoch follows the odometry; epochs that are
                later than that come too late. In a log that ends with its epochs there is none.
        """
        self._believed, self._wait_ns = believed, round(1e9 * wait_s)
        self._timeout_ns, self._channels = 1e9 * max(timeout_s, wait_s), dict(channels)
        self._letters = "".join(letter * count for letter, count in channels.items())
        others = np.array(list(channels)[1:], dtype=str)
        self.member = (np.array(list(self._letters))[:, None] == others[None, :]).astype(float)
        self._clear_columns()
        self._odometry_ns, self._odometry = np.zeros(0, np.int64), np.zeros((0, 4))
        self._waiting: list[tuple[int, list[str], np.ndarray]] = []
        self.begin_ns: int | None = None
        self.time_ns: int | None = None
        self.fix = np.zeros(4 + self.member.shape[1])
        self.way_m, self._is_long, self.without_fix = 0.0, False, 0

    def _clear_columns(self) -> None:
        count = len(self._letters)
        self.satellites, self.dropped, self._epochs = [""] * count, 0, 0
        self._used = np.full(count, -1)  # number of the last epoch of each column
        self._shown = np.zeros((count, 2))  # its elevation [rad] and C/N0 [dBHz]
        self._satellite_e = np.tile([_FAR_M, 0.0, 0.0], (count, 1))  # where it was last

    def push_odometry(self, time_ns: np.ndarray, rows: np.ndarray) -> None:
        """Add odometry.

        Args:
            time_ns: (M,) int64, rising.
            rows: (M, 4) speed [m/s] forward, yaw rate [rad/s] to the right, their sigmas.
        """
        self._odometry_ns = np.concatenate([self._odometry_ns, time_ns])
        self._odometry = np.concatenate([self._odometry, rows])

    def push_ranges(self, time_ns: int, names: list[str], rows: np.ndarray) -> None:
        """Add the pseudoranges of an epoch later than that of the last step.

        Args:
            time_ns: of the receiver.
            names: of the satellites, a letter of `channels` and more.
            rows: (n, 7) range and sigma [m], satellite (3,) [m, ECEF], elevation [rad] and C/N0
                [dBHz], NaN where unknown.

        Raises:
            ValueError: a satellite has two pseudoranges.
        """
        if len(set(names)) < len(names):
            what = "a satellite has two pseudoranges at one time; leave one signal of each"
            raise ValueError(what)
        bisect.insort(self._waiting, (time_ns, names, rows), key=lambda epoch: epoch[0])

    def drop_oldest(self) -> None:
        """Drop the oldest epoch that waits for odometry."""
        del self._waiting[0]

    def steps(self) -> list[tuple[int, GnssWorld]]:
        """Time [ns] and world, without a leading axis, of each step that can be made now.

        The first is to the first epoch with a fix of four satellites while there is odometry; it
        has no length.
        """
        out: list[tuple[int, GnssWorld]] = []
        while (due := self._due()) is not None:
            time_ns, names, rows = due
            if self.time_ns is not None or self._find_first_fix(time_ns, names, rows):
                out.append((time_ns, self._step(time_ns, names, rows)))
            self._forget(time_ns)
        if self.time_ns is None and self.newest_ns is not None and self._timeout_ns < math.inf:
            self._forget(self.newest_ns - round(self._timeout_ns))
        return out

    def _due(self) -> tuple[int, list[str], np.ndarray] | None:
        """Next epoch, or end of a step without one; None: the odometry does not reach it yet."""
        if (newest_ns := self.newest_ns) is None:
            return None
        first_ns = self._waiting[0][0] if self._waiting else math.inf
        ready = first_ns <= newest_ns - self._wait_ns
        if self.time_ns is not None:
            edge_ns = self.time_ns + BRIDGE_NS
            if edge_ns < first_ns and (ready or edge_ns <= newest_ns - self._timeout_ns):
                return edge_ns, [], np.zeros((0, 7))
        return self._waiting.pop(0) if ready else None

    def _find_first_fix(self, time_ns: int, names: list[str], rows: np.ndarray) -> bool:
        """Find the first fix; False where an epoch gives none."""
        of = Counter(name[0] for name in names)
        able = sum(min(of[letter], count) for letter, count in self._channels.items())
        if able < LEAST or self._odometry_ns[0] > time_ns:
            return False
        y, sky, _ = self._in_columns(names, rows)
        fix = np.asarray(_fix(y, sky, self.member, self._believed.clock.system_bias))
        self._clear_columns()
        if not _EARTH_M[0] < float(np.linalg.norm(fix[:3])) < _EARTH_M[1]:
            self.without_fix += 1
            return False
        self.fix, self.begin_ns, self.time_ns = fix, time_ns, time_ns
        return True

    def since(self) -> MotionStep:
        """Step from the last epoch to the newest odometry."""
        u, _ = self._travel(int(self._odometry_ns[-1]))
        return self._with_delays(u, np.zeros(len(self._letters)))

    @property
    def place(self) -> LocalFrame:
        """Origin of the state: the first fix."""
        return evaluated(LocalFrame.at, self.fix[:3])

    @property
    def waiting_ns(self) -> list[int]:
        """Times of the epochs that wait for odometry."""
        return [time_ns for time_ns, _, _ in self._waiting]

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest odometry; None before the first."""
        return int(self._odometry_ns[-1]) if len(self._odometry_ns) else None

    def _step(self, time_ns: int, names: list[str], rows: np.ndarray) -> GnssWorld:
        u, way_m = self._travel(time_ns)
        self.way_m += way_m
        y, sky, fresh = self._in_columns(names, rows)
        is_long = self.way_m >= self._believed.wheels.aligned_after
        length = np.array([1.0 if is_long and not self._is_long else np.nan])
        self.time_ns, self._is_long = time_ns, self._is_long or is_long
        return GnssWorld(self.fix, self._with_delays(u, fresh), {RANGES: y, LENGTH: length}, sky)

    def _travel(self, until_ns: int) -> tuple[MotionStep, float]:
        """Step from the last one to a time, without delays, and the distance travelled [m].

        Speed and yaw rate are straight lines between their samples; a step has their means.
        """
        assert self.time_ns is not None
        ns = self._odometry_ns
        rows = slice(
            max(int(np.searchsorted(ns, self.time_ns, side="right")) - 1, 0),
            int(np.searchsorted(ns, until_ns, side="left")) + 1,
        )
        t, dt = (ns[rows] - self.time_ns) * 1e-9, (until_ns - self.time_ns) * 1e-9
        at = np.concatenate([[0.0], t[(t > 0.0) & (t < dt)], [dt]])
        v, w = (np.interp(at, t, x) for x in self._odometry[rows, :2].T)
        slip, sway = (float(np.interp(dt, t, x)) for x in self._odometry[rows, 2:].T)
        speed, rate = (float(np.trapezoid(x, at)) / dt if dt > 0.0 else 0.0 for x in (v, w))
        none = np.zeros(0)
        way_m = float(np.trapezoid(np.abs(v), at))
        return MotionStep(dt, speed, rate, slip, sway, none, none, none), way_m

    def _with_delays(self, u: MotionStep, fresh: np.ndarray) -> MotionStep:
        mean, spread = delay_law(self._believed.delays, *self._shown.T)
        return u._replace(delay_mean=mean, delay_sigma=spread, fresh=fresh)

    def _in_columns(self, names: list[str], rows: np.ndarray) -> tuple[np.ndarray, Sky, np.ndarray]:
        """Pseudoranges (N,), NaN where there is none, satellites, and (N,) one where new."""
        count = len(self._letters)
        y, sigma, fresh = np.full(count, np.nan), np.ones(count), np.zeros(count)
        self._epochs += 1
        for name in set(names) & set(self.satellites):  # these keep their columns
            self._used[self.satellites.index(name)] = self._epochs
        for name, row in zip(names, rows, strict=True):
            k = self._column(name)
            if k is None:
                self.dropped += 1
                continue
            if name != self.satellites[k]:
                self.satellites[k], self._shown[k], fresh[k] = name, 0.0, 1.0
            self._used[k] = self._epochs
            y[k], sigma[k], self._satellite_e[k] = row[0], row[1], row[2:5]
            self._shown[k] = np.where(np.isfinite(row[5:]), row[5:], self._shown[k])
        return y, Sky(self._satellite_e.copy(), sigma), fresh

    def _column(self, name: str) -> int | None:
        """Column of a satellite; a new one gets the column that has been unused for longest."""
        if name in self.satellites:
            return self.satellites.index(name)
        of = [k for k, letter in enumerate(self._letters) if name.startswith(letter)]
        free = min(of, key=lambda k: self._used[k], default=None)
        return None if free is None or self._used[free] == self._epochs else free

    def _forget(self, time_ns: int) -> None:
        """Drop odometry before the last sample up to an epoch."""
        first = max(int(np.searchsorted(self._odometry_ns, time_ns, side="right")) - 1, 0)
        self._odometry_ns, self._odometry = self._odometry_ns[first:], self._odometry[first:]
