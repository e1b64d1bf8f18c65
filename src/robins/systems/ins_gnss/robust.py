"""The filter of a log that nobody tuned it for: fixes are weighed, none is refused for ever.

Every measurement has a weight of its own, that of noise with Student's t (`rules.student_t`), which
answers a single one that is off. What the files of a log do not say is in the state, or is asked as
hypotheses of an interacting multiple model (`robins.filters.composite.imm`):

    x = (ins, z, share, o)   ins: the navigation state; tangent components behind its 15 or 21

    z       (3,) NED: the part of the error of positions that lasts, over its sigma: first-order
            Gauss-Markov (`robins.systems.ins_gnss.correlated_errors`); where the log shows such a
            part
    share   what a velocity is: that of the fix (0), or the mean since the last one (1); constant
    o       (3,) m, NED: by how much positions are off, as multipath makes them

    right 1, 8, 64   positions are right; the covariance of the process noise is so many times that
                     which is told. A motion that was not foreseen is answered here.
    begins           from this step on positions are off: o is new, of `OFF_M`
    lasts            they are still off: o stays, but for a walk. Fixes tell the motion, not where
    ends             they are right again, and the state was: o is dropped
    wild             this position alone says nothing, as one at the other end of the Earth; what
                     was known of o is dropped with it
    strayed          they were right, and the state was off: o is added to the position and dropped

Whether positions that stay away are off or the state is, both are weighed: the stated covariance is
that of the mixture, and grows while the two disagree. Probabilities of a change are rates times the
time of a step, so that they do not depend on how often fixes come.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, PyTree

from robins.earth import Geodetic
from robins.filters import Belief, Filter, Model, Motion, Rule, Sensor, kalman, taylor
from robins.filters.composite.bank import (
    EVERY,
    HypothesisRow,
    bank,
    scale_transitions,
    stacked,
    transitions,
)
from robins.filters.composite.imm import Mode
from robins.filters.observation import Observation
from robins.filters.rule import Memory
from robins.filters.rules import student_t
from robins.filters.values import Numbers, as_data, value
from robins.ins.state import InsState
from robins.linalg import block_diagonal
from robins.program.evaluated import evaluated
from robins.systems.ins_gnss.model import IMU, POSITION, VELOCITY, Fix, Velocity
from robins.systems.parts import ImuBlock, moved_by
from robins.systems.study import Case

SCALES = (1.0, 8.0, 64.0)
RISE, FALL = 1e-4, 1e-2  # probability in a step that the process noise changes upwards, and back
OFF_M = 10.0  # m, sigma of what positions are off by when they are
WILD_M = 1e6  # m, the same of one that says nothing
WILD_S = 1000.0  # s from one such position to the next, in the mean
WALK = 0.005  # m/sqrt(s), by which that wanders; more makes `lasts` less likely than `right`
SELDOM_S = 100.0  # s from one time that positions are off to the next, in the mean
LATER = math.exp(4.0) - 1.0  # `diverged` is so much rarer than `ends`: as likely after 4 patiences
_SHARE = 0.5, 0.5  # mean and sigma before anything is seen
_TAILS = 4.0  # degrees of freedom of Student's t
HEAVIEST = 16.0  # times the covariance of a position, by its weight in a mode


class AugmentedInsState(NamedTuple):
    """The navigation state and what is not known of its receiver."""

    ins: InsState
    lasting: Array | None  # (3,) NED, of unit variance; None where errors of positions are white
    share: Array | None  # (1,); None where the configuration says it
    offset: Array  # (3,) m, NED


class FixHypothesis(NamedTuple):
    """Numbers of a mode; of the bank with a leading axis."""

    scale: Any  # of the covariance of the process noise
    read: Any  # 1 where positions are off by o
    kept: Any  # 1 where o lasts
    new: Any  # m, sigma of o where it is drawn anew
    taken: Any  # 1 where the position takes o


COUNT = len(SCALES)
RIGHT, LASTS = slice(COUNT), slice(COUNT, 2 * COUNT)
BEGINS, ENDS, STRAYED, WILD = range(2 * COUNT, 2 * COUNT + 4)
"""Where the modes stand in the bank."""

_IMU, _POSITION = (IMU,), (POSITION,)  # what is wrong
_ROWS = [
    HypothesisRow(FixHypothesis(s, off, off, 0.0, 0.0), _POSITION * int(off) + _IMU * (s > 1.0))
    for off in (0.0, 1.0)
    for s in SCALES
] + [
    HypothesisRow(FixHypothesis(SCALES[1], 1.0, 0.0, OFF_M, 0.0), _POSITION),
    HypothesisRow(FixHypothesis(SCALES[1], 0.0, 0.0, 0.0, 0.0)),
    HypothesisRow(FixHypothesis(SCALES[1], 0.0, 0.0, 0.0, 1.0), _IMU),
    # it leads to no mode that keeps its o: so wide a spread would be mixed into what `lasts` knows
    HypothesisRow(FixHypothesis(SCALES[0], 1.0, 0.0, WILD_M, 0.0), _POSITION),
]
HYPOTHESES = stacked(_ROWS)
AS_TOLD = FixHypothesis(*np.array(_ROWS[0].numbers))


def mode_changes(step_s: float, patience_s: float) -> np.ndarray:
    """(modes, modes) probabilities to change in a step.

    Args:
        step_s: its length.
        patience_s: how long positions are off, in the mean.
    """
    step_s = min(step_s, 0.5 * patience_s)
    lengths = SELDOM_S, WILD_S, patience_s
    begin, wild, over = (-math.expm1(-step_s / length) for length in lengths)
    edges: list[Any] = [
        (same, same, scale_transitions(SCALES, RISE, FALL)) for same in (RIGHT, LASTS)
    ]
    edges += [(EVERY, BEGINS, begin), (EVERY, WILD, wild)]
    for off in (LASTS, BEGINS):
        edges += [(off, ENDS, over), (off, STRAYED, over / LATER)]
    return transitions(len(_ROWS), edges, rest=[*range(2 * COUNT), COUNT, 0, 0, 0])


# ------------------------------------------------------------------------------------ the model


def augmented_belief(
    start: Belief, with_share: bool, lasting: Array | None = None, start_m: float | Array = 0.0
) -> Belief:
    """A belief about the navigation state with what the bank adds to it.

    Args:
        start: at the place of the first fix; sigmas of position S, uncorrelated with the rest.
        with_share: with a state for what velocities are.
        lasting: (2,) share of the variance of positions that lasts, and its time constant [s].
        start_m: the part of S that is not the first fix's. The rest is: where the fix is off by
            s z, so is the start, by cov(p, z) = -s with s^2 = share (S^2 - start_m^2).
    """
    mean, sigma = _SHARE
    share = jnp.full(1, mean) if with_share else None
    spread = np.zeros((3 + with_share, 3 + with_share))
    if with_share:
        spread[0, 0] = sigma
    factor = jnp.asarray(start.factor, float)
    z = None
    if lasting is not None:
        z, n, own = jnp.zeros(3), len(factor), jnp.diagonal(factor)[6:9] ** 2
        tied = jnp.sqrt(lasting[0] * (1.0 - start_m**2 / own))
        factor = block_diagonal(factor, jnp.diag(jnp.sqrt(1.0 - tied**2)))
        factor = factor.at[n + jnp.arange(3), 6 + jnp.arange(3)].set(-tied)
    factor = block_diagonal(factor, jnp.asarray(spread))
    return Belief(AugmentedInsState(start.mean, z, share, jnp.zeros(3)), factor)


def navigation(x: InsState | AugmentedInsState) -> InsState:
    """The navigation state of a wide one; another as it is."""
    return x.ins if isinstance(x, AugmentedInsState) else x


def _moved(of: FixHypothesis, x: AugmentedInsState) -> AugmentedInsState:
    place = x.ins.position.retract(of.taken * x.offset)
    return x._replace(ins=x.ins._replace(position=place), offset=of.kept * x.offset)


def _faded(
    lasting: Array | None, x: AugmentedInsState, u: ImuBlock
) -> tuple[AugmentedInsState, Array | None]:
    """The state with what a step leaves of z, and the share that it leaves."""
    if lasting is None or x.lasting is None:
        return x, None
    left = jnp.exp(-jnp.sum(u.increments.dt) / lasting[1])
    return x._replace(lasting=left * x.lasting), left


def _step(
    motion: Motion, of: FixHypothesis, lasting: Array | None, x: AugmentedInsState, u: ImuBlock
) -> AugmentedInsState:
    x, _ = _faded(lasting, _moved(of, x), u)
    return x._replace(ins=motion.step(x.ins, u))


def _step_linear(
    motion: Motion, of: FixHypothesis, lasting: Array | None, x: AugmentedInsState, u: ImuBlock
):
    assert motion.linear is not None
    x, left = _faded(lasting, _moved(of, x), u)
    ins, Phi, factor = motion.linear(x.ins, u)
    factor = jnp.sqrt(of.scale) * factor
    if left is not None:
        Phi = block_diagonal(Phi, left * jnp.eye(3))
        factor = block_diagonal(factor, jnp.sqrt(1.0 - left**2) * jnp.eye(3))
    free = 0 if x.share is None else 1
    unit, zero = jnp.eye(free), jnp.zeros((free, free))
    Phi = block_diagonal(Phi, block_diagonal(unit, of.kept * jnp.eye(3)))
    n = len(Phi)
    takes = jnp.eye(n).at[jnp.arange(6, 9), jnp.arange(n - 3, n)].set(of.taken)
    drawn = of.new + of.kept * WALK * jnp.sqrt(jnp.sum(u.increments.dt))
    noise = block_diagonal(factor, block_diagonal(zero, drawn * jnp.eye(3)))
    return x._replace(ins=ins), Phi @ takes, noise


def _read(read: Callable, x: AugmentedInsState, aux: PyTree):
    return read(x.ins, aux)


def _read_off(read: Callable[..., Geodetic], off: ArrayLike, x: AugmentedInsState, aux: Fix):
    return read(x.ins, aux).retract(jnp.asarray(off) * x.offset)


def _read_correlated(
    read: Callable[..., Geodetic], off: ArrayLike, lasting: Array, x: AugmentedInsState, fix: Fix
):
    assert x.lasting is not None
    error = jnp.sqrt(lasting[0]) * jnp.asarray(fix.sigma) * x.lasting
    return read(x.ins, fix).retract(jnp.asarray(off) * x.offset + error)


def _white(sigma: Callable[..., Array], lasting: Array, x: AugmentedInsState, fix: Fix):
    return jnp.sqrt(1.0 - lasting[0]) * sigma(x.ins, fix)


def _aged(fix: Velocity, share: ArrayLike) -> Velocity:
    gained, age = share * jnp.asarray(fix.gained_b), share * jnp.asarray(fix.age_s)
    return fix._replace(gained_b=gained, age_s=age)


def _read_share(read: Callable, x: AugmentedInsState, fix: Velocity):
    return read(x.ins, fix if x.share is None else _aged(fix, x.share[0]))


def _read_fresh(read: Callable, x: InsState, fix: Velocity):
    return read(x, _aged(fix, 0.0))


def fresh(model: Model) -> Model:
    """The model whose velocities are those of the fix, whatever window ``aux`` says."""

    def sensor(s: Sensor) -> Sensor:
        read = Partial(_read_fresh, as_data(s.read))
        return Sensor(read, s.noise, s.dim, s.name) if s.name == VELOCITY else s

    return Model(model.motion, tuple(map(sensor, model.sensors)))


def hypothesis_model(model: Model, of: FixHypothesis, lasting: Array | None = None) -> Model:
    """The model of the wide state under a hypothesis.

    Args:
        model: from `ins_gnss_model`.
        of: its numbers.
        lasting: as in `augmented_belief`.
    """

    def sensor(s: Sensor) -> Sensor:
        own = as_data(s.read)
        if s.name == POSITION and lasting is not None:
            white = Partial(_white, as_data(s.noise), lasting)
            return Sensor(Partial(_read_correlated, own, of.read, lasting), white, s.dim, s.name)
        if s.name == POSITION:
            read = Partial(_read_off, own, of.read)
        else:
            read = Partial(_read_share if s.name == VELOCITY else _read, own)
        noise = Partial(_read, as_data(s.noise)) if callable(s.noise) else s.noise
        return Sensor(read, noise, s.dim, s.name)

    sensors = tuple(map(sensor, model.sensors))
    return Model(moved_by(_step, _step_linear, model.motion, of, lasting), sensors)


def augmented_case(
    with_share: bool, lasting: tuple[float, float] | None, start_m: float, world: Case
) -> Case:
    """Case of a world whose start is about the navigation state alone, as in `augmented_belief`."""

    def wide(start: Belief, *numbers: Array) -> Belief:
        return augmented_belief(start, with_share, *numbers)

    numbers = () if lasting is None else (jnp.asarray(lasting), jnp.asarray(start_m))
    return world._replace(start=evaluated(wide, world.start, *numbers))


# ----------------------------------------------------------------------------- in hindsight


class HindsightVerdict(NamedTuple):
    """Verdict of a bank on each step, once the whole log is known."""

    off: np.ndarray  # (E,) probability that positions are off
    scale: np.ndarray  # (E,) of the covariance of the process noise, geometric mean
    diverged: np.ndarray  # (E,) probability that the estimate was off and took the fixes' word


def smoothed_probabilities(probability: np.ndarray, change: np.ndarray) -> HindsightVerdict:
    """Probabilities of the modes given all of a log (Kim 1994, *Dynamic linear models with
    Markov-switching*, J. Econometrics 60, eq. 2.20), backwards from the filtered ones.

        P(i at k | all) = P(i at k) sum_j P(j at k+1 | all) p_ij / P(j at k+1 | k)

    Args:
        probability: (E, modes) after each step.
        change: (modes, modes), from `mode_changes`.
    """
    known = np.array(probability, float)
    for k in range(len(known) - 2, -1, -1):
        ahead = known[k] @ change
        known[k] *= change @ np.divide(known[k + 1], ahead, np.zeros_like(ahead), where=ahead > 0.0)
        known[k] /= known[k].sum()
    off = known[:, HYPOTHESES.read > 0.0].sum(axis=1)
    return HindsightVerdict(off, np.exp(known @ np.log(HYPOTHESES.scale)), known[:, STRAYED])


# ----------------------------------------------------------------------------------- the filters


@value
class Tails(Rule):
    """The rule of `bounded_student_t`: of a position s R with s = min(1 / weight, heaviest)."""

    inner: Rule
    heaviest: Numbers  # ()

    name = "tails"

    def before(self, memory: Memory, prior: Belief, observation: Observation):
        """Noise by Student's t, of a position within bounds."""
        memory, prior, seen = self.inner.before(memory, prior, observation)
        if observation.sensor == POSITION:
            scale = jnp.minimum(1.0 / seen.notes["student_t.weight"], jnp.asarray(self.heaviest))
            seen = seen._replace(noise=jnp.sqrt(scale) * observation.noise)
        return memory, prior, seen


def bounded_student_t() -> Rule:
    """Student's t on every measurement; of a position no more than `HEAVIEST`.

    A position far away is a matter of the hypotheses. A mode that explains it by a weight, again at
    every step, would stay likelier than what has to be believed once, and swallow it in the mixing.
    """
    # the hypotheses are the way out
    return Tails(student_t(_TAILS, patience=None), np.asarray(HEAVIEST))


def single_hypothesis() -> Filter:
    """A filter of one hypothesis; it can be smoothed."""
    return kalman(taylor(), [student_t(_TAILS)])


def _mode(model: Model, rule: Rule, lasting: Array | None, row: FixHypothesis) -> Mode:
    own = hypothesis_model(model, row, lasting)
    mine = tuple(s for s in own.sensors if s.name == POSITION)
    return Mode(kalman(taylor(), [rule]), own.motion, mine)


def robust(model: Model, step_s: float, patience_s: float, lasting: Array | None = None) -> Filter:
    """The bank over the hypotheses, for a model.

    Args:
        model: from `ins_gnss_model`; the filter runs on `hypothesis_model` of it, from
            `augmented_belief`.
        step_s: between fixes, or of the longest block where that is shorter.
        patience_s: how long positions are off where they are, in the mean.
        lasting: as in `augmented_belief`.
    """
    start = np.zeros(len(_ROWS))
    start[RIGHT] = 1.0 / COUNT
    # a position that may be off by `OFF_M` is seldom expected, and would hide what is
    make = Partial(_mode, model, bounded_student_t(), lasting)
    return bank(make, _ROWS, mode_changes(step_s, patience_s), start, likeliest=True)
