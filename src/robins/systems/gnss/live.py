"""Navigation by pseudoranges and odometry while the vehicle moves, by the filter of a replay.

`LiveGnss` takes samples of the odometry and epochs of pseudoranges as they come, and answers with
the state at the newest odometry. Its epochs are those of a replay. Differences:

- An epoch that comes late is used at its own time, unless a later one was used before
  (`ranges_too_old`); where that happens, `wait_s` lets each epoch wait for earlier ones. One that
  is newer than the odometry waits for it.
- In an outage the filter takes a step each second, `longest_delay_s` behind the odometry; an epoch
  that is later than that is refused.
- A replay has a column for each satellite of the log. Here their number is given for each system;
  a satellite that is new takes the column that has not been used for longest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, PyTree

from robins.earth import Geodetic
from robins.errors import require
from robins.filters import Belief, Code, Filter, FilterState, Model, OnlineFilter
from robins.filters.belief import FAILURES
from robins.filters.machine import usual
from robins.filters.online import WatchedStep
from robins.filters.run import Step
from robins.systems.gnss.filters import SMOOTHERS, GnssWorld, contender
from robins.systems.gnss.model import LENGTH, RANGES, LocalFrame, MotionStep
from robins.systems.gnss.parameters import GnssReplay
from robins.systems.gnss.path import LEAST, GnssPath
from robins.systems.streaming import (
    Flag,
    Live,
    LiveError,
    numbers,
    online,
    stamp,
)
from robins.systems.study import Contender

_FASTEST = 150.0  # m/s, of wheels
_GAP_S, _PATIENCE = 10.0, 10  # of the odometry: longest gap, and samples after it to believe it
_MOST_WAITING = 600  # epochs without odometry
_LONGEST_WAIT_S = 10.0
CHANNELS = {"G": 12, "R": 8, "E": 12}
"""Columns of each satellite system: GPS, GLONASS, Galileo."""


class RoadNavigation(NamedTuple):
    """Answer to a record: the state at the newest odometry; NaN while `STARTING`."""

    time_ns: int
    r_e: np.ndarray  # (3,) m, Earth-fixed
    sigma_m: np.ndarray  # (3,) m, north, east, down, at the first fix
    heading_rad: float  # from the north of the first fix to east; NaN while unknown
    sigma_heading_rad: float
    flags: Flag
    code: Code | None = None  # of the pseudoranges of the last step; MISSING in an outage
    nis: float = math.nan  # its normalised innovation squared
    dof: int = 0  # pseudoranges in it

    @property
    def geodetic(self) -> Geodetic:
        """Latitude and longitude [rad], and height [m] above the ellipsoid."""
        return Geodetic.from_ecef(jnp.asarray(self.r_e))


def predicted_vector(filter_: Filter, model: Model, state: FilterState, u: MotionStep) -> jax.Array:
    """State after a step, in one vector."""
    return _vector(filter_.predict(state, model.motion, u)[1].belief)


def posterior_vector(step: Step) -> WatchedStep:
    """Posterior as in `predicted_vector`, then code, NIS and number of the pseudoranges."""
    info = step.info[RANGES]
    outcome = [jnp.asarray(x, float) for x in (info.code, info.nis, info.dof)]
    return WatchedStep.of(step, jnp.concatenate([_vector(step.posterior), jnp.stack(outcome)]))


def _vector(belief: Belief) -> jax.Array:
    """Position and its sigmas (3,) [m], direction (2,), covariance (2, 2) of it."""
    S = belief.factor[3:5]
    x = belief.mean
    return jnp.concatenate([x.position, belief.sigma[:3], x.direction, (S @ S.T).ravel()])


def answer_of(time_ns: int, place: LocalFrame, x: np.ndarray, flags: Flag) -> RoadNavigation:
    """Unpack a vector of `predicted_vector` or `posterior_vector` into an answer.

    Args:
        time_ns: its stamp.
        place: origin of the state.
        x: the vector.
        flags: of the answer.
    """
    c, P = x[6:8], x[8:12].reshape(2, 2)
    length, sigma = float(np.hypot(*c)), math.inf
    if length > 1e-6 * float(np.sqrt(np.trace(P))):  # else it has no direction
        across = np.array([-c[1], c[0]]) / length
        sigma = float(np.sqrt(across @ P @ across)) / length
    known = sigma < np.pi / 2
    heading = math.atan2(c[1], c[0]) if known else math.nan
    r_e = np.asarray(place.origin_e) + np.asarray(place.C_en) @ x[:3]
    found = RoadNavigation(time_ns, r_e, x[3:6], heading, sigma if known else math.nan, flags)
    if len(x) > 12:
        found = found._replace(code=Code(int(x[12])), nis=float(x[13]), dof=int(x[14]))
    return found


class LiveGnss(Live):
    """Live state of a road vehicle at each record (the module lists differences from a replay).

    Attributes:
        counts: records refused by reason: `odometry_...`, `ranges_...` (epochs), `range_...`
            (single pseudoranges); `epoch_...` by `Code`, epochs that the filter could not use
            (`Flag.DOUBTFUL`); `begun_anew` after a gap of 10 s or a clock that was set.
        epoch: answer of the filter at its last step, an epoch or a second of an outage; None
            before.
        passed: answers at the steps that the last record brought, in order.
    """

    _parameters = GnssReplay
    _kept: ClassVar[tuple[str, ...]] = ("_last_step", "_frame")
    _parts: ClassVar[tuple[str, ...]] = ("_gate", "_path")
    _assumed = (LENGTH,)

    def __init__(
        self,
        parameters: GnssReplay,
        channels: Mapping[str, int] = CHANNELS,
        filter: str = "delays",
        wait_s: float = 0.0,
        longest_delay_s: float = 1.0,
        machine: str | None = None,
    ):
        """Create the object, and build its programs before the first record.

        Args:
            parameters: as of a replay.
            channels: columns of each system, by the first letter of its satellites; the clocks of
                the others are estimated against the first.
            filter: a causal one of the replays.
            wait_s: time that an epoch waits for earlier ones; the answers carry on meanwhile.
            longest_delay_s: how late an epoch may come in an outage, where steps without
                pseudoranges follow the odometry.
            machine: the machine that steps the filter, as for `OnlineFilter`; default: `usual()`.

        Raises:
            ValueError: fewer than four columns, a letter that is none, a wait or delay below zero
                or over 10 s, or no such filter or machine.
        """
        for letter, count in channels.items():
            is_letter = len(letter) == 1 and letter.isalpha()
            require(
                is_letter, "channels must be named by the letter of a system, G for GPS", letter
            )
            require(count >= 1, f"channels of {letter} must be positive", count)
        total = sum(channels.values())
        require(total >= LEAST, f"channels must be {LEAST} or more in all", total)
        require(filter not in SMOOTHERS, f"{filter} smooths: it needs the whole log")
        for what, value in {"wait_s": wait_s, "longest_delay_s": longest_delay_s}.items():
            require(0.0 <= value <= _LONGEST_WAIT_S, f"{what} must be 0 to 10 s", value)
        made_with = {"channels": dict(channels), "filter": filter, "wait_s": wait_s}
        made_with["longest_delay_s"] = longest_delay_s
        made_with |= {"machine": machine or usual()}
        super().__init__(parameters, _GAP_S, _PATIENCE, **made_with)
        self.start_over()
        self._compile()

    def _restart(self) -> None:
        """Reset all but the counts and the stamps."""
        given = self._made_with
        waits = given["wait_s"], given["longest_delay_s"]
        self._path = GnssPath(self.parameters, given["channels"], *waits)
        self._last_step: tuple[int, np.ndarray] | None = None  # stamp and vector of the last step
        self._frame = np.zeros((4, 3))  # of the state: origin [m, ECEF], and C_en
        self._online, self.epoch = None, None
        self.passed: list[RoadNavigation] = []

    def push_odometry(
        self,
        time_ns: int | np.integer,
        speed_mps: float,
        yaw_rate: float,
        sigma_speed: float,
        sigma_yaw: float,
    ) -> RoadNavigation:
        """Process a sample of wheels and yaw gyro; return the state at its stamp.

        Args:
            time_ns: stamp, whole nanoseconds, of the clock that the epochs share.
            speed_mps: forward.
            yaw_rate: rad/s, positive to the right.
            sigma_speed: m/s, noise of the sample.
            sigma_yaw: rad/s.

        Raises:
            LiveError: a stamp or number of another kind; the object goes on.
        """
        self.passed, time = [], stamp(time_ns)
        given = [speed_mps, yaw_rate, sigma_speed, sigma_yaw]
        row = numbers("speed_mps, yaw_rate, sigma_speed, sigma_yaw", given, 4)
        why = "" if np.all(np.isfinite(row)) else "nan"
        if not why and (abs(row[0]) > _FASTEST or np.any(row[2:] <= 0.0)):
            why = "absurd"
        self.counts.update([f"odometry_{why}"] if why else [])
        if why or not self._accepts("odometry", time, np.array([row[1], 0.0, 0.0, 0.0, 0.0, 0.0])):
            return self._answer(Flag.REFUSED)
        self._path.push_odometry(np.array([time]), row[None])
        self._advance()
        return self._answer(Flag(0))

    def push_ranges(
        self,
        time_ns: int | np.integer,
        satellites: Sequence[str],
        range_m: ArrayLike,
        sigma_m: ArrayLike,
        satellite_e: ArrayLike,
        elevation_rad: ArrayLike,
        cn0_dbhz: ArrayLike,
    ) -> RoadNavigation:
        """Process the pseudoranges of an epoch, late or not; return the state at the newest
        odometry.

        Args:
            time_ns: of the receiver, whole nanoseconds.
            satellites: names such as "G05"; the first letter is one of the channels.
            range_m: (n,) m, corrected for the atmosphere and the satellites' clocks.
            sigma_m: (n,) m.
            satellite_e: (n, 3) m, Earth-fixed at the time of transmission.
            elevation_rad: (n,) rad; NaN is taken for the last one, at first for the horizon.
            cn0_dbhz: (n,) dBHz; NaN for the last one, at first for a blocked signal.

        Raises:
            LiveError: a stamp, name or number of another kind, or one satellite twice; the object
                goes on.
        """
        self.passed, time = [], stamp(time_ns)
        if isinstance(satellites, str) or not isinstance(satellites, Sequence | np.ndarray):
            raise LiveError(f"are {satellites!r:.80}", "satellites", 'give names such as ["G05"]')
        names, n = list(satellites), len(satellites)
        if not all(isinstance(name, str) and name for name in names) or len(set(names)) < n:
            raise LiveError(f"are {names!r:.80}", "satellites", "give each by its name, once")
        columns = {"range_m": range_m, "sigma_m": sigma_m}
        columns |= {"elevation_rad": elevation_rad, "cn0_dbhz": cn0_dbhz}
        given = [numbers(name, values, n) for name, values in columns.items()]
        if np.shape(satellite_e) != (n, 3):
            what = f"has the shape {np.shape(satellite_e)}, not ({n}, 3)"
            raise LiveError(what, "satellite_e", "give x, y, z of each satellite in a row")
        place = numbers("satellite_e", np.ravel(satellite_e), 3 * n).reshape(n, 3)
        rows = np.column_stack([*given[:2], place, *given[2:]])
        if why := self._refused(time):
            self.counts[f"ranges_{why}"] += 1
            return self._answer(Flag.REFUSED)
        letters = self._made_with["channels"]
        good = np.all(np.isfinite(rows[:, :5]), axis=1) & (rows[:, 1] > 0.0)
        known = np.array([name[0] in letters for name in names], dtype=bool)
        self.counts.update(["range_bad"] * int(np.sum(~good)))
        self.counts.update(["range_of_another_system"] * int(np.sum(good & ~known)))
        taken = np.flatnonzero(good & known)
        if not len(taken):
            self.counts["ranges_empty"] += 1
            return self._answer(Flag.REFUSED)
        if len(self._path.waiting_ns) >= _MOST_WAITING:
            self._path.drop_oldest()
            self.counts["ranges_without_odometry"] += 1
        self._path.push_ranges(time, [names[k] for k in taken], rows[taken])
        self._advance()
        return self._answer(Flag(0))

    def _refused(self, time_ns: int) -> str:
        """Reason for refusing an epoch; "" if it is accepted."""
        last_ns = self._path.time_ns
        if last_ns is not None and time_ns <= last_ns:
            return "too_old"
        if time_ns in self._path.waiting_ns:
            return "duplicate"
        newest_ns = self._path.newest_ns
        return "ahead" if newest_ns is not None and time_ns > newest_ns + _GAP_S * 1e9 else ""

    def _advance(self) -> None:
        """Make all filter steps that the records allow."""
        dropped, without_fix = self._path.dropped, self._path.without_fix
        for time_ns, world in self._path.steps():
            if self._online is None:
                self._begin(world)
            assert self._online is not None
            found = self._online.step(world.y, world.u, {RANGES: world.sky}, keep=posterior_vector)
            self._last_step = time_ns, np.asarray(found)
            self.epoch = self._epoch()
            self.passed.append(self.epoch)
            if self.epoch.flags and self.epoch.code is not None:
                self.counts[f"epoch_{self.epoch.code.name.lower()}"] += 1
        lost = {"range_without_column": self._path.dropped - dropped}
        lost["ranges_without_fix"] = self._path.without_fix - without_fix
        self.counts.update({name: count for name, count in lost.items() if count})

    def _begin(self, first: GnssWorld) -> None:
        """Begin the filter at the first epoch."""
        place = self._path.place
        self._frame = np.vstack([place.origin_e, place.C_en])
        u = jax.tree_util.tree_map(lambda a: np.asarray(a)[None], first.u)
        self._online = self._on(self._contender.case(first._replace(u=u)).start)

    @property
    def _place(self) -> LocalFrame:
        return LocalFrame(self._frame[0], self._frame[1:])

    @property
    def _contender(self) -> Contender:
        member, name = self._path.member, self._made_with["filter"]
        return contender(self.parameters, self._place, member, name)

    def _on(self, start: Belief | FilterState) -> OnlineFilter:
        made = self._contender
        return online(made.filter, made.model, start, self._made_with["machine"])

    def _epoch(self) -> RoadNavigation:
        """Answer of the last step of the filter."""
        assert self._last_step is not None
        time_ns, found = self._last_step
        answer = answer_of(time_ns, self._place, found, Flag(0))
        return answer._replace(flags=Flag.DOUBTFUL if answer.code in FAILURES else Flag(0))

    def _answer(self, mark: Flag) -> RoadNavigation:
        newest = self._path.newest_ns or 0
        if self._online is None or self.epoch is None:
            none = np.full(3, np.nan)
            return RoadNavigation(newest, none, none, math.nan, math.nan, mark | Flag.STARTING)
        found = np.asarray(self._online.look(predicted_vector, self._path.since()))
        answer = answer_of(newest, self._place, found, mark | self.epoch.flags)
        return answer._replace(code=self.epoch.code, nis=self.epoch.nis, dof=self.epoch.dof)

    def _compile(self) -> None:
        """Compile all programs by running through a standstill, which is discarded."""
        letters = [name for name, n in self._made_with["channels"].items() for _ in range(n)]
        z = 1.0 - (2.0 * np.arange(len(letters)) + 1.0) / len(letters)
        turns = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(len(letters))
        flat = np.sqrt(1.0 - z**2)
        # at a place none of whose directions is an axis: zeros in the numbers of a model are of
        # another program
        up_e = np.array([0.6, 0.2, np.sqrt(0.6)])
        line = up_e + 0.8 * np.column_stack([flat * np.cos(turns), flat * np.sin(turns), z])
        line /= np.linalg.norm(line, axis=1)[:, None]
        names = [f"{letter}{k}" for k, letter in enumerate(letters)]
        known, size = np.full(len(letters), 40.0), np.full(len(letters), 2e7)
        satellite_e = 2e7 * line + 6.37e6 * up_e
        step_ns, waits_ns = 500_000_000, round(1e9 * self._made_with["wait_s"])
        for k in range(6 + waits_ns // step_ns):
            time_ns = step_ns * k
            self.push_ranges(time_ns, names, size, known, satellite_e, 0.01 * known, known)
            self.push_odometry(time_ns, 0.0, 0.0, 0.1, 0.01)
        self._compiled_state = None if self._online is None else self._online.state
        self.start_over()

    def _resume_from(self, states: list[PyTree]) -> None:
        super()._resume_from(states)
        self.epoch = None if self._last_step is None else self._epoch()
