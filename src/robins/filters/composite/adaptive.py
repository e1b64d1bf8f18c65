"""One filter for a model of which nobody knows when it is wrong: a bank over the process noise.

An innovation that is too large is a bad record or a motion that was not foreseen. A robust weight
alone takes it for the first, and once the motion is wrong it refuses the truth; a fading factor
takes it for the second, and follows outliers. The bank (`robins.filters.composite.imm`) holds both:
each mode weighs its records by Huber's rule (`robins.filters.rules.huber`) and believes in another
scale of the process noise,

    Q_s = s^2 Q + s^2 back C,     s of the scales,  C = diag of the initial variance of constants

so a motion that is wrong for long makes a mode of more noise likely, and a bad record, which is
gone at the next step, does not. There is no gate: nothing is refused, so nothing is locked out.

States that the model holds for constant (biases, misalignments) have no noise of their own to be
scaled. A mode lasts 1 / back steps once it has begun, and over these lets a constant wander by s
times the sigma that it began with. The first scale is that of the model as it is: constants stay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.composite.imm import Family, Mode, imm
from robins.filters.kalman import Filter, Form, kalman
from robins.filters.linearise import Linearisation, Transition, taylor
from robins.filters.model import Motion
from robins.filters.rule import Rule
from robins.filters.rules import huber

SCALES = (1.0, 8.0, 64.0)
UP, BACK = 1e-4, 1e-2
OTHER = 1e-5  # that an alternative gives way to another in a step


def excited(
    scale: ArrayLike,
    constants: Sequence[int] = (),
    wander: ArrayLike = 0.0,
    only: Sequence[int] | None = None,
) -> Rule:
    """Process noise of another scale; constants wander.

    Args:
        scale: s, of the standard deviations of the process noise.
        constants: tangent components that the model holds for constant.
        wander: standard deviation of what is added to each in a step, over its initial sigma.
        only: tangent components whose process noise is scaled; None: all.
    """
    which = np.asarray(constants, int)
    moved = slice(None) if only is None else np.asarray(only, int)

    def init(belief: Belief, dims: Any) -> Array:
        return jnp.sqrt(jnp.sum(belief.factor[which] ** 2, axis=1))

    def process(first: Array, t: Transition):
        noise = t.noise.at[moved].multiply(scale)
        if len(which):
            columns = jnp.zeros((len(noise), len(which)))
            columns = columns.at[which, np.arange(len(which))].set(wander * first)
            noise = jnp.concatenate([noise, columns], axis=1)
        return first, t._replace(noise=noise)

    return Rule(init=init, process=process, name="excited")


def changes(count: int, up: float = UP, back: float = BACK) -> np.ndarray:
    """(count, count) probabilities of a change in one step between scales in rising order.

    From any to one that is louder up each, to one that is quieter back each.

    Raises:
        ValueError: they are no probabilities.
    """
    louder = np.triu(np.full((count, count), up), 1)
    quieter = np.tril(np.full((count, count), back), -1)
    change = louder + quieter
    stay = 1.0 - change.sum(axis=1)
    good = 0.0 < up < 1.0 and 0.0 < back < 1.0 and bool(np.all(stay > 0.0))
    require(good, "up and back of adaptive must leave a mode a chance to stay", (up, back))
    return change + np.diag(stay)


def lasting(change: np.ndarray) -> np.ndarray:
    """(count,) probabilities that stay as they are under a change of each step."""
    count = len(change)
    A = np.vstack([change.T - np.eye(count), np.ones(count)])
    found, *_ = np.linalg.lstsq(A, np.append(np.zeros(count), 1.0))
    found = np.maximum(found, 0.0)
    return found / found.sum()


def adaptive(
    scales: Sequence[float] = SCALES,
    robust: float = 0.99,
    up: float = UP,
    back: float = BACK,
    constants: Sequence[int] = (),
    only: Sequence[int] | None = None,
    motions: Callable[[Any], Motion] | None = None,
    alternatives: Any = None,
    linearise: Linearisation | None = None,
    form: Form = "sqrt",
) -> Filter:
    """A bank of Kalman filters over the scale of the process noise, with Huber's rule in each.

    Nothing in it belongs to a scenario: the numbers are decades of what a motion may do, and the
    same for every system.

    Args:
        scales: of the standard deviations of the process noise, rising; the first is the model's.
        robust: share of right records that keep their weight (`huber`).
        up: probability of a change to one louder scale in a step.
        back: of a change to one quieter scale.
        constants: tangent components that the model holds for constant.
        only: components whose process noise is scaled, where others are driven by something else,
            such as the error of a wind; all where not given.
        motions: makes the motion of one row of the alternatives.
        alternatives: pytree of arrays, one row an alternative of the motion that holds for good.
            Each is combined with every scale.
        linearise: of each mode; by Taylor where not given.
        form: of the update, "sqrt" or "joseph".

    Raises:
        ValueError: scales that do not rise from above zero; probabilities that are none; of motions
            and alternatives one without the other.
    """
    s = np.asarray(scales, float)
    rising = s.ndim == 1 and len(s) > 0 and s[0] > 0.0 and bool(np.all(np.diff(s) > 0.0))
    require(rising, "scales of adaptive must rise, from above zero", scales)
    if (motions is None) != (alternatives is None):
        raise ValueError("adaptive needs both motions and alternatives, or neither")
    wander = np.where(np.arange(len(s)) > 0, s * np.sqrt(back), 0.0)
    by = taylor() if linearise is None else linearise

    def one(row: Any) -> Filter | Mode:
        scale, wandering, *other = row
        rules = (excited(scale, constants, wandering, only), huber(robust))
        made = kalman(by, rules, form)
        return made if motions is None else Mode(made, motions(other[0]))

    change = changes(len(s), up, back)
    start = lasting(change)
    if motions is None:
        return imm(Family(one, (s, wander)), change, start)
    (count,) = {np.shape(x)[0] for x in jax.tree_util.tree_leaves(alternatives)}
    here = np.repeat(np.arange(count), len(s))
    rows = jax.tree_util.tree_map(lambda x: np.asarray(x)[here], alternatives)
    between = np.full((count, count), OTHER) + np.diag(np.full(count, 1.0 - count * OTHER))
    numbers = (np.tile(s, count), np.tile(wander, count), rows)
    return imm(Family(one, numbers), np.kron(between, change), np.tile(start, count) / count)
