"""Heavy-tailed noise: the weight of a measurement is estimated together with the state."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.checks import one_of
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.rules._robust import MOST, PATIENCE, shares, weighed, with_recovery
from robins.filters.values import Numbers, kind, number, value

Whose = Literal["R", "both"]


@value
class StudentT(Rule):
    """Rule of `student_t`: covariances c R and b P of Gaussian scale mixtures."""

    dof: Numbers  # () nu
    iterations: int = kind()
    whose: Whose = kind()

    name = "student_t"

    def before(self, memory: Memory, prior: Belief, o: Observation):
        b, c = self.scales(o, prior.factor.shape[0])
        o, weight = weighed(o, c)
        b = jnp.where(weight > 0.0, b, 1.0)
        if self.whose == "both":
            prior = prior._replace(factor=jnp.sqrt(b) * prior.factor)
        return memory, prior, o.noted("student_t", weight=weight, prior=1.0 / b)

    def scales(self, o: Observation, n: int) -> tuple[Array, Array]:
        """Scales () b and () c, for a state of n components."""
        of = shares(o)
        noisy = jnp.any(of.noise != 0.0, axis=1)
        m = jnp.sum(noisy).astype(float)
        exact = jnp.sum(of.seen.used & ~noisy).astype(float)
        W, one, one_by_nu = of.white_noise, jnp.eye(len(noisy)), 1.0 / self.dof
        R = W @ W.T
        columns = jnp.concatenate([of.seen.white[:, None], W, one], axis=1)

        def better(_: Array, scale: tuple[Array, Array]) -> tuple[Array, Array]:
            b, c = scale
            root = linalg.cholesky(b * of.prior + c * R + of.idle)
            X = linalg.solve_lower(root, columns)
            w, W_, inverse = X[:, 0], X[:, 1 : -len(one)], X[:, -len(one) :]
            v = inverse.T @ w
            known = b * jnp.sum((inverse.T @ inverse) * of.prior)  # trace of S^-1 H P H'
            left = c * c * jnp.sum((W_.T @ w) ** 2) + c * jnp.maximum(known - exact, 0.0)
            if self.whose == "both":
                moved = b * b * (v @ (of.prior @ v)) + b * (n - known)
                b = jnp.minimum((1.0 + moved * one_by_nu) * (1.0 / (1.0 + n / self.dof)), MOST)
            return b, jnp.minimum((1.0 + left * one_by_nu) / (1.0 + m * one_by_nu), MOST)

        return jax.lax.fori_loop(0, self.iterations, better, (jnp.ones(()), jnp.ones(())))


def student_t(
    dof: Number = 5.0, iterations: int = 3, whose: Whose = "R", patience: int | None = PATIENCE
) -> Rule:
    r"""Student's t filter by variational Bayes (Huang, Zhang, Li, Wu & Chambers 2017, sec. III).

    Noise v ~ t(0, R, nu) is Gaussian of covariance R / u with u ~ Gamma(nu/2, nu/2) (Roth, Özkan &
    Gustafsson 2013). Given the posterior of the state, u has the mean 1 / c below; given u, the
    update is a Kalman update with c R. With e the residual *after* the update,

        c = (nu + E[e' R^-1 e]) / (nu + m),   e ~ N(c R S^-1 r, c R - c R S^-1 c R)
        S = b H P H' + c R,                   b = 1

    iterated from c = 1, with m x m matrices only. ``whose="both"`` gives the prior such tails too,
    b = (nu + E[d' P^-1 d]) / (nu + n), d being the correction of the state. On Gaussian data the
    filter is slightly less efficient; weights below one are common.

    Notes: ``student_t.weight``, 1 / c, 0 if refused (1e-12 or less); ``.prior``, 1 / b; and
    ``.recovered``. Components without noise do not count. The Kalman filter is ``dof=inf``.

    Args:
        dof: nu, degrees of freedom of the tails: 3 to 10; 1 is Cauchy.
        iterations: number of iterations of c, at least 1.
        whose: heavy tails of the measurement noise only, "R", or of "both" it and the prior.
        patience: measurements in a row with a weight below 1e-2 before one is used
            (`robins.filters.rules._robust.with_recovery`); None never recovers.

    Raises:
        ValueError: an argument is out of its range.
    """
    nu = number("student_t dof must be positive", dof, lambda nu: nu > 0.0)
    require(iterations >= 1, "student_t iterations must be at least 1", iterations)
    one_of("student_t whose", whose, Whose)
    return with_recovery(StudentT(nu, iterations, whose), patience)
