"""The state of an aided INS: attitude, velocity, position and sensor errors.

A sensor reads ``raw = (1 + scale) true + bias``, component-wise in body axes. `step` and
`propagate` correct for that and mechanise; `propagate_linear` also gives the transition of small
errors over a whole block of samples, so that a filter propagates its covariance once per block.

The state is a pytree on a manifold: `robins.manifold.retract` and `local` work on it, and its
tangent vector is the error state of `robins.ins.errors`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic
from robins.ins.errors import decay_rates, scale_of
from robins.ins.increments import Increments, displacement
from robins.ins.mechanise import Nav, advance, rows, unpacked, vector
from robins.ins.transition import linearise
from robins.linalg.rows import each_row
from robins.rotation import Rotation

Perturbation = Any  # a number or (3,) body axes


class InsState(NamedTuple):
    """State of an aided INS. Scale factors are states if given, else not in the pytree."""

    q_nb: Rotation  # body FRD to navigation NED
    v_n: Array  # (3,) m/s
    position: Geodetic
    gyro_bias: Array  # (3,) rad/s
    accel_bias: Array  # (3,) m/s^2
    gyro_scale: Array | None = None  # (3,)
    accel_scale: Array | None = None  # (3,)

    @classmethod
    def start(cls, nav: Nav, scales: bool = False) -> InsState:
        """State at `nav`, with zero sensor errors."""
        scale = jnp.zeros(3) if scales else None
        return cls(*nav, jnp.zeros(3), jnp.zeros(3), scale, scale)

    @property
    def nav(self) -> Nav:
        """Attitude, velocity and position alone."""
        return Nav(self.q_nb, self.v_n, self.position)


class InsNoise(NamedTuple):
    """Densities of sensor noise and of drift of sensor errors: numbers, or (3,) by body axis."""

    gyro_arw: Perturbation  # rad/sqrt(s), angle random walk
    accel_vrw: Perturbation  # m/s/sqrt(s), velocity random walk
    gyro_bias_rw: Perturbation = 0.0  # rad/s/sqrt(s)
    accel_bias_rw: Perturbation = 0.0  # m/s^2/sqrt(s)
    gyro_bias_tau: Perturbation = jnp.inf  # s, of a first-order Markov process; inf: random walk
    accel_bias_tau: Perturbation = jnp.inf  # s
    gyro_scale_rw: Perturbation = 0.0  # 1/sqrt(s)
    accel_scale_rw: Perturbation = 0.0  # 1/sqrt(s)


def step(x: InsState, inc: Increments, noise: InsNoise | None = None) -> InsState:
    """Propagate by one raw increment (scalar dt); biases decay with the time constants of `noise`.

    A zero increment returns x unchanged.
    """
    one = Increments(*(None if a is None else jnp.asarray(a, float)[None] for a in inc))
    return propagate(x, one, noise)


def propagate(x: InsState, block: Increments, noise: InsNoise | None = None) -> InsState:
    """Propagate over a block of K raw increments (leading axis); zero ones change nothing."""
    true, faded = _corrected(x, block, noise)
    last, _ = lax.scan(lambda at, inc: (advance(at, rows(inc)), None), vector(x.nav), true)
    return _at(x, last, faded)


def path(x: InsState, block: Increments, noise: InsNoise | None = None) -> Float[Array, "K 10"]:
    """Attitude, velocity and position after each of K raw increments, as `mechanise.vector`."""
    true, _ = _corrected(x, block, noise)

    def step(at: Array, inc: Increments) -> tuple[Array, Array]:
        return (now := advance(at, rows(inc))), now

    return lax.scan(step, vector(x.nav), true)[1]


def propagate_linear(
    x: InsState, block: Increments, noise: InsNoise, segments: int = 4
) -> tuple[InsState, Float[Array, "n n"], Float[Array, "n n"]]:
    """`propagate`, with transition matrix and process noise of the block.

    See `robins.ins.transition` for the approximations. Zero increments may pad the block.

    Args:
        x: at the start of the block.
        block: K raw increments, leading axis.
        noise: of the sensors.
        segments: parts of the block in which the navigation frame is assumed to turn evenly and
            noise is sampled; a quarter of a second each is enough. At most K are used.

    Returns:
        The state at the end; Phi, with ``error(end) = Phi error(start)``; and a lower-triangular
        factor L of the process noise covariance Q = L L'.
    """
    true, faded = _corrected(x, block, noise)
    last, starts = lax.scan(lambda at, inc: (advance(at, rows(inc)), at), vector(x.nav), true)
    Phi, L = linearise(x, true, starts, noise, segments)
    return _at(x, last, faded), Phi, L


def _corrected(x: InsState, block: Increments, noise: InsNoise | None):
    """Increments corrected for sensor errors, and biases at the end of the block."""
    block = Increments(*(None if a is None else jnp.asarray(a, float) for a in block))
    until = jnp.cumsum(block.dt)
    rates = decay_rates(x, noise)[:6]
    gyro_gain = 1.0 / (1.0 + scale_of(x, "gyro"))
    accel_gain = 1.0 / (1.0 + scale_of(x, "accel"))

    def corrected(raw: Increments, end: Array) -> Increments:
        dt = raw.dt
        fading = jnp.exp(-(end - 0.5 * dt) * rates)  # in the middle of the increment
        gyro_bias, accel_bias = x.gyro_bias * fading[:3], x.accel_bias * fading[3:]
        return Increments(
            dt,
            (raw.theta - gyro_bias * dt) * gyro_gain,
            (raw.dv - accel_bias * dt) * accel_gain,
            (displacement(raw) - 0.5 * accel_bias * dt**2) * accel_gain,
        )

    return each_row(corrected, block, until), jnp.exp(-until[-1] * rates)


def _at(x: InsState, last: Float[Array, "10"], faded: Float[Array, "6"]) -> InsState:
    return x._replace(
        **unpacked(last)._asdict(),
        gyro_bias=x.gyro_bias * faded[:3],
        accel_bias=x.accel_bias * faded[3:],
    )
