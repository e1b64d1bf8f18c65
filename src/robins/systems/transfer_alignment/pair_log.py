"""A master and a slave as a log: what the simulator makes of it, and what a filter is given of it.

The tables of a `Dataset` hold the slave's samples (``imu``) and the master's records (``master``);
`robins.logs` writes and reads them. There and back is the same `PairRun`, but for what no log
knows: the truth, and the slave before the first record of its master.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from robins.dataset import Dataset, ImuTable, Trajectory
from robins.earth import Geodetic, earth_rate_n, transport_rate_n
from robins.ins.blocks import cut, epochs_between
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, after_gap, from_imu
from robins.ins.mechanise import Nav, as_trajectory, refuse_polar
from robins.rotation import Rotation
from robins.scenario import Parameters, Quantity, default
from robins.systems.transfer_alignment.pair import PairRun, SlaveTruth, simulate_pair
from robins.systems.transfer_alignment.pair_course import lay_out
from robins.systems.transfer_alignment.pair_parameters import PairParameters


class Recording(Parameters):
    """How a recorded pair is cut into steps of the filter."""

    longest_block: Annotated[float, Quantity("time", above="0 s")] = default("0.25 s")
    # a gap in the slave's samples that is longer is declared: the alignment begins anew after it
    longest_gap: Annotated[float, Quantity("time", above="0 s")] = default("0.5 s")
    # process noise factor across one
    gap_noise: Annotated[float, pydantic.Field(ge=1.0, le=1e6)] = 30.0


class Piece(NamedTuple):
    """A stretch of a recorded pair without a gap in the slave's samples; E epochs."""

    run: PairRun  # its truth is NaN; `start` is where the slave is taken to be
    start_s: float  # on the clock of the log, whose zero is the slave's first sample
    epoch_s: np.ndarray  # (E,)
    record: np.ndarray  # (E,) row of the master's table used there, -1 where there is none
    first: int  # row that the slave starts from
    noise_scale: np.ndarray  # (E,) of the process noise factor: 1, more across a short gap


# ------------------------------------------------------------------------------- run to log


def pair_dataset(parameters: PairParameters, seed: int, run: int = 0) -> Dataset:
    """One run of a simulated pair as a log; its noise is that of the same run in a campaign.

    Raises:
        ValueError: as `lay_out`.
    """
    course = lay_out(parameters)
    simulated = jax.jit(lambda k: simulate_pair(parameters, course, seed, k))(run)
    return recorded(simulated, "simulated pair")


def recorded(run: PairRun, name: str) -> Dataset:
    """A run as tables; the truth about the slave, at the epochs, comes along.

    The slave's samples are integrals of rate and specific force, which `from_imu` turns into the
    increments of the run again.
    """
    flat = Increments(*(np.asarray(a).reshape(-1, *np.shape(a)[2:]) for a in run.increments[:3]))
    each = np.shape(run.increments.dt)[1]
    time_ns = np.concatenate([[0], np.cumsum(np.round(flat.dt * 1e9).astype(np.int64))])
    epoch_ns = time_ns[each::each]
    at = run.master_position
    master = Nav(Rotation(run.master_q_nb), run.master_v_n, at)
    table = as_trajectory(epoch_ns, master, f"master of {name}")
    truth = Nav(Rotation(run.truth.q_nb), run.truth.v_n, run.truth.position)
    return Dataset(
        name,
        _samples(time_ns, flat, f"slave of {name}"),
        truth=as_trajectory(epoch_ns, truth, f"truth of {name}"),
        master=replace(table, omega_ib_b=np.asarray(run.master_omega_b)),
    )


def _samples(
    time_ns: np.ndarray, wanted: Increments, name: str, rounds: int = 50, tolerance: float = 1e-13
) -> ImuTable:
    """The table of which `from_imu` makes these increments; its first row repeats the second.

    What coning and sculling terms add is small beside the samples, so correcting these by what is
    missing converges.

    Raises:
        ValueError: it does not, for the body turns too far within a sample.
    """

    def table(gyro, accel) -> ImuTable:
        doubled = (np.concatenate([a[:1], a]) for a in (gyro, accel))
        return ImuTable(time_ns, *doubled, kind="increment", source=name)

    gyro, accel = np.asarray(wanted.theta), np.asarray(wanted.dv)
    for _ in range(rounds):
        made = from_imu(table(gyro, accel))[0]
        turn, push = wanted.theta - made.theta, wanted.dv - made.dv
        gyro, accel = gyro + turn, accel + push
        if max(np.abs(turn).max(), np.abs(push).max()) < tolerance:
            return table(gyro, accel)
    raise ValueError(f"{name}: the body turns too far within a sample to be written as samples")


# ------------------------------------------------------------------------------- log to run


def pieces_of(
    dataset: Dataset, parameters: PairParameters, recording: Recording
) -> tuple[list[Piece], list[str]]:
    """A recorded pair made ready for a filter, piece by piece.

    Args:
        dataset: with a master, examined and cleaned (`robins.logs`).
        parameters: nominal mounting, lever arm and delay.
        recording: block lengths and gaps.

    Returns:
        The pieces, and a sentence for each stretch that cannot be used.

    Raises:
        ValueError: there is no master, or no stretch can be used; the sentence says why.
    """
    if dataset.master is None or len(dataset.master) == 0:
        raise ValueError("a recorded pair needs the records of a master; this log has none")
    master = to_ned_frd(dataset.master)
    refuse_polar(master.lat_rad[np.isfinite(master.lat_rad)])
    increments, end_ns = from_imu(dataset.imu)
    increments = Increments(*(np.asarray(a, float) for a in increments[:3]))
    origin = int(dataset.imu.time_ns[0])
    time_s, master_s = (end_ns - origin) * 1e-9, (master.time_ns - origin) * 1e-9
    if not np.any((master_s > 0.0) & (master_s <= time_s[-1])):
        raise ValueError(
            f"no record of the master lies within the slave's log: the slave spans 0 to "
            f"{time_s[-1]:.1f} s, the master {master_s[0]:.1f} to {master_s[-1]:.1f} s; do both "
            "use the same time scale?"
        )
    broken = np.flatnonzero(increments.dt > recording.longest_gap)
    edges = [-1, *broken.tolist(), len(time_s)]
    usual = float(np.median(increments.dt))
    found, problems = [], []
    for a, b in pairwise(edges):
        if b - a < 2:
            continue
        part = Increments(*(x[a + 1 : b] for x in increments[:3]))
        stretch = _Stretch(part, time_s[a + 1 : b], master, master_s, usual)
        try:
            found.append(_prepare(stretch, parameters, recording))
        except ValueError as error:
            problems.append(f"{stretch.begin_s:.1f} to {stretch.time_s[-1]:.1f} s: {error}")
    if not found:
        raise ValueError("; ".join(problems) or "the slave's log has no two samples in a row")
    return found, problems


class _Stretch(NamedTuple):
    increments: Increments  # (N,), (N, 3), (N, 3)
    time_s: np.ndarray  # (N,) end of each
    master: Trajectory  # NED/FRD, whole
    master_s: np.ndarray  # (M,)
    usual_dt: float  # s, between samples of the log

    @property
    def begin_s(self) -> float:
        return float(self.time_s[0] - self.increments.dt[0])


def _prepare(stretch: _Stretch, parameters: PairParameters, recording: Recording) -> Piece:
    increments, time_s, master, master_s, _ = stretch
    delay = parameters.master.delay
    end_s = float(time_s[-1])
    within = (master_s - delay >= stretch.begin_s - 1e-9) & (master_s <= end_s + 1e-9)
    first = np.flatnonzero(within & _whole(master))
    if len(first) == 0:
        raise ValueError(
            "no record of the master with position, velocity and attitude, which the slave could "
            f"start from, while it was sampled{_delayed(delay)}"
        )
    k = int(first[0])
    start_s = float(np.clip(master_s[k] - delay, stretch.begin_s, end_s))
    used = np.flatnonzero((master_s > master_s[k]) & (master_s <= end_s + 1e-9))
    if len(used) == 0:
        raise ValueError(f"the master has no record after the first whole one, {master_s[k]:.1f} s")
    stamps = np.minimum(master_s[used], end_s)
    epochs = epochs_between(start_s, end_s, stamps, recording.longest_block)
    blocks = cut(increments, time_s, start_s, epochs)
    record = np.full(len(epochs), -1)
    record[np.searchsorted(epochs, stamps - 1e-9)] = used
    turn = turn_rate(stretch, parameters)
    gap = after_gap(increments.dt)
    bridged = np.any(gap[blocks.parent] & (blocks.parent >= 0), axis=1)
    return Piece(
        run=_run(stretch, parameters, blocks.increments, record, k, turn),
        start_s=start_s,
        epoch_s=epochs,
        record=record,
        first=k,
        noise_scale=np.where(bridged, recording.gap_noise, 1.0),
    )


def _whole(master: Trajectory) -> np.ndarray:
    columns = np.column_stack([*_place(master), master.v_n, master.q_nb])
    return np.asarray(np.isfinite(columns).all(axis=1))


def _delayed(delay_s: float) -> str:
    return f" (records are {delay_s:g} s old)" if delay_s else ""


def turn_rate(stretch: _Stretch, parameters: PairParameters) -> np.ndarray:
    """Turn rate omega_ib_b of the master at each of its records (M, 3) [rad/s].

    Where it was not recorded the slave's gyros stand in, turned by the nominal mounting: a lever
    arm of metres does not notice their biases, nor the mounting error.
    """
    valid_s = stretch.master_s - parameters.master.delay
    at_s = np.clip(valid_s, stretch.begin_s, stretch.time_s[-1])
    of_slave = jnp.asarray(_gyro_rate(stretch, at_s))
    of_gyros = np.asarray(Rotation.from_euler(*parameters.mounting.nominal).apply(of_slave))
    told = stretch.master.omega_ib_b
    return of_gyros if told is None else np.where(np.isfinite(told), told, of_gyros)


def _gyro_rate(stretch: _Stretch, at_s: np.ndarray) -> np.ndarray:
    """Mean of the gyros over 10 ms, or a sample, to either side of times (M,): (M, 3) rad/s."""
    half = max(0.01, stretch.usual_dt)
    edge_s = np.concatenate([[stretch.begin_s], stretch.time_s])
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(stretch.increments.theta, axis=0)])
    # towards an end of the samples both sides become shorter, so that the mean stays centred
    half = np.minimum(half, np.minimum(at_s - edge_s[0], edge_s[-1] - at_s))
    half = np.maximum(half, 0.5 * stretch.usual_dt)

    def until(t):
        return np.stack([np.interp(t, edge_s, a) for a in angle.T], -1)

    early, late = (np.clip(at_s + k * half, edge_s[0], edge_s[-1]) for k in (-1.0, 1.0))
    return (until(late) - until(early)) / (late - early)[:, None]


def _run(
    stretch: _Stretch,
    parameters: PairParameters,
    increments: Increments,
    record: np.ndarray,
    first: int,
    turn: np.ndarray,
) -> PairRun:
    """What a simulation would hand to the filters, from the records; its truth is NaN."""
    master, count = stretch.master, len(record)

    def at_epochs(values: np.ndarray, fill: float = np.nan) -> np.ndarray:
        out = np.full((count, *values.shape[1:]), fill)
        here = record >= 0
        out[here] = values[record[here]]
        return out

    three = np.full((count, 3), np.nan)
    unknown = SlaveTruth(
        q_nb=np.full((count, 4), np.nan),
        v_n=three,
        position=Geodetic(*three.T),
        gyro_bias=three,
        accel_bias=three,
        mounting_rad=three,
        flexure_rad=three,
        flexure_rate_rad_s=three,
    )
    found = PairRun(
        increments=increments,
        start=slave_at(master, first, turn[first], parameters),
        initial_error=np.zeros(9),
        master_position=Geodetic(*(at_epochs(a) for a in _place(master))),
        master_v_n=at_epochs(master.v_n),
        master_q_nb=at_epochs(master.q_nb),
        master_omega_b=at_epochs(turn, 0.0),
        truth=unknown,
    )
    return jax.tree.map(jnp.asarray, found)


def _place(master: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return master.lat_rad, master.lon_rad, master.alt_m


def slave_at(master: Trajectory, row: int, omega_b: np.ndarray, parameters: PairParameters) -> Nav:
    """Where a record of the master puts the slave: nominal mounting, lever arm, no flexure."""
    q_nm = Rotation(jnp.asarray(master.q_nb[row]))
    at = Geodetic(*(jnp.asarray(a[row]) for a in _place(master)))
    v_n, arm = jnp.asarray(master.v_n[row]), jnp.asarray(parameters.lever_arm)
    q_ms = Rotation.from_euler(*parameters.mounting.nominal)
    return _moved(q_nm, v_n, at, q_ms, arm, jnp.asarray(omega_b))


@jax.jit
def _moved(q_nm: Rotation, v_n, at: Geodetic, q_ms: Rotation, arm, omega_b) -> Nav:
    arm_n = q_nm.apply(arm)
    omega_in = earth_rate_n(at.lat) + transport_rate_n(at.lat, at.alt, v_n)
    swing = q_nm.apply(jnp.cross(omega_b, arm)) - jnp.cross(omega_in, arm_n)
    return Nav(q_nm @ q_ms, v_n + swing, at.retract(arm_n))
