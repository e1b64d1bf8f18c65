"""Align a recorded slave to its recorded master: filter, and say what came out and how well.

The slave begins where the first whole record of the master puts it. What is unknown about that, the
mounting, the flexure and the noise of the record, is in its attitude too, so the initial covariance
correlates them. A gap in the slave's samples that is too long to bridge ends a piece; the next one
is aligned anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pydantic
from jax.tree_util import Partial

from robins import linalg
from robins.dataset import Dataset
from robins.filters import Belief, Model, Motion, run
from robins.ins.frames import to_ned_frd
from robins.results import Outcome, Progress, silent
from robins.rotation import Rotation
from robins.systems.parts import Names
from robins.systems.replaying import (
    doubts_told_at_the_end,
    end_to_end,
    replay_warnings,
    together,
)
from robins.systems.study import Contender
from robins.systems.system import Alignment
from robins.systems.transfer_alignment.pair_answer import (
    Answer,
    Recorded,
    metrics_of,
    remarks,
    solution_of,
)
from robins.systems.transfer_alignment.pair_log import Piece, Recording, pieces_of
from robins.systems.transfer_alignment.pair_parameters import (
    Aircraft,
    PairParameters,
    Ship,
    Vehicle,
)
from robins.systems.transfer_alignment.product_filters import FILTERS, product_contender
from robins.systems.transfer_alignment.product_problem import Product

CAUSES = (
    "Likely causes: a delay of the master that is not stated, a sign or frame of its velocity or "
    "attitude (down for up, heading counterclockwise), a nominal mounting or lever arm that is "
    "wrong, flexure without states for it, or noise of master and slave told too small."
)


class Replay(Product):
    """What is believed of a recorded pair; the log brings its own motion."""

    manoeuvre: (  # pyright: ignore[reportIncompatibleVariableOverride]
        Annotated[Aircraft | Ship | Vehicle, pydantic.Field(discriminator="kind")] | None
    ) = None
    recording: Recording = pydantic.Field(default_factory=Recording)
    filters: Names = ("product",)


_ATTITUDE, _MOUNTING, _FLEXURE = slice(0, 3), slice(15, 18), slice(18, 21)


class Bridged(NamedTuple):
    """Input of a step that may lie across a gap."""

    u: Any
    noise_scale: Any  # () of the process noise factor


def _step(motion: Motion, x, bridged: Bridged):
    return motion.step(x, bridged.u)


def _noise(motion: Motion, x, bridged: Bridged):
    return motion.noise_factor(x, bridged.u) * bridged.noise_scale


def _linear(motion: Motion, x, bridged: Bridged):
    assert motion.linear is not None
    new, F, noise = motion.linear(x, bridged.u)
    return new, F, noise * bridged.noise_scale


def over_gaps(model: Model) -> Model:
    """The model with `Bridged` inputs: the same motion, with more process noise across a gap."""
    motion = model.motion
    linear = None if motion.linear is None else Partial(_linear, motion)
    return Model(Motion(Partial(_step, motion), Partial(_noise, motion), linear), model.sensors)


def start_belief(belief: Belief, parameters: PairParameters) -> Belief:
    """Add to an uncorrelated start that the slave's attitude comes from a record of the master.

    To first order the attitude error is ``C_ns mu + C_nm lambda`` and the noise of the record, all
    of which come on top of what `belief` doubts by itself; noise of the record is also in velocity
    and position.
    """
    ins = belief.mean.ins
    C_ns = ins.q_nb.as_dcm()
    q_ms = Rotation.from_euler(*parameters.mounting.nominal)
    C_nm = (ins.q_nb @ q_ms.inverse()).as_dcm()
    S, n = jnp.asarray(belief.factor), belief.factor.shape[-1]
    attitude = S[_ATTITUDE] + C_ns @ S[_MOUNTING]
    if n > _FLEXURE.start:
        attitude = attitude + C_nm @ S[_FLEXURE]
    m = parameters.master
    noise = jnp.asarray([*m.attitude_noise, *m.velocity_noise, *m.position_noise])
    of_record = jnp.pad(jnp.diag(noise), ((0, n - 9), (0, 0)))
    return Belief(belief.mean, linalg.tria(S.at[_ATTITUDE].set(attitude), of_record))


def aligned(piece: Piece, contender: Contender, parameters: PairParameters) -> Answer:
    """What one filter makes of a piece."""
    case = contender.case(piece.run)
    start = start_belief(case.start, parameters)
    inputs = Bridged(case.u, jnp.asarray(piece.noise_scale))
    filter_, model = contender.filter, over_gaps(contender.model)
    with doubts_told_at_the_end():
        found = run(filter_, model, start, case.y, inputs, case.aux, time_s=piece.epoch_s)
    steps = found.steps
    likelihood = float(found.log_likelihood)
    belief, info = steps.posterior, steps.info
    return Answer(belief, info, start, likelihood, contender.bounds, found.tally)


def _joined(answers: list[Answer]) -> Answer:
    """The answers of all pieces, laid out as `end_to_end` does."""
    if len(answers) == 1:
        return answers[0]
    belief, info = end_to_end([(a.belief, dict(a.info)) for a in answers])
    return answers[-1]._replace(
        belief=belief,
        info=info,
        log_likelihood=sum(a.log_likelihood for a in answers),
        tally=together([a.tally for a in answers]),
    )


def align(
    dataset: Dataset,
    parameters: PairParameters,
    recording: Recording,
    contenders: Mapping[str, Contender],
    progress: Progress = silent,
) -> Outcome:
    """Align the slave of a recorded pair with each filter.

    Args:
        dataset: the slave's samples and the master's records, examined and cleaned (`robins.logs`).
        parameters: what is believed of both units, of the mounting and of the flexure.
        recording: how the log is cut into steps.
        contenders: by name, filters of the product model; each makes its case of a `PairRun`.
        progress: called with the share done and what is being done.

    Raises:
        ValueError: the pair cannot be aligned; the sentence says why.
    """
    pieces, problems = pieces_of(dataset, parameters, recording)
    answers: dict[str, Answer] = {}
    for i, (name, contender) in enumerate(contenders.items()):
        progress(i / len(contenders), f"aligning with {name}")
        answers[name] = _joined([aligned(p, contender, parameters) for p in pieces])
    assert dataset.master is not None
    master = to_ned_frd(dataset.master)
    origin = int(dataset.imu.time_ns[0])
    recorded = Recorded(_epochs(pieces), master, (master.time_ns - origin) * 1e-9)
    used = sum(int(np.sum(p.record >= 0)) for p in pieces)
    counts = dict(dataset.counts) | {
        "imu_gaps_declared": len(pieces) + len(problems) - 1,
        "blocks_over_imu_gaps": sum(int(np.sum(p.noise_scale > 1.0)) for p in pieces),
        "master_records_not_used": len(master) - used - len(pieces),
    }
    notes = [_started(p, recorded.master_s, parameters) for p in pieces]
    notes += [f"Not aligned, {problem}." for problem in problems]
    if master.omega_ib_b is None and any(parameters.lever_arm):
        notes.append("The master's turn rate was not recorded; the slave's gyros stand in for it.")
    notes += [line for name, answer in answers.items() for line in remarks(name, answer)]
    return Outcome(
        solution=solution_of(recorded, answers),
        metrics={name: metrics_of(answer) for name, answer in answers.items()},
        counts=counts,
        notes=notes,
        warnings=replay_warnings(
            {name: answer.tally for name, answer in answers.items()},
            CAUSES,
            bounds=[name for name, contender in contenders.items() if contender.bounds],
        ),
    )


def replay(
    dataset: Dataset,
    parameters: Replay,
    filters: tuple[str, ...] = (),
    progress: Progress = silent,
) -> Outcome:
    """Align a recorded pair with the filters named; see `align`.

    Raises:
        ValueError: no such filter; or the pair cannot be aligned.
    """
    wanted = tuple(filters) or parameters.filters
    contenders = {name: product_contender(parameters, name, parameters.believed) for name in wanted}
    return align(dataset, parameters, parameters.recording, contenders, progress)


def orientation(parameters: Replay) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of the master's axes as seen from the slave's."""
    back = Rotation.from_euler(*parameters.mounting.nominal).inverse()
    roll, pitch, yaw = (float(angle) for angle in back.as_euler())
    return roll, pitch, yaw


ALIGNMENT = Alignment("product", Replay, FILTERS, replay)


def _epochs(pieces: list[Piece]) -> np.ndarray:
    """(E,) of all pieces, laid out as `end_to_end` does."""
    rows = [a for p in pieces for a in (np.array([p.start_s]), p.epoch_s)]
    return np.concatenate(rows[1:])


def _started(piece: Piece, master_s: np.ndarray, parameters: PairParameters) -> str:
    delay = parameters.master.delay
    old = f", which was {delay:g} s old" if delay else ""
    return (
        f"Aligned from {piece.start_s:.2f} to {piece.epoch_s[-1]:.2f} s, starting from the "
        f"master's record of {master_s[piece.first]:.2f} s{old}."
    )
