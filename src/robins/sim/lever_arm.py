"""The motion of another point of a rigid body."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from robins import _float64  # noqa: F401
from robins.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.rotation import from_dcm, to_dcm
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
    lat, lon, alt, q_nb = _carried(k.lat, k.lon, k.alt, k.q_nb, lever)
    return from_waypoints(t, *(np.asarray(a) for a in (lat, lon, alt)), q_nb=np.asarray(q_nb))


@jax.jit
def _carried(lat, lon, alt, q_nb, lever_b):
    """Latitude, longitude, height and attitude of a point carried along (leading axis)."""
    C_en = dcm_en(lat, lon)
    C_eb = C_en @ to_dcm(q_nb)
    r_e = ecef_from_geodetic(lat, lon, alt) + jnp.sum(C_eb * lever_b[None, None], -1)
    there = geodetic_from_ecef(r_e)
    C_en_there = dcm_en(there[0], there[1])
    return *there, from_dcm(jnp.swapaxes(C_en_there, -1, -2) @ C_eb)
