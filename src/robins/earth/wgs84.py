"""The WGS-84 ellipsoid: curvature, coordinates, normal gravity and the rates of the local frame.

Latitude is geodetic [rad], longitude [rad] east, height [m] above the ellipsoid. The local frame n
is north, east, down; e is Earth-centred, Earth-fixed. All functions broadcast over leading axes and
take Python, NumPy or JAX numbers; given NumPy arrays only they compute by NumPy, with nothing to
compile, else by JAX.

The constants are those of NIMA TR8350.2 (3rd ed., 2000): four defining ones, the rest derived here
to full precision.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from robins.errors import require
from robins.linalg.library import ArrayLike, Each, Real, is_traced, library

A_M = 6378137.0  # semi-major axis
F = 1.0 / 298.257223563  # flattening
GM = 3.986004418e14  # m^3/s^2, atmosphere included
OMEGA_E = 7.292115e-5  # rad/s, rotation relative to inertial space

B_M = A_M * (1.0 - F)  # semi-minor axis
E2 = F * (2.0 - F)  # first eccentricity squared
_FOCAL_SQ = A_M**2 * E2  # linear eccentricity squared, m^2
_EP2 = _FOCAL_SQ / B_M**2  # second eccentricity squared


def _q(x):
    """``q / (2 t^3)`` with q = ((1 + 3/t^2) atan(t) - 3/t)/2 and x = t^2.

    The closed form cancels five digits for t = E/u < 0.082; the series does not, and needs neither
    arctangent nor division. Six terms leave 1e-15 of a quantity that is 1e-3 of gravity.
    """
    return _alternating(x, [(j + 1) / ((2 * j + 3) * (2 * j + 5)) for j in range(6)])


def _q_prime(x):
    """``q' / (6 t^2)`` with q' = 3 (1 + 1/t^2) (1 - atan(t)/t) - 1 and x = t^2."""
    return _alternating(x, [1 / ((2 * j + 3) * (2 * j + 5)) for j in range(6)])


def _alternating(x, coefficients):
    """``c0 - c1 x + c2 x^2 - ...`` by Horner's rule."""
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = c - x * total
    return total


_Q0 = _q(_EP2)
_DEEPEST = 5.3e6  # m from the centre, some 1060 km deep at the poles
_FARTHEST = 1e100  # m, whose square is finite
_LOWEST = -1e6  # m, height; the confocal ellipsoids of gravity degenerate near the centre
_POLAR = 1e-9  # cosine of a latitude 6 mm from a pole


def _floats(*values: ArrayLike) -> list[Real]:
    """Library of the given numbers, and they as its arrays."""
    xp = library(*values)
    return [xp, *(xp.asarray(v, float) for v in values)]


def _refuse_deep(alt_m: ArrayLike) -> None:
    if not is_traced(alt_m):
        lowest = np.min(np.asarray(alt_m, float), initial=np.inf)
        require(not lowest < _LOWEST, f"a height must be {_LOWEST:g} m or more, got {lowest:.6g}")


def curvature_radii(lat_rad: ArrayLike) -> tuple[Each, Each]:
    """Radii of curvature [m] of the ellipsoid: in the meridian and in the prime vertical.

    A step d north, e east at height h changes latitude by ``d / (meridian + h)`` and longitude by
    ``e / ((transverse + h) cos(lat))`` (Groves 2013, eq. 2.105 and 2.106).
    """
    xp, lat = _floats(lat_rad)
    w_sq = 1.0 - E2 * xp.sin(lat) ** 2
    transverse = A_M / xp.sqrt(w_sq)
    return transverse * (1.0 - E2) / w_sq, transverse


def ecef_from_geodetic(
    lat_rad: ArrayLike, lon_rad: ArrayLike, alt_m: ArrayLike
) -> Float[Real, "*b 3"]:
    """Earth-fixed position r_e [m] of geodetic coordinates."""
    xp, lat, lon, alt = _floats(lat_rad, lon_rad, alt_m)
    sin_lat = xp.sin(lat)
    transverse = A_M / xp.sqrt(1.0 - E2 * sin_lat**2)
    across = (transverse + alt) * xp.cos(lat)
    up = ((1.0 - E2) * transverse + alt) * sin_lat
    x, y, z = xp.broadcast_arrays(across * xp.cos(lon), across * xp.sin(lon), up)
    return xp.stack([x, y, z], -1)


def geodetic_from_ecef(r_e: ArrayLike) -> tuple[Each, Each, Each]:
    """Latitude [rad], longitude [rad] in [-pi, pi] and height [m] of an Earth-fixed position [m].

    Bowring (1976): the parametric latitude is improved a fixed two times, each of which squares the
    error (3e-3 rad at the start in the worst case), so only rounding is left for every height
    above -1000 km. It is kept as sine and cosine, so the poles are regular. The height is that of
    Bowring (1985), stationary in latitude. The gradient is finite off the polar axis.

    Raises:
        ValueError: a position is deeper than that (the Earth's centre, or kilometres given for
            metres) or infinite; not in compiled code, where the centre gives NaN.
    """
    xp, r = _floats(r_e)
    if not is_traced(r):
        with np.errstate(over="ignore"):
            distance = np.linalg.norm(np.asarray(r), axis=-1)
        farthest = np.max(distance, initial=0.0)
        far = "a position must be of finite numbers of metres, got one at a distance of"
        require(not farthest > _FARTHEST, f"{far} {farthest:.6g} m")
        nearest = np.min(distance, initial=np.inf)
        require(
            not nearest < _DEEPEST,
            f"a position {nearest:.6g} m from the centre of the Earth has no geodetic coordinates: "
            f"give metres, {_DEEPEST:g} m or more from it",
        )
    x, y, z = r[..., 0], r[..., 1], r[..., 2]
    p = xp.sqrt(x * x + y * y)
    sin_lat, cos_lat = _unit(xp, z, (1.0 - E2) * p)
    for _ in range(2):
        sin_beta, cos_beta = _unit(xp, (1.0 - F) * sin_lat, cos_lat)
        sin_lat, cos_lat = _unit(xp, z + _EP2 * B_M * sin_beta**3, p - E2 * A_M * cos_beta**3)
    alt = p * cos_lat + z * sin_lat - A_M * xp.sqrt(1.0 - E2 * sin_lat**2)
    return xp.arctan2(sin_lat, cos_lat), xp.arctan2(y, x), alt


def _unit(xp, s, c):
    length = xp.sqrt(s * s + c * c)
    return s / length, c / length


def dcm_en(lat_rad: ArrayLike, lon_rad: ArrayLike) -> Float[Real, "*b 3 3"]:
    """C_en: maps north-east-down components to Earth-fixed ones, ``v_e = C_en @ v_n``."""
    xp, *given = _floats(lat_rad, lon_rad)
    lat, lon = xp.broadcast_arrays(*given)
    sp, cp, sl, cl = xp.sin(lat), xp.cos(lat), xp.sin(lon), xp.cos(lon)
    rows = (
        (-sp * cl, -sl, -cp * cl),
        (-sp * sl, cl, -cp * sl),
        (cp, xp.zeros_like(cp), -sp),
    )
    return xp.stack([xp.stack(r, -1) for r in rows], -2)


def gravity_n(lat_rad: ArrayLike, alt_m: ArrayLike) -> Float[Real, "*b 3"]:
    """Normal gravity vector [m/s^2] in north, east, down; the centrifugal part is included.

    The closed form in ellipsoidal coordinates (Heiskanen & Moritz 1967, section 2-7 and 2-8; NIMA
    TR8350.2, eq. 4-5 to 4-20), exact at every height; on the ellipsoid it is Somigliana's formula.
    Above the ellipsoid the plumb line is curved: the north component is -8.1e-9 sin(2 lat) per
    metre of height, 8e-5 m/s^2 at 10 km and 45 deg. The mechanisation evaluates
    `robins.ins.zonal_gravity`: change both.

    Raises:
        ValueError: a height is below -1000 km; not in compiled code.
    """
    _refuse_deep(alt_m)
    xp, *given = _floats(lat_rad, alt_m)
    lat, alt = xp.broadcast_arrays(*given)
    sin_lat, cos_lat = xp.sin(lat), xp.cos(lat)
    transverse = A_M / xp.sqrt(1.0 - E2 * sin_lat**2)
    p = (transverse + alt) * cos_lat
    z = ((1.0 - E2) * transverse + alt) * sin_lat

    # Semi-minor axis u of the confocal ellipsoid through the point, v its semi-major axis; the
    # reduced latitude on it has the sine z/u and the cosine p/v.
    half = 0.5 * (p * p + z * z - _FOCAL_SQ)
    u_sq = half + xp.sqrt(half * half + _FOCAL_SQ * z * z)
    u = xp.sqrt(u_sq)
    per_u = 1.0 / u
    sin_sq = (z * per_u) ** 2
    v_sq = u_sq + _FOCAL_SQ
    per_v_sq = 1.0 / v_sq
    spread = u_sq + _FOCAL_SQ * sin_sq

    b_over_u = B_M * per_u
    t_sq = _EP2 * b_over_u**2
    q_ratio = b_over_u**3 * _q(t_sq) / _Q0  # q/q0
    focal_q_prime = 3.0 * B_M * b_over_u**2 * _q_prime(t_sq) / _Q0  # E q'/q0
    spin_sq = OMEGA_E**2
    bulge = spin_sq * A_M**2 * focal_q_prime * (0.5 * sin_sq - 1.0 / 6.0)
    inward = (GM + bulge - spin_sq * u * p * p) * per_v_sq
    poleward = spin_sq * (A_M**2 * q_ratio * per_v_sq - 1.0)

    # The two components along the confocal axes, rotated to the polar axis and the equator plane;
    # no square root of v_sq and few divisions.
    across = -p * (inward * u + poleward * sin_sq * v_sq) / spread
    axial = -z * (inward * v_sq * per_u - poleward * p * p) / spread
    north = axial * cos_lat - across * sin_lat
    down = -axial * sin_lat - across * cos_lat
    return xp.stack([north, xp.zeros_like(north), down], -1)


def gravity(lat_rad: ArrayLike, alt_m: ArrayLike) -> Each:
    """Magnitude of normal gravity [m/s^2], exact at every height; see `gravity_n`."""
    g = gravity_n(lat_rad, alt_m)
    return library(g).sqrt(g[..., 0] ** 2 + g[..., 2] ** 2)


def earth_rate_n(lat_rad: ArrayLike) -> Float[Real, "*b 3"]:
    """Rotation of the Earth omega_ie_n [rad/s], north-east-down."""
    xp, lat = _floats(lat_rad)
    return xp.stack(
        [OMEGA_E * xp.cos(lat), xp.zeros_like(lat), -OMEGA_E * xp.sin(lat)],
        -1,
    )


def transport_rate_n(lat_rad: ArrayLike, alt_m: ArrayLike, v_n: ArrayLike) -> Float[Real, "*b 3"]:
    """Rotation of the local frame over the Earth omega_en_n [rad/s] at velocity v_n [m/s].

    North-east-down; Groves (2013), eq. 5.44.

    Raises:
        ValueError: a latitude is that of a pole, where north is not defined; a height is below
            -1000 km; v_n does not have three components (the only check in compiled code).
    """
    xp, lat, alt, v = _floats(lat_rad, alt_m, v_n)
    require(v.shape[-1:] == (3,), "v_n has 3 components along its last axis", v.shape)
    _refuse_deep(alt)
    if not is_traced(lat):
        require(
            not np.any(np.abs(np.cos(np.asarray(lat))) < _POLAR),
            "the local frame has no rate at a pole, where north is not defined; use ECEF",
        )
    meridian, transverse = curvature_radii(lat)
    north = v[..., 1] / (transverse + alt)
    east = -v[..., 0] / (meridian + alt)
    north, east, down = xp.broadcast_arrays(north, east, -north * xp.tan(lat))
    return xp.stack([north, east, down], -1)
