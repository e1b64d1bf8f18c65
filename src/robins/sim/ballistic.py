"""Free flight above the atmosphere: a Kepler orbit from a launch site back to the Earth.

Only the central attraction acts. The oblateness of the Earth, left out, shifts a flight of ten
minutes by some kilometres, which turns the geomagnetic field by hundredths of a degree.

Frames: i is inertial, its axes are those of the Earth-fixed frame at t = 0; "launch" is the
north-east-down frame of the launch site as it stood at t = 0, so inertial too; "local" is
north, east, down at the point of the rotating Earth below the vehicle at t.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth.wgs84 import GM, OMEGA_E, dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.rotation import conjugate, from_dcm, from_rotvec, multiply, normalise, rotate
from robins.sim import _arguments

_ROUNDS = 30  # iterations of Kepler's equation, each at least as good as a bisection


class BallisticPath(NamedTuple):
    """A free flight at E epochs."""

    time_s: Any  # (E,) s since launch
    r_i_m: Any  # (E, 3) m, inertial
    v_i_m_s: Any  # (E, 3) m/s, inertial
    lat_rad: Any  # (E,) geodetic latitude
    lon_rad: Any  # (E,) longitude on the rotating Earth, in [-pi, pi]
    alt_m: Any  # (E,) m above the ellipsoid
    q_local: Any  # (E, 4) q_{launch<-local}: local north-east-down to launch north-east-down


def ballistic(
    lat_rad: _arguments.Listed,
    lon_rad: _arguments.Listed,
    alt_m: _arguments.Listed,
    speed_m_s: _arguments.Listed,
    elevation_rad: _arguments.Listed,
    azimuth_rad: _arguments.Listed,
    time_s: _arguments.Listed,
) -> BallisticPath:
    """Ballistic flight from a launch site with a given inertial velocity.

    Lagrange's coefficients of the change of eccentric anomaly, which solves Kepler's equation in
    the form that begins at any point of the orbit (Battin 1999, section 4.3); a vertical flight is
    no exception. All is pure JAX: map over the arguments for many launches.

    Args:
        lat_rad: geodetic latitude of the launch.
        lon_rad: its longitude.
        alt_m: its height above the ellipsoid [m].
        speed_m_s: inertial speed [m/s]; a vehicle at rest on the ground has that of the Earth's
            rotation already, 356 m/s to the east at 40 deg.
        elevation_rad: of the velocity above the local horizon.
        azimuth_rad: of the velocity, clockwise from north.
        time_s: (E,) s since launch.

    Raises:
        ValueError: a number out of range, a speed at or above escape speed, a time before the
            launch, or one after the vehicle has fallen back to the radius of the launch.
    """
    time = jnp.asarray(time_s, float)
    if time.ndim != 1 or len(time) < 1:
        raise ValueError(f"time_s must have shape (E,), E at least one, got {time.shape}")
    quarter = 0.5 * np.pi
    _arguments.number("lat_rad", lat_rad, -quarter, quarter)
    _arguments.number("lon_rad", lon_rad)
    _arguments.number("alt_m", alt_m, -1e4)
    _arguments.number("speed_m_s", speed_m_s, 0.0, above=True)
    _arguments.number("elevation_rad", elevation_rad, 0.0, quarter, above=True)
    _arguments.number("azimuth_rad", azimuth_rad)
    _arguments.number("time_s", time, 0.0)

    launch = (lat_rad, lon_rad, alt_m, speed_m_s, elevation_rad, azimuth_rad)
    path, r0, v0 = _path(*(jnp.asarray(x, float) for x in launch), time)
    _refuse_no_return(r0, v0, time)
    return path


@jax.jit
def _path(lat, lon, alt, speed, elevation, azimuth, time) -> tuple[BallisticPath, Array, Array]:
    """The flight, and its initial inertial position [m] and velocity [m/s]."""
    c_il = dcm_en(lat, lon)
    r0 = ecef_from_geodetic(lat, lon, alt)
    v0 = c_il @ _velocity(speed, elevation, azimuth)
    r_i, v_i = _fly(r0, v0, time)
    turn = jnp.zeros((len(time), 3)).at[:, 2].set(OMEGA_E * time)
    q_ie = from_rotvec(turn)
    here = geodetic_from_ecef(rotate(conjugate(q_ie), r_i))
    q_il = multiply(q_ie, from_dcm(dcm_en(*here[:2])))
    q_local = normalise(multiply(conjugate(from_dcm(c_il)), q_il))
    return BallisticPath(time, r_i, v_i, *here, q_local), r0, v0


def _velocity(speed, elevation, azimuth) -> Float[Array, "3"]:
    """Velocity of a speed, elevation and azimuth: north, east, down [m/s]."""
    level = speed * jnp.cos(elevation)
    rest = (level * jnp.cos(azimuth), level * jnp.sin(azimuth), -speed * jnp.sin(elevation))
    return jnp.stack(rest)


def _orbit(r0: Float[Array, "3"], v0: Float[Array, "3"]) -> tuple[Array, Array, Array]:
    """Radius r0 [m], semi-major axis a [m] and r0.v0/sqrt(GM a) = e sin E0 at the start."""
    r = jnp.sqrt(r0 @ r0)
    a = 1.0 / (2.0 / r - (v0 @ v0) / GM)
    return r, a, (r0 @ v0) / jnp.sqrt(GM * a)


def _fly(r0, v0, time):
    """Inertial position [m] and velocity [m/s] at the times, (E, 3) each."""
    r_start, a, e_sin = _orbit(r0, v0)
    e_cos = 1.0 - r_start / a
    mean = jnp.sqrt(GM / a**3) * time

    # While the vehicle is above the radius of the launch the mean anomaly grows with the eccentric
    # one at a slope from r0/a to 1 + e, which brackets the root; Newton's step is clipped to it.
    least = mean / (1.0 + jnp.sqrt(e_cos**2 + e_sin**2))
    most = mean * a / r_start

    def nearer(_, state):
        turn, least, most = state
        sin, cos = jnp.sin(turn), jnp.cos(turn)
        miss = turn - e_cos * sin + e_sin * (1.0 - cos) - mean
        most = jnp.where(miss > 0.0, jnp.minimum(most, turn), most)
        least = jnp.where(miss < 0.0, jnp.maximum(least, turn), least)
        newton = turn - miss / (1.0 - e_cos * cos + e_sin * sin)
        outside = (newton < least) | (newton > most)
        return jnp.where(outside, 0.5 * (least + most), newton), least, most

    turn, _, _ = jax.lax.fori_loop(0, _ROUNDS, nearer, (least, least, most))

    sin, cos = jnp.sin(turn), jnp.cos(turn)
    r = a * (1.0 - e_cos * cos + e_sin * sin)
    f = 1.0 - a / r_start * (1.0 - cos)
    g = time - jnp.sqrt(a**3 / GM) * (turn - sin)
    f_dot = -jnp.sqrt(GM * a) / (r * r_start) * sin
    g_dot = 1.0 - a / r * (1.0 - cos)
    position = f[:, None] * r0[None] + g[:, None] * v0[None]
    return position, f_dot[:, None] * r0[None] + g_dot[:, None] * v0[None]


def _refuse_no_return(r0, v0, time) -> None:
    if not _arguments.known(r0, v0, time):
        return
    r0, v0 = np.asarray(r0), np.asarray(v0)
    radius, speed = np.linalg.norm(r0), np.linalg.norm(v0)
    escape = np.sqrt(2.0 * GM / radius)
    if speed >= escape:
        raise ValueError(
            f"speed_m_s is {speed:g}; from {escape:g} m/s on a vehicle does not come back"
        )
    a = 1.0 / (2.0 / radius - speed**2 / GM)
    e_sin, e_cos = (r0 @ v0) / np.sqrt(GM * a), 1.0 - radius / a
    # From the eccentric anomaly E0 the same radius comes again at 2 pi - E0.
    start = np.arctan2(e_sin, e_cos)
    back = 2.0 * (np.pi - start + e_sin) / np.sqrt(GM / a**3)
    last = float(np.max(time))
    if last > back * (1.0 + 1e-9):
        raise ValueError(
            f"time_s goes to {last:g} s, but after {back:.6g} s the vehicle is "
            "back at the radius of its launch: end the flight there"
        )
