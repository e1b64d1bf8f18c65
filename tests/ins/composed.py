"""Increments put together one by one in NumPy, as a reference for what is joined otherwise."""

import numpy as np
from scipy.spatial.transform import Rotation

from robins.ins.increments import Increments, displacement


def composed(increments: Increments) -> Increments:
    """One increment for all of them, which may lack ``dr``."""
    turned, v, r = Rotation.identity(), np.zeros(3), np.zeros(3)
    rows = (increments.dt, increments.theta, increments.dv, displacement(increments))
    for dt, theta, dv, dr in zip(*(np.asarray(a) for a in rows), strict=True):
        r = r + v * dt + turned.apply(dr)
        v = v + turned.apply(dv)
        turned = turned * Rotation.from_rotvec(theta)
    return Increments(np.sum(increments.dt), turned.as_rotvec(), v, r)
