"""Replay of recorded logs: pieces, their estimates by filters and smoothers, and the outcome.

A log is cut where a gap is too long to bridge, and every piece is prepared as a world, from which a
`Contender` makes its case just as from a simulated one. The estimates of the pieces are
concatenated. A system provides the preparation, its contenders, and its own parts of the report.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from robins import rotation
from robins.filters import Belief, Code, StepWarning, Tally, doubts, rts_smoother, run
from robins.filters.analysis.consistency import grand_mean_nis
from robins.filters.consistency_limits import correlated_band
from robins.filters.kalman import WRONG
from robins.filters.run import Keep, Solution, Step, everything
from robins.filters.whiteness import joined
from robins.ins.blocks import cut, usual_width
from robins.ins.increments import Increments, after_gap
from robins.program import BuildError, ProgramError
from robins.program.scanned import mapped_rows
from robins.results import Outcome, Progress, ignore_progress, variable
from robins.systems.judgement import Metric
from robins.systems.parts import ImuBlock, LogPartition
from robins.systems.study import Case, Contender, SensorAxes, StateBlock
from robins.systems.suspects import probabilities, probability_array, sentences
from robins.systems.tables import (
    EULER,
    SensorUpdates,
    attitude_array,
    block_array,
    innovation_tables,
    updates,
)


@dataclass(frozen=True, kw_only=True)
class LogPiece:
    """A stretch of a log without a long gap, prepared for filters; E epochs.

    A system derives its own class to add what else it needs.
    """

    world: Any  # input of `Contender.case`
    begin_s: float  # on the clock of the log
    epoch_s: np.ndarray  # (E,)
    noise_scale: np.ndarray | float = 1.0  # (E,) multiplier of the process noise factor


class PreparedLog(NamedTuple):
    """A log prepared for its filters."""

    pieces: Sequence[LogPiece]
    contender: Callable[[str], Contender]  # by name; raises a ValueError if unknown


PROBABILITY = "imm.probability"  # note of a bank, (modes,); kept for every step, like `WRONG`

PieceT = TypeVar("PieceT", bound=LogPiece)


class FilterEstimates(NamedTuple):
    """Estimates of a filter or smoother on a log; leading axis E epochs, over all pieces."""

    name: str
    mean: Any
    sigma: Any  # (E, n)
    updates: Mapping[str, SensorUpdates]  # by sensor; empty for a smoother
    start: Belief  # before the first step of the last piece
    log_likelihood: float
    tally: Tally  # outcomes of the steps of each piece
    bounds: bool  # its sigmas are bounds of an H-infinity filter
    wrong: Mapping[str, Any] = {}  # (E,) probability by suspect
    by_jax: str = ""  # reason why the interpreter could not run the filter


class ReportedItems(NamedTuple):
    """Quantities that the replays of a system report for every filter."""

    blocks: Sequence[StateBlock]
    sensors: Mapping[str, SensorAxes]
    # mean, leading axis E -> (E, k) estimates by block, and "q_nb" (E, 4), the attitude, scalar
    # first; or "euler" [rad] along the axes of `euler` if the attitude is only partly known
    estimates: Callable[[Any], Mapping[str, Any]]
    causes: str  # sentence on the likely causes, added to a warning
    # sensors that do not exist as devices, such as "the wheels do not slip": their noise is a guess
    # on the cautious side, so that small innovations are no sign of a fault
    assumed: Collection[str] = ()
    euler: StateBlock = EULER  # how the attitude is reported; its frame is that of q_nb


# -------------------------------------------------------------------------------- log to pieces


def prepare_pieces(
    time_s: np.ndarray, dt_s: np.ndarray, longest_gap_s: float, prepare: Callable[[slice], PieceT]
) -> tuple[list[PieceT], list[str]]:
    """Split a log into the pieces that can be run, and explain in a sentence each that cannot.

    The inertial increments end at `time_s` (N,) and are `dt_s` (N,) long; one longer than
    `longest_gap_s` ends a piece and belongs to none. `prepare` makes a piece of a slice of rows,
    and raises a ValueError if they cannot be run.

    Raises:
        ValueError: no piece can be run; the message gives the reason.
    """
    edges = [-1, *np.flatnonzero(dt_s > longest_gap_s).tolist(), len(dt_s)]
    found, problems = [], []
    for before, end in pairwise(edges):
        first = before + 1
        if first == end:
            continue
        try:
            found.append(prepare(slice(first, end)))
        except ValueError as error:
            begin_s = time_s[first] - dt_s[first]
            problems.append(f"{begin_s:.1f} to {time_s[end - 1]:.1f} s: {error}")
    if not found:
        raise ValueError("; ".join(problems) or "the log has no two inertial samples in a row")
    return found, problems


def imu_blocks(
    increments: Increments,
    time_s: np.ndarray,
    begin_s: float,
    epochs: np.ndarray,
    partition: LogPartition,
    usual_s: float,
    spare: int = 0,
) -> ImuBlock:
    """Blocks (E, K) from epoch to epoch, and factors (E,) on their process noise.

    Args:
        increments: dt (N,), theta (N, 3), dv (N, 3).
        time_s: (N,) end of each.
        begin_s: s, beginning of the first block.
        epochs: (E,) s, end of each block.
        partition: of its `longest_block` the width K follows; `gap_noise` is the factor where
            samples are missing.
        usual_s: s, sampling interval.
        spare: increments by which K is larger.
    """
    width = usual_width(partition.longest_block, usual_s) + spare
    pieces, parent = cut(increments, time_s, begin_s, epochs, least=width)
    gap = after_gap(np.asarray(increments.dt), usual_s)
    missing = np.any(gap[parent] & (parent >= 0), axis=1)
    return ImuBlock(pieces, np.where(missing, partition.gap_noise, 1.0))


def gap_counts(pieces: Sequence[LogPiece], problems: Sequence[str]) -> dict[str, int]:
    """Numbers of gaps that ended a piece, and of blocks that bridge a shorter gap."""
    across = (np.sum(np.asarray(piece.noise_scale) > 1.0) for piece in pieces)
    return {
        "imu_gaps_declared": len(pieces) + len(problems) - 1,
        "blocks_over_imu_gaps": int(sum(across)),
    }


# ----------------------------------------------------------------------------- pieces to answers


def kept_step(step: Step) -> tuple[PyTree, Array, dict[str, SensorUpdates]]:
    """Keep the posterior's mean and standard deviations, and the updates by sensor.

    For a bank, also keep the probability of each mode.
    """
    return step.posterior.mean, step.posterior.sigma, updates(step, (PROBABILITY, WRONG))


def run_filters(
    pieces: Sequence[LogPiece],
    wanted: Sequence[str],
    contender: Callable[[str], Contender],
    smoothers: Mapping[str, str] | None = None,
    progress: Progress = ignore_progress,
) -> dict[str, FilterEstimates]:
    """Run filters and smoothers over all pieces; each filter runs once over a piece.

    Args:
        pieces: of a log, in the order of time.
        wanted: names of filters and smoothers.
        contender: filter with its model, by name; its error for an unknown name propagates.
        smoothers: name of each smoother -> name of the filter whose run it smooths.
        progress: called with the fraction done and the current task.
    """
    causal = {name: (smoothers or {}).get(name, name) for name in wanted}
    contenders = {name: contender(name) for name in dict.fromkeys(causal.values())}
    answers: dict[str, list[FilterEstimates]] = {name: [] for name in causal}
    for number, piece in enumerate(pieces):
        for done, (base, chosen) in enumerate(contenders.items()):
            share = (number + done / len(contenders)) / len(pieces)
            progress(share, f"{base}, piece {number + 1} of {len(pieces)}")
            asked = [name for name in causal if causal[name] == base]
            found = _piece_estimates(piece, chosen, smoothed=any(name != base for name in asked))
            for name in asked:
                answers[name].append(found[name != base]._replace(name=name))
    return {name: _joined(parts) for name, parts in answers.items()}


def _piece_estimates(
    piece: LogPiece, contender: Contender, smoothed: bool
) -> tuple[FilterEstimates, FilterEstimates]:
    """Estimates of a filter on a piece, and of its smoother (if not requested, the same again)."""
    filter_, case = contender.filter, contender.case(piece.world)
    with warnings.catch_warnings():
        # the outcome reports these among its warnings
        warnings.simplefilter("ignore", StepWarning)
        found, why = _run_case(
            contender, case, everything if smoothed else kept_step, piece.epoch_s
        )
        of_steps = mapped_rows(kept_step, found.steps) if smoothed else found.steps
    mean, sigma, seen = of_steps
    likelihood, bounds = float(found.log_likelihood), contender.bounds
    tally = found.tally.with_innovations(seen, case.y)
    wrong = probabilities(filter_, seen)
    answer = FilterEstimates(
        "", mean, sigma, seen, case.start, likelihood, tally, bounds, wrong, why
    )
    if not smoothed:
        return answer, answer
    belief = rts_smoother(found, machine="vm")
    sigma = np.linalg.norm(belief.factor, axis=-1)
    return answer, answer._replace(mean=belief.mean, sigma=sigma, updates={}, wrong={})


def _run_case(
    contender: Contender, case: Case, keep: Keep, time_s: np.ndarray
) -> tuple[Solution, str]:
    """Run by the interpreter, or, if it cannot, by JAX; and the reason for that ("" if none)."""
    arguments = contender.filter, contender.model, case.start, case.y, case.u, case.aux
    try:
        return run(*arguments, keep=keep, time_s=time_s, machine="vm"), ""
    except (BuildError, ProgramError) as error:
        return run(*arguments, keep=keep, time_s=time_s), str(error)


def _joined(parts: Sequence[FilterEstimates]) -> FilterEstimates:
    if len(parts) == 1:
        return parts[0]
    kept = "mean", "sigma", "updates", "wrong"
    whole = end_to_end([{name: getattr(a, name) for name in kept} for a in parts])
    return parts[-1]._replace(
        **whole, log_likelihood=sum(a.log_likelihood for a in parts), tally=_tally_of(parts)
    )


def _tally_of(parts: Sequence[FilterEstimates]) -> Tally:
    looks = [a.tally.looks for a in parts]
    tally = jax.tree_util.tree_map(
        lambda *x: np.stack(x), *[a.tally._replace(looks={}) for a in parts]
    )
    return tally._replace(looks={k: joined([look[k] for look in looks]) for k in looks[0]})


def epochs_of(pieces: Sequence[LogPiece]) -> np.ndarray:
    """Epochs (E,) [s] of all pieces, in the order of `end_to_end`; its blank rows get `begin_s`."""
    rows = [a for piece in pieces for a in (np.array([piece.begin_s]), piece.epoch_s)]
    return np.concatenate(rows[1:])


def end_to_end(trees: Sequence[PyTree]) -> PyTree:
    """Concatenate the results of the pieces, with a row of NaN between two: no curve crosses a gap.

    Arrays of another type than float have a zero there.
    """

    def join(*leaves: ArrayLike) -> jax.Array:
        rows = [np.asarray(leaf) for leaf in leaves]
        blank = np.full_like(rows[0][:1], np.nan if rows[0].dtype.kind == "f" else 0)
        return jnp.asarray(np.concatenate([rows[0], *(a for r in rows[1:] for a in (blank, r))]))

    return jax.tree_util.tree_map(join, *trees)


# ---------------------------------------------------------------------------- answers to outcome


def outcome(
    epoch_s: np.ndarray,
    answers: Mapping[str, FilterEstimates],
    reported: ReportedItems,
    *,
    metrics: Callable[[FilterEstimates], Mapping[str, Metric]],
    variables: Mapping[str, xr.Variable],
    counts: Mapping[str, int],
    notes: Sequence[str],
    origin_ns: int | None = None,
) -> Outcome:
    """Outcome of a replay: the solution, metrics and warnings common to all systems, and its own.

    Args:
        epoch_s: (E,) on the clock of the log.
        answers: estimates by filter.
        reported: quantities to report for every filter.
        metrics: figures of merit of an answer, in addition to the consistency of its innovations.
        variables: further variables of the solution, as `robins.results` lists them.
        counts: of samples and pieces.
        notes: sentences for the reader.
        origin_ns: stamp of the log at time zero of `epoch_s`, kept as an attribute.
    """
    doubtful = [
        f"{name}: {sentence}."
        for name, answer in answers.items()
        if answer.updates
        for sentence in doubts(answer.tally, bounds=answer.bounds, assumed=reported.assumed)
    ]
    compiled = [
        f"{name}: computed by JAX, which compiles first, as {answer.by_jax}"
        for name, answer in answers.items()
        if answer.by_jax
    ]
    suspicions = [s for k, a in answers.items() for s in sentences(k, epoch_s, a.wrong)]
    origin = {} if origin_ns is None else {"origin_ns": np.int64(origin_ns)}
    return Outcome(
        solution=xr.Dataset(_tables(epoch_s, answers, reported) | dict(variables), attrs=origin),
        metrics={
            name: dict(metrics(answer)) | _innovations(answer) for name, answer in answers.items()
        },
        counts=dict(counts),
        notes=[*notes, *suspicions, *compiled],
        warnings=[*doubtful, reported.causes] if doubtful else [],
    )


def _tables(
    epoch_s: np.ndarray, answers: Mapping[str, FilterEstimates], reported: ReportedItems
) -> dict[str, Any]:
    data: dict[str, Any] = {
        "filter": ("filter", list(answers)),
        "time": variable("time", epoch_s, "s", "time since the first inertial sample"),
    }
    found = [reported.estimates(answer.mean) for answer in answers.values()]
    for block in reported.blocks:
        sigma = [_sigma(answer, block) for answer in answers.values()]
        for role, rows in (("sigma", sigma), ("estimate", [of.get(block.name) for of in found])):
            if any(row is not None for row in rows):
                blank = np.full((len(epoch_s), len(block.axes)), np.nan)
                values = np.stack([blank if row is None else np.asarray(row) for row in rows])
                data |= block_array(role, block, values)
    if all("q_nb" in of for of in found):
        q_nb = np.stack([np.asarray(of["q_nb"]) for of in found])
        euler = np.stack(mapped_rows(rotation.to_euler, q_nb.reshape(-1, 4)), axis=-1)
        euler = euler.reshape(*q_nb.shape[:-1], 3)
        data |= attitude_array(q_nb, reported.euler.frame)
    else:
        euler = np.stack([np.asarray(of["euler"]) for of in found])
    data |= block_array("estimate", reported.euler, euler, "estimated roll, pitch, heading")
    seen = [answer.updates for answer in answers.values()]
    data |= probability_array("wrong", [answer.wrong for answer in answers.values()])
    return data | innovation_tables(seen, reported.sensors, epoch_s)


def _sigma(answer: FilterEstimates, block: StateBlock) -> np.ndarray | None:
    """Standard deviations (E, k) of a block; None if the filter lacks these states."""
    here = np.asarray(answer.sigma)[:, block.where]
    return here if here.shape[1] == len(block.axes) else None


def _innovations(answer: FilterEstimates) -> dict[str, Metric]:
    """Grand mean NIS with its band, and number of refusals, of each sensor with measurements.

    The band is that of `correlated_band`, since innovations of real data are correlated.
    An H-infinity filter has no NIS, since its bound is not a covariance.
    """
    out: dict[str, Any] = {}
    for sensor, update in answer.updates.items():
        refused = np.asarray(update.code) == Code.REFUSED
        used = np.asarray(update.dof) * ~refused
        if np.any(used) and not answer.bounds:
            out[f"nis_{sensor}"] = grand_mean_nis(np.asarray(update.nis), used).value
            out[f"nis_{sensor}_band"] = correlated_band(int(np.sum(used))).tolist()
        if np.any(used) or np.any(refused):
            out[f"refused_{sensor}"] = int(np.sum(refused))
    return out | ({"log_likelihood": answer.log_likelihood} if answer.updates else {})
