"""A circular orbit and the Earth's magnetic field along it.

Inertial axes i: z along the Earth's axis, x towards the ascending node of right ascension zero. The
Earth is a point mass that turns uniformly about z, by ``OMEGA_E t`` from a given angle at t = 0;
flattening (nodal drift of up to 8 deg a day), drag and precession are not modelled. That is enough
for the torques and fields of an attitude study; it is not an ephemeris.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth.magnetic import RADIUS_M, field_along, wmm_for
from robins.earth.wgs84 import A_M, GM, OMEGA_E, dcm_en, geodetic_from_ecef
from robins.errors import require
from robins.filters.belief import Number
from robins.sim import _arguments

LOWEST_M = 100e3  # lowest height of an orbit

# Degree one of the IGRF-14 for 2025.0 [T]: a dipole at the centre, 9.2 deg from the Earth's axis.
_DIPOLE_E = (-1410.3e-9, 4545.5e-9, -29350.0e-9)  # g11, h11, g10


class OrbitStates(NamedTuple):
    """Positions and velocities at times, inertial axes."""

    time_s: Any  # (E,)
    r_i_m: Any  # (E, 3) from the Earth's centre
    v_i_m_s: Any  # (E, 3)


def circular_orbit(
    alt_m: Number,
    incl_rad: Number,
    raan_rad: Number,
    arg_lat_rad: Number,
    time_s: Number,
) -> OrbitStates:
    """A circular two-body orbit.

    Args:
        alt_m: height above the equatorial radius of WGS-84, at least 100 km.
        incl_rad: inclination, from 0 to pi; retrograde beyond pi/2.
        raan_rad: right ascension of the ascending node.
        arg_lat_rad: argument of latitude at t = 0, from the ascending node along the motion.
        time_s: (E,) times.

    Raises:
        ValueError: a number out of its range, or times that are not a list.
    """
    _arguments.number("alt_m (height above the Earth [m]; is it in km?)", alt_m, LOWEST_M)
    _arguments.number("incl_rad (is it in degrees?)", incl_rad, 0.0, np.pi)
    _arguments.number("raan_rad", raan_rad)
    _arguments.number("arg_lat_rad", arg_lat_rad)
    time = jnp.asarray(time_s, float)
    require(time.ndim == 1, "time_s must have shape (E,)", time.shape)
    _arguments.number("time_s", time)
    elements = (jnp.asarray(x, float) for x in (alt_m, incl_rad, raan_rad, arg_lat_rad))
    return OrbitStates(time, *_circular(*elements, time))


@jax.jit
def _circular(alt, incl, raan, arg_lat, time) -> tuple[Array, Array]:
    radius = A_M + alt
    turns = jnp.sqrt(GM / radius**3)
    node = jnp.stack([jnp.cos(raan), jnp.sin(raan), jnp.zeros(())])
    level = jnp.cos(incl)
    across = jnp.stack([-jnp.sin(raan) * level, jnp.cos(raan) * level, jnp.sin(incl)])
    angle = (arg_lat + turns * time)[:, None]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return (
        radius * (cos * node[None] + sin * across[None]),
        radius * turns * (cos * across[None] - sin * node[None]),
    )


def dipole_field_i(r_i_m: Float[Array, "*b 3"], earth_angle_rad: Number) -> Float[Array, "*b 3"]:
    """Field [T] of the tilted dipole in inertial axes, ``(a/r)^3 (3 (m r) r/r^2 - m)``.

    It differs from the full field at 500 km by 11 deg rms and 35 deg at most, and in size by a
    factor of 0.7 to 1.7: accurate enough for wheel desaturation, not for attitude determination.

    Args:
        r_i_m: (..., 3) positions from the Earth's centre.
        earth_angle_rad: (...) rotation angle of the Earth relative to i.
    """
    angle = jnp.broadcast_to(jnp.asarray(earth_angle_rad, float), r_i_m.shape[:-1])
    return _dipole(r_i_m, angle)


@jax.jit
def _dipole(r, angle) -> Array:
    x, y, z = _DIPOLE_E
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    m = jnp.stack([x * cos - y * sin, x * sin + y * cos, jnp.full_like(angle, z)], -1)
    distance = jnp.sqrt(jnp.sum(r * r, -1, keepdims=True))
    up = r / distance
    return (RADIUS_M / distance) ** 3 * (3.0 * jnp.sum(m * up, -1, keepdims=True) * up - m)


def field_along_orbit(
    orbit: OrbitStates,
    model: str = "dipole",
    earth_angle_rad: Number = 0.0,
    decimal_year: float = 2025.0,
    knot_s: float = 10.0,
) -> Float[Array, "epochs 3"]:
    """Magnetic field (E, 3) [T] in inertial axes along an orbit.

    Args:
        orbit: positions at increasing times.
        model: ``"dipole"``, or ``"wmm"`` for the World Magnetic Model of the date.
        earth_angle_rad: rotation angle of the Earth relative to i at t = 0.
        decimal_year: date of the WMM, constant along the orbit; the dipole is that of 2025.0.
        knot_s: spacing of WMM evaluations, interpolated linearly (error 15 nT at 10 s).

    Raises:
        ValueError: another model.
        MagneticModelError: a date or height the WMM does not cover.
    """
    angle = earth_angle_rad + OMEGA_E * orbit.time_s
    if model == "dipole":
        return dipole_field_i(orbit.r_i_m, angle)
    require(model == "wmm", f"the field models of an orbit are 'dipole' and 'wmm', not {model!r}")
    lat, lon, alt = _geodetic(orbit.r_i_m, angle)
    b_n = field_along(
        wmm_for(decimal_year), lat, lon, alt, decimal_year, orbit.time_s, knot_s=knot_s
    )
    return _to_inertial(lat, lon, jnp.asarray(b_n), angle)


@jax.jit
def _geodetic(r, angle) -> tuple[Array, Array, Array]:
    return geodetic_from_ecef(_about_z(-angle, r))


@jax.jit
def _to_inertial(lat, lon, b_n, angle) -> Array:
    return _about_z(angle, jnp.sum(dcm_en(lat, lon) * b_n[:, None, :], -1))


def _about_z(angle: Array, v: Array) -> Array:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
