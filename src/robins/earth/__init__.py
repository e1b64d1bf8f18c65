"""The Earth: ellipsoid, gravity, rates of the local frame, magnetic field, air, positions.

- `wgs84`: constants and functions of the WGS-84 ellipsoid; `Geodetic`, latitude, longitude and
  height with `retract` and `local` in metres.
- `magnetic`: the field of the WMM2020 and WMM2025 (import it by its name).
- `atmosphere`: the U.S. Standard Atmosphere 1976 (import it by its name).
- `stars`: star catalogues, and the stars near a direction (import it by its name).
"""

from robins.earth.wgs84 import (
    A_M,
    B_M,
    E2,
    GM,
    OMEGA_E,
    F,
    Geodetic,
    curvature_radii,
    dcm_en,
    earth_rate_n,
    ecef_from_geodetic,
    geodetic_from_ecef,
    gravity,
    gravity_n,
    transport_rate_n,
)

__all__ = [
    "A_M",
    "B_M",
    "E2",
    "GM",
    "OMEGA_E",
    "F",
    "Geodetic",
    "curvature_radii",
    "dcm_en",
    "earth_rate_n",
    "ecef_from_geodetic",
    "geodetic_from_ecef",
    "gravity",
    "gravity_n",
    "transport_rate_n",
]
