"""Where samples of an IMU are missing, and over which time the sample after a gap was taken.

An increment is the integral since the sample before it. Where that one was lost, most sensors have
put out the integral of their own interval only, and the motion of the others is lost with them;
some go on summing up and have the motion of the whole gap. Stamps cannot tell the two apart, but
rate and specific force can: the one that fits those of the sample before is true.
"""

from __future__ import annotations

import numpy as np

_MISSING = 1.5  # usual intervals; from here on at least one sample is missing
_SPAN = 8  # intervals that are measured together, so that bursts of stamps average out
_GRAVITY = 9.8  # m/s^2 that counts as much as 1 rad/s


def usual_interval(dt: np.ndarray) -> float:
    """The interval [s] of a sensor from those between its samples (N,), of which some are missing.

    Their median, unless stamps come in bursts: then a tenth percentile of the means over eight.
    """
    span = min(_SPAN, len(dt))
    ends = np.concatenate([[0.0], np.cumsum(dt)])
    together = float(np.percentile(ends[span:] - ends[:-span], 10.0)) / span
    usual = float(np.median(dt))
    return usual if usual > 0.5 * together else together


def after_gap(dt: np.ndarray) -> np.ndarray:
    """(N,) bool: whether samples are missing in an interval, from the intervals (N,) [s].

    A long interval with a short one behind it is a late stamp: nothing is missing there.
    """
    usual = usual_interval(dt)
    late = np.append(dt[1:] < (2.0 - _MISSING) * usual, False)
    return (dt > _MISSING * usual) & ~late


def own_intervals(dt: np.ndarray, theta: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """How long each increment of a table lasted [s]: the interval before it, or less after a gap.

    Args:
        dt: (N - 1,) s, between the samples.
        theta: (N, 3) rad, as recorded.
        dv: (N, 3) m/s.

    Returns:
        (N,) s; the first as long as the second, or the usual interval if that ends a gap.
    """
    gap = after_gap(dt)
    usual = usual_interval(dt)
    own = np.concatenate([np.where(gap[:1], usual, dt[:1]), dt])
    both = np.hstack([theta, dv / _GRAVITY])
    for k in np.flatnonzero(gap) + 1:
        before = both[k - 1] / own[k - 1]
        alone, whole = (np.linalg.norm(both[k] / h - before) for h in (usual, own[k]))
        if alone < whole:
            own[k] = usual
    return own
