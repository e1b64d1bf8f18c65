"""Process noise of attitude and bias on one axis of a rate-integrating gyro.

Over a sample of length T it is exact at rest (Farrenkopf 1978; Markley & Crassidis 2014, eq. 6.93):

    Q = [arw^2 T + rrw^2 T^3/3   -rrw^2 T^2/2]
        [                *          rrw^2 T  ]
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

ARCSEC = math.pi / 648000.0


def equivalent_walk(rate_walk: Any, markov: Any, markov_time: Any) -> Any:
    """Rate random walk equivalent to itself plus a Markov drift, sqrt(rrw^2 + 2 s^2/tau).

    For times short against tau a Markov process grows like this random walk.
    """
    return math.sqrt(rate_walk**2 + 2.0 * markov**2 / markov_time)


def walk_covariance(random_walk: float, rate_walk: float, step_s: float) -> np.ndarray:
    """(2, 2) Q of an axis: angle, rate."""
    a, r, T = random_walk**2, rate_walk**2, step_s
    return np.array([[a * T + r * T**3 / 3.0, -r * T**2 / 2.0], [-r * T**2 / 2.0, r * T]])
