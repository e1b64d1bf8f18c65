"""The U.S. Standard Atmosphere 1976 up to 86 km: temperature and pressure against height.

Seven layers in which the temperature is linear in the geopotential height H:

    T = T_b + L (H - H_b)
    P = P_b (T_b / T)^(g M / (R L)),   where L = 0:  P = P_b exp(-g M (H - H_b) / (R T_b))

(NOAA, NASA, USAF: U.S. Standard Atmosphere, 1976, eq. 18, 23, 33a, 33b and table 4; the constants
are those of its table 2.) Heights are geometric, above mean sea level. The molecular temperature of
the standard is the temperature here: above 80 km the two differ by up to 0.04 %.
"""

from __future__ import annotations

import itertools
import math

from robins.errors import require

G0 = 9.80665  # m/s^2; one metre of geopotential height is 9.80665 m^2/s^2
R_OVER_M = 8314.32 / 28.9644  # J/(kg K), dry air, with the gas constant of the 1976 standard
RADIUS_M = 6356766.0  # effective Earth radius of the standard, for geopotential heights
P0_PA = 101325.0
LOW_M, HIGH_M = -5000.0, 86000.0  # range of the standard's tables

# H_b [m], T_b [K], L [K/m] of each layer from the ground up.
_TABLE = (
    (0.0, 288.15, -6.5e-3),
    (11e3, 216.65, 0.0),
    (20e3, 216.65, 1.0e-3),
    (32e3, 228.65, 2.8e-3),
    (47e3, 270.65, 0.0),
    (51e3, 270.65, -2.8e-3),
    (71e3, 214.65, -2.0e-3),
)


def _pressure_ratio(base: tuple[float, float, float], geopotential_m: float) -> float:
    """P / P_b at a geopotential height in the layer that begins at a base (H_b, T_b, L)."""
    base_m, base_k, lapse = base
    if lapse == 0.0:
        return math.exp(-G0 * (geopotential_m - base_m) / (R_OVER_M * base_k))
    warm = base_k + lapse * (geopotential_m - base_m)
    return (base_k / warm) ** (G0 / (R_OVER_M * lapse))


def _base_pressures() -> tuple[float, ...]:
    found = [P0_PA]
    for below, above in itertools.pairwise(_TABLE):
        found.append(found[-1] * _pressure_ratio(below, above[0]))
    return tuple(found)


_PRESSURES_PA = _base_pressures()


def _layer(alt_m: float) -> tuple[int, float]:
    require(LOW_M <= alt_m <= HIGH_M, f"a height lies in [{LOW_M:g}, {HIGH_M:g}] m", alt_m)
    geopotential_m = float(RADIUS_M * alt_m / (RADIUS_M + alt_m))
    at = sum(geopotential_m >= base_m for base_m, *_ in _TABLE[1:])
    return at, geopotential_m


def temperature_K(alt_m: float) -> float:
    """Temperature [K] at a height above mean sea level [m].

    Raises:
        ValueError: the height is beyond the standard's tables, -5 km to 86 km, or NaN.
    """
    at, geopotential_m = _layer(alt_m)
    base_m, base_k, lapse = _TABLE[at]
    return base_k + lapse * (geopotential_m - base_m)


def pressure_Pa(alt_m: float) -> float:
    """Static pressure [Pa] at a height above mean sea level [m].

    Raises:
        ValueError: the height is beyond the standard's tables, -5 km to 86 km, or NaN.
    """
    at, geopotential_m = _layer(alt_m)
    return _PRESSURES_PA[at] * _pressure_ratio(_TABLE[at], geopotential_m)


def pressure_altitude_m(pressure: float) -> float:
    """Height above mean sea level [m] at which the standard atmosphere has a pressure [Pa].

    Raises:
        ValueError: the pressure is not one of the standard's between -5 km and 86 km.
    """
    low, high = pressure_Pa(HIGH_M), pressure_Pa(LOW_M)
    require(low <= pressure <= high, f"a pressure lies in [{low:.3g}, {high:.6g}] Pa", pressure)
    at = sum(float(pressure) <= base for base in _PRESSURES_PA[1:])
    base_m, base_k, lapse = _TABLE[at]
    ratio = pressure / _PRESSURES_PA[at]
    if lapse == 0.0:
        geopotential_m = base_m - R_OVER_M * base_k / G0 * math.log(ratio)
    else:
        warm = base_k * ratio ** (-R_OVER_M * lapse / G0)
        geopotential_m = base_m + (warm - base_k) / lapse
    return RADIUS_M * geopotential_m / (RADIUS_M - geopotential_m)
