"""Iterated filters: linearisation about the updated state."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.linearise import Linearisation, Transition, taylor
from robins.filters.model import Data, Motion, Sensor
from robins.filters.observation import Observation, left_out, whiten
from robins.filters.values import kind, value
from robins.manifold import State

# Below this share of the prior's spread, differences between sigma points are rounding.
_NARROW = 1e-6


@value
class Iterated(Linearisation):
    """Linearisation of `iterated`: e_i+1 = K_i (y - g(e_i) + H_i e_i)."""

    way: Linearisation
    iterations: int = kind()

    def transition(self, belief: Belief, motion: Motion, u: Data) -> Transition:
        return self.way.transition(belief, motion, u)

    def observation(self, prior: Belief, sensor: Sensor, y: Data, aux: Data) -> Observation:
        first = self.way.observation(prior, sensor, y, aux)
        if self.iterations == 1:
            return first
        by_slope = first.excess.shape[1] == 0  # Taylor: independent of the covariance

        def look(t: Array, M: Array) -> Observation:
            return self.look(prior, sensor, y, aux, t, M)

        t, M = jax.lax.fori_loop(
            0,
            self.iterations - 2,
            lambda _, state: _updated(look(*state), by_slope),
            _updated(first, by_slope),
        )
        return look(t, M)

    def look(
        self, prior: Belief, sensor: Sensor, y: Data, aux: Data, t: Array, M: Array
    ) -> Observation:
        """Observation relative to the prior, linearised at retract(m, S t) with factor S M."""
        mean, S = _carried(prior, t)
        o = self.way.observation(Belief(mean, S @ M), sensor, y, aux)
        spread = linalg.solve_lower_transposed(M, o.spread.T).T
        residual = jnp.where(o.present, o.residual + spread @ t, 0.0)
        return o._replace(prior=prior, residual=residual, spread=spread)


def _updated(o: Observation, by_slope: bool) -> tuple[Array, Array]:
    """Posterior in units of the prior: the state moves by S t, its factor is S M."""
    unit = jnp.eye(o.prior.factor.shape[0])
    spread, excess, noise, deficit, used = left_out(o)
    S_y, cross, M = linalg.block_factor(spread, (excess, noise), unit, deficit)
    t = cross @ whiten(S_y, used, o.residual).white
    narrow = by_slope | jnp.any(jnp.diagonal(M) < _NARROW)
    return t, jnp.where(narrow, unit, M)


def iterated(linearise: Linearisation | None = None, iterations: int = 4) -> Linearisation:
    """Linearisation of a measurement about its own update.

    With Taylor this is the iterated extended Kalman filter, Gauss-Newton on the posterior density
    (Bell & Cathey 1993, eq. 12), with the most probable state as fixed point. In the tangent space
    of the prior mean m, with g(e) = h(retract(m, e)) and H_i its Jacobian at e_i,

        e_i+1 = K_i (y - g(e_i) + H_i e_i),        K_i = P H_i' (H_i P H_i' + R)^-1

    With sigma points it is iterated posterior linearisation: the regression is over the last
    posterior, mean and covariance (García-Fernández, Svensson, Morelande & Särkkä 2015, sec. III).
    Where a measurement leaves less than 1e-6 of a prior standard deviation, differences between
    points would be rounding: their spread is then the prior's, about the new mean (Sibley, Sukhatme
    & Matthies 2006).

    Rules and `StepInfo.innovation` get the *effective* residual y - g(e) + H e of the last
    linearisation; the earlier ones use the sensor's own noise and all components. Gauss-Newton is
    not damped, so it need not converge where the measurement is far from its prediction.

    Args:
        linearise: each linearisation; `taylor` by default.
        iterations: number of linearisations; 1 is the filter without iteration.

    Raises:
        ValueError: iterations is not positive, or `linearise` reuses predicted sigma points.
    """
    require(iterations >= 1, "iterated: iterations must be at least 1", iterations)
    way = taylor() if linearise is None else linearise
    require(
        way.redraw,
        "iterated: points that were predicted cannot be drawn about another mean; "
        "use unscented(redraw=True)",
    )
    return Iterated(way, iterations)


def _carried(prior: Belief, t: Array) -> tuple[State, Array]:
    """State retract(m, S t), and S in its tangent space."""
    S = prior.factor
    mean = manifold.retract(prior.mean, S @ t)
    if not any(manifold.is_element(leaf) for leaf in manifold.leaves(prior.mean)):
        return mean, S

    def moved(shift: Array) -> Array:
        return manifold.local(mean, manifold.retract(prior.mean, S @ (t + shift)))

    return mean, jax.jacfwd(moved)(jnp.zeros_like(t))
