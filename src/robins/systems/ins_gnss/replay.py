"""Navigate a recorded log: align, filter, smooth, and see how far it is from the fixes.

Two rates: every IMU sample is mechanised, the covariance moves once a block. A gap in the IMU that
is too long to bridge ends a piece of the log; the next piece is aligned anew.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from robins.dataset import Dataset
from robins.earth import Geodetic
from robins.filters import Solution, rts_smoother, run
from robins.ins.state import InsState
from robins.results import Outcome, Progress, silent
from robins.systems.ins_gnss.answer import Answer, Flight, replay_metrics, replay_solution
from robins.systems.ins_gnss.model import ROAD, STANDSTILL, STILL_RATE, Mount, read_position
from robins.systems.ins_gnss.parameters import Replay
from robins.systems.ins_gnss.prepare import Log, Prepared, on_one_clock, pieces, prepare
from robins.systems.ins_gnss.setup import SMOOTHED, make_filter, model_of, mount_of
from robins.systems.replaying import (
    doubts_told_at_the_end,
    end_to_end,
    replay_warnings,
    together,
)

CAUSES = (
    "Likely causes: the lever arm or the latency of the GNSS, the mounting of the unit, sigmas "
    "that the receiver states too small, noise of the IMU told too small, a velocity that is a "
    "mean over the receiver's interval, or a vehicle that was taken for still; `robins doctor` "
    "tells some of them."
)


@jax.jit
def _antenna(mount: Mount, mean: InsState, rate_b) -> Geodetic:
    return jax.vmap(lambda x, omega: read_position(mount, x, omega))(mean, rate_b)


def navigate(prepared: Prepared, parameters: Replay, wanted: tuple[str, ...]) -> dict[str, Answer]:
    """Run the filters over a piece of a log, each once, and their smoothers."""
    model = model_of(parameters.imu, parameters.gnss, parameters.aids)
    mount = mount_of(parameters.gnss, parameters.aids)
    rate = jnp.asarray(prepared.rate_b)
    solutions: dict[str, Solution] = {}
    out: dict[str, Answer] = {}
    for name in wanted:
        base = name.removesuffix(SMOOTHED)
        if base not in solutions:
            filter_ = make_filter(base, parameters.update.gate)
            p = prepared
            with doubts_told_at_the_end():
                solutions[base] = run(filter_, model, p.belief, p.y, p.u, p.aux)
        solution = solutions[base]
        smoothed = name.endswith(SMOOTHED)
        belief = rts_smoother(solution) if smoothed else solution.steps.posterior
        info = {} if smoothed else solution.steps.info
        out[name] = Answer(
            belief,
            _antenna(mount, belief.mean, rate),
            info,
            float(solution.log_likelihood),
            None if smoothed else solution.tally,
        )
    return out


def _joined(answers: list[Answer]) -> Answer:
    """The answers of all pieces, laid out as `end_to_end` does."""
    if len(answers) == 1:
        return answers[0]
    belief, place, info = end_to_end([(a.belief, a.antenna, a.info) for a in answers])
    likelihood = sum(a.log_likelihood for a in answers)
    return Answer(belief, place, info, likelihood, together([a.tally for a in answers]))


def _flight(log: Log, parts: list[Prepared]) -> Flight:
    """The epochs and fixes of all pieces together, laid out as `end_to_end` does."""
    epoch, withheld = [], []
    fix_epoch = np.full(len(log.gnss), -1)
    for part in parts:
        if epoch:
            epoch.append(np.array([part.start.time_s]))
            withheld.append(np.zeros(1, dtype=bool))
        offset = sum(len(e) for e in epoch)
        here = part.fix_epoch >= 0
        fix_epoch[here] = part.fix_epoch[here] + offset
        epoch.append(part.blocks.epoch_s)
        withheld.append(part.withheld)
    return Flight(log, np.concatenate(epoch), np.concatenate(withheld), fix_epoch)


def _with_lever_arm(dataset: Dataset, parameters: Replay) -> Replay:
    """The parameters with the lever arm that the dataset was loaded with.

    Raises:
        ValueError: the parameters have another.
    """
    arm, other = dataset.lever_arm_b_m, parameters.gnss.lever_arm
    if arm is None:
        return parameters
    if any(other) and not np.allclose(arm, other, rtol=0.0, atol=1e-6):
        raise ValueError(
            f"the log was loaded with a lever arm of {arm} m, and gnss.lever_arm is {other} m; "
            "give one of the two"
        )
    gnss = parameters.gnss.model_copy(update={"lever_arm": arm})
    return parameters.model_copy(update={"gnss": gnss})


def replay(
    dataset: Dataset,
    parameters: Replay,
    filters: tuple[str, ...] = (),
    progress: Progress = silent,
) -> Outcome:
    """Navigate a log with the filters named and say how good they are.

    Args:
        dataset: IMU and GNSS of a log, examined and cleaned (`robins.logs`).
        parameters: what the files do not say.
        filters: names such as "ekf", "ukf", "ekf+rts"; by default those of the parameters.
        progress: called with the share done and what is being done.

    Raises:
        ValueError: the log cannot be navigated; the sentence says why and what to do.
    """
    wanted = tuple(filters) or parameters.filters
    parameters = _with_lever_arm(dataset, parameters)
    log = on_one_clock(dataset, parameters)
    found = pieces(log, parameters.update.longest_gap)
    parts: list[Prepared] = []
    answers: dict[str, list[Answer]] = {name: [] for name in wanted}
    notes, problems = [], []
    for number, piece in enumerate(found):
        progress(number / len(found), f"piece {number + 1} of {len(found)}")
        span = f"{log.time_s[piece.start]:.1f} to {log.time_s[piece.stop - 1]:.1f} s"
        try:
            part = prepare(log, piece, parameters)
        except ValueError as error:
            problems.append(f"Not navigated, {span}: {error}.")
            continue
        parts.append(part)
        notes.append(f"Start: {part.start.sentence}.")
        for name, answer in navigate(part, parameters, wanted).items():
            answers[name].append(answer)
    if not parts:
        raise ValueError(" ".join(problems))
    flight = _flight(log, parts)
    joined = {name: _joined(rows) for name, rows in answers.items()}
    counts = dict(dataset.counts) | {
        "imu_gaps_declared": len(found) - 1,
        "blocks_over_imu_gaps": sum(int(np.sum(np.asarray(p.u.noise_scale) > 1)) for p in parts),
        "pieces_not_navigated": len(problems),
    }
    return Outcome(
        solution=replay_solution(flight, joined, parameters),
        metrics={name: replay_metrics(flight, answer) for name, answer in joined.items()},
        counts=counts,
        notes=notes + problems,
        warnings=replay_warnings(
            {name: a.tally for name, a in joined.items() if a.tally is not None},
            CAUSES,
            assumed=(STANDSTILL, STILL_RATE, ROAD),
        ),
    )
