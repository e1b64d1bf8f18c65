"""Transition of errors and noise over a block of increments: Phi and a factor of Q.

A block of K samples is cut into a few segments. Within one, the error dynamics F is split in two:

*fast*, what the samples decide: specific force turns a misalignment into velocity, the attitude
takes sensor errors into n, velocity becomes position. It is nilpotent, so its transition is a set
of plain sums over the samples, taken as the mechanisation takes them, and no matrix product per
sample.

*slow*, the rest (`errors.frame_dynamics`): Earth and transport rate, Coriolis, gravity gradient,
decay of biases; constants of 1e-4 1/s, taken in the middle of the segment.

The two are put together as exp(slow/2) fast exp(slow/2) (Strang 1968), wrong by the third order in
(slow x segment). With segments of a quarter of a second Phi differs from the Jacobian of the
mechanisation by less than 3e-6 of what matters (see the test), even where the body shakes at 2 Hz.

Noise is sampled at the two Gauss points of each segment, with the mean specific force and sensor
axes over it. That is exact for what a segment adds to attitude, velocity and biases by itself, and
of second order where axes and force change within it: Q is good to 5e-4 in a turn, and to 2 % where
the body shakes.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64, linalg  # noqa: F401
from robins.ins.errors import decay_rates, frame_dynamics, scale_of
from robins.ins.increments import Increments
from robins.ins.mechanise import unpacked
from robins.linalg.rows import each_row
from robins.rotation import skew

_GAUSS = 0.5 + np.array([-1.0, 1.0]) * np.sqrt(3.0) / 6.0  # points of the unit interval


def linearise(
    x: Any, true: Increments, starts: Float[Array, "k 10"], noise: Any, segments: int
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Phi and the factor L of Q over a block.

    Args:
        x: the `InsState` at the start.
        true: K increments, corrected for the sensors' errors, with ``dr``.
        starts: the vectors (see `mechanise.vector`) each of them starts from.
        noise: an `InsNoise`.
        segments: how many, K at most.
    """
    count = len(starts)
    segments = max(1, min(segments, count))
    each = -(-count // segments)

    def cut(a, mode):
        padding = [(0, segments * each - count)] + [(0, 0)] * (a.ndim - 1)
        return jnp.pad(a, padding, mode).reshape(segments, each, *a.shape[1:])

    parts = each_row(
        lambda inc, at: _segment(x, inc, at, noise),
        jax.tree.map(lambda a: cut(a, "constant"), true),
        cut(starts, "edge"),
    )
    Phi, M = parts[0][0], parts[1][0]
    for Phi_next, M_next in zip(parts[0][1:], parts[1][1:], strict=True):
        Phi, M = Phi_next @ Phi, jnp.concatenate([Phi_next @ M, M_next], 1)
    return Phi, linalg.tria(M)


def _segment(x, true: Increments, starts, noise):
    """Phi of one segment, and columns M with M M' the covariance its noise adds."""
    dt = true.dt
    C = unpacked(starts).q_nb.as_dcm()
    total = jnp.sum(dt)
    left = (total - jnp.cumsum(dt))[:, None, None]  # time in the segment after each sample

    # What each sample does to phi, dv and dp, as `mechanise` does it, and what becomes of that by
    # the end of the segment.
    push = skew(_apply(C, true.dv))
    shift = skew(_apply(C, true.dr)) + left * push
    turn = _into(_product(C, _mean_rotation(true.theta)), dt, true.theta, x, "gyro")
    turned = jnp.cumsum(turn, 0) - turn  # misalignment before each sample, per gyro error
    drive = _into(C, dt, true.dv, x, "accel")
    drift = _into(C, 0.5 * dt**2, true.dr, x, "accel") + left * drive
    by_gyro = (-turn, _product(push, turned), _product(shift, turned))
    by_accel = (jnp.zeros_like(drive), -drive, -drift)
    push, shift = jnp.sum(push, 0), jnp.sum(shift, 0)
    by_gyro, by_accel = (tuple(jnp.sum(a, 0) for a in by) for by in (by_gyro, by_accel))

    eye, zero = jnp.eye(3), jnp.zeros((3, 3))
    fast = jnp.block([[eye, zero, zero], [-push, eye, zero], [-shift, total * eye, eye]])
    inputs = _in_order(jnp.concatenate(by_gyro), jnp.concatenate(by_accel))

    # Half of the slow part before, half after.
    middle = unpacked(starts[len(starts) // 2])
    slow = 0.5 * total * frame_dynamics(middle).at[6:9, 3:6].set(0.0)
    slow = jnp.eye(9) + slow + 0.5 * slow @ slow
    rates = decay_rates(x, noise)
    fade = jnp.exp(-0.5 * total * rates)
    m = len(rates)
    Phi = jnp.block(
        [[slow @ fast @ slow, slow @ inputs * fade[None]], [jnp.zeros((m, 9)), jnp.diag(fade**2)]]
    )

    safe = jnp.where(total > 0.0, total, 1.0)
    means = (push / safe, -by_gyro[0] / safe, -by_accel[1] / safe)
    return Phi, _impulses(x, noise, C, total, means)


def _impulses(x, noise, C, total, means) -> Float[Array, "n c"]:
    """Columns M with M M' the covariance that noise adds over a segment of length `total`.

    The response at the end to unit impulses at the Gauss points, times the size of the noise and
    the root of the weight. `means` are over the segment: skew of the specific force in n, and what
    errors of gyros and accelerometers do to attitude and velocity a second.
    """
    force, turn, drive = means
    rates, sigma = decay_rates(x, noise), _drives(x, noise)
    m = len(rates)
    columns = []
    for c in _GAUSS:
        to_end = total * (1.0 - c)
        C_c = C[int(c * len(C))]
        phi = C_c * (_spread(noise.gyro_arw) / (1.0 + scale_of(x, "gyro")))[None]
        dv = C_c * (_spread(noise.accel_vrw) / (1.0 + scale_of(x, "accel")))[None]
        pull = to_end * force  # a misalignment becomes velocity at this share
        white = jnp.block(
            [[phi, jnp.zeros((3, 3))], [-pull @ phi, dv], [-0.5 * to_end * pull @ phi, to_end * dv]]
        )
        g, a = to_end * turn, to_end * drive
        by_gyro = (-g, 0.5 * pull @ g, to_end / 6.0 * pull @ g)
        by_accel = (jnp.zeros_like(a), -a, -0.5 * to_end * a)
        walk = _in_order(jnp.concatenate(by_gyro), jnp.concatenate(by_accel)) * sigma[None]
        left = jnp.diag(jnp.exp(-to_end * rates) * sigma)
        columns.append(jnp.block([[white, walk], [jnp.zeros((m, 6)), left]]))
    # The root of zero has no slope, and a block may be all padding.
    safe = jnp.where(total > 0.0, 0.5 * total, 1.0)
    weight = jnp.where(total > 0.0, jnp.sqrt(safe), 0.0)
    return weight * jnp.concatenate(columns, 1)


def _into(C, dt, value, x, sensor: str):
    """C diag(dt), and C diag(value) if the scale is a state: (k, 3, 3 or 6)."""
    gain = 1.0 / (1.0 + scale_of(x, sensor))[None]
    columns = [C * (dt[:, None] * gain)[:, None]]
    if getattr(x, f"{sensor}_scale") is not None:
        columns.append(C * (value * gain)[:, None])
    return jnp.concatenate(columns, -1)


def _in_order(by_gyro, by_accel):
    """Columns of both sensors in tangent order: biases first."""
    parts = (by_gyro[:, :3], by_accel[:, :3], by_gyro[:, 3:], by_accel[:, 3:])
    return jnp.concatenate(parts, 1)


def _drives(x, noise) -> Float[Array, "m"]:
    """Random walk of each bias and scale state, in tangent order."""
    drives = [_spread(noise.gyro_bias_rw), _spread(noise.accel_bias_rw)]
    if x.gyro_scale is not None:
        drives.append(_spread(noise.gyro_scale_rw))
    if x.accel_scale is not None:
        drives.append(_spread(noise.accel_scale_rw))
    return jnp.concatenate(drives)


def _spread(value) -> Float[Array, "3"]:
    return jnp.broadcast_to(jnp.asarray(value, float), 3)


def _mean_rotation(theta):
    """Mean of exp(s theta x) over s from 0 to 1; the series is good to 1e-6 at half a radian."""
    turn = skew(theta)
    sq = jnp.sum(theta * theta, -1)[:, None, None]
    once = 1.0 / 2.0 - sq / 24.0 * (1.0 - sq / 30.0)
    twice = 1.0 / 6.0 - sq / 120.0 * (1.0 - sq / 42.0)
    return jnp.eye(3)[None] + once * turn + twice * _product(turn, turn)


def _product(a, b):
    """Matrix products (k, 3, 3) (k, 3, m): sums, for small products one by one are slow."""
    return jnp.sum(a[..., None] * b[:, None], 2)


def _apply(C, v):
    return jnp.sum(C * v[:, None], 2)
