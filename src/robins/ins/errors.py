"""Linear error dynamics of the strapdown mechanisation.

The error x is that of `robins.manifold`: true = retract(estimate, x). In tangent order

    phi       rad      C_true = exp(phi x) C_estimate, seen in n
    dv_n      m/s      north, east, down
    dp        m        north, east, down, by the curvature radii at the estimate
    d(bias)   rad/s and m/s^2, gyro and accelerometer, in body axes
    d(scale)  -        gyro and accelerometer, where the state has them

and ``dx/dt = F x + G w``. As in Groves (2013), section 14.2, but with position in metres,
where the position block is not -omega_en x, since the radii are those at the estimate; and with the
full gradient of gravity.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import A_M, E2, OMEGA_E
from robins.ins.zonal_gravity import gravity_nd
from robins.manifold import State
from robins.rotation import skew


def frame_dynamics(state: State) -> Float[Array, "9 9"]:
    """F of attitude, velocity and position in free fall: the part that needs no sensor data."""
    v, lat, alt = state.v_n, state.position.lat, state.position.alt
    s, c = jnp.sin(lat), jnp.cos(lat)
    t = s / c
    w_sq = 1.0 - E2 * s * s
    transverse = A_M / jnp.sqrt(w_sq)
    meridian = transverse * (1.0 - E2) / w_sq
    # radii at height, and their derivatives by latitude
    n, e = meridian + alt, transverse + alt
    n_lat, e_lat = 3.0 * meridian * E2 * s * c / w_sq, transverse * E2 * s * c / w_sq
    north, east, down = v[0], v[1], v[2]
    o = jnp.zeros_like(t)

    earth = _vector(OMEGA_E * c, o, -OMEGA_E * s)
    over = _vector(east / e, -north / n, -east * t / e)
    # by latitude [1/rad] and height [1/m]
    earth_lat = _vector(-OMEGA_E * s, o, -OMEGA_E * c)
    over_lat = _vector(
        -east * e_lat / e**2, north * n_lat / n**2, east * (t * e_lat / e - 1.0 / c**2) / e
    )
    over_alt = _vector(-east / e**2, north / n**2, east * t / e**2)
    over_v = _matrix((o, 1.0 / e, o), (-1.0 / n, o, o), (o, -t / e, o))

    def gravity(lat, alt):
        s = jnp.sin(lat)
        g_north, g_down = gravity_nd(s, jnp.cos(lat), A_M / jnp.sqrt(1.0 - E2 * s * s), alt)
        return _vector(g_north, o, g_down)

    g_lat, g_alt = jax.jacfwd(gravity, (0, 1))(lat, alt)

    def by_metres(by_lat, by_alt):
        """Derivative by position in metres north, east, down."""
        return jnp.stack([by_lat / n, jnp.zeros(3), -by_alt], 1)

    omega_p = by_metres(earth_lat + over_lat, over_alt)
    turn_p = by_metres(2.0 * earth_lat + over_lat, over_alt)
    rows = (
        (-skew(earth + over), -over_v, -omega_p),
        (
            jnp.zeros((3, 3)),
            skew(v) @ over_v - skew(2.0 * earth + over),
            by_metres(g_lat, g_alt) + skew(v) @ turn_p,
        ),
        (
            jnp.zeros((3, 3)),
            jnp.eye(3),
            _matrix(
                (-down / n, o, north / n),
                (east * t / e, -(north * t + down) / e, east / e),
                (o, o, o),
            ),
        ),
    )
    return jnp.concatenate([jnp.concatenate(row, 1) for row in rows])


def scale_of(state: State, sensor: str) -> Float[Array, "3"]:
    """Scale factor errors of a sensor; zero if they are not states."""
    scale = getattr(state, f"{sensor}_scale", None)
    return jnp.zeros(3) if scale is None else scale


def decay_rates(state: State, noise: State) -> Float[Array, "m"]:
    """Inverse time constants [1/s] of the bias and scale states, in tangent order."""
    if noise is None:
        rates = [jnp.zeros(3), jnp.zeros(3)]
    else:
        taus = (noise.gyro_bias_tau, noise.accel_bias_tau)
        rates = [jnp.broadcast_to(1.0 / jnp.asarray(tau, float), 3) for tau in taus]
    scales = [state.gyro_scale, state.accel_scale]
    return jnp.concatenate(rates + [jnp.zeros(3) for scale in scales if scale is not None])


def _vector(*components) -> Float[Array, "3"]:
    return jnp.stack([jnp.asarray(c, float) for c in components])


def _matrix(*rows) -> Float[Array, "3 3"]:
    return jnp.stack([_vector(*row) for row in rows])
