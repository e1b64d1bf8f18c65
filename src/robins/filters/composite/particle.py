"""Particle filter, bootstrap and Rao-Blackwellised in one.

Gordon, Salmond & Smith, *Novel approach to nonlinear/non-Gaussian Bayesian state estimation*, IEE
Proc. F 140 (1993); Schön, Gustafsson & Nordlund, *Marginalized particle filters for mixed
linear/nonlinear state-space models*, IEEE Trans. Signal Processing 53 (2005).

A particle is a belief: exact in the components that are *sampled*, Gaussian in the rest. Each step

    predicts   a Kalman prediction of every particle, m and S S'. With the sampled components first,
               S = [[A, 0], [B, C]]: draw xi ~ N(0, I) and move the mean by [A; B] xi; the factor
               of the remaining covariance is [[0, 0], [0, C]].
    updates    a Kalman update of every particle; its likelihood, N(y; z, H S S' H' + R), weighs it.

With all components sampled no covariance remains: that is the bootstrap filter. With none it is the
Kalman filter. The draw conditions the rest on the sampled components, so if the model is linear in
the rest given these, each particle is exact (Rao-Blackwell).
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, Code, Number, StepInfo
from robins.filters.composite.mixture import Innovation, innovation, log_normalised, matched
from robins.filters.kalman import (
    Advanced,
    Filter,
    FilterState,
    Prediction,
    Updated,
    predicted_factor,
    updated,
)
from robins.filters.linearise import Linearisation, taylor
from robins.filters.model import Data, Motion, Sensor
from robins.filters.trees import finite, repeated, row_of, select
from robins.filters.values import Numbers, is_known, kind, number, value
from robins.linalg.rows import each_row
from robins.manifold import State

_GENERATOR = "threefry2x32"  # explicit, so that a key gives the same draws under any JAX setting


class ParticleCloud(NamedTuple):
    """Memory of a particle filter."""

    particles: Belief  # leading axis; rows of sampled components are zero in the factors
    log_weight: Array  # (count,), the weights sum to one
    key: Array  # (2,) uint32, key of the next draws


@value
class Particle(Filter):
    """Filter made by `particle`."""

    way: Linearisation
    key: Numbers  # (2,) words of the key as floats: JAX cannot differentiate by integers
    resample: Numbers  # () share of the count
    jitter: Numbers  # (2,) factor of a copy's deviation from the mean, and of its random move
    count: int = kind()
    chosen: tuple[int, ...] | None = kind()
    moves: bool = kind()  # resampled copies are moved

    def order(self, n: int) -> tuple[np.ndarray, int]:
        """Indices of the tangent components, sampled ones first, and the number of these."""
        first = tuple(range(n)) if self.chosen is None else self.chosen
        return np.array([*first, *(i for i in range(n) if i not in first)], dtype=int), len(first)

    def even(self) -> Array:
        """Logarithm of the weight of each particle if all are equal."""
        return -jnp.log(float(self.count))

    def drawn(self, key: Array, means: State, factors: Array) -> Belief:
        """Particles with the sampled components drawn and the rest conditioned on the draw."""
        n = factors.shape[1]
        order, k = self.order(n)
        back = np.argsort(order)
        xi = jax.random.normal(key, (self.count, k))

        def one(xi: Array, mean: State, S: Array) -> Belief:
            S = S if np.all(order == np.arange(n)) else linalg.tria(S[order])
            left = jnp.where((jnp.arange(n) < k)[None], 0.0, S)
            return Belief(manifold.retract(mean, (S[:, :k] @ xi)[back]), left[back])

        return each_row(one, xi, means, factors)

    def spread(self, belief: Belief, key: Array) -> FilterState:
        """New cloud drawn from a Gaussian belief."""
        key, now = _split(key, 1)
        weight = jnp.full(self.count, self.even())
        drawn = self.drawn(now, *repeated(belief, self.count))
        return FilterState(belief, ParticleCloud(drawn, weight, key))

    def gaussian(self, cloud: ParticleCloud) -> Belief:
        """Gaussian with the moments of the cloud."""
        best = row_of(cloud.particles.mean, jnp.argmax(cloud.log_weight))
        _, k = self.order(cloud.particles.factor.shape[1])  # the first k columns are zero
        slim = cloud.particles._replace(factor=cloud.particles.factor[:, :, k:])
        return matched(slim, jnp.exp(cloud.log_weight), best)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        n = belief.factor.shape[0]
        if self.chosen is not None and max(self.chosen, default=0) >= n:
            raise ValueError(f"sampled components {self.chosen}: the state has only {n}")
        return self.spread(belief, jnp.asarray(self.key).astype(jnp.uint32))

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        return self.spread(belief, state.memory.key)

    def refreshed(self, state: FilterState, choose: Array, jitter: Array) -> tuple[Belief, Array]:
        """Particles and log-weights, resampled if the weights are too uneven."""
        cloud = state.memory
        weight = jnp.exp(cloud.log_weight)
        due = _effective(weight) < jnp.asarray(self.resample) * float(self.count)
        index = jnp.where(due, _systematic(choose, weight), jnp.arange(self.count))
        particles = row_of(cloud.particles, index)
        if self.moves:
            particles = select(due, self.jittered(particles, state.belief, jitter), particles)
        return particles, jnp.where(due, self.even(), cloud.log_weight)

    def jittered(self, particles: Belief, cloud: Belief, key: Array) -> Belief:
        """Particles moved at random, and towards the mean, so that the moments are preserved."""
        order, k = self.order(cloud.factor.shape[0])
        some = order[:k]
        L = linalg.tria(cloud.factor[some])
        keep, move = jnp.asarray(self.jitter)

        def one(x: State, xi: Array) -> State:
            d = manifold.local(cloud.mean, x)
            d = d.at[some].set(keep * d[some] + move * (L @ xi))
            return manifold.retract(cloud.mean, d)

        xi = jax.random.normal(key, (self.count, k))
        return particles._replace(mean=each_row(one, particles.mean, xi))

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        key, choose, jitter, draw = _split(state.memory.key, 3)
        before, log_weight = self.refreshed(state, choose, jitter)

        def ahead(b: Belief):
            t = self.way.transition(b, motion, u)
            return t.mean, predicted_factor(t, "sqrt")

        after = self.drawn(draw, *each_row(ahead, before))
        sound = jax.vmap(finite)(after)
        log_weight, total = log_normalised(jnp.where(sound, log_weight, -jnp.inf))
        taken = jnp.isfinite(total)
        cloud = ParticleCloud(_each(sound, after, before), log_weight, key)
        new = FilterState(self.gaussian(cloud), cloud)
        new = select(taken, new, state._replace(memory=state.memory._replace(key=key)))
        code = jnp.where(taken, int(Code.DONE), int(Code.NOT_FINITE))
        return new, Prediction(None, new.belief, code)

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        before, log_prior, key = state.memory

        def one(b: Belief):
            o = self.way.observation(b, sensor, y, aux)
            posterior, info = updated(b, o, "sqrt")
            return posterior, info, b.factor @ jnp.where(info.used[:, None], o.spread, 0.0).T

        after, infos, cross = each_row(one, before)
        sound = jax.vmap(finite)((after, infos.log_likelihood))
        gained = jnp.where(sound, infos.log_likelihood, -jnp.inf)
        log_post, total = log_normalised(log_prior + gained)
        lost = ~jnp.isfinite(total)
        cloud = ParticleCloud(_each(sound, after, before), log_post, key)
        cloud = select(lost, state.memory, cloud)
        used = jnp.any(infos.used & sound[:, None], axis=0) & ~lost
        belief = select(jnp.any(used), self.gaussian(cloud), state.belief)
        info = _update_info(
            state, jnp.where(sound, log_prior, -jnp.inf), infos, cross, cloud, used, total
        )
        return FilterState(belief, cloud), info


def particle(
    count: int,
    key: ArrayLike,
    sampled: Sequence[int] | None = None,
    linearise: Linearisation | None = None,
    resample: Number = 0.5,
    regularise: Number = 0.0,
) -> Filter:
    """Particle filter; its belief is the Gaussian with the moments of the weighted cloud.

    The cloud itself is the state's memory, a `ParticleCloud`. The log-likelihood of an update is
    that of the weighted particles, log sum_i w_i L_i; ``particle.ess`` notes the effective number
    of particles, 1 / sum w^2. Before a prediction the cloud is resampled (systematic: Kitagawa
    1996) if that number has fallen below ``resample * count``.

    A particle that is not finite gets no weight. If the log-likelihood of a measurement is finite
    in no particle, the measurement is not used (``NOT_FINITE``).

    Runs with the same key draw the same numbers: give each run of a campaign its own key, by
    ``jax.vmap`` over keys or by `reseed`. There are no derivatives through the draws.

    Args:
        count: number of particles.
        key: seed or JAX key; may be traced.
        sampled: tangent components that are sampled; None: all. The model should be (nearly) linear
            in the rest given these.
        linearise: linearisation in the rest; `taylor()` by default. If all components are sampled,
            only its noise and predicted measurements are used.
        resample: share of ``count``, 0 (never) to 1 (always).
        regularise: after resampling, each sampled component moves at random by this share of the
            cloud's standard deviation and towards its mean, so that the cloud keeps its moments
            (Liu & West 2001): for states without process noise, whose particles would otherwise
            become identical. 0 leaves the copies; 0.1 is usual.

    Raises:
        ValueError: count is not positive, a share is not between 0 and 1, or sampled components
            are negative or repeated. When a run starts: the state has no such component.
    """
    count = operator.index(count)
    require(count >= 1, "a particle filter needs a positive count of particles", count)
    share, moved = (
        number(f"{name} of a particle filter must lie in 0..1", x, lambda s: (s >= 0) & (s <= 1))
        for name, x in (("resample", resample), ("regularise", regularise))
    )
    chosen = None if sampled is None else tuple(operator.index(i) for i in sampled)
    if chosen is not None and (len(set(chosen)) < len(chosen) or min(chosen, default=0) < 0):
        raise ValueError(f"sampled components must be different and not negative, got {chosen}")
    words, xp = _as_key(key).astype(float), np if is_known(moved) else jnp
    return Particle(
        way=taylor() if linearise is None else linearise,
        key=np.asarray(words) if is_known(words) else words,
        resample=share,
        jitter=xp.stack([xp.sqrt(1.0 - moved**2), moved], axis=-1),
        count=count,
        chosen=chosen,
        moves=not is_known(moved) or bool(np.any(moved > 0.0)),
    )


def reseed(state: FilterState, key: ArrayLike) -> FilterState:
    """State of a particle filter with another key for the next draws.

    The particles stay; `Filter.reset` draws them again.

    Args:
        state: state of a `particle` filter.
        key: seed or JAX key.
    """
    return state._replace(memory=state.memory._replace(key=_as_key(key)))


def _as_key(key: ArrayLike) -> Array:
    """Words of a key as numbers, which unlike keys can be saved."""
    if not jnp.issubdtype(jnp.result_type(key), jax.dtypes.prng_key):
        if jnp.shape(key) == (2,):
            return jnp.asarray(key, jnp.uint32)
        key = jax.random.key(key, impl=_GENERATOR)
    return jax.random.key_data(key)


def _split(key: Array, count: int) -> tuple[Array, ...]:
    """Words of the next key to keep, and keys to use."""
    keys = jax.random.split(jax.random.wrap_key_data(key, impl=_GENERATOR), count + 1)
    return jax.random.key_data(keys[0]), *keys[1:]


def _systematic(key: Array, weight: Array) -> Array:
    """Indices of resampled particles, each about count * weight times (Kitagawa 1996, sec. 3)."""
    count = weight.shape[0]
    upto = jnp.cumsum(weight)
    at = (jnp.arange(count, dtype=float) + jax.random.uniform(key)) / count * upto[-1]
    index = jnp.searchsorted(upto, at, side="right").astype(int)
    # Rounding may give an index past the end, or of a particle without weight.
    return jnp.minimum(index, jnp.max(jnp.where(weight > 0.0, jnp.arange(count), 0)))


def _effective(weight: Array) -> Array:
    return 1.0 / jnp.sum(weight**2)


def _update_info(
    state: FilterState,
    log_prior: Array,
    infos: StepInfo,
    cross: Array,
    cloud: ParticleCloud,
    used: Array,
    total: Array,
) -> StepInfo:
    """Information of the whole cloud.

    Args:
        state: state before the update.
        log_prior: (count,) log-weights before it; -inf for particles that cannot be updated.
        infos: information of each particle.
        cross: (count, n, m) covariance of state and measurement in each particle.
        cloud: cloud after the update.
        used: (m,) bool, components used.
        total: () log-likelihood of the measurement.
    """
    weight = jnp.exp(log_normalised(log_prior)[0])
    expected = innovation(infos, weight, used)
    gain = _gain(state.belief, state.memory.particles, infos, weight, cross, expected)
    # If no particle is left, each may have been contradicted: all sampled and R = 0.
    best = jnp.argmax(cloud.log_weight)
    wrong = infos.code[best] == int(Code.CONTRADICTED)
    lost = ~jnp.isfinite(total)
    gain = jnp.where(used[None], gain, 0.0)
    code = jnp.where(lost & ~wrong, int(Code.NOT_FINITE), infos.code[best])
    info = expected.info(used, gain, code, wrong, total)
    return info.noted("particle", ess=_effective(jnp.exp(cloud.log_weight)))


def _gain(
    prior: Belief, cloud: Belief, infos: StepInfo, weight: Array, cross: Array, expected: Innovation
) -> Array:
    """(n, m) gain of the whole cloud: cross-covariance times inverse innovation covariance."""
    d = jax.vmap(lambda x: manifold.local(prior.mean, x))(cloud.mean)
    apart = jnp.where(jnp.isnan(expected.mean)[None], 0.0, expected.mean[None] - infos.innovation)
    counts = weight > 0.0
    d, apart = jnp.where(counts[:, None], d, 0.0), jnp.where(counts[:, None], apart, 0.0)
    cross = jnp.where(counts[:, None, None], cross, 0.0)
    covariance = jnp.einsum("i,inm->nm", weight, cross) + (d * weight[:, None]).T @ apart
    return linalg.solve_spd(expected.factor, covariance.T).T


def _each(condition: Array, new: Belief, old: Belief) -> Belief:
    """Select new or old particle by particle."""
    return jax.vmap(select)(condition, new, old)
