"""Positions over the ellipsoid as elements of a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins.earth.wgs84 import curvature_radii, ecef_from_geodetic, geodetic_from_ecef
from robins.linalg.library import Real
from robins.manifold import wrap


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Geodetic:
    """Geodetic latitude and longitude [rad] and height above the ellipsoid [m]: one or many.

    Tangent vectors are metres north, east, down, taken with the curvature radii at the point the
    step begins. `local` is the exact inverse of `retract`, also across the 180 deg meridian; the
    longitude stays in [-pi, pi). Neither is defined at the poles, where there is no east.
    """

    lat: Any  # (...) array, rad
    lon: Any  # (...) array, rad
    alt: Any  # (...) array, m

    dim = 3
    units: ClassVar[dict[str, str]] = {
        "lat": "rad, geodetic latitude, positive north",
        "lon": "rad, longitude, positive east",
        "alt": "m, height above the ellipsoid, positive up",
    }

    @classmethod
    def from_degrees(cls, lat_deg, lon_deg, alt_m) -> Geodetic:
        """Make from latitude and longitude [deg] and height [m]; not for use under `jit`.

        Raises:
            ValueError: a latitude is beyond 90 deg, or a number is not finite.
        """
        lat, lon, alt = (np.asarray(v, float) for v in (lat_deg, lon_deg, alt_m))
        for name, value in (("lat_deg", lat), ("lon_deg", lon), ("alt_m", alt)):
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{name} = {value}: every value must be finite")
        if np.any(np.abs(lat) > 90.0):
            raise ValueError(
                f"lat_deg = {lat}: a latitude lies in [-90, 90] deg; "
                "are latitude and longitude exchanged?"
            )
        lat, lon, alt = np.broadcast_arrays(np.deg2rad(lat), np.deg2rad(lon), alt)
        return cls(jnp.asarray(lat), wrap(jnp.asarray(lon)), jnp.asarray(alt))

    @classmethod
    def from_ecef(cls, r_e) -> Geodetic:
        """Make from an Earth-fixed position [m]."""
        lat, lon, alt = geodetic_from_ecef(jnp.asarray(r_e, float))
        return cls(lat, wrap(lon), alt)

    def as_ecef(self) -> Float[Real, "*b 3"]:
        """Earth-fixed position r_e [m]."""
        return ecef_from_geodetic(self.lat, self.lon, self.alt)

    def _metres_per_radian(self):
        meridian, transverse = curvature_radii(self.lat)
        return meridian + self.alt, (transverse + self.alt) * jnp.cos(self.lat)

    def retract(self, delta: Float[Array, "*b 3"]) -> Geodetic:
        """Move by metres north, east, down."""
        north, east = self._metres_per_radian()
        return Geodetic(
            self.lat + delta[..., 0] / north,
            wrap(self.lon + delta[..., 1] / east),
            self.alt - delta[..., 2],
        )

    def local(self, other: Geodetic) -> Float[Array, "*b 3"]:
        """Metres north, east, down for which ``self.retract(metres) == other``."""
        north, east = self._metres_per_radian()
        n, e, d = jnp.broadcast_arrays(
            (other.lat - self.lat) * north,
            wrap(other.lon - self.lon) * east,
            self.alt - other.alt,
        )
        return jnp.stack([n, e, d], -1)
