"""The motion of another point of a rigid body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation as _Rotation

from robins.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.sim.trajectory import Motion, from_waypoints


def at_lever_arm(
    motion: Motion, lever_b_m: Sequence[float] | np.ndarray, knots_hz: float = 100.0
) -> Motion:
    """The motion of a point that is carried along, with the axes of the body.

    The point's path is that of ``r_e + C_eb lever_b``, and its velocity and acceleration are the
    path's, so all that a rotating Earth and a rotating body do is in them. North, east and down
    are those at the point: they differ from the body's own by the lever arm over the radius of the
    Earth, 0.2 arcsec at 6 m.

    Args:
        motion: of the origin of the body axes.
        lever_b_m: (3,) from there to the point, in body axes FRD [m].
        knots_hz: of the new splines.

    Raises:
        ValueError: not three finite numbers.
    """
    lever = np.asarray(lever_b_m, float)
    if lever.shape != (3,) or not np.all(np.isfinite(lever)):
        raise ValueError(f"lever_b_m must be three finite numbers, got {lever_b_m}")
    if not np.any(lever):
        return motion
    count = max(int(np.ceil(motion.duration_s * knots_hz)), 8)
    t = np.linspace(0.0, motion.duration_s, count + 1)
    k = motion.at(t)
    axes = _Rotation.from_matrix(np.asarray(dcm_en(k.lat, k.lon)))
    body = axes * _Rotation.from_quat(k.q_nb, scalar_first=True)
    r_e = np.asarray(ecef_from_geodetic(k.lat, k.lon, k.alt)) + body.apply(lever)
    lat, lon, alt = (np.asarray(a) for a in geodetic_from_ecef(r_e))
    there = _Rotation.from_matrix(np.asarray(dcm_en(lat, lon)))
    return from_waypoints(t, lat, lon, alt, (there.inv() * body).as_quat(scalar_first=True))
