"""Align a recorded slave to its recorded master, with the results and their accuracy.

The tables of a `Dataset` hold the slave's samples (``imu``) and the master's records (``master``).
The slave starts at the state given by the master's first complete record. Errors of mounting,
flexure and that record enter the slave's attitude too, so the initial covariance correlates them. A
gap in the slave's samples that is too long to bridge ends a piece; the next one is aligned again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from robins import linalg, units
from robins.dataset import Dataset
from robins.filters import Belief
from robins.filters.values import Numbers
from robins.ins.frames import to_ned_frd
from robins.ins.increments import from_imu, usual_interval
from robins.ins.mechanise import nav_at, refuse_polar, vector
from robins.results import Outcome, Progress, ignore_progress, variable
from robins.rotation import Rotation
from robins.systems import replaying
from robins.systems.judgement import Metric
from robins.systems.replaying import FilterEstimates, LogPiece, ReportedItems
from robins.systems.study import Case, Contender, PairAlignment, Recipe
from robins.systems.tables import place_arrays
from robins.systems.transfer_alignment.product.filters import FILTERS
from robins.systems.transfer_alignment.product.model import ProductState
from robins.systems.transfer_alignment.product.parameters import PairParameters, PairReplay
from robins.systems.transfer_alignment.product.path import PairPath
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


def on_one_clock(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """The tables of a pair that was examined and cleaned (`robins.logs`), in NED/FRD.

    Returns:
        Increments of the slave (N, 8) and records of the master (M, 14), rows of `PairPath`; the
        slave's first sample is zero of their clock.

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
    rate = np.full_like(master.v_n, np.nan) if master.omega_ib_b is None else master.omega_ib_b
    records = np.column_stack([master_s, vector(nav_at(master, slice(None))), rate])
    return np.column_stack([time_s, *increments[:3]]), records


def pieces_of(
    increments: np.ndarray, records: np.ndarray, parameters: PairReplay
) -> tuple[list[LogPiece], list[str]]:
    """Pieces prepared for filters, and a sentence for each stretch that cannot be used.

    Args:
        increments: (N, 8), and
        records: (M, 14), see `on_one_clock`.
        parameters: of the replay.

    Raises:
        ValueError: no stretch can be used; the message gives the reason.
    """
    time_s, dt = increments[:, 0], increments[:, 1]
    path = partial(PairPath, parameters, usual_interval(dt))
    prepare = partial(_prepare, path, increments, records, parameters.master.delay)
    return replaying.prepare_pieces(time_s, dt, parameters.recording.longest_gap, prepare)


def _prepare(
    new_path: Callable[[], PairPath],
    increments: np.ndarray,
    records: np.ndarray,
    delay_s: float,
    rows: slice,
) -> LogPiece:
    path, end_s = new_path(), float(increments[rows][-1, 0])
    path.push(increments[rows])
    at_end = np.abs(records[:, 0] - end_s) <= 1e-9
    path.push_records(np.column_stack([np.where(at_end, end_s, records[:, 0]), records[:, 1:]]))
    path.end()
    if (found := path.start()) is None:
        late = f" (records are {delay_s:g} s old)" if delay_s else ""
        raise ValueError(
            "no record of the master with position, velocity and attitude, which the slave could "
            f"start from, while it was sampled{late}"
        )
    begin_s, start = found
    if not np.any(path.records[:, 0] <= end_s):
        only_s = begin_s + delay_s
        raise ValueError(f"the master has no record after the first whole one, {only_s:.1f} s")
    epochs = np.array([edge_s for edge_s, _ in path.due(begin_s, begin_s)])
    block, master, lag = path.steps(begin_s, epochs)
    world = PairRun(*block, start, np.zeros(9), master, lag.omega_m, None, lag)
    return LogPiece(
        world=jax.tree.map(jnp.asarray, world),
        begin_s=begin_s,
        epoch_s=epochs,
        noise_scale=np.asarray(block.noise_scale),
    )


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


def _started(piece: LogPiece, delay_s: float) -> str:
    old = f", which was {delay_s:g} s old" if delay_s else ""
    return (
        f"Aligned from {piece.begin_s:.2f} to {piece.epoch_s[-1]:.2f} s, starting from the "
        f"master's record of {piece.begin_s + delay_s:.2f} s{old}."
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
    increments, records = on_one_clock(dataset)
    pieces, problems = pieces_of(increments, records, parameters)
    wanted = tuple(filters) or parameters.filters
    answers = replaying.run_filters(
        pieces, wanted, partial(contender, parameters), progress=progress
    )
    notes = [_started(piece, parameters.master.delay) for piece in pieces]
    notes += [f"Not aligned, {problem}." for problem in problems]
    if not np.any(np.isfinite(records[:, 11:])) and any(parameters.lever_arm):
        notes.append("The master's turn rate was not recorded; the slave's gyros stand in for it.")
    notes += [line for name, answer in answers.items() for line in remarks(name, answer)]
    time, path = "master_time", tuple(records[:, 8:11].T)
    variables = {time: variable(time, records[:, 0], "s", "time of the master's records")}
    variables |= tracks({name: answer.mean for name, answer in answers.items()})
    variables |= place_arrays("reference", path, "{} of the master", dims=time)
    used = sum(int(np.sum(np.isin(records[:, 0], piece.epoch_s))) for piece in pieces)
    return replaying.outcome(
        replaying.epochs_of(pieces),
        answers,
        REPORTED,
        metrics=metrics_of,
        variables=variables,
        counts=dict(dataset.counts)
        | replaying.gap_counts(pieces, problems)
        | {"master_records_not_used": len(records) - used - len(pieces)},
        notes=notes,
        origin_ns=int(dataset.imu.time_ns[0]),
    )


def orientation(parameters: PairReplay) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of the master's axes as seen from the slave's."""
    back = Rotation.from_euler(*parameters.mounting.nominal).inverse()
    roll, pitch, yaw = (float(angle) for angle in back.as_euler())
    return roll, pitch, yaw


ALIGNMENT = PairAlignment("product", PairReplay, FILTERS, replay)
