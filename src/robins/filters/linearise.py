r"""Linearisations: first-order Taylor, unscented, cubature.

All of them return a statistical linear regression y ~ F x + c + e, e ~ N(0, Omega) (Särkkä 2013,
sec. 5.3; Arasaratnam, Haykin & Elliott 2007), so one Kalman update serves them all. The update
needs F S, the *spread*, not F itself: sigma points give it without inverting S, which may be
singular.

Symmetric points m +- c s_i (s_i column i of S, c^2 = alpha^2 (n + kappa)) split each
function value into an odd part o_i, which makes the spread, o_i / c, and an even part a_i =
(y_i+ + y_i-)/2 - y_0, which makes the mean shift b = 2 w sum a_i and the residual covariance

    Omega = 2 w sum a_i a_i' + (beta - alpha^2) b b',        w = 1 / (2 c^2).

The textbook form sums squares about the mean with weights Wc_0 of either sign and size 1/alpha^2;
here the cancellation is analytic. No subtraction is left for beta >= alpha^2, at any alpha; for
beta < alpha^2 a shift of the a_i by s b removes it as long as 1 + 2 n w (beta - alpha^2) >= 0, that
is kappa alpha^2 + n beta >= 0. Beyond that Omega can be indefinite: the update then subtracts a
deficit, and returns `Code.INDEFINITE` where no covariance is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg, manifold
from robins.filters.belief import Belief, Number
from robins.filters.model import Data, Motion, Sensor, as_noise
from robins.filters.observation import Observation, innovation
from robins.filters.values import kind, value
from robins.linalg.rows import each_row
from robins.manifold import State

NARROWEST = 1e3 * float(jnp.finfo(float).eps)  # least (n + lambda) / n of sigma points


class Transition(NamedTuple):
    """Linearisation of a motion about a belief."""

    mean: State  # predicted
    spread: Array  # (n, n) F S; cross-covariance with the state before is S @ spread.T
    excess: Array  # (n, k) factor of the linearisation error Omega; k = 0 for Taylor
    noise: Array  # (n, q) factor of the process noise
    deficit: Array | None = None  # (n,) vector whose square is subtracted, for indefinite weights
    points: Points | None = None  # where the update reuses sigma points


class Points(NamedTuple):
    """Predicted sigma points, and the process noise that they do not include."""

    states: State  # leading axis 2n + 1, centre first
    noise: Array  # (n, n) factor


Regressed = tuple[State, Array, Array, Array | None]  # mean, spread, excess, deficit


class Linearisation:
    """Base class of linearisations: `taylor`, `unscented`, `cubature`, `iterated`.

    Attributes:
        transition: ``(belief, motion, u) -> Transition``, a prediction.
        observation: ``(prior, sensor, y, aux) -> Observation``, a measurement relative to a belief.
        redraw: true if each update draws points of its own, if it uses any.
        drawn: ``belief -> points`` for an update that draws none.
        first_observation: ``(points, prior, sensor, y, aux) -> Observation`` by these.
    """

    redraw: bool = True

    def transition(self, belief: Belief, motion: Motion, u: Data) -> Transition:
        raise NotImplementedError(f"{type(self).__name__} has no method `transition`")

    def observation(self, prior: Belief, sensor: Sensor, y: Data, aux: Data) -> Observation:
        raise NotImplementedError(f"{type(self).__name__} has no method `observation`")

    def drawn(self, belief: Belief) -> Data:
        return ()

    def first_observation(
        self, points: Data, prior: Belief, sensor: Sensor, y: Data, aux: Data
    ) -> Observation:
        return self.observation(prior, sensor, y, aux)


def _form(x: State) -> Hashable:
    """Structure and shapes, comparable without `__eq__` of an element."""
    leaves, tree = jax.tree_util.tree_flatten(x, is_leaf=lambda leaf: leaf is None)
    return tree, tuple(None if leaf is None else jnp.shape(leaf) for leaf in leaves)


def _magnitude(x: State) -> Array:
    """(n,) magnitude of the numbers behind each tangent component; rounding is 1e-16 of it."""

    def of(leaf: State) -> Array:
        if not manifold.is_element(leaf):
            return jnp.abs(leaf).reshape(-1)
        # tangent vector of one unit in the last place, in any representation
        moved = jax.tree_util.tree_map(lambda v: jnp.nextafter(v, jnp.inf), leaf)
        return jnp.abs(leaf.local(moved)).reshape(-1) / jnp.finfo(float).eps

    return jnp.concatenate([of(leaf) for leaf in manifold.leaves(jax.lax.stop_gradient(x))])


def _observe(
    sensor: Sensor, prior: Belief, y: Data, aux: Data, reading: Regressed, size: Array
) -> Observation:
    """Observation from a predicted measurement z and its linearisation."""
    z, spread, excess, deficit = reading
    if _form(z) != _form(y):
        reads, given = jax.tree_util.tree_map(jnp.shape, (z, y))
        raise ValueError(
            f"sensor '{sensor.name}' reads shape {reads}, but was given {given} to compare"
        )
    if manifold.dim(z) != sensor.dim:
        raise ValueError(
            f"sensor '{sensor.name}' says dim = {sensor.dim}, but reads {manifold.dim(z)} numbers"
        )
    residual, present = innovation(z, y)
    return Observation(
        sensor=sensor.name,
        prior=prior,
        residual=residual,
        present=present,
        accepted=present,
        spread=spread,
        excess=excess,
        noise=sensor.noise_factor(prior.mean, aux),
        size=size,
        deficit=deficit,
    )


def _jacobian(g: Callable[[State], State], x: State) -> tuple[State, Array]:
    """``g(x)`` and the Jacobian of g between the tangent spaces at x and at g(x)."""
    value = g(x)
    origin = jnp.zeros(manifold.dim(x))
    return value, jax.jacfwd(lambda d: manifold.local(value, g(manifold.retract(x, d))))(origin)


@value
class Taylor(Linearisation):
    """Linearisation of `taylor`."""

    def transition(self, belief: Belief, motion: Motion, u: Data) -> Transition:
        if motion.linear is not None:
            mean, F, given = motion.linear(belief.mean, u)
            noise = as_noise(given, F.shape[0], "the motion")
        else:
            mean, F = _jacobian(lambda x: motion.moved(x, u), belief.mean)
            noise = motion.noise_factor(belief.mean, u)
        return Transition(mean, F @ belief.factor, jnp.zeros((F.shape[0], 0)), noise)

    def observation(self, prior: Belief, sensor: Sensor, y: Data, aux: Data) -> Observation:
        if sensor.linear is not None:
            z, H = sensor.linear(prior.mean, aux)
        else:
            z, H = _jacobian(lambda x: sensor.reading(x, aux), prior.mean)
        size = jnp.abs(H) @ (prior.sigma + _magnitude(prior.mean))
        nothing = jnp.zeros((sensor.dim, 0))
        return _observe(sensor, prior, y, aux, (z, H @ prior.factor, nothing, None), size)


def taylor() -> Linearisation:
    """First-order Taylor expansion at the mean: the extended Kalman filter.

    It uses ``linear`` of the model if given, else forward-mode automatic differentiation.
    """
    return Taylor()


class SigmaWeights(NamedTuple):
    """Weights of 2n + 1 symmetric sigma points, centre first (Wan & van der Merwe 2000)."""

    mean: Array  # (2n+1,)
    covariance: Array  # (2n+1,)
    reach: float  # c: points lie at m +- c s_i


def sigma_weights(n: int, alpha: Number, beta: Number, kappa: Number) -> SigmaWeights:
    """Weights of the sigma points of n dimensions.

    Raises:
        ValueError: n + kappa or alpha is not positive, or the points are so close together that
            their differences are rounding.
    """
    if not (alpha > 0.0 and n + kappa > 0.0):
        raise ValueError(
            f"sigma points need alpha > 0 and n + kappa > 0, got alpha = {alpha}, "
            f"n = {n}, kappa = {kappa}"
        )
    c_sq = alpha**2 * (n + kappa)
    if c_sq < NARROWEST * n:
        raise ValueError(
            f"sigma points with alpha = {alpha} are too close together: n + lambda = {c_sq:.1e} of "
            f"n = {n} vanishes in rounding; take alpha from 1e-3 to 1"
        )
    wm0 = 1.0 - n / c_sq
    ring = jnp.full(2 * n, 1.0 / (2.0 * c_sq))
    mean = jnp.concatenate([jnp.array([wm0]), ring])
    cov = jnp.concatenate([jnp.array([wm0 + 1.0 - alpha**2 + beta]), ring])
    return SigmaWeights(mean, cov, math.sqrt(c_sq))


def sigma_points(belief: Belief, reach: Number) -> State:
    """States, with a leading axis of 2n + 1: the mean, then +reach and -reach times the columns."""
    n = belief.factor.shape[0]
    ring = reach * belief.factor.T
    offsets = jnp.concatenate([jnp.zeros((1, n)), ring, -ring])
    return each_row(partial(manifold.retract, belief.mean), offsets)


def _regress(values: State, n: int, alpha: Number, beta: Number, kappa: Number) -> Regressed:
    """Mean, spread, excess and deficit of function values at sigma points (module docstring)."""
    w = sigma_weights(n, alpha, beta, kappa)
    ring = 1.0 / (2.0 * w.reach**2)
    centre = jax.tree_util.tree_map(lambda v: v[0], values)

    def split(origin: State) -> tuple[Array, Array, Array]:
        d = each_row(partial(manifold.local, origin), values)
        plus, minus = d[1 : n + 1], d[n + 1 :]
        even = 0.5 * (plus + minus) - d[:1]
        return d[0], even, (plus - minus) / (2.0 * w.reach)

    offset, even, spread = split(centre)
    mean = manifold.retract(centre, offset + 2.0 * ring * jnp.sum(even, axis=0))
    if any(manifold.is_element(x) for x in manifold.leaves(centre)):
        # On a curved space deviations are about the mean, not about the centre point.
        _, even, spread = split(mean)
    b = 2.0 * ring * jnp.sum(even, axis=0)

    lack = beta - alpha**2
    root = math.sqrt(2.0 * ring)
    if lack >= 0.0:
        columns = [root * even.T] + ([math.sqrt(lack) * b[:, None]] if lack > 0.0 else [])
        return mean, spread.T, jnp.concatenate(columns, axis=1), None
    nu = n / (alpha**2 * (n + kappa))  # 2 n w
    # 1 + nu (beta - alpha^2), written so that it is exactly zero for the cubature points
    room = (kappa * alpha**2 + n * beta) / (alpha**2 * (n + kappa))
    if room >= 0.0:
        shift = (1.0 - math.sqrt(room)) / nu  # s of s^2 nu - 2 s = beta - alpha^2
        return mean, spread.T, root * (even - shift * b[None, :]).T, None
    return mean, spread.T, root * even.T, math.sqrt(-lack) * b


@value
class Unscented(Linearisation):
    """Linearisation of `unscented`. Its numbers choose columns and signs, so they are kinds."""

    numbers: tuple[float, float, float] = kind()
    redraw: bool = kind()

    def reach(self, n: int) -> float:
        """Distance c of the points, in columns of the factor."""
        return sigma_weights(n, *self.numbers).reach

    def transition(self, belief: Belief, motion: Motion, u: Data) -> Transition:
        n = belief.factor.shape[0]
        points = sigma_points(belief, self.reach(n))
        values = each_row(lambda x: motion.moved(x, u), points)
        mean, spread, excess, deficit = _regress(values, n, *self.numbers)
        noise = motion.noise_factor(belief.mean, u)
        moved = None if self.redraw else Points(values, of_width(noise, n))
        return Transition(mean, spread, excess, noise, deficit, moved)

    def observation(self, prior: Belief, sensor: Sensor, y: Data, aux: Data) -> Observation:
        n = prior.factor.shape[0]
        reach = self.reach(n)
        values = each_row(lambda x: sensor.reading(x, aux), sigma_points(prior, reach))
        reading = _regress(values, n, *self.numbers)
        size = jnp.max(jax.vmap(_magnitude)(values), axis=0) / reach
        return _observe(sensor, prior, y, aux, reading, size)

    def drawn(self, belief: Belief) -> Data:
        if self.redraw:
            return ()
        n = belief.factor.shape[0]
        return Points(sigma_points(belief, self.reach(n)), jnp.zeros((n, n)))

    def first_observation(
        self, points: Data, prior: Belief, sensor: Sensor, y: Data, aux: Data
    ) -> Observation:
        if self.redraw:
            return self.observation(prior, sensor, y, aux)
        n = prior.factor.shape[0]
        values = each_row(lambda x: sensor.reading(x, aux), points.states)
        _, *state, lack = _regress(points.states, n, *self.numbers)
        z, *reading, deficit = _regress(values, n, *self.numbers)
        if lack is not None or deficit is not None:
            alpha, beta, kappa = self.numbers
            raise ValueError(
                "sigma points can be used again only where kappa alpha^2 + n beta >= 0, got "
                f"alpha = {alpha}, beta = {beta}, kappa = {kappa}, n = {n}"
            )
        # State and reading are combinations of the same unit deviations, process noise aside:
        # state = S T with T T' = I, so the part of the reading in the row space of T is its spread,
        # and the orthogonal part its excess.
        wide = jnp.concatenate([*state, points.noise], axis=1)
        deviation = jnp.concatenate([*reading, jnp.zeros((sensor.dim, n))], axis=1)
        solid, independent = linalg.guard(prior.factor)
        T = jnp.where(independent[:, None], linalg.solve_lower(solid, wide), 0.0)
        spread = deviation @ T.T
        size = jnp.max(jax.vmap(_magnitude)(values), axis=0) / self.reach(n)
        return _observe(sensor, prior, y, aux, (z, spread, deviation - spread @ T, None), size)


def unscented(
    alpha: Number = 1.0, beta: Number = 2.0, kappa: Number = 0.0, redraw: bool = True
) -> Linearisation:
    """Sigma points (Julier & Uhlmann 2004), drawn before every prediction and update.

    The defaults put points at +- sqrt(n) standard deviations. kappa alpha^2 + n beta >= 0 keeps
    every covariance a sum of squares. On linear models any values give the Kalman filter.

    Args:
        alpha: spread of the points, without unit, as beta and kappa.
        beta: addition to the covariance weight of the centre point; 2 is best for Gaussians.
        kappa: second parameter of the spread; 3 - n in older texts, 0 here.
        redraw: False updates with the predicted points, as in many papers. These do not include the
            process noise, so the gain ignores it: not optimal unless the noise is small. They serve
            the first update after a prediction, if no rule fades the prior; other updates draw new
            points.
    """
    # kinds must be hashable, which arrays are not
    return Unscented((float(alpha), float(beta), float(kappa)), redraw)


def of_width(factor: Array, width: int) -> Array:
    """Factor of the same covariance with `width` columns; width is at least the number of rows."""
    n, k = factor.shape
    if k > width:
        factor, k = linalg.tria(factor), n
    return jnp.concatenate([factor, jnp.zeros((n, width - k))], axis=1)


def cubature() -> Linearisation:
    """Third-degree spherical-radial cubature (Arasaratnam & Haykin 2009): 2n equal weights."""
    return unscented(alpha=1.0, beta=0.0, kappa=0.0)


def unscented_transform(
    belief: Belief,
    g: Callable[[State], State],
    alpha: Number = 1.0,
    beta: Number = 2.0,
    kappa: Number = 0.0,
) -> Belief:
    """Propagate a belief through a function by sigma points, without noise."""
    n = belief.factor.shape[0]
    values = each_row(g, sigma_points(belief, sigma_weights(n, alpha, beta, kappa).reach))
    mean, spread, excess, deficit = _regress(values, n, alpha, beta, kappa)
    factor = linalg.tria(spread, excess)
    return Belief(mean, factor if deficit is None else linalg.downdate(factor, deficit))
