"""Moments of Gaussian mixtures on a manifold: the Gaussian with the same mean and covariance."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg, manifold
from robins.filters.belief import Belief, StepInfo
from robins.filters.trees import select
from robins.linalg.rows import each_row
from robins.manifold import State

_ROUNDS = 6  # iterations of the mean on a curved space: error times about spread^2 in each


def log_normalised(log_weight: Array) -> tuple[Array, Array]:
    """Logarithms of weights scaled to sum to one, and the logarithm of their previous sum.

    If all weights are zero or NaN they become equal, and the second result is -inf.
    """
    log_weight = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight)
    total = jax.scipy.special.logsumexp(log_weight)
    lost = ~jnp.isfinite(total)
    even = jnp.full_like(log_weight, -jnp.log(float(log_weight.shape[0])))
    # A sum that is not finite is replaced, so that no derivative is NaN.
    safe = jnp.where(lost, 0.0, total)
    return jnp.where(lost, even, log_weight - safe), jnp.where(lost, -jnp.inf, total)


def root(weight: Array) -> Array:
    """Square root of weights, with a finite derivative at zero."""
    some = weight > 0.0
    return jnp.where(some, jnp.sqrt(jnp.where(some, weight, 1.0)), 0.0)


def mean_of(states: State, weight: Array, about: State) -> State:
    """Weighted mean of states (leading axis), by Gauss-Newton steps from ``about``.

    States of weight zero are ignored, even if they are not finite.
    """
    curved = any(manifold.is_element(leaf) for leaf in manifold.leaves(about))
    for _ in range(_ROUNDS if curved else 1):
        about = manifold.retract(about, weight @ _offsets(states, weight, about))
    return about


def deviations(states: State, factors: Array, weight: Array, mean: State) -> Array:
    """Columns of a factor of the mixture's covariance about a mean, one block per state.

    The covariance is the sum of w_i (J_i P_i J_i' + d_i d_i'), with d_i the tangent vector from the
    mean to state i, and J_i the Jacobian from the tangent space at state i to that at the mean.

    Args:
        states: leading axis r.
        factors: (r, n, k), zero rows and columns allowed; k = 0 for points.
        weight: (r,), sums to one.
        mean: a single state.

    Returns:
        (r, n, k + 1) blocks.
    """
    curved = any(manifold.is_element(leaf) for leaf in manifold.leaves(mean))

    def block(x: State, S: Array, w: Array) -> Array:
        x = select(w > 0.0, x, mean)  # a state of weight zero may not be finite
        share = root(w)
        kept = jnp.where(share > 0.0, S, 0.0)
        if S.shape[1] and curved:
            kept = _transport(mean, x) @ kept
        return share * jnp.concatenate([kept, manifold.local(mean, x)[:, None]], axis=1)

    return each_row(block, states, factors, weight)


def matched(beliefs: Belief, weight: Array, about: State) -> Belief:
    """Gaussian with the first two moments of a mixture (leading axis r), mean near ``about``."""
    mean = mean_of(beliefs.mean, weight, about)
    blocks = deviations(beliefs.mean, beliefs.factor, weight, mean)
    return Belief(mean, linalg.tria(side_by_side(blocks)))


def side_by_side(blocks: Array) -> Array:
    """(n, r k) matrix of (r, n, k) blocks side by side."""
    r, n, k = blocks.shape
    return jnp.moveaxis(blocks, 0, 1).reshape(n, r * k)


class Innovation(NamedTuple):
    """Innovation of a mixture of filters, with its covariance."""

    mean: Array  # (m,) y minus its prediction; NaN where missing
    expected: Array  # (m,) standard deviation of y - prediction, before robust rules raise noise
    factor: Array  # (m, m) factor of the innovation covariance; identity rows where not used
    nis: Array
    dof: Array

    def info(
        self, used: Array, gain: Array, code: Array, wrong: Array, log_likelihood: Array
    ) -> StepInfo:
        """Information of an update with this innovation, no notes; wrong: it is contradicted."""
        nis = jnp.where(wrong, jnp.inf, self.nis)
        innovation = self.mean, self.expected, self.factor
        return StepInfo(*innovation, gain, used, nis, self.dof, log_likelihood, code, {})


def innovation(seen: StepInfo, weight: Array, used: Array) -> Innovation:
    """Weighted moments of the innovations of several filters (leading axis)."""
    counts = (weight > 0.0)[:, None]
    missing = jnp.any(jnp.isnan(seen.innovation) & counts, axis=0)
    residual = jnp.where(counts & ~missing[None], seen.innovation, 0.0)
    mean = weight @ residual
    residual = jnp.where(used[None], residual, mean[None])
    factor = linalg.tria(side_by_side(deviations(residual, seen.factor, weight, mean)))
    white = linalg.solve_lower(factor, jnp.where(used, mean, 0.0)[:, None])[:, 0]
    spread = jnp.where(counts, seen.expected, 0.0) ** 2 + (residual - mean[None]) ** 2
    expected, mean = jnp.sqrt(weight @ spread), jnp.where(missing, jnp.nan, mean)
    return Innovation(mean, expected, factor, jnp.sum(white**2), jnp.sum(used))


def _offsets(states: State, weight: Array, about: State) -> Array:
    """(r, n) tangent vectors from a state to others; zero for those of weight zero."""

    def offset(x: State, w: Array) -> Array:
        return manifold.local(about, select(w > 0.0, x, about))

    return each_row(offset, states, weight)


def _transport(mean: State, x: State) -> Array:
    """Jacobian of ``local(mean, retract(x, e))`` at e = 0."""
    origin = jnp.zeros(manifold.dim(mean))
    return jax.jacfwd(lambda e: manifold.local(mean, manifold.retract(x, e)))(origin)
