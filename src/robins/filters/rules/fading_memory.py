"""Inflation of the covariance by a constant factor in every step."""

from __future__ import annotations

import math

import jax.numpy as jnp

from robins.errors import require
from robins.filters.belief import Belief, Code, Number
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import Numbers, is_factor, number, value


@value
class FadingMemory(Rule):
    """Rule of `fading_memory`: alpha^2 P before a prediction."""

    factor: Numbers  # () alpha

    name = "fading_memory"

    def settle(self, memory: Memory, belief: Belief):
        return memory, belief._replace(factor=self.factor * belief.factor), int(Code.DONE)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        return memory, prior, o.noted(self.name, factor=jnp.asarray(self.factor))


def fading_memory(factor: Number = 1.01) -> Rule:
    """Exponential data weighting (Anderson 1973; Simon 2006, sec. 7.4): alpha^2 F P F' + Q.

    In the least-squares problem of the filter, data j steps old have alpha^(-2j) of the weight of
    new data, so accumulated model errors are forgotten. The covariance is then a weight, an upper
    bound where the model is right.

    Standard deviations are multiplied by alpha after all measurements of a step, before the
    prediction, so that sigma points and smoothers use the widened belief. This is done in every
    step, measured or not, and to every state: variances of unobserved states grow as alpha^(2k).

    Notes: ``fading_memory.factor``. factor = 1 is the Kalman filter, bit for bit.

    Args:
        factor: alpha, without unit; `per_step` computes it from a time constant.

    Raises:
        ValueError: the factor is not finite or below 1.
    """
    return FadingMemory(
        number("fading_memory factor must be finite and not below 1", factor, is_factor)
    )


def per_step(memory_s: Number, step_s: Number) -> float:
    """Factor for which the weight of data falls to 1/e in ``memory_s``: exp(step / (2 memory)).

    Args:
        memory_s: time constant [s] of the weight, infinity for the Kalman filter.
        step_s: time between predictions [s].

    Raises:
        ValueError: one of them is not positive, or the step is not finite.
    """
    require(memory_s > 0.0, "fading_memory memory_s must be positive", memory_s)
    require(0.0 < step_s < math.inf, "fading_memory step_s must be positive and finite", step_s)
    return math.exp(step_s / (2.0 * memory_s))
