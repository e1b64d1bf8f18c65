"""Align a recorded slave to its recorded master, with the results and their accuracy.

The tables of a `Dataset` hold the slave's samples (``imu``) and the master's records (``master``).
The slave starts at the state given by the master's first complete record. Errors of mounting,
flexure and that record enter the slave's attitude too, so the initial covariance correlates them. A
gap in the slave's samples that is too long to bridge ends a piece; the next one is aligned again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins import linalg, units
from robins.dataset import Dataset, Trajectory
from robins.earth import earth_rate_n, transport_rate_n
from robins.filters import Belief
from robins.filters.values import Numbers
from robins.ins.blocks import cut, epochs_between
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav, nav_at, refuse_polar, vector
from robins.results import Outcome, Progress, ignore_progress, variable
from robins.rotation import Rotation
from robins.systems import replaying
from robins.systems.judgement import Metric
from robins.systems.replaying import FilterEstimates, LogPiece, ReportedItems
from robins.systems.study import Case, Contender, PairAlignment, Recipe
from robins.systems.tables import place_arrays
from robins.systems.transfer_alignment.product.filters import FILTERS
from robins.systems.transfer_alignment.product.model import Installation, ProductState
from robins.systems.transfer_alignment.product.parameters import PairParameters, PairReplay
from robins.systems.transfer_alignment.product.study import (
    BLOCKS,
    SENSORS,
    installation_of,
    product_contender,
    tracks,
)
from robins.systems.transfer_alignment.product.world import PairRun

_ATTITUDE, _MOUNTING, _FLEXURE = slice(0, 3), slice(15, 18), slice(18, 21)


# -------------------------------------------------------------------------------- log to pieces


class RecordedPair(NamedTuple):
    """A recorded pair on one clock, whose zero is the slave's first sample; NED/FRD."""

    increments: Increments  # of the slave: (N,), (N, 3), (N, 3)
    time_s: np.ndarray  # (N,) end of each
    master: Trajectory
    master_s: np.ndarray  # (M,)


@dataclass(frozen=True, kw_only=True)
class PairPiece(LogPiece):
    """A stretch of a recorded pair without a long gap in the slave's samples."""

    world: PairRun
    record: np.ndarray  # (E,) row of the master's table used there, -1 where there is none
    first: int  # row of the initial state


def on_one_clock(dataset: Dataset) -> RecordedPair:
    """The tables of a pair that was examined and cleaned (`robins.logs`).

    Raises:
        ValueError: there is no master, or it has no record within the slave's log.
    """
    if dataset.master is None or len(dataset.master) == 0:
        raise ValueError("a recorded pair needs the records of a master; this log has none")
    master = to_ned_frd(dataset.master)
    refuse_polar(master.lat_rad[np.isfinite(master.lat_rad)])
    increments, end_ns = from_imu(dataset.imu)
    origin = int(dataset.imu.time_ns[0])
    time_s, master_s = (end_ns - origin) * 1e-9, (master.time_ns - origin) * 1e-9
    if not np.any((master_s > 0.0) & (master_s <= time_s[-1])):
        raise ValueError(
            f"no record of the master lies within the slave's log: the slave spans 0 to "
            f"{time_s[-1]:.1f} s, the master {master_s[0]:.1f} to {master_s[-1]:.1f} s; do both "
            "use the same time scale?"
        )
    return RecordedPair(
        Increments(*(np.asarray(a, float) for a in increments[:3])), time_s, master, master_s
    )


def pieces_of(recorded: RecordedPair, parameters: PairReplay) -> tuple[list[PairPiece], list[str]]:
    """Pieces prepared for filters, and a sentence for each stretch that cannot be used.

    Raises:
        ValueError: no stretch can be used; the message gives the reason.
    """
    longest = parameters.recording.longest_gap
    prepare = partial(_prepare, recorded, parameters)
    return replaying.prepare_pieces(
        recorded.time_s, np.asarray(recorded.increments.dt), longest, prepare
    )


def _prepare(recorded: RecordedPair, parameters: PairReplay, rows: slice) -> PairPiece:
    increments = Increments(*(np.asarray(a)[rows] for a in recorded.increments[:3]))
    time_s, master_s, delay = recorded.time_s[rows], recorded.master_s, parameters.master.delay
    begin_s, end_s = float(time_s[0] - increments.dt[0]), float(time_s[-1])
    reported = nav_at(recorded.master, slice(None))
    whole = np.isfinite(np.asarray(vector(reported))).all(axis=1)
    within = (master_s - delay >= begin_s - 1e-9) & (master_s <= end_s + 1e-9)
    if not np.any(within & whole):
        late = f" (records are {delay:g} s old)" if delay else ""
        raise ValueError(
            "no record of the master with position, velocity and attitude, which the slave could "
            f"start from, while it was sampled{late}"
        )
    k = int(np.flatnonzero(within & whole)[0])
    start_s = float(np.clip(master_s[k] - delay, begin_s, end_s))
    used = np.flatnonzero((master_s > master_s[k]) & (master_s <= end_s + 1e-9))
    if len(used) == 0:
        raise ValueError(f"the master has no record after the first whole one, {master_s[k]:.1f} s")
    stamps, recording = np.minimum(master_s[used], end_s), parameters.recording
    epochs = epochs_between(start_s, end_s, stamps, recording.longest_block)
    blocks = cut(increments, time_s, start_s, epochs)
    record = np.full(len(epochs), -1)
    record[np.searchsorted(epochs, stamps - 1e-9)] = used

    def at_epochs(values: Numbers, fill: float = np.nan) -> np.ndarray:
        known = (record >= 0).reshape(-1, *([1] * (np.ndim(values) - 1)))
        return np.where(known, np.asarray(values)[record], fill)

    at = installation_of(parameters)
    at_s = np.clip(master_s - delay, begin_s, end_s)
    of_slave = _gyro_rate(increments, time_s, float(np.median(recorded.increments.dt)), at_s)
    turn = np.asarray(at.q_ms.apply(jnp.asarray(of_slave)))
    if (omega := recorded.master.omega_ib_b) is not None:
        turn = np.where(np.isfinite(omega), omega, turn)
    scale = replaying.noise_scale(blocks, np.asarray(increments.dt), recording.gap_noise)
    world = PairRun(
        increments=blocks.increments,
        noise_scale=scale,
        start=_slave_of(jax.tree.map(lambda x: x[k], reported), at, jnp.asarray(turn[k])),
        initial_error=np.zeros(9),
        master=jax.tree.map(at_epochs, reported),
        master_omega_b=at_epochs(turn, 0.0),
        truth=None,
    )
    return PairPiece(
        world=jax.tree.map(jnp.asarray, world),
        begin_s=start_s,
        epoch_s=epochs,
        noise_scale=scale,
        record=record,
        first=k,
    )


def _gyro_rate(
    increments: Increments, time_s: np.ndarray, usual_dt: float, at_s: np.ndarray
) -> np.ndarray:
    """Mean of the gyros over 10 ms, or a sample, to either side of times (M,): (M, 3) rad/s.

    Rotated by the nominal mounting it replaces the master's angular rate where that was not
    recorded: with a lever arm of metres, biases and mounting error are negligible.
    """
    edge_s = np.concatenate([[time_s[0] - increments.dt[0]], time_s])
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(increments.theta, axis=0)])
    # towards an end of the samples both sides become shorter, so that the mean stays centred
    half = np.minimum(max(0.01, usual_dt), np.minimum(at_s - edge_s[0], edge_s[-1] - at_s))
    half = np.maximum(half, 0.5 * usual_dt)

    def until(t):
        return np.stack([np.interp(t, edge_s, a) for a in angle.T], -1)

    early, late = (np.clip(at_s + k * half, edge_s[0], edge_s[-1]) for k in (-1.0, 1.0))
    return (until(late) - until(early)) / (late - early)[:, None]


@jax.jit
def _slave_of(master: Nav, at: Installation, omega_b) -> Nav:
    """State of the slave from a master record: nominal mounting, lever arm, no flexure."""
    q_nm, v_n, place = master
    arm_n = q_nm.apply(at.lever_m)
    omega_in = earth_rate_n(place.lat) + transport_rate_n(place.lat, place.alt, v_n)
    swing = q_nm.apply(jnp.cross(omega_b, at.lever_m)) - jnp.cross(omega_in, arm_n)
    return Nav(q_nm @ at.q_ms, v_n + swing, place.retract(arm_n))


def start_belief(belief: Belief, parameters: PairParameters) -> Belief:
    """Correlate an uncorrelated start for a slave attitude that comes from a master record.

    To first order the attitude error is ``C_ns mu + C_nm lambda`` plus the noise of the record, all
    added to the uncertainty of `belief`; noise of the record is also in velocity and position.
    """
    q_ns, q_ms = belief.mean.ins.q_nb, installation_of(parameters).q_ms
    S, n = jnp.asarray(belief.factor), belief.factor.shape[-1]
    attitude = S[_ATTITUDE] + q_ns.as_dcm() @ S[_MOUNTING]
    if n > _FLEXURE.start:
        attitude = attitude + (q_ns @ q_ms.inverse()).as_dcm() @ S[_FLEXURE]
    m = parameters.master
    noise = jnp.asarray([*m.attitude_noise, *m.velocity_noise, *m.position_noise])
    of_record = jnp.pad(jnp.diag(noise), ((0, n - 9), (0, 0)))
    return Belief(belief.mean, linalg.tria(S.at[_ATTITUDE].set(attitude), of_record))


def contender(parameters: PairReplay, name: str) -> Contender:
    """A filter of the product model, for pieces of a recorded pair.

    Raises:
        ValueError: no such filter; a noise of the master that is zero.
    """
    made = product_contender(parameters, name, parameters.believed)
    return replace(made, case=Recipe(_case, (parameters,), made.case))


def _case(parameters: PairReplay, simulated: Recipe, run: PairRun) -> Case:
    """The case of a simulated pair with another start."""
    given = simulated(run)
    return given._replace(start=start_belief(given.start, parameters))


# ---------------------------------------------------------------------------------------- results


def _estimates(mean: ProductState) -> Mapping[str, Numbers]:
    """Blocks that are vectors, and the attitude of the slave."""
    found = {
        "velocity": mean.ins.v_n,
        "gyro_bias": mean.ins.gyro_bias,
        "accel_bias": mean.ins.accel_bias,
        "mounting": mean.mounting_rad,
        "q_nb": mean.ins.q_nb.wxyz,
    }
    return found if mean.flexure is None else found | {"flexure": mean.flexure[..., :3]}


REPORTED = ReportedItems(
    blocks=BLOCKS,
    sensors=SENSORS,
    estimates=_estimates,
    causes="Likely causes: a delay of the master that is not stated, a sign or frame of its "
    "velocity or attitude (down for up, heading counterclockwise), a nominal mounting or lever arm "
    "that is wrong, flexure without states for it, or noise of master and slave stated too small.",
)
_FOUND = ("gyro_bias", "accel_bias", "mounting")  # results of an alignment, besides the attitude
_UNKNOWN = 0.7  # of the initial sigma; a component that keeps more was hardly observed
_LARGE_RAD = np.deg2rad(5.0)


def metrics_of(answer: FilterEstimates) -> dict[str, Metric]:
    """Mounting, biases and attitude at the end with their sigmas."""
    out: dict[str, Any] = {}
    found, last = _estimates(answer.mean), np.asarray(answer.sigma)[-1]
    for block in BLOCKS:
        name, shown = block.name, (block.units, block.display_unit)
        ending = units.as_ending(block.display_unit)
        if name in _FOUND:
            value = units.convert(np.asarray(found[name])[-1], *shown)
            out[f"{name}_{ending}"] = value.tolist()
        if name in ("attitude", *_FOUND):
            sigma = units.convert(last[block.where], *shown)
            out[f"{name}_sigma_{ending}"] = sigma.tolist()
    return out


def remarks(name: str, answer: FilterEstimates) -> list[str]:
    """Sentences on unobserved components, and on a mounting far from the nominal one."""
    remarks_found = []
    before, after = np.asarray(answer.start.sigma), np.asarray(answer.sigma)[-1]
    for block in BLOCKS:
        hidden = [
            axis
            for axis, s, t in zip(block.axes, before[block.where], after[block.where], strict=False)
            if t > _UNKNOWN * s > 0
        ]
        if hidden and block.name in _FOUND:
            remarks_found.append(
                f"{name}: {block.name.replace('_', ' ')} {', '.join(hidden)} was hardly observed; "
                "its sigma is near what it was before. Another manoeuvre would show it."
            )
    size = float(np.linalg.norm(answer.mean.mounting_rad[-1]))
    if size > _LARGE_RAD:
        remarks_found.append(
            f"{name}: the slave sits {np.degrees(size):.1f} deg from its nominal mounting. Models "
            "of first order do not hold beyond 5 deg; this one keeps whole rotations, but a better "
            "nominal mounting makes it converge sooner."
        )
    return remarks_found


def _started(piece: PairPiece, recorded: RecordedPair, delay_s: float) -> str:
    old = f", which was {delay_s:g} s old" if delay_s else ""
    return (
        f"Aligned from {piece.begin_s:.2f} to {piece.epoch_s[-1]:.2f} s, starting from the "
        f"master's record of {recorded.master_s[piece.first]:.2f} s{old}."
    )


def replay(
    dataset: Dataset,
    parameters: PairReplay,
    filters: tuple[str, ...] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Align the slave of a recorded pair, examined and cleaned; see `System.replay`.

    Raises:
        ValueError: no such filter; or the pair cannot be aligned, the message gives the reason.
    """
    recorded = on_one_clock(dataset)
    pieces, problems = pieces_of(recorded, parameters)
    wanted = tuple(filters) or parameters.filters
    answers = replaying.run_filters(
        pieces, wanted, partial(contender, parameters), progress=progress
    )
    master = recorded.master
    notes = [_started(piece, recorded, parameters.master.delay) for piece in pieces]
    notes += [f"Not aligned, {problem}." for problem in problems]
    if master.omega_ib_b is None and any(parameters.lever_arm):
        notes.append("The master's turn rate was not recorded; the slave's gyros stand in for it.")
    notes += [line for name, answer in answers.items() for line in remarks(name, answer)]
    time, path = "master_time", (master.lat_rad, master.lon_rad, master.alt_m)
    variables = {time: variable(time, recorded.master_s, "s", "time of the master's records")}
    variables |= tracks({name: answer.mean for name, answer in answers.items()})
    variables |= place_arrays("reference", path, "{} of the master", dims=time)
    used = sum(int(np.sum(piece.record >= 0)) for piece in pieces)
    return replaying.outcome(
        replaying.epochs_of(pieces),
        answers,
        REPORTED,
        metrics=metrics_of,
        variables=variables,
        counts=dict(dataset.counts)
        | replaying.gap_counts(pieces, problems)
        | {"master_records_not_used": len(master) - used - len(pieces)},
        notes=notes,
        origin_ns=int(dataset.imu.time_ns[0]),
    )


def orientation(parameters: PairReplay) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of the master's axes as seen from the slave's."""
    back = Rotation.from_euler(*parameters.mounting.nominal).inverse()
    roll, pitch, yaw = (float(angle) for angle in back.as_euler())
    return roll, pitch, yaw


ALIGNMENT = PairAlignment("product", PairReplay, FILTERS, replay)
