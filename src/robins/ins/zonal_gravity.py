"""Fast normal gravity for the strapdown step: no trigonometry, one root, one division.

`robins.earth.gravity_n` evaluates the closed form of the level ellipsoid from a latitude. At every
IMU sample that is the costliest part of the step, and a library sine prevents vectorisation over
runs. The zonal series of the same field converges as e^(2n), so five terms equal the closed form to
rounding.
"""

from __future__ import annotations

from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import leg2poly
from numpy.polynomial.polynomial import polyder

from robins import _float64  # noqa: F401
from robins.earth import A_M, E2, GM, OMEGA_E
from robins.earth.wgs84 import B_M, F
from robins.linalg.library import Real

Scalar = Float[Real, "..."]

_TERMS = 5  # the first one omitted, J12, is 1e-16


def _zonal_harmonics() -> list[float]:
    """J2, J4, ... of the level ellipsoid (Heiskanen & Moritz 1967, eq. 2-92 and 2-90)."""
    m = OMEGA_E**2 * A_M**2 * B_M / GM
    t = np.sqrt(E2) / (1.0 - F)  # second eccentricity
    # q0 = ((1 + 3/t^2) atan(t) - 3/t) / 2 as a series, since the closed form cancels
    q0 = sum(
        (-1) ** (k + 1) * 2.0 * k * t ** (2 * k + 1) / ((2 * k + 1) * (2 * k + 3))
        for k in range(1, 12)
    )
    j2 = E2 / 3.0 * (1.0 - 2.0 / 15.0 * m * t / q0)
    return [
        -((-1.0) ** n) * 3.0 * E2**n / ((2 * n + 1) * (2 * n + 3)) * (1.0 - n + 5.0 * n * j2 / E2)
        for n in range(1, _TERMS + 1)
    ]


def _polynomials(j: list[float]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Coefficients in u^2 (u = z/r) of the factor of (a/r)^l, across the axis and along it.

    d/dx (P_l(u) / r^(l+1)) = -x / r^(l+3) P'_(l+1)(u), and along the axis (l+1) P_(l+1)(u) / u
    takes the place of P'.
    """
    across, along = [], []
    for n, j_2n in enumerate(j, start=1):
        above = leg2poly([0.0] * (2 * n + 1) + [1.0])
        across.append(-j_2n * polyder(above)[::2])
        along.append(-j_2n * (2 * n + 1) * above[1::2])
    return across, along


_ACROSS, _ALONG = _polynomials(_zonal_harmonics())


def horner(coefficients, x):
    """Value at x of the polynomial with these coefficients, the constant first."""
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = c + x * total
    return total


def gravity_nd(
    sin_lat: Scalar, cos_lat: Scalar, transverse_m: Scalar, alt_m: Scalar, library: ModuleType = jnp
) -> tuple[Scalar, Scalar]:
    """North and down components [m/s^2] of normal gravity; the east one is zero.

    Args:
        sin_lat: of the geodetic latitude.
        cos_lat: of the same.
        transverse_m: radius of curvature in the prime vertical [m] at that latitude.
        alt_m: height above the ellipsoid [m], above -10 km.
        library: of the scalars, JAX's or NumPy.
    """
    p = (transverse_m + alt_m) * cos_lat
    z = ((1.0 - E2) * transverse_m + alt_m) * sin_lat
    per_r_sq = 1.0 / (p * p + z * z)
    x = z * z * per_r_sq
    k = A_M**2 * per_r_sq
    pull = GM * per_r_sq * library.sqrt(per_r_sq)
    across = OMEGA_E**2 * p - pull * p * (1.0 + k * horner([horner(c, x) for c in _ACROSS], k))
    along = -pull * z * (1.0 + k * horner([horner(c, x) for c in _ALONG], k))
    return along * cos_lat - across * sin_lat, -along * sin_lat - across * cos_lat
