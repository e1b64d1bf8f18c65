"""Inflate the covariance by a constant factor in every step."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from robins.errors import require
from robins.filters.belief import Belief, Code, Number
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import Numbers, number, value


@value
class FadingMemory(Rule):
    """The rule of `fading_memory`: alpha^2 P before a prediction."""

    factor: Numbers  # () alpha

    name = "fading_memory"

    def settle(self, memory: Memory, belief: Belief):
        return memory, belief._replace(factor=self.factor * belief.factor), int(Code.DONE)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        return memory, prior, o.noted(self.name, factor=jnp.asarray(self.factor))


def fading_memory(factor: Number = 1.01) -> Rule:
    """Exponential data weighting (Anderson 1973; Simon 2006, sec. 7.4): alpha^2 F P F' + Q.

    In the least-squares problem that the filter solves, whatever is j steps old weighs
    alpha^(-2j) of what is new: errors of a model that builds up over the steps are forgotten. The
    covariance is then a weight, an upper bound where the model is right.

    The belief is widened by alpha when all measurements of a step are in, before it is predicted:
    for a linear motion the equation above, and sigma points are drawn from the widened belief. A
    smoother so finds the belief that was predicted.

    It fades every step, measured or not, and every state, seen or not: what is never measured
    grows as alpha^(2k).

    Notes: ``fading_memory.factor``. factor = 1 is the Kalman filter, bit for bit.

    Args:
        factor: alpha, without unit; from a time constant by `per_step`.

    Raises:
        ValueError: the factor is not finite or below 1.
    """
    below = "fading_memory factor must be finite and not below 1"
    return FadingMemory(number(below, factor, lambda a: (a >= 1.0) & (a < np.inf)))


def per_step(memory_s: Number, step_s: Number) -> float:
    """The factor with which the weight of data falls to 1/e in a time: exp(step / (2 memory)).

    Args:
        memory_s: time constant [s] of the weight, infinity for the Kalman filter.
        step_s: time between predictions [s].

    Raises:
        ValueError: one of them is not positive, or the step is not finite.
    """
    require(memory_s > 0.0, "fading_memory memory_s must be positive", memory_s)
    require(0.0 < step_s < math.inf, "fading_memory step_s must be positive and finite", step_s)
    return math.exp(step_s / (2.0 * memory_s))
