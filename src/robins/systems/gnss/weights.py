r"""Robust weights by satellite: each component of a vector of pseudoranges has its own weight.

The rules `huber` and `student_t` of `robins.filters.rules` weight a measurement as a whole. Here
one reflected signal must not reduce the weight of the others. A component's residual is taken
*after* the update, where the clock, which all satellites share, is known, and the update is
repeated (iteratively reweighted least squares, started at the Kalman filter)::

    e_i = (y - h(x+))_i / sqrt(R_ii),   w_i = w(e_i),   R_ij becomes R_ij / sqrt(w_i w_j)

    huber        w = min(1, k / |e|)                     Huber (1964)
    student-t    w = (nu + 1) / (nu + e^2)               Lange, Little & Taylor (1989)
    switchable   w = min(1, 2 phi / (phi + e^2))^2       Sünderhauf & Protzel (2012)

The last is the closed form of switchable constraints by Agarwal et al. (2013, eq. 15): the switch
s = min(1, 2 phi / (phi + e^2)) scales the residual, and its square the information.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.rules._robust import MOST, reweighted, weighed
from robins.filters.values import Numbers, kind, number, value

LEAST = 1.0 / MOST  # a component with less weight is refused


def huber_weight(k: float) -> Callable[[Array], Array]:
    """Huber's weight: full up to k standard deviations, then of constant influence."""
    return Partial(_huber, number("k must be a number", k))


def _huber(k: Numbers, e: Array) -> Array:
    return k / jnp.maximum(jnp.abs(e), k)


def student_weight(dof: float) -> Callable[[Array], Array]:
    """Weight of a residual distributed as Student's t with `dof` degrees of freedom."""
    return Partial(_student, number("dof must be a number", dof))


def _student(dof: Numbers, e: Array) -> Array:
    return (dof + 1.0) / (dof + e**2)


def switch_weight(phi: float) -> Callable[[Array], Array]:
    """Square of the switch of a switchable constraint with prior weight phi."""
    return Partial(_switch, number("phi must be a number", phi))


def _switch(phi: Numbers, e: Array) -> Array:
    return jnp.minimum(1.0, 2.0 * phi / (phi + e**2)) ** 2


@value
class ByComponent(Rule):
    """Rule of `by_component`: R_ij / sqrt(w_i w_j), with weights from the posterior residuals."""

    weight: Callable[[Array], Array]
    name: str = kind()
    iterations: int = kind()

    def before(self, memory: Memory, prior: Belief, o: Observation):
        """Scale the noise of each component by its own weight."""
        w = reweighted(o, lambda e: jnp.maximum(self.weight(e), LEAST), self.iterations)
        given, w = weighed(o, 1.0 / w)
        there = o.present & o.accepted
        least = jnp.min(jnp.where(there, w, 1.0))
        mean = jnp.sum(jnp.where(there, w, 0.0)) / jnp.maximum(jnp.sum(there.astype(float)), 1.0)
        return memory, prior, given.noted(self.name, least=least, mean=mean)


def by_component(
    weight: Callable[[Array], Array], name: str = "weights", iterations: int = 5
) -> Rule:
    """Rule that scales the noise of each component by its own weight.

    Notes: ``name.least``, the least weight of a component present, and ``name.mean``.

    Args:
        weight: (m,) residuals in standard deviations -> (m,) weights in (0, inf).
        name: prefix of the notes.
        iterations: number of reweightings, at least 1.

    Raises:
        ValueError: there are fewer.
    """
    require(iterations >= 1, "weights need at least 1 iteration", iterations)
    return ByComponent(weight, name, iterations)
