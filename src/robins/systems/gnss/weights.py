r"""Weights by satellite: a vector of pseudoranges, of which each component has a weight of its own.

The rules `huber` and `student_t` of `robins.filters.rules` weigh a measurement as a whole. Here one
reflected signal must not cost the others their weight. A component's residual is taken *after* the
update, where the clock, which all satellites share, is known, and the update is repeated
(iteratively reweighted least squares, begun at the Kalman filter)::

    e_i = (y - h(x+))_i / sqrt(R_ii),   w_i = w(e_i),   R_ij becomes R_ij / sqrt(w_i w_j)

    huber        w = min(1, k / |e|)                     Huber (1964)
    student-t    w = (nu + 1) / (nu + e^2)               Lange, Little & Taylor (1989)
    switchable   w = min(1, 2 phi / (phi + e^2))^2       Sünderhauf & Protzel (2012)

The last is the closed form of switchable constraints by Agarwal et al. (2013, eq. 15): the switch
s = min(1, 2 phi / (phi + e^2)) scales the residual, and its square the information.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.observation import Observation
from robins.filters.rule import Rule, hooks
from robins.filters.rules._robust import MOST, shares, weighed

LEAST = 1.0 / MOST  # beyond it a component is refused


def huber_weight(k: float) -> Callable[[Array], Array]:
    """Full weight up to k standard deviations, then a constant pull."""
    return lambda e: k / jnp.maximum(jnp.abs(e), k)


def student_weight(dof: float) -> Callable[[Array], Array]:
    """Weight of a residual with the tails of Student's t."""
    return lambda e: (dof + 1.0) / (dof + e**2)


def switch_weight(phi: float) -> Callable[[Array], Array]:
    """Square of the switch of a switchable constraint with prior weight phi."""
    return lambda e: jnp.minimum(1.0, 2.0 * phi / (phi + e**2)) ** 2


def by_component(
    weight: Callable[[Array], Array], name: str = "weights", iterations: int = 5
) -> Rule:
    """The rule: the noise of each component by its own weight.

    Notes: ``name.least``, the least weight of a component present, and ``name.mean``.

    Args:
        weight: (m,) residuals in standard deviations -> (m,) weights in (0, inf).
        name: prefix of the notes.
        iterations: of the weights, at least 1.

    Raises:
        ValueError: there is no iteration.
    """
    require(iterations >= 1, "weights need at least 1 iteration", iterations)

    def weights(o: Observation) -> Array:
        of = shares(o)
        L, white = of.seen.factor, of.seen.white[:, None]
        variance = jnp.sum(of.noise**2, axis=1)
        own = jnp.sqrt(jnp.where(variance > 0.0, variance, jnp.inf))

        def better(_, w: Array) -> Array:
            scaled = of.noise / jnp.sqrt(w)[:, None]
            W = linalg.solve_lower(L, scaled)
            root = linalg.cholesky(of.prior + W @ W.T + of.idle)
            # what is left of the residual after the update is R S^-1 r
            e = scaled @ (W.T @ linalg.solve_spd(root, white))
            return jnp.maximum(weight(e[:, 0] / own), LEAST)

        return jax.lax.fori_loop(0, iterations, better, jnp.ones(len(own)))

    def before(memory, prior: Belief, o: Observation):
        given, w = weighed(o, 1.0 / weights(o))
        there = o.present & o.accepted
        least = jnp.min(jnp.where(there, w, 1.0))
        mean = jnp.sum(jnp.where(there, w, 0.0)) / jnp.maximum(jnp.sum(there.astype(float)), 1.0)
        return memory, prior, given.noted(name, least=least, mean=mean)

    return hooks(before=before, name=name)
