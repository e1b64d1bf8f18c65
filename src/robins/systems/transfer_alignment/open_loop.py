"""The slave by itself: inertial navigation from a wrong start, with the vertical channel held.

Nothing is fed back, so the errors that a filter is to estimate grow as its linear model says, as
long as they are small. The height stays and the vertical velocity is zero, as in the model of
`velocity_attitude`: what the accelerometers feel along the vertical is not integrated.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic
from robins.ins.frames import swap
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav, advance, rows, unpacked, vector
from robins.manifold import retract
from robins.rotation import Rotation, conjugate, multiply, rotate
from robins.systems.transfer_alignment.velocity_attitude import Flight, dcm_enu

_Q, _V, _V_DOWN, _LAT, _ALT = slice(0, 4), slice(4, 7), 6, 7, 9  # places in the vector of a step


class OpenLoop(NamedTuple):
    """What the slave computes; leading axis E."""

    nav: Nav  # at the end of each epoch, NED/FRD
    flight: Flight  # on average over the interval that ends there, ENU/RFU


def start_with_error(start: Nav, error: ArrayLike) -> Nav:
    """Where the slave believes it starts.

    Args:
        start: the truth, NED/FRD.
        error: (9,) tangent of attitude, velocity and position, true = retract(believed, error); its
            vertical velocity and height do not count.
    """
    horizontal = jnp.asarray(error, float).at[jnp.array([5, 8])].set(0.0)
    estimate = retract(start, -horizontal)
    return estimate._replace(v_n=jnp.asarray(estimate.v_n).at[2].set(0.0))


def navigate(start: Nav, increments: Increments) -> OpenLoop:
    """Navigate over E blocks of K increments; pure, for any number of runs under `vmap`.

    Args:
        start: where the slave believes it is, NED/FRD; its height is held.
        increments: of the slave as reported, dt (E, K), theta and dv (E, K, 3).
    """
    first = vector(start)
    E, K = increments.dt.shape
    samples = rows(increments).reshape(E * K, -1)

    def held(x: Array) -> Array:
        return x.at[_V_DOWN].set(0.0).at[_ALT].set(first[_ALT])

    def sample(x: Array, row: Array):
        x = held(advance(x, row))
        return x, x

    first = held(first)
    _, path = lax.scan(sample, first, samples)
    path = jnp.concatenate([first[None], path])
    return OpenLoop(unpacked(path[K::K]), _flights(path, increments))


def _flights(path: Float[Array, "n 10"], increments: Increments) -> Flight:
    """Averages over the E blocks of a path that holds both ends of each of its N samples."""
    E, K = increments.dt.shape

    def average(x: Array) -> Array:
        """Of something given at both ends of each sample."""
        middle = 0.5 * (x[1:] + x[:-1])
        return jnp.mean(middle.reshape(E, K, *x.shape[1:]), 1)

    dv = increments.dv.reshape(E * K, 3)
    felt = rotate(path[:-1, _Q], dv).reshape(E, K, 3)  # dv has the axes of a sample's begin
    return Flight(
        lat_rad=average(path[:, _LAT]),
        alt_m=average(path[:, _ALT]),
        v_enu=swap(average(path[:, _V])),
        f_enu=swap(jnp.sum(felt, 1) / jnp.sum(increments.dt, 1)[:, None]),
        C_nb=average(dcm_enu(path[:, _Q])),
    )


def as_master_sees(loop: OpenLoop, master: Nav) -> tuple[Flight, Float[Array, "e 3 3"]]:
    """The slave's flight and attitudes with what the master reports in place of what is off.

    A model linearised there errs less than one about the slave's own idea, whose attitude is off by
    degrees. Each interval is turned and shifted by the difference at its end, so that the slave's
    samples still say what happened within it.

    Args:
        loop: what the slave computes.
        master: as reported at each epoch, of a box aligned with the slave's; NaN where missing, and
            there the slave's own idea stands.

    Returns:
        The flight over the intervals, and C from body RFU to ENU at the epochs.
    """
    own, flight = loop.nav, loop.flight
    q = jnp.asarray(master.q_nb.wxyz)
    there = jnp.all(jnp.isfinite(q), -1, keepdims=True)
    turn = multiply(jnp.where(there, q, own.q_nb.wxyz), conjugate(own.q_nb.wxyz))
    turn = dcm_enu(turn)

    def off(own: Array, reported: Array) -> Array:
        return jnp.where(jnp.isfinite(reported), own - reported, 0.0)

    about = Flight(
        lat_rad=flight.lat_rad - off(own.position.lat, master.position.lat),
        alt_m=flight.alt_m,
        v_enu=flight.v_enu - swap(off(own.v_n, master.v_n)),
        f_enu=jnp.einsum("eij,ej->ei", turn, flight.f_enu),
        C_nb=turn @ flight.C_nb,
    )
    return about, turn @ dcm_enu(own.q_nb.wxyz)


def attitude_error_enu(q_computed: ArrayLike, q_true: ArrayLike) -> Float[Array, "*b 3"]:
    """The phi of C_computed = exp(-phi x) C_true [rad], east north up, from attitudes NED/FRD."""
    computed, true = (Rotation(jnp.asarray(q, float)) for q in (q_computed, q_true))
    return swap(computed.local(true))


def true_errors(
    computed: Nav,
    q_nb: ArrayLike,
    v_n: ArrayLike,
    position: Geodetic,
    gyro_bias: ArrayLike,
    accel_bias: ArrayLike,
) -> Float[Array, "*b 12"]:
    """The state of `velocity_attitude` as it truly is, from truth in NED/FRD; any leading axes."""
    p = computed.position
    v_n, gyro_bias, accel_bias = (jnp.asarray(a, float) for a in (v_n, gyro_bias, accel_bias))
    return jnp.concatenate(
        [
            jnp.stack([p.lat - position.lat, p.lon - position.lon], -1),
            swap(computed.v_n - v_n)[..., :2],
            attitude_error_enu(computed.q_nb.wxyz, q_nb),
            swap(accel_bias)[..., :2],
            swap(gyro_bias),
        ],
        -1,
    )
