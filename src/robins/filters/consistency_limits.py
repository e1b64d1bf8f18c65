"""Limits by which the NIS and NEES of a filter are judged, and the band of recorded data.

Bands are two-sided bands of chi-square (Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4). All other
limits are those of robins: they state which deviation is worth a warning.
"""

from __future__ import annotations

import numpy as np

from robins.filters.chi_square import chi2_band

LEVEL = 0.95  # of the band that a result shows beside a statistic
TEST_LEVEL = 0.999  # of the band of the mean NIS by which a filter is called inconsistent
FEWEST = 20  # measurements, or degrees of freedom, below which no share and no mean is tested
CORRELATED = 10  # degrees of freedom that count as one, since innovations may be correlated

# Mean NIS per degree of freedom above or below which it is reported: standard deviations are half
# or four times what they should be. Robust filters are cautious by design, so that side is wider.
NIS_HIGH, NIS_LOW = 4.0, 1.0 / 16.0

REFUSED_SHARE = 1.0 / 3.0  # share of refused measurements above which they are reported


def correlated_band(dof: int, level: float = LEVEL) -> np.ndarray:
    """Band (2,) of the mean NIS of recorded data, in which `CORRELATED` innovations count as one.

    Args:
        dof: degrees of freedom of all innovations.
        level: probability of the two-sided band.
    """
    count = max(dof // CORRELATED, 1)
    return chi2_band(count, 1, level) / count
