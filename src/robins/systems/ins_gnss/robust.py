"""Default INS/GNSS filter: IMM over position-fault hypotheses with Student-t weights.

It needs no tuning to a log, and refuses no fixes permanently. Student's t (`rules.student_t`)
weights each measurement, against single outliers. Properties that a log does not state are states,
or hypotheses of an interacting multiple model (`robins.filters.composite.imm`):

    x = (ins, z, share, o)   ins: the navigation state; the others follow its 15 or 21 components

    z       (3,) NED: time-correlated part of the position errors over its sigma, first-order
            Gauss-Markov (`robins.systems.ins_gnss.correlated_errors`); only if the log shows such
            a part
    share   kind of the velocities: at the fix (0), or mean since the last one (1); constant
    o       (3,) m, NED: offset of faulty positions, as from multipath

    right 1, 8, 64   positions are right; the covariance of the process noise is the stated one
                     times this factor, for unforeseen motion
    begins           positions are off from this step on: o is new, with sigma `OFF_M`
    lasts 1, 8, 64   positions are still off: o persists, with a random walk. Fixes give the motion,
                     not the position
    ends             positions are right again, and the state was right: o is dropped
    wild             this position alone is meaningless, however far away; o is dropped with it
    strayed          positions were right, and the state was off: it is corrected by o, which is
                     dropped

Both explanations of positions that stay away, faulty positions or a diverged state, are weighted:
the stated covariance is that of the mixture, and grows while they disagree. Probabilities of a
change are rates times the duration of a step, so they do not depend on the rate of fixes.
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
OFF_M = 10.0  # m, sigma of the offset of faulty positions
WILD_M = 1e6  # m, the same for a meaningless position
WILD_S = 1000.0  # s, mean time between such positions
WALK = 0.005  # m/sqrt(s), random walk of the offset; more makes `lasts` less likely than `right`
SELDOM_S = 100.0  # s, mean time between faults of positions
LATER = math.exp(4.0) - 1.0  # `ends` to `strayed`; equally likely after 4 patiences
_SHARE = 0.5, 0.5  # initial mean and sigma
_TAILS = 4.0  # degrees of freedom of Student's t
HEAVIEST = 16.0  # largest factor on the covariance of a position, by its weight in a mode


class AugmentedInsState(NamedTuple):
    """Navigation state augmented by unknown errors of the receiver."""

    ins: InsState
    lasting: Array | None  # (3,) NED, of unit variance; None where errors of positions are white
    share: Array | None  # (1,); None if configured
    offset: Array  # (3,) m, NED


class FixHypothesis(NamedTuple):
    """Parameters of a mode; with a leading axis, of the bank."""

    scale: Any  # factor on the covariance of the process noise
    read: Any  # 1 if positions are off by o
    kept: Any  # 1 if o persists
    new: Any  # m, sigma of a newly drawn o
    taken: Any  # 1 if o is added to the position of the state


COUNT = len(SCALES)
RIGHT, LASTS = slice(COUNT), slice(COUNT, 2 * COUNT)
BEGINS, ENDS, STRAYED, WILD = range(2 * COUNT, 2 * COUNT + 4)
"""Indices of modes in the bank."""

_IMU, _POSITION = (IMU,), (POSITION,)  # suspects at fault
_ROWS = [
    HypothesisRow(FixHypothesis(s, off, off, 0.0, 0.0), _POSITION * int(off) + _IMU * (s > 1.0))
    for off in (0.0, 1.0)
    for s in SCALES
] + [
    HypothesisRow(FixHypothesis(SCALES[1], 1.0, 0.0, OFF_M, 0.0), _POSITION),
    HypothesisRow(FixHypothesis(SCALES[1], 0.0, 0.0, 0.0, 0.0)),
    HypothesisRow(FixHypothesis(SCALES[1], 0.0, 0.0, 0.0, 1.0), _IMU),
    # it leads to no mode that keeps o: so large a sigma would spoil the o of `lasts` by mixing
    HypothesisRow(FixHypothesis(SCALES[0], 1.0, 0.0, WILD_M, 0.0), _POSITION),
]
HYPOTHESES = stacked(_ROWS)
AS_TOLD = FixHypothesis(*np.array(_ROWS[0].numbers))


def mode_changes(step_s: float, fault_s: float) -> np.ndarray:
    """Transition probabilities (modes, modes) of a step.

    Args:
        step_s: duration of the step [s].
        fault_s: mean duration of a fault of positions [s].
    """
    step_s = min(step_s, 0.5 * fault_s)
    lengths = SELDOM_S, WILD_S, fault_s
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
    """Belief about the navigation state, augmented by the states of the bank.

    Args:
        start: at the first fix; its position has sigmas S and is uncorrelated with the rest.
        with_share: with the state `share`.
        lasting: (2,) correlated share of the variance of positions, and its time constant [s].
        start_m: the part of S that does not come from the first fix [m]. The error s z of the fix
            is one of the start too: cov(p, z) = -s with s^2 = share (S^2 - start_m^2).
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
    """Navigation state within an augmented state; an `InsState` is returned unchanged."""
    return x.ins if isinstance(x, AugmentedInsState) else x


def _moved(of: FixHypothesis, x: AugmentedInsState) -> AugmentedInsState:
    place = x.ins.position.retract(of.taken * x.offset)
    return x._replace(ins=x.ins._replace(position=place), offset=of.kept * x.offset)


def _step_linear(
    motion: Motion, of: FixHypothesis, lasting: Array | None, x: AugmentedInsState, u: ImuBlock
):
    assert motion.linear is not None
    x = _moved(of, x)
    ins, Phi, factor = motion.linear(x.ins, u)
    factor = jnp.sqrt(of.scale) * factor
    if lasting is not None and x.lasting is not None:
        left = jnp.exp(-jnp.sum(u.increments.dt) / lasting[1])
        x = x._replace(lasting=left * x.lasting)
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


def _read_off(
    read: Callable[..., Geodetic],
    off: ArrayLike,
    lasting: Array | None,
    x: AugmentedInsState,
    fix: Fix,
):
    error = jnp.asarray(off) * x.offset
    if lasting is not None:
        assert x.lasting is not None
        error = error + jnp.sqrt(lasting[0]) * jnp.asarray(fix.sigma) * x.lasting
    return read(x.ins, fix).retract(error)


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
    """Model whose velocities are those at the fix, whatever window ``aux`` states."""

    def sensor(s: Sensor) -> Sensor:
        read = Partial(_read_fresh, as_data(s.read))
        return Sensor(read, s.noise, s.dim, s.name) if s.name == VELOCITY else s

    return Model(model.motion, tuple(map(sensor, model.sensors)))


def hypothesis_model(model: Model, of: FixHypothesis, lasting: Array | None = None) -> Model:
    """Model of the augmented state under a hypothesis.

    Args:
        model: from `ins_gnss_model`.
        of: parameters of the hypothesis.
        lasting: as in `augmented_belief`.
    """

    def sensor(s: Sensor) -> Sensor:
        read = Partial(_read_share if s.name == VELOCITY else _read, as_data(s.read))
        noise = Partial(_read, as_data(s.noise)) if callable(s.noise) else s.noise
        if s.name == POSITION:
            read = Partial(_read_off, as_data(s.read), of.read, lasting)
            noise = noise if lasting is None else Partial(_white, as_data(s.noise), lasting)
        return Sensor(read, noise, s.dim, s.name)

    sensors = tuple(map(sensor, model.sensors))
    return Model(moved_by(None, _step_linear, model.motion, of, lasting), sensors)


def augmented_case(
    with_share: bool, lasting: tuple[float, float] | None, start_m: float, world: Case
) -> Case:
    """Case with the start of a world augmented by `augmented_belief`."""

    def wide(start: Belief, *numbers: Array) -> Belief:
        return augmented_belief(start, with_share, *numbers)

    numbers = () if lasting is None else (jnp.asarray(lasting), jnp.asarray(start_m))
    return world._replace(start=evaluated(wide, world.start, *numbers))


# ----------------------------------------------------------------------------- in hindsight


class HindsightVerdict(NamedTuple):
    """Smoothed verdict of a bank on each step, given the whole log."""

    off: np.ndarray  # (E,) probability that positions are off
    scale: np.ndarray  # (E,) factor on the covariance of the process noise, geometric mean
    diverged: np.ndarray  # (E,) probability that the state was off and was corrected by o


def smoothed_probabilities(probability: np.ndarray, change: np.ndarray) -> HindsightVerdict:
    """Probabilities of the modes given a whole log (Kim 1994, *Dynamic linear models with
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
    """Rule of `bounded_student_t`: s R for a position, with s = min(1 / weight, heaviest)."""

    inner: Rule
    heaviest: Numbers  # ()

    name = "tails"

    def before(self, memory: Memory, prior: Belief, observation: Observation):
        """Scale the noise by Student's t; for a position, within bounds."""
        memory, prior, seen = self.inner.before(memory, prior, observation)
        if observation.sensor == POSITION:
            scale = jnp.minimum(1.0 / seen.notes["student_t.weight"], jnp.asarray(self.heaviest))
            seen = seen._replace(noise=jnp.sqrt(scale) * observation.noise)
        return memory, prior, seen


def bounded_student_t() -> Rule:
    """Student's t on every measurement, bounded by `HEAVIEST` for a position.

    Large position errors are left to the hypotheses: a mode that explained them by weights, step by
    step, would stay likelier than a change of mode, and absorb it in the mixing.
    """
    # no patience: the hypotheses handle lasting outliers
    return Tails(student_t(_TAILS, patience=None), np.asarray(HEAVIEST))


def single_hypothesis() -> Filter:
    """Filter of a single hypothesis, which can be smoothed."""
    return kalman(taylor(), [student_t(_TAILS)])


def _mode(model: Model, rule: Rule, lasting: Array | None, row: FixHypothesis) -> Mode:
    own = hypothesis_model(model, row, lasting)
    mine = tuple(s for s in own.sensors if s.name == POSITION)
    return Mode(kalman(taylor(), [rule]), own.motion, mine)


def robust(model: Model, step_s: float, fault_s: float, lasting: Array | None = None) -> Filter:
    """Bank of filters over the hypotheses, for a model.

    Args:
        model: from `ins_gnss_model`; the filter runs on its `hypothesis_model`, from
            `augmented_belief`.
        step_s: interval of fixes [s], or the longest block if that is shorter.
        fault_s: mean duration of a fault of positions [s].
        lasting: as in `augmented_belief`.
    """
    start = np.zeros(len(_ROWS))
    start[RIGHT] = 1.0 / COUNT
    # innovations are the likeliest mode's: the large sigma of a rare fault mode would hide others
    make = Partial(_mode, model, bounded_student_t(), lasting)
    return bank(make, _ROWS, mode_changes(step_s, fault_s), start, likeliest=True)
