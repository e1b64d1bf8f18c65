"""Times at which the GNSS is withheld."""

from __future__ import annotations

import numpy as np

from robins.systems.ins_gnss.parameters import Outages


def outage_mask(time_s: np.ndarray, first_s: float, last_s: float, outages: Outages) -> np.ndarray:
    """Which times lie in an outage; outages repeat until none may begin any more.

    Args:
        time_s: (N,) times to judge.
        first_s: time of the first fix.
        last_s: time of the last fix.
        outages: length, gap and margins.
    """
    period = outages.length + outages.gap
    since = time_s - (first_s + outages.first)
    begin = np.floor(since / period) * period
    inside = (since >= 0.0) & (since - begin < outages.length)
    return inside & (first_s + outages.first + begin < last_s - outages.last)
