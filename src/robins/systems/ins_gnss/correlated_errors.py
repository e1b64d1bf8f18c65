"""Time-correlated part of GNSS position errors, estimated from a log.

A receiver states the sigma of a position. If its positions scatter about the motion by far less,
either the sigma is too large or most of the error is correlated from fix to fix: orbits,
ionosphere, multipath, smoothing in the receiver. A filter must assume the latter, since the fixes
do not show it: a filter that takes such an error for white states a sigma that is too small.
The error of a position is then s (sqrt(share) z + sqrt(1 - share) w), with the stated sigma s,
white w, and z first-order Gauss-Markov (Brown & Hwang 2012, ch. 4), both of unit variance.
"""

from __future__ import annotations

import numpy as np

from robins.earth import curvature_radii
from robins.systems.ins_gnss.parameters import InsGnssReplay
from robins.systems.ins_gnss.recording import Log

LEAST = 0.3  # least share of the variance taken as correlated; less may be chance
MOST = 0.99  # largest share, however small the scatter; the rest is white
_FEWEST = 100  # differences on each axis from which scatter is estimated
# quantile of absolute values (and of a unit normal); smaller ones may be from rest
_QUANTILE, _NORMAL = 0.8, 1.2816
_THIRD = np.sqrt(20.0)  # sigma of the third difference of unit white noise


def scatter(log: Log) -> np.ndarray | None:
    """Scatter (3,) of positions about the motion, in their sigmas; north, east, down.

    From third differences of positions, or, if velocities are known, from differences minus the
    integrated velocity, whichever scatter less. This is an upper bound, as both contain some
    motion. None if there are too few fixes at even intervals.
    """
    g = log.gnss
    place = np.stack([g.lat_rad, g.lon_rad, g.alt_m], -1)
    rows = np.flatnonzero(np.isfinite(place).all(axis=1) & ~log.withheld)
    if len(rows) < _FEWEST + 3:
        return None
    lat, lon, alt = place[rows].T
    meridian, transverse = (np.asarray(r) for r in curvature_radii(lat))
    r_n = np.stack(
        [(lat - lat[0]) * meridian, (lon - lon[0]) * transverse * np.cos(lat), -alt], axis=-1
    )
    step_s, sigma = np.diff(log.gnss_s[rows]), log.sigma_m[rows]
    even = np.abs(step_s / np.median(step_s) - 1.0) < 0.5
    third = np.diff(r_n, 3, axis=0) / _THIRD
    found = [_spread(third / sigma[1:-2], even[:-2] & even[1:-1] & even[2:])]
    if log.v_n is not None:
        v = log.v_n[rows]
        rest = np.diff(r_n, axis=0) - 0.5 * (v[1:] + v[:-1]) * step_s[:, None]
        found.append(_spread(rest / np.sqrt(2.0) / sigma[1:], even))
    least = np.fmin.reduce(found)
    return least if np.all(np.isfinite(least)) else None


def _spread(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Sigma (3,) of normal values, from a quantile; NaN if too few are finite."""
    out = np.full(3, np.nan)
    for k, column in enumerate(values.T):
        finite = column[chosen & np.isfinite(column)]
        if len(finite) >= _FEWEST:  # minus the median: velocities may lag by a fix
            out[k] = np.quantile(np.abs(finite - np.median(finite)), _QUANTILE) / _NORMAL
    return out


def with_correlated_share(parameters: InsGnssReplay, log: Log) -> tuple[InsGnssReplay, list[str]]:
    """Parameters with `gnss.lasting_share` set, and a note if it was estimated from the log."""
    if parameters.gnss.lasting_share is not None:
        return parameters, []
    found = scatter(log)
    share = 0.0 if found is None else float(1.0 - np.max(found) ** 2)
    share = min(share, MOST) if share >= LEAST else 0.0
    gnss = parameters.gnss.model_copy(update={"lasting_share": share})
    parameters = parameters.model_copy(update={"gnss": gnss})
    if found is None or not share:
        return parameters, []
    return parameters, [
        f"Positions scatter from fix to fix by {np.max(found):.2g} of their sigma, stated or "
        f"assumed. So {share:.0%} of the variance is taken to last (gnss.lasting_share; "
        f"first-order Gauss-Markov of {gnss.lasting_time:g} s, gnss.lasting_time): the more of it, "
        "the less the sigma of `robust` falls below that of the fixes. gnss.lasting_share = 0 "
        "takes all of it for white."
    ]
