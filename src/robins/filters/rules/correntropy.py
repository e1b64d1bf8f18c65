"""Maximum correntropy: weigh components by a Gaussian kernel of their residuals."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.rules._robust import MOST, PATIENCE, reweighted, weighed, with_recovery
from robins.filters.values import Numbers, kind, number, value


@value
class Correntropy(Rule):
    """Rule of `correntropy`: R_ij / sqrt(w_i w_j), w_i = G(e_i) of posterior residuals."""

    kernel: Numbers  # () sigma
    iterations: int = kind()

    name = "correntropy"

    def before(self, memory: Memory, prior: Belief, o: Observation):
        o, w = weighed(o, 1.0 / reweighted(o, self.weight, self.iterations))
        return memory, prior, o.noted("correntropy", weight=jnp.min(w))

    def weight(self, e: Array) -> Array:
        """Weights of residuals in standard deviations of their noise."""
        w = jnp.exp(-0.5 * (e * (1.0 / self.kernel)) ** 2)
        # least weight for numerical accuracy: 1e-8, less if that would correct by a milli-sigma
        return jnp.maximum(w, 1e-3 / jnp.minimum(1e5 + jnp.abs(e), 1e-3 * MOST))


def correntropy(kernel: Number = 3.0, iterations: int = 3, patience: int | None = PATIENCE) -> Rule:
    r"""Maximum correntropy Kalman filter (Chen, Liu, Zhao & Principe 2017), in the measurement.

    The state that maximises -(x - m)' P^-1 (x - m) / 2 + sigma^2 sum G(e_i), the Gaussian kernel
    G(e) = exp(-e^2 / (2 sigma^2)) of each component's residual in its own noise,
    e_i = (y - h(x))_i / sqrt(R_ii), by the fixed point of

        w_i = G(e_i),   R_ij becomes R_ij / sqrt(w_i w_j),   e = residual after that update,

    started at the Kalman filter, w = 1: each iteration then raises the objective. Chen et al. start
    at the prior, where a poor prior makes every measurement an outlier, and weigh the components of
    the prior in the same way: the result then depends on the order of the states in the factor of
    P, and a diverged state is not corrected. Here the term of the prior stays quadratic.

    Notes: ``correntropy.weight``, the least of the measurement, 0 if refused (1e-12 or less), and
    ``correntropy.recovered``. Components without noise of their own keep their weight. The Kalman
    filter is ``kernel=inf``.

    Args:
        kernel: width sigma of the kernel, in standard deviations of the noise: below 2 good
            measurements lose weight, above 6 outliers of 10 sigma keep some.
        iterations: number of iterations of the weights, at least 1.
        patience: measurements in a row with a weight below 1e-2 before one is used
            (`robins.filters.rules._robust.with_recovery`); None never recovers.

    Raises:
        ValueError: an argument is out of its range.
    """
    sigma = number("correntropy kernel must be positive", kernel, lambda k: k > 0.0)
    require(iterations >= 1, "correntropy iterations must be at least 1", iterations)
    return with_recovery(Correntropy(sigma, iterations), patience)
