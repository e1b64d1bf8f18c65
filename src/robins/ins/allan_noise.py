"""Mean and covariance of the Allan variance of inertial sensor noise.

The overlapping estimate at cluster size m is the mean of z_i^2 / (2 tau^2) over the second
differences ``z_i = x_i - 2 x_(i+m) + x_(i+2m)`` of the integrated output x. For each noise,

    term               PSD of the rate     Allan variance       s(t) of x
    Q quantisation     (2 pi f)^2 Q^2 t0   3 Q^2 / tau^2        Q^2 at t = 0, else 0
    N random walk      N^2                 N^2 / tau            -N^2 |t| / 2
    B bias instability B^2 / (2 pi f)      2 ln 2 / pi B^2      B^2 t^2 ln|t| / (2 pi)
    K rate random walk K^2 / (2 pi f)^2    K^2 tau / 3          K^2 |t|^3 / 12
    R rate ramp        (a drift)           R^2 tau^2 / 2        -

where the variances and letters are those of IEEE Std 952 (annex on Allan variance) and s is a
generalised autocovariance: a difference of second or higher order of x turns it into a true
covariance. So the covariance of two estimates, at sizes m and m', is the sum over lags of

    2 R(l)^2,   R(l) = sum_pq w_p w_q s(l + q m' - p m),   w = (1, -2, 1),

over ``4 tau^2 tau'^2 M M'``, each lag counted as often as it occurs: the method by which C. A.
Greenhall and W. J. Riley, "Uncertainty of stability variances based on finite differences" (PTTI
2003), find the equivalent degrees of freedom ``2 mean^2 / variance`` of one estimate, here extended
to sums of noise terms and pairs of cluster sizes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TERMS = "QNBKR"
_SECOND_DIFFERENCE = ((0, 1.0), (1, -2.0), (2, 1.0))


class Moments(NamedTuple):
    """Mean and covariance of overlapping Allan variances, for any mix of noise terms.

    A mix is a vector p of the squares ``(Q^2, N^2, B^2, K^2, R^2)``.
    """

    mean: np.ndarray  # (T, 5): the expected variances are mean @ p
    quadratic: np.ndarray  # (T, T, 4, 4): covariance of the random terms, a quadratic form in p
    ramp: np.ndarray  # (T, T, 4): covariance of the random terms times the ramp

    def covariance(self, p: np.ndarray) -> np.ndarray:
        """Covariance (..., T, T) of the estimates under the mix p (..., 5)."""
        noise, ramp = p[..., :4], p[..., 4, None, None]
        both = np.einsum("tusr,...s,...r->...tu", self.quadratic, noise, noise)
        return both + ramp * np.einsum("tus,...s->...tu", self.ramp, noise)

    def degrees_of_freedom(self, p: np.ndarray) -> np.ndarray:
        """Equivalent degrees of freedom (..., T) of each estimate under the mix p (..., 5)."""
        variance = np.diagonal(self.covariance(p), axis1=-2, axis2=-1)
        return 2.0 * (p @ self.mean.T) ** 2 / variance


def mean_variances(tau_s: np.ndarray) -> np.ndarray:
    """Allan variance (T, 5) at cluster times (T,) of each term with coefficient one."""
    flat = np.full(len(tau_s), 2.0 * np.log(2.0) / np.pi)
    return np.stack([3.0 / tau_s**2, 1.0 / tau_s, flat, tau_s / 3.0, tau_s**2 / 2.0], axis=-1)


def moments(
    clusters: np.ndarray, n_samples: int | tuple[int, ...] | np.ndarray, dt_s: float
) -> Moments:
    """Moments of the overlapping Allan variances of n rate samples at the cluster sizes given.

    Args:
        clusters: (T,) sizes in samples, ascending, at most half of the longest stretch.
        n_samples: number of rate samples; the integrated output has one point more. For a record
            with gaps, numbers of each stretch (S,), which are taken to be independent.
        dt_s: sampling interval [s].
    """
    lengths = np.sort(np.atleast_1d(n_samples))
    tau = clusters * dt_s
    mean = mean_variances(tau)
    count = len(clusters)
    quadratic, ramp = np.zeros((count, count, 4, 4)), np.zeros((count, count, 4))
    unit = np.array([1.0, dt_s, dt_s**2, dt_s**3])
    for i, m in enumerate(clusters):
        for j in range(i, count):
            lags, weights = _lags(int(m), int(clusters[j]), lengths)
            r = _cross_covariance(lags, int(m), int(clusters[j])) * unit[:, None]
            scale = 4.0 * tau[i] ** 2 * tau[j] ** 2
            quadratic[i, j] = quadratic[j, i] = 2.0 * (r * weights) @ r.T / scale
            # The ramp shifts every z by R tau^2: the covariance of (z + a)^2 and (z' + b)^2
            # gains 4 a b R(l) over that of z^2 and z'^2.
            ramp[i, j] = ramp[j, i] = 4.0 * tau[i] ** 2 * tau[j] ** 2 * (r @ weights) / scale
    return Moments(mean, quadratic, ramp)


def _beyond(lengths: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Sum (L,) over ascending lengths (S,) of their excess over each least one (L,)."""
    sums = np.append(np.cumsum(lengths[::-1])[::-1], 0)
    first = np.searchsorted(lengths, least)
    return sums[first] - (len(lengths) - first) * least


def _lags(m: int, m_large: int, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lags at which to evaluate R and weights that make their sum the mean over all pairs."""
    rows, rows_large = (int(lengths[-1]) + 1 - 2 * size for size in (m, m_large))
    # Beyond the reach of both differences, -2 m' to 2 m, only flicker is correlated, and R falls
    # off as 1 / l^2: the squares left out are below 1e-3 of the sum.
    first, last = max(1 - rows, -6 * m_large), min(rows_large - 1, 6 * m_large)
    # R varies on the scale m around its kinks at p m - q m', and on the scale m' elsewhere.
    kinks = np.array([p * m - q * m_large for p in range(3) for q in range(3)])
    corners = np.array([first, last, 0, rows_large - rows])
    near = np.concatenate([np.arange(-4, 5), np.rint(2 * m * np.linspace(-1.0, 1.0, 97))])
    far = np.linspace(first, last, 1201)
    grid = np.concatenate([np.add.outer(kinks, near).ravel(), corners, np.rint(far)])
    grid = np.unique(grid[(grid >= first) & (grid <= last)]).astype(np.int64)
    # Trapezoids over whole lags: a run of consecutive lags is summed exactly.
    step = np.diff(grid)
    weights = 0.5 * (np.concatenate([[1], step]) + np.concatenate([step, [1]]))
    # A stretch of n samples has n + 1 less this number of pairs at a lag.
    reach = np.maximum(2 * m_large + np.maximum(grid, 0), 2 * m + np.maximum(-grid, 0))
    found = _beyond(lengths + 1, np.append(reach, [2 * m, 2 * m_large]))
    pairs, all_, all_large = found[:-2], float(found[-2]), float(found[-1])
    return grid, weights * pairs / (all_ * all_large)


def _cross_covariance(lags: np.ndarray, m: int, m_large: int) -> np.ndarray:
    """R(l) (4, L) of the terms Q, N, B, K with unit coefficients and unit sampling interval."""
    total = np.zeros((4, len(lags)))
    for p, w_p in _SECOND_DIFFERENCE:
        for q, w_q in _SECOND_DIFFERENCE:
            t = np.abs(lags + q * m_large - p * m).astype(float)
            log_t = np.log(np.maximum(t, 1.0))
            s = np.stack([t == 0.0, -t / 2, t * t * log_t / (2 * np.pi), t**3 / 12])
            total += w_p * w_q * s
    # Without overlap of the two differences, white noise and its integral are independent;
    # rounding of |t|^3 would correlate them.
    total[[1, 3]] *= (lags > -2 * m_large) & (lags < 2 * m)
    return total
