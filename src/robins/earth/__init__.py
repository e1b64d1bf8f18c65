"""The Earth: ellipsoid, gravity, rates of the local frame, magnetic field, air, positions.

- `wgs84`: constants and functions of the WGS-84 ellipsoid, by NumPy or JAX.
- `geodetic`: `Geodetic`, latitude, longitude and height with `retract` and `local` in metres.
- `magnetic`: the field of the WMM2020 and WMM2025 (import it by its name).
- `atmosphere`: the U.S. Standard Atmosphere 1976 (import it by its name).
- `stars`: star catalogues, and the stars near a direction (import it by its name).
"""

from typing import TYPE_CHECKING

from robins.errors import lazy

if TYPE_CHECKING:
    from robins.earth.geodetic import Geodetic
    from robins.earth.wgs84 import (
        A_M,
        B_M,
        E2,
        GM,
        OMEGA_E,
        F,
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

__getattr__ = lazy(
    __name__,
    dict.fromkeys(__all__, f"{__name__}.wgs84") | {"Geodetic": f"{__name__}.geodetic"},
)
