"""What robust rules share: parts of an innovation's covariance, heavier noise, wider priors."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from robins import linalg
from robins.filters.belief import Belief
from robins.filters.observation import Normalised, Observation, left_out, normalised, whiten


class Shares(NamedTuple):
    """Parts of S = H P H' + Omega + R in units of S = L L', where they add up to the identity.

    With R and P rescaled, L^-1 S L^-T is a weighted sum of these parts: no subtraction, however
    large the weights, and no factor larger than the measurement.
    """

    seen: Normalised  # the innovation, with L and w = L^-1 r
    noise: Array  # (m, q) factor N of R, zero where not used
    white_noise: Array  # (m, q) L^-1 N
    prior: Array  # (m, m) L^-1 (H P H' + Omega) L^-T
    idle: Array  # (m, m) ones on the diagonal where not used


def shares(o: Observation) -> Shares:
    """The parts of an innovation's covariance."""
    # What `normalised` does, and its blocks again: looking for what is used twice costs time.
    spread, excess, padded, deficit, used = left_out(o)
    L = linalg.tria(spread, excess, padded)
    if deficit is not None:
        L = linalg.downdate(L, deficit)
    seen, noise = whiten(L, used, o.residual), padded[:, : o.noise.shape[1]]
    columns = [spread, excess, noise] + ([] if deficit is None else [deficit[:, None]])
    white = linalg.solve_lower(L, jnp.concatenate(columns, axis=1))
    known = spread.shape[1] + excess.shape[1]
    W, rest = white[:, :known], white[:, known : known + noise.shape[1]]
    prior = W @ W.T
    if deficit is not None:
        prior = prior - white[:, -1:] @ white[:, -1:].T
    return Shares(seen, noise, rest, prior, jnp.diag(jnp.where(used, 0.0, 1.0)))


MOST = 1e12  # noise raised this far is noise of infinity, and still leaves digits to compare with
_STEPS = 40  # some four are needed; forty is a bound, not a plan
_CLOSE = 1e-13


def scale_to_quantile(o: Observation, limit: ArrayLike, seen: Normalised | None = None) -> Array:
    r"""Factor s >= 1 of R such that the normalised innovation squared equals a limit.

    Solves r' (H P H' + s R)^-1 r = limit, the joint Mahalanobis distance of Chang (2014); exactly 1
    where the NIS is not above the limit. With S = H P H' + R = L L', w = L^-1 r, B = L^-1 R L^-T

        g(s) = w' (I + (s - 1) B)^-1 w,

    and 1 / g is concave in s, so that Newton's steps on it climb to the root from s = 1 without
    ever passing it (the secular equation of trust regions; Moré & Sorensen 1983), and reach it in
    one where there is one component.

    Args:
        o: the measurement as the prior sees it; components not used do not count.
        limit: () upper bound of the NIS, more than 0.
        seen: `normalised` of the observation, where it is known already.

    Returns:
        () the factor of the covariance R, at most 1e12: an innovation without noise of its own
        cannot be made likely. Its derivative is that of the root.
    """
    seen = normalised(o) if seen is None else seen
    noise = jnp.where(seen.used[:, None], o.noise, 0.0)
    W = linalg.solve_lower(seen.factor, noise)
    B = W @ W.T
    above = seen.nis > limit
    nis = jnp.where(above, seen.nis, 1.0)
    ratio = jnp.where(above, nis / limit, 1.0)
    unit = jnp.where(above, seen.white, 0.0) / jnp.sqrt(nis)
    B_, unit_, ratio_ = jax.lax.stop_gradient((B, unit, ratio))

    def at(s):
        """Of the unit innovation: (I + (s-1) B)^-1 u, g and -g'."""
        L = linalg.cholesky(jnp.eye(len(unit_)) + (s - 1.0) * B_)
        v = linalg.solve_spd(L, unit_[:, None])[:, 0]
        return v, unit_ @ v, v @ (B_ @ v)

    def unfinished(state):
        s, (_, g, _), count = state
        return (g * ratio_ > 1.0 + _CLOSE) & (s < MOST) & (count < _STEPS)

    def newton(state):
        s, (_, g, slope), count = state
        step = (g * ratio_ - 1.0) * g / jnp.where(slope > 0.0, slope, 1.0)
        s = jnp.minimum(jnp.where(slope > 0.0, s + step, MOST), MOST)
        return s, at(s), count + 1

    first = jnp.ones(()), (unit_, jnp.sum(unit_**2), unit_ @ (B_ @ unit_)), 0
    s, (v, g, slope), _ = jax.lax.while_loop(unfinished, newton, first)
    # One more step whose value is rounding but whose derivative is the root's: dg is 2 v'du -
    # (s-1) v'dB v, whatever else v depends on.
    again = 2.0 * (v @ unit) - v @ v - (s - 1.0) * (v @ (B @ v))
    free = above & (s < MOST) & (slope > 0.0)
    turn = jnp.where(free, g / jnp.where(free, slope, 1.0), 0.0)
    return jnp.where(above, s + turn * (again * ratio - 1.0), 1.0)


def widened(due: Array, prior: Belief, o: Observation, chosen: Array, root: Array) -> Belief:
    r"""The prior with a covariance D added to what some components see, where that is due.

        P' = P + G D G',   G = P H' (H P H')^-1,   so that H G = I and H P' H' = H P H' + D,

    H being the rows of those components. The state's other directions follow as far as they are
    correlated with those seen; otherwise their variance stays. A component that is known exactly
    stays so: its column of G is 0.

    Args:
        due: () bool; without it the prior stands.
        prior: the belief.
        o: the measurement as this belief sees it.
        chosen: (m,) bool, the components.
        root: (m, k) root of D; its other rows do not count.
    """

    def wider() -> Belief:
        spread = jnp.where(chosen[:, None], o.spread, 0.0)
        solid, _ = linalg.guard(spread, o.size)
        G_root = prior.factor @ (spread.T @ linalg.solve_spd(solid, root))
        return prior._replace(factor=linalg.tria(prior.factor, G_root))

    return jax.lax.cond(due, wider, lambda: Belief(*prior))
