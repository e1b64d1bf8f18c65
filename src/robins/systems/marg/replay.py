"""Replay a nine-axis log: align, filter, smooth, and see how far it is from the truth if known."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from robins.dataset import Dataset
from robins.filters import Belief, Code, Filter, Model, rts_smoother, run
from robins.filters.run import Step
from robins.results import Outcome, Progress, silent
from robins.systems.marg.answer import Answer, metrics, sentences, solution
from robins.systems.marg.blocks import causal_attitudes, smoothed_attitudes
from robins.systems.marg.model import REST_RATE, TRAVEL
from robins.systems.marg.parameters import Replay
from robins.systems.marg.prepare import Prepared, prepare
from robins.systems.marg.setup import CAUSAL, SMOOTHED, filter_of, model_of
from robins.systems.replaying import doubts_told_at_the_end, replay_warnings
from robins.systems.tables import updates

CAUSES = (
    "Likely causes: a magnetometer without calibration (`robins calibrate`) or beside iron, axes "
    "or units of a sensor that differ from what the log says, or noise of the gyro told too small."
)


class Light(NamedTuple):
    """What is kept of a step where nothing is smoothed."""

    mean: Any
    sigma: Any
    info: Any  # by sensor, an `Update`
    failed: Any  # () the prediction was not taken


def light(step: Step) -> Light:
    """Keep the posterior's mean and standard deviations and how the updates went."""
    return Light(
        step.posterior.mean,
        step.posterior.sigma,
        updates(step),
        step.prediction.code != int(Code.DONE),
    )


@jax.jit
def _light_of(steps: Step) -> Light:
    return jax.vmap(light)(steps)


def orient(
    log: Prepared, filter_: Filter, model: Model, wanted: tuple[str, ...]
) -> tuple[dict[str, Answer], int]:
    """Run the filter over a log once, and its smoother if that is wanted.

    Args:
        log: from `prepare`.
        filter_: from `setup.filter_of`, or any other of the same model.
        model: from `setup.model_of`.
        wanted: names out of "marg" and "marg-smoothed".

    Returns:
        Answers by name, and the number of steps that could not be taken.
    """
    smooth = SMOOTHED in wanted
    arguments = (filter_, model, log.start, log.y, log.u, log.aux)
    with doubts_told_at_the_end():
        found = run(*arguments) if smooth else run(*arguments, keep=light)
    kept = _light_of(found.steps) if smooth else found.steps
    blocks = len(log.epoch_s)
    kept, likelihood = _cut(kept, blocks), float(found.log_likelihood)
    out = {}
    if CAUSAL in wanted:
        mean = found.steps.posterior.mean if smooth else found.steps.mean
        q = causal_attitudes(log.start.mean, mean, log.samples)
        q_nb = _by_sample(log, q, log.look.q_nb)
        sigma = np.asarray(kept.sigma)
        out[CAUSAL] = Answer(kept.mean, sigma, q_nb, kept.info, likelihood, found.tally)
    if smooth:
        belief: Belief = rts_smoother(found)
        q, first = smoothed_attitudes(belief.mean, log.samples)
        sigma = np.asarray(belief.sigma)[:blocks]
        q_nb = _by_sample(log, q, first)
        out[SMOOTHED] = Answer(_cut(belief.mean, blocks), sigma, q_nb, {}, likelihood)
    return {name: out[name] for name in wanted}, int(np.sum(kept.failed))


def _cut(tree: Any, blocks: int) -> Any:
    """Without the padding, as NumPy."""
    return jax.tree_util.tree_map(lambda x: np.asarray(x)[:blocks], tree)


def _by_sample(log: Prepared, q: Any, first: Any) -> np.ndarray:
    rows = np.asarray(q).reshape(-1, 4)[: log.used]
    return np.concatenate([np.asarray(first)[None], rows])


def replay(
    dataset: Dataset,
    parameters: Replay,
    filters: tuple[str, ...] = (),
    progress: Progress = silent,
) -> Outcome:
    """Find the orientation over a log and say how good it is.

    Args:
        dataset: inertial samples; magnetic field and true attitude where there are.
        parameters: what the files do not say.
        filters: "marg" and "marg-smoothed"; by default those of the parameters.
        progress: called with the share done and what is being done.

    Raises:
        ValueError: the log cannot be used; the sentence says why.
    """
    wanted = tuple(dict.fromkeys(tuple(filters) or parameters.filters))
    progress(0.0, "integrating blocks")
    log = prepare(dataset, parameters)
    progress(0.2, "filtering")
    answers, failed = orient(log, filter_of(parameters), model_of(parameters), wanted)
    progress(0.9, "measuring")
    notes = sentences(log, answers)
    if dataset.mag is None:
        notes.append("There is no magnetometer in this log: the heading is that of the gyros.")
    return Outcome(
        solution=solution(dataset, log, answers),
        metrics={name: metrics(dataset, log, answer) for name, answer in answers.items()},
        counts=dict(dataset.counts) | log.counts | {"steps_not_taken": failed},
        notes=notes,
        warnings=replay_warnings(
            {name: a.tally for name, a in answers.items() if a.tally is not None},
            CAUSES,
            assumed=(TRAVEL, REST_RATE),
        ),
    )
