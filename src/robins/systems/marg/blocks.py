"""Samples to blocks and back: the integrals a filter steps by, and attitudes at every sample."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import rotation
from robins.systems.marg.model import MargState


class Samples(NamedTuple):
    """Increments in blocks of n; a block that is not full ends in increments of no length."""

    dt_s: Any  # (K, n)
    theta: Any  # (K, n, 3) rad, rotation vector of each interval
    dv: Any  # (K, n, 3) m/s
    field_b: Any  # (K, n, 3) T at the end of each interval; NaN where there is none


class Integrals(NamedTuple):
    """What blocks integrate to; see `model.Block`."""

    dt_s: Array  # (K,)
    turn: Array  # (K, 4)
    dv: Array  # (K, 3)
    turn_time: Array  # (K, 3, 3)
    turn_rates: Array  # (K, 3, 9)
    angle: Array  # (K,)
    field_b: Array  # (K, 3) T, mean in body axes at the end; NaN where there is none


def _of_block(samples: Samples) -> Integrals:
    """Of one block: leading axis n."""

    def add(q, row):
        dt, theta, dv, field_b = row
        half = rotation.to_dcm(rotation.multiply(q, rotation.from_rotvec(0.5 * theta)))
        pushed = rotation.rotate(q, dv)
        q = rotation.multiply(q, rotation.from_rotvec(theta))
        there = jnp.all(jnp.isfinite(field_b))
        field = jnp.where(there, rotation.rotate(q, jnp.where(there, field_b, 0.0)), 0.0)
        rates = (half[:, :, None] * theta[None, None, :]).reshape(3, 9)
        angle = jnp.sqrt(jnp.sum(theta * theta))
        return q, (pushed, half * dt, rates, angle, field, there.astype(float))

    start = jnp.array([1.0, 0.0, 0.0, 0.0])
    q, rows = jax.lax.scan(add, start, tuple(samples))
    dv, turn_time, turn_rates, angle, field, count = (jnp.sum(r, axis=0) for r in rows)
    q = rotation.normalise(q)
    mean = field / jnp.where(count > 0.0, count, jnp.nan)
    field_b = rotation.rotate(rotation.conjugate(q), mean)
    return Integrals(jnp.sum(samples.dt_s), q, dv, turn_time, turn_rates, angle, field_b)


@jax.jit
def integrate(samples: Samples) -> Integrals:
    """Integrate every block by itself."""
    return jax.vmap(_of_block)(samples)


def _turns(bias: Array, gain: Array, dt: Array, theta: Array) -> Array:
    """(n, 4) attitude at each sample against the start of the block."""

    def add(q, row):
        dt, theta = row
        true = theta + gain @ theta - bias * dt
        q = rotation.multiply(q, rotation.from_rotvec(true))
        return q, q

    return jax.lax.scan(add, jnp.array([1.0, 0.0, 0.0, 0.0]), (dt, theta))[1]


@jax.jit
def causal_attitudes(
    start: MargState, posterior: MargState, samples: Samples
) -> Float[Array, "K n 4"]:
    """Attitude at every sample from what was known by then.

    Inside a block the last posterior is carried on by the gyro; at its end stands the new one.

    Args:
        start: the state before the first block.
        posterior: states at the ends of the blocks, leading axis K.
        samples: of the blocks.
    """
    before = jax.tree_util.tree_map(
        lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b[:-1]]), start, posterior
    )
    turned = jax.vmap(_turns)(before.gyro_bias, before.gyro_gain, samples.dt_s, samples.theta)
    q = rotation.normalise(rotation.multiply(before.q_nb.wxyz[:, None, :], turned))
    return q.at[:, -1].set(posterior.q_nb.wxyz)


@jax.jit
def smoothed_attitudes(
    smoothed: MargState, samples: Samples
) -> tuple[Float[Array, "K n 4"], Float[Array, "4"]]:
    """Attitude at every sample from smoothed states at the ends of blocks, and at the start.

    The gyro carries each state over the next block; what it misses the next one by is laid over
    the block in equal parts. The first block is gone through backwards.
    """
    bias, gain, q_end = smoothed.gyro_bias, smoothed.gyro_gain, smoothed.q_nb.wxyz
    turned = jax.vmap(_turns)(bias, gain, samples.dt_s, samples.theta)
    first = rotation.multiply(q_end[:1], rotation.conjugate(turned[:1, -1]))
    start = jnp.concatenate([first, q_end[:-1]])
    q = rotation.multiply(start[:, None, :], turned)
    missed = rotation.to_rotvec(rotation.multiply(q_end, rotation.conjugate(q[:, -1])))
    n = samples.dt_s.shape[1]
    share = jnp.arange(1.0, n + 1.0) / float(n)
    mend = rotation.from_rotvec(share[None, :, None] * missed[:, None, :])
    return rotation.normalise(rotation.multiply(mend, q)), rotation.normalise(start[0])
