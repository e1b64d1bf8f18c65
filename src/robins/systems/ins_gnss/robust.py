"""The filter of a log that nobody tuned it for: fixes are weighed, none is refused for ever.

Every measurement has a weight of its own, that of noise with Student's t (`rules.student_t`), and
the estimate follows positions that stay away from it (`find_back`). What the files of a log do not
say is asked as hypotheses of an interacting multiple model (`robins.filters.composite.imm`):

    s   how much larger the covariance of the process noise is than told, 1, 8 or 64
    f   what the receiver's velocity is: that of the fix (0), or the mean since the last one (1)

A measurement that is off is weighed down in all modes alike and moves no probability; a motion that
is off is explained by a larger s without weighing anything down. What the velocities are does not
change in a run; s rises rarely and falls back within seconds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.filters import Family, Filter, Model, Rule, Sensor, imm, kalman, taylor
from robins.filters.belief import Belief
from robins.filters.chi_square import quantiles
from robins.filters.composite.imm import Mode
from robins.filters.observation import Observation, normalised
from robins.filters.rules import student_t
from robins.filters.rules._robust import widened
from robins.systems.ins_gnss.model import POSITION, VELOCITY, Velocity

SCALES = (1.0, 8.0, 64.0)
RISE, FALL = 1e-4, 1e-2  # probability in a step that s changes upwards, and back
_TAILS = 4.0  # degrees of freedom of Student's t
_AWAY = 0.9999  # a position is away from the estimate if its NIS is beyond this quantile


class Strayed(NamedTuple):
    """What is remembered of positions that lie away from the estimate."""

    count: Any  # () of them in a row, all on one side
    mean: Any  # (3,) m, of their innovations


def find_back(patience: int) -> Rule:
    """Follow positions that stay away from the estimate, all to one side, for long enough.

    A weight that falls with the distance locks out an estimate that has strayed: the farther off it
    is, the less the fixes can pull. After ``patience`` positions in a row whose NIS is beyond the
    0.9999 quantile, each nearer to the mean of those before than half of that mean's length, the
    next one finds the covariance widened by the square of its innovation along what it sees. A
    receiver that is deceived for less long is not followed. A position with a missing component
    tells nothing here.

    Args:
        patience: positions in a row.
    """

    def init(belief, dims):
        return Strayed(jnp.zeros((), int), jnp.zeros(3))

    def before(memory: Strayed, prior: Belief, o: Observation):
        if o.sensor != POSITION:
            return memory, prior, o
        seen = normalised(o)
        judged = seen.dof == len(o.residual)
        r = jnp.where(judged, o.residual, 0.0)
        off = judged & (seen.nis > quantiles(_AWAY, 3)[3])
        apart = jnp.linalg.norm(r - memory.mean) > 0.5 * jnp.linalg.norm(memory.mean)
        held = jnp.where(apart, 0, memory.count)
        due = off & (held >= patience)
        now = Strayed(
            jnp.where(off & ~due, held + 1, 0),
            jnp.where(held > 0, memory.mean + (r - memory.mean) / (held + 1).astype(float), r),
        )
        kept = Strayed(*(jnp.where(judged, a, b) for a, b in zip(now, memory, strict=True)))
        prior = widened(due, prior, o, jnp.full(3, True), r[:, None])
        return kept, prior, o.noted("find_back", followed=due)

    return Rule(init=init, before=before, name="find_back")


def supposing(scale: Any) -> Rule:
    """Process noise whose covariance is larger than told, by this factor."""

    def process(memory, transition):
        return memory, transition._replace(noise=jnp.sqrt(scale) * transition.noise)

    return Rule(process=process, name="supposing")


def weighed(patience: int) -> Filter:
    """A filter of one hypothesis, the one that is told; it can be smoothed."""
    return kalman(taylor(), [find_back(patience), student_t(_TAILS)])


# ----------------------------------------------------------------------------------- the bank


class Hypothesis(NamedTuple):
    """Numbers of a mode; of the bank with a leading axis."""

    scale: Any  # s
    mean: Any  # f


def hypotheses(asked: bool) -> Hypothesis:
    """The numbers of all modes, with both f or with f = 1 alone."""
    rows = np.array([(s, f) for f in ((0.0, 1.0) if asked else (1.0,)) for s in SCALES])
    return Hypothesis(rows[:, 0], rows[:, 1])


def changes(of: Hypothesis) -> np.ndarray:
    """(modes, modes) probabilities to change in a step."""
    up = of.scale[None, :] > of.scale[:, None]
    other = (of.scale[None, :] != of.scale[:, None]) & (of.mean[None, :] == of.mean[:, None])
    p = np.where(up, RISE, FALL) * other
    return p + np.diag(1.0 - p.sum(axis=1))


def _read_share(read: Any, share: Any, x: Any, fix: Velocity):
    gained, age = share * jnp.asarray(fix.gained_b), share * jnp.asarray(fix.age_s)
    return read(x, fix._replace(gained_b=gained, age_s=age))


def mean_velocity(model: Model, share: Any) -> Sensor:
    """The sensor of velocities with the window that ``aux`` says (1), with none (0)."""
    (velocity,) = (s for s in model.sensors if s.name == VELOCITY)
    read = Partial(_read_share, velocity.read, share)
    return Sensor(read, velocity.noise, velocity.dim, velocity.name)


def supposing_mean(model: Model, share: float) -> Model:
    """The model whose velocities are such."""
    own = mean_velocity(model, share)
    return Model(model.motion, tuple(own if s.name == VELOCITY else s for s in model.sensors))


def robust(model: Model, asked: bool, patience: int) -> Filter:
    """The bank over the hypotheses, for a model.

    Args:
        model: from `ins_gnss_model`.
        asked: whether velocities may be of the fix or means over the window that ``aux`` says; else
            they are the latter.
        patience: positions in a row that stay away before they are followed.
    """
    numbers = hypotheses(asked)

    def mode(row: Hypothesis) -> Mode:
        rules = [supposing(row.scale), find_back(patience), student_t(_TAILS)]
        own = mean_velocity(model, row.mean)
        return Mode(kalman(taylor(), rules), sensors=(own,))

    return imm(Family(mode, numbers), changes(numbers))
