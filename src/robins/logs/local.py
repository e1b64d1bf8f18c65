"""A trajectory in local metres: east, north, up about an origin; there and back without drift."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import Trajectory
from robins.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.logs.findings import LogError

# Exchanges east-north-up and north-east-down; its own inverse.
SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class LocalPath(NamedTuple):
    """Path in the axes east, north, up of one origin."""

    time_ns: np.ndarray  # (n,)
    r_l: np.ndarray  # (n, 3) m
    v_l: np.ndarray  # (n, 3) m/s
    q_lb: np.ndarray  # (n, 4) scalar first, body to local


class Origin(NamedTuple):
    """Where the local axes sit."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    @classmethod
    def of(cls, trajectory: Trajectory) -> Origin:
        """The first point of a trajectory.

        Raises:
            LogError: it has no points.
        """
        if not len(trajectory):
            name = trajectory.source or "trajectory"
            raise LogError(name, "the trajectory has no points", "give an origin")
        lat, lon = (float(np.rad2deg(a[0])) for a in (trajectory.lat_rad, trajectory.lon_rad))
        return cls(lat, lon, float(trajectory.alt_m[0]))

    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        """C_el and the Earth-fixed position of the origin."""
        lat, lon = np.deg2rad(self.lat_deg), np.deg2rad(self.lon_deg)
        r_e = np.asarray(ecef_from_geodetic(lat, lon, self.alt_m))
        return np.asarray(dcm_en(lat, lon)) @ SWAP, r_e


def to_local(trajectory: Trajectory, origin: Origin) -> LocalPath:
    """A trajectory in the axes of the origin, curvature of the Earth included."""
    C_el, r0_e = origin._axes()
    r_e = np.asarray(ecef_from_geodetic(trajectory.lat_rad, trajectory.lon_rad, trajectory.alt_m))
    C_ln = C_el.T @ _axes_at(trajectory.lat_rad, trajectory.lon_rad, trajectory.nav)
    return LocalPath(
        trajectory.time_ns,
        (r_e - r0_e) @ C_el,
        np.einsum("nij,nj->ni", C_ln, trajectory.v_n),
        _compose(C_ln, trajectory.q_nb),
    )


def from_local(path: LocalPath, origin: Origin, source: str = "") -> Trajectory:
    """The trajectory, along east, north, up of each place on the way; body axes stay."""
    C_el, r0_e = origin._axes()
    lat, lon, alt = (np.asarray(a) for a in geodetic_from_ecef(r0_e + path.r_l @ C_el.T))
    C_nl = np.swapaxes(_axes_at(lat, lon, "ENU"), -1, -2) @ C_el
    return Trajectory(
        time_ns=path.time_ns,
        lat_rad=lat,
        lon_rad=lon,
        alt_m=alt,
        v_n=np.einsum("nij,nj->ni", C_nl, path.v_l),
        q_nb=_compose(C_nl, path.q_lb),
        nav="ENU",
        source=source,
    )


def _axes_at(lat_rad: np.ndarray, lon_rad: np.ndarray, nav: str) -> np.ndarray:
    """(n, 3, 3) C_en of the navigation axes at each place."""
    C_en = np.asarray(dcm_en(lat_rad, lon_rad))
    return C_en @ SWAP if nav == "ENU" else C_en


def _compose(C: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Quaternion of C after q."""
    turned = rotation.multiply(rotation.from_dcm(jnp.asarray(C)), jnp.asarray(q, float))
    return np.asarray(turned)
