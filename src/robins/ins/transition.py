"""Transition of errors and noise over a block of increments: Phi and a factor of Q.

A block of K samples is cut into a few segments. Within one, the error dynamics F is split in two:

*fast*, which depends on the samples: specific force turns a misalignment into velocity, attitude
rotates sensor errors into n, velocity is integrated to position. It is nilpotent, so its transition
is a set of plain sums over the samples, as in the mechanisation, without a matrix product per
sample.

*slow*, the rest (`errors.frame_dynamics`): Earth and transport rate, Coriolis, gravity gradient,
decay of biases; constants of 1e-4 1/s, evaluated in the middle of the segment.

The two are combined as exp(slow/2) fast exp(slow/2) (Strang 1968), with an error of third order in
(slow x segment). With segments of a quarter of a second Phi differs from the Jacobian of the
mechanisation by less than 3e-6 (relative; see the test), even if the body shakes at 2 Hz.

Noise is sampled at the two Gauss points of each segment, with the mean specific force and sensor
axes over it. That is exact for the noise of attitude, velocity and biases within a segment of
constant axes and force, and of second order if these change: Q is accurate to 5e-4 in a turn, and
to 2 % if the body shakes.
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
from robins.rotation import skew

_GAUSS = 0.5 + np.array([-1.0, 1.0]) * np.sqrt(3.0) / 6.0  # points of the unit interval


# [[nav, inputs], [0, diag(fade)]] of navigation errors and sensor errors: (9, 9), (9, m), (m,)
Transition = tuple[Array, Array, Array]
# Columns [[white, walk], [0, diag(left)]] of noise at one time: (9, 6), (9, m), (m,)
Impulses = tuple[Array, Array, Array]


def linearise(
    x: Any, true: Increments, starts: Float[Array, "k 10"], noise: Any, segments: int
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Phi and the factor L of Q over a block.

    Args:
        x: the `InsState` at the start.
        true: K increments, corrected for the sensors' errors, with ``dr``.
        starts: states at their starts, as in `mechanise.vector`.
        noise: an `InsNoise`.
        segments: number of segments, at most K.
    """
    count = len(starts)
    segments = max(1, min(segments, count))
    each = -(-count // segments)

    def cut(a, mode):
        padding = [(0, segments * each - count)] + [(0, 0)] * (a.ndim - 1)
        return jnp.pad(a, padding, mode).reshape(segments, each, *a.shape[1:])

    def before(later: Transition, row):
        """Transition from the start of a segment to the end of the block, and its noise there."""
        increments, at = row
        return _after(later, *_segment(x, increments, at, noise))

    rows = jax.tree.map(lambda a: cut(a, "constant"), true), cut(starts, "edge")
    m = len(decay_rates(x, noise))
    nothing = jnp.eye(9), jnp.zeros((9, m)), jnp.ones(m)
    (nav, inputs, fade), columns = jax.lax.scan(before, nothing, rows, reverse=True)
    Phi = jnp.block([[nav, inputs], [jnp.zeros((m, 9)), jnp.diag(fade)]])
    # from the last segment to the first: in the order of computation, without a copy
    return Phi, linalg.tria(columns[::-1].reshape(-1, 9 + m).T)


def _after(later: Transition, first: Transition, impulses: list[Impulses]):
    """Return ``later @ first``, and the columns ``later @ impulses``, one to a row."""
    nav, inputs, fade = later
    parts = [*first[:2], *(part for white, walk, _ in impulses for part in (white, walk))]
    ends = np.cumsum([part.shape[1] for part in parts])[:-1]
    nav, first_inputs, *columns = jnp.split(nav @ jnp.concatenate(parts, 1), ends, 1)
    rows = []
    for white, walk, (_, _, left) in zip(columns[::2], columns[1::2], impulses, strict=True):
        lower = jnp.zeros((len(left), white.shape[1])), jnp.diag(fade * left)
        for upper, low in zip((white, walk + inputs * left[None]), lower, strict=True):
            rows.append(jnp.concatenate([upper, low]).T)
    whole = nav, first_inputs + inputs * first[2][None], fade * first[2]
    return whole, jnp.concatenate(rows)


def _segment(x, true: Increments, starts, noise) -> tuple[Transition, list[Impulses]]:
    """Transition over one segment, and the impulses of noise in it."""
    total = jnp.sum(true.dt)
    push, shift, turn, lever, drive, drift = _sums(x, true, starts, total)

    push = skew(push)
    by_accel = jnp.concatenate([jnp.zeros_like(drive), -drive, -drift])
    inputs = _in_order(jnp.concatenate([-turn, lever]), by_accel)

    # Half of the slow part before, half after.
    middle = unpacked(starts[len(starts) // 2])
    slow = 0.5 * total * frame_dynamics(middle).at[6:9, 3:6].set(0.0)
    slow = jnp.eye(9) + slow + 0.5 * slow @ slow
    fade = jnp.exp(-0.5 * total * decay_rates(x, noise))
    phi, dv, dp = slow[:3], slow[3:6], slow[6:]
    then = jnp.concatenate([phi, dv - push @ phi, dp + total * dv - skew(shift) @ phi])  # fast slow
    nav, inputs = jnp.split(slow @ jnp.concatenate([then, inputs], 1), [9], 1)
    whole = nav, inputs * fade[None], fade**2

    safe = jnp.where(total > 0.0, total, 1.0)
    return whole, _impulses(x, noise, starts, total, (push / safe, turn / safe, drive / safe))


def _sums(x, true: Increments, starts, total):
    """Sums over the samples of a segment, in a loop, so that a program contains its body once.

    Samples are integrated as in `mechanise`. Columns of the matrices are errors of three axes:
    biases, and scale factors if they are states.

    Returns:
        push, shift: (3,), whose skews are -dv and -dp of a misalignment.
        turn, lever: (3, a) -phi and (6, a) dv and dp of errors of gyros.
        drive, drift: (3, b) -dv and (3, b) -dp of errors of accelerometers.
    """
    scaled = x.gyro_scale is not None, x.accel_scale is not None
    a, b = (3 + 3 * s for s in scaled)

    def columns(C, bias, scale, has_scale):
        parts = [C * bias, C * scale[None]] if has_scale else [C * bias]
        return jnp.concatenate(parts, 1)

    def sample(sums, row):
        (dt, theta, dv, dr), start, elapsed = row
        C = unpacked(start).q_nb.as_dcm()
        left = total - elapsed  # time in the segment after the sample
        push = _product(C, dv[:, None])[:, 0]
        shift = _product(C, dr[:, None])[:, 0] + left * push
        # the misalignment from gyro errors so far is integrated to velocity and position
        lever = jnp.concatenate([_product(skew(by), sums[2]) for by in (push, shift)])
        turn = columns(_product(C, _mean_rotation(theta)), dt, theta, scaled[0])
        drive = columns(C, dt, dv, scaled[1])
        drift = columns(C, dt * (0.5 * dt + left), dr + left * dv, scaled[1])
        more = push, shift, turn, lever, drive, drift
        return tuple(map(jnp.add, sums, more)), None

    begin = tuple(map(jnp.zeros, ((3,), (3,), (3, a), (6, a), (3, b), (3, b))))
    rows = true, starts, jnp.cumsum(true.dt)
    (push, shift, *of_sensors), _ = jax.lax.scan(sample, begin, rows)
    by_gyro, by_accel = (
        jnp.tile(1.0 / (1.0 + scale_of(x, sensor)), 1 + has_scale)[None]
        for sensor, has_scale in zip(("gyro", "accel"), scaled, strict=True)
    )
    turn, lever, drive, drift = of_sensors
    return push, shift, turn * by_gyro, lever * by_gyro, drive * by_accel, drift * by_accel


def _impulses(x, noise, starts, total, means) -> list[Impulses]:
    """Columns M with M M' the covariance that noise adds over a segment of length `total`.

    The response at the end to unit impulses at the Gauss points, times the noise density and the
    root of the weight. `means` are over the segment: skew of the specific force in n, and the rates
    of attitude and velocity errors due to errors of gyros and accelerometers.
    """
    force, turn, drive = means
    rates, sigma = decay_rates(x, noise), _drives(x, noise)
    # the root of zero has no derivative, and a block may be all padding
    safe = jnp.where(total > 0.0, 0.5 * total, 1.0)
    weight = jnp.where(total > 0.0, jnp.sqrt(safe), 0.0)
    found = []
    for c in _GAUSS:
        to_end = total * (1.0 - c)
        C_c = unpacked(starts[int(c * len(starts))]).q_nb.as_dcm()
        phi = C_c * (_spread(noise.gyro_arw) / (1.0 + scale_of(x, "gyro")))[None]
        dv = C_c * (_spread(noise.accel_vrw) / (1.0 + scale_of(x, "accel")))[None]
        pull = to_end * force  # velocity error per misalignment
        white = jnp.block(
            [[phi, jnp.zeros((3, 3))], [-pull @ phi, dv], [-0.5 * to_end * pull @ phi, to_end * dv]]
        )
        g, a = to_end * turn, to_end * drive
        by_gyro = (-g, 0.5 * pull @ g, to_end / 6.0 * pull @ g)
        by_accel = (jnp.zeros_like(a), -a, -0.5 * to_end * a)
        walk = _in_order(jnp.concatenate(by_gyro), jnp.concatenate(by_accel)) * sigma[None]
        left = jnp.exp(-to_end * rates) * sigma
        found.append((weight * white, weight * walk, weight * left))
    return found


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
    """Mean of exp(s theta x) over s from 0 to 1; the series is accurate to 1e-6 at 0.5 rad."""
    turn = skew(theta)
    sq = jnp.sum(theta * theta)
    once = 1.0 / 2.0 - sq / 24.0 * (1.0 - sq / 30.0)
    twice = 1.0 / 6.0 - sq / 120.0 * (1.0 - sq / 42.0)
    return jnp.eye(3) + once * turn + twice * _product(turn, turn)


def _product(a, b):
    """Product of two matrices as sums, since single small products are slow."""
    return jnp.sum(a[:, :, None] * b[None], 1)
