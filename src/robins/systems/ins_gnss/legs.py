"""The legs of a scenario's drive as one smooth motion of a ground vehicle.

Speed, course and slope change along quintic steps, whose first two derivatives vanish at both ends,
so that legs join with continuous jerk and an ideal IMU feels no steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robins.earth import Geodetic
from robins.sim.trajectory import Motion, from_velocity, quaternion
from robins.systems.ins_gnss.parameters import Leg, Place

STEP_S = 0.05  # of the knots; spline errors are then below a micrometre

# what each leg must say, and what it may not
NEEDS = {
    "stop": {"seconds"},
    "straight": {"seconds"},
    "accelerate": {"seconds", "speed"},
    "turn": {"angle", "rate"},
    "climb": {"seconds", "angle"},
}


def smooth_step(u: np.ndarray) -> np.ndarray:
    """Quintic from 0 to 1 over u in [0, 1], flat to the second derivative at both ends."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 + u * (-15.0 + 6.0 * u))


def leg_seconds(leg: Leg) -> float:
    """How long a leg takes [s]; a turn reaches its stated rate in the middle.

    Raises:
        ValueError: the leg lacks a quantity it needs, or has one it does not take.
    """
    given = {k for k in ("seconds", "speed", "angle", "rate") if getattr(leg, k) is not None}
    needed = NEEDS[leg.do]
    if given != needed:
        wrong = sorted(given ^ needed)[0]
        what = "needs" if wrong in needed else "does not take"
        raise ValueError(f"legs: '{leg.do}' {what} '{wrong}'; it takes {', '.join(sorted(needed))}")
    if leg.do == "turn":
        assert leg.angle is not None
        assert leg.rate is not None
        return 1.875 * abs(leg.angle) / leg.rate  # the quintic's slope peaks at 15/8 of its mean
    assert leg.seconds is not None
    return leg.seconds


def motion_of(place: Place, legs: Sequence[Leg]) -> Motion:
    """The motion that legs describe, from rest.

    Raises:
        ValueError: there are no legs, or one of them is not complete.
    """
    if not legs:
        raise ValueError("legs: a drive needs at least one [[legs]]")
    edges = np.cumsum([0.0, *(leg_seconds(leg) for leg in legs)])
    count = max(int(np.ceil(edges[-1] / STEP_S)), 20)
    t = np.linspace(0.0, edges[-1], count + 1)
    speed, heading, slope = np.zeros_like(t), np.full_like(t, place.heading), np.zeros_like(t)
    now = 0.0
    for leg, a, b in zip(legs, edges[:-1], edges[1:], strict=True):
        shape = smooth_step((t - a) / (b - a))
        if leg.do == "turn":
            heading += leg.angle * shape
        elif leg.do == "climb":
            slope += leg.angle * (shape * (t < b)) * smooth_step((b - t) / (b - a)) * 4.0
        else:
            target = {"accelerate": leg.speed, "stop": 0.0}.get(leg.do, now)
            speed += (target - now) * shape
            now = target
    v_n = speed[:, None] * np.stack(
        [np.cos(slope) * np.cos(heading), np.cos(slope) * np.sin(heading), -np.sin(slope)], -1
    )
    start = Geodetic(place.latitude, place.longitude, place.height)
    return from_velocity(t, v_n, start, quaternion(np.zeros_like(t), slope, heading))
