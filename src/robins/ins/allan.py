"""Overlapping Allan deviation of inertial sensor data, with bounds, and fitted noise terms.

`deviation` estimates the curve, `fit` fits the noise model (IEEE Std 952-1997, Annex C): angle or
velocity random walk N, bias instability B, rate random walk K and, if requested, quantisation Q
and rate ramp R. Everything is NumPy and per axis, in SI units: for gyros in rad/s the coefficients
are in rad, rad/sqrt(s), rad/s, rad/s/sqrt(s), rad/s^2.

Outputs that are low-passed, averaged or resampled have too little power at short times: there the
slope is not that of white noise. For any filter whose autocovariance is of finite duration, the
Allan variance of filtered white noise at longer times is

    N^2 / tau - C / tau^2,    C = 3 integral_0^inf t r(t) dt

with the rate's autocovariance r. If the requested terms do not explain the curve, `fit` adds the
term C, omits the shortest times until the rest is explained, and then all up to twice that time.

Bounds and weights come from the covariance of the estimates under the fitted noise terms
(`robins.ins.allan_noise`), not from a rule of thumb for white noise.
"""

from __future__ import annotations

from bisect import bisect
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.special import chdtrc, chdtri, ndtri

from robins.errors import require
from robins.ins.allan_noise import TERMS, Moments, mean_variances, moments
from robins.ins.imu_errors import FLICKER_FLAT, MARKOV_PEAK, TriadErrors
from robins.units import from_si

_FEWEST_CLUSTERS = 9  # in the longest averages, which so have about ten degrees of freedom
_PER_DECADE = 10
_HUGE = 1e100  # of a sample, or one over a change
# p-values of the residual: below the first a fit of the whole curve is rejected, above the second
# that of a part is accepted, above the third it is accepted if there is no better one.
_DOUBTED, _EXPLAINED, _BARELY = 1e-3, 1e-2, 1e-5
_FURTHER = 2  # further points omitted, each at least 1.5 times the previous time
_WHITE = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
_FIELD_UNITS = {  # name -> term, unit; for a ramp, the drift in an hour
    "gyro": {
        "angle_random_walk": ("N", "deg/sqrt(h)"),
        "noise_density": ("N", "deg/s/sqrt(Hz)"),
        "bias_instability": ("B", "deg/h"),
        "rate_random_walk": ("K", "deg/h/sqrt(h)"),
        "rate_ramp": ("R", "deg/h"),
        "quantisation": ("Q", "arcsec"),
    },
    "accel": {
        "velocity_random_walk": ("N", "m/s/sqrt(h)"),
        "noise_density": ("N", "ug/sqrt(Hz)"),
        "bias_instability": ("B", "ug"),
        "acceleration_random_walk": ("K", "ug/sqrt(h)"),
        "ramp": ("R", "ug"),
        "quantisation": ("Q", "m/s"),
    },
}


class Allan(NamedTuple):
    """Overlapping Allan deviation; T cluster times, A axes."""

    tau_s: np.ndarray  # (T,) cluster times [s]
    deviation: np.ndarray  # (T, A), unit of the rate
    lower: np.ndarray  # (T, A) bounds of the two-sided interval of the stated confidence
    upper: np.ndarray  # (T, A)
    edf: np.ndarray  # (T, A) equivalent degrees of freedom
    clusters: np.ndarray  # (T,) cluster sizes in samples
    n_samples: int
    dt_s: float
    confidence: float
    stretches: tuple[int, ...] = ()  # samples of each part between gaps; () without a gap


class NoiseCoefficients(NamedTuple):
    """Coefficients of the noise terms, each (A,), in SI units of the sensor."""

    Q: np.ndarray  # quantisation [rad | m/s]
    N: np.ndarray  # angle or velocity random walk [rad/sqrt(s) | m/s/sqrt(s)]
    B: np.ndarray  # bias instability [rad/s | m/s^2]; the flat part of the curve is 0.664 B
    K: np.ndarray  # rate random walk [rad/s/sqrt(s) | m/s^2/sqrt(s)]
    R: np.ndarray  # rate ramp [rad/s^2 | m/s^3]


class AllanFit(NamedTuple):
    """Noise terms fitted to an Allan curve. Terms not requested are zero with zero interval."""

    value: NoiseCoefficients
    lower: NoiseCoefficients  # of the interval of the given confidence; 0 if a term is not resolved
    upper: NoiseCoefficients
    chi2: np.ndarray  # (A,) weighted squared residual; far above dof if the terms do not fit
    dof: np.ndarray  # (A,) its degrees of freedom
    terms: str
    confidence: float
    from_s: np.ndarray  # (A,) shortest fitted cluster time; above the first one if coloured


def deviation(
    rate: ArrayLike,
    *,
    dt_s: float | None = None,
    time_ns: ArrayLike | None = None,
    clusters: ArrayLike | None = None,
    confidence: float = 0.95,
) -> Allan:
    """Overlapping Allan deviation of evenly sampled rates.

    The interval is ``sigma sqrt(edf / chi2_q(edf))`` at ``q = (1 +- confidence) / 2``, with
    ``edf = 2 E[V]^2 / var V`` of the variance estimate V under the noises fitted to this very curve
    (Greenhall and Riley 2003; see `robins.ins.allan_noise`).

    Args:
        rate: (N,) or (N, A) rates or specific forces; divide increments by their interval.
        dt_s: sampling interval [s]; or
        time_ns: (N,) sampling times, from which the interval is taken and gaps are found: squares
            are averaged over the differences within all stretches between them.
        clusters: cluster sizes in samples; if not given, ten per decade, up to the size of which
            there are nine.
        confidence: of the interval, between 0 and 1.

    Raises:
        ValueError: neither or both of dt_s and time_ns; a step back or a repeated time; NaN or
            infinite data; constant data or a pure ramp; too few samples; clusters out of range.
    """
    x = np.asarray(rate, float)
    x = x[:, None] if x.ndim == 1 else x
    require(x.ndim == 2, f"rate must have shape (N,) or (N, axes), got {np.shape(rate)}")
    n = len(x)
    if n < 2 * _FEWEST_CLUSTERS:
        raise ValueError(
            f"an Allan deviation needs at least {2 * _FEWEST_CLUSTERS} samples, got {n}"
        )
    require(0.0 < confidence < 1.0, "confidence must lie between 0 and 1", confidence)
    _refuse_bad_values(x)
    interval, bounds = _interval(dt_s, time_ns, n)
    lengths = np.diff(bounds)
    sizes = _cluster_sizes(clusters, lengths)

    variance = np.stack([_variances(np.split(a, bounds[1:-1]), sizes) for a in x.T], axis=-1)
    # Cluster by cluster: the covariance between clusters is not needed here.
    single = [moments(m[None], lengths, interval) for m in sizes]
    mean = np.concatenate([s.mean for s in single])
    white = np.concatenate([s.degrees_of_freedom(_WHITE) for s in single])
    mixes = np.stack([_rough_mix(v, mean, white, np.arange(5)) for v in variance.T])
    edf = np.concatenate([s.degrees_of_freedom(mixes) for s in single], axis=-1).T

    low, high = (chdtri(edf, (1.0 - side * confidence) / 2.0) for side in (1.0, -1.0))
    sigma = np.sqrt(variance)
    lower, upper = sigma * np.sqrt(edf / low), sigma * np.sqrt(edf / high)
    parts = tuple(lengths.tolist()) if len(lengths) > 1 else ()
    return Allan(sizes * interval, sigma, lower, upper, edf, sizes, n, interval, confidence, parts)


def stretches(time_ns: np.ndarray) -> np.ndarray:
    """Bounds (S + 1,) of the rows between gaps of 1.5 usual intervals."""
    step = np.diff(time_ns)
    edges = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    return np.concatenate([[0], edges, [len(time_ns)]])


def _variances(parts: list[np.ndarray], sizes: np.ndarray) -> np.ndarray:
    squares, count = np.zeros(len(sizes)), np.zeros(len(sizes))
    for rate in parts:
        # Removing the mean keeps the running sum small; it cancels in second differences.
        angle = np.concatenate([[0.0], np.cumsum(rate - rate.mean())])
        for i, m in enumerate(sizes[2 * sizes <= len(rate)]):
            z = angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]
            squares[i] += z @ z
            count[i] += len(z)
    return squares / (2.0 * sizes**2 * count)


def fit(allan: Allan, terms: str = "NBK", confidence: float = 0.95) -> AllanFit:
    """Noise terms of an Allan curve by generalised least squares.

    The Allan variance is linear in the squared coefficients, which are fitted as nonnegative, with
    the inverse covariance of the estimates as weight. That covariance grows with the variance
    itself, which makes the fit one of relative (logarithmic) errors; it is computed from the fitted
    terms, and iterated until nothing changes. It includes the correlation of neighbouring points,
    which share their data, so the intervals are not too short. They hold if the terms explain the
    curve: compare ``chi2`` with ``dof``.

    If the terms do not explain the whole curve (a residual of a probability below 1e-3), short
    times are assumed to be coloured (module docstring): the term -C / tau^2 is added, and the
    shortest times are omitted one by one until the rest is explained, and two more; ``from_s`` is
    the first time left. If no part is explained, the fit is that of the whole curve.

    Args:
        allan: from `deviation`.
        terms: any of Q, N, B, K, R.
        confidence: of the intervals of the coefficients.

    Raises:
        ValueError: unknown or repeated terms; a curve too short to separate the terms; a curve
            that no term fits.
        ArithmeticError: the fit does not converge.
    """
    if len(set(terms)) != len(terms) or not set(terms) <= set(TERMS) or set(terms) <= {"R"}:
        raise ValueError(
            f"terms must be different letters out of {TERMS}, not R alone, got {terms!r}"
        )
    require(0.0 < confidence < 1.0, "confidence must lie between 0 and 1", confidence)
    _refuse_short_curve(allan, terms)
    # Sizes closer than this add hardly any information and make the covariance nearly singular.
    keep = [0]
    for i, m in enumerate(allan.clusters):
        if m >= 1.5 * allan.clusters[keep[-1]]:
            keep.append(i)
    expected = moments(allan.clusters[keep], allan.stretches or allan.n_samples, allan.dt_s)
    index = np.array(sorted(TERMS.index(t) for t in terms))
    least = max(len(terms) + 3, 6)
    columns = [_explained(v, expected, index, least) for v in (allan.deviation[keep] ** 2).T]

    squares, sigmas = (np.stack([c[k] for c in columns], axis=-1) for k in (0, 1))  # (5, A)
    reach = ndtri((1.0 + confidence) / 2.0) * sigmas
    value, lower, upper = (
        NoiseCoefficients(*np.sqrt(np.maximum(squares + side * reach, 0.0)))
        for side in (0.0, -1.0, 1.0)
    )
    chi2, dof, first = (np.array([c[k] for c in columns]) for k in (2, 3, 4))
    return AllanFit(value, lower, upper, chi2, dof, terms, confidence, allan.tau_s[keep][first])


def term_curves(coefficients: NoiseCoefficients, tau_s: np.ndarray) -> np.ndarray:
    """Allan deviation (5, T, A) of each term Q, N, B, K, R; their root sum square is the total.

    Args:
        coefficients: of a fit, or of a data sheet in SI.
        tau_s: (T,) cluster times [s].
    """
    return np.sqrt(mean_variances(tau_s).T)[:, :, None] * np.stack(coefficients)[:, None, :]


class CoefficientInterval(NamedTuple):
    """A coefficient of each axis (A,) in a data-sheet unit, and the bounds of its interval."""

    unit: str
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def in_field_units(
    fitted: AllanFit, sensor: Literal["gyro", "accel"]
) -> dict[str, CoefficientInterval]:
    """Terms of a fit in the units of data sheets.

    White noise is stated twice, as random walk and as density: the density here is that of the
    two-sided spectrum (IEEE Std 952), so 1 deg/sqrt(h) is 1/60 deg/s/sqrt(Hz); a data sheet that
    means the one-sided spectrum prints sqrt(2) more.
    """
    out = {}
    for name, (term, unit) in _FIELD_UNITS[sensor].items():
        if term in fitted.terms:
            per_hour, factor = ("/h", 3600.0) if term == "R" else ("", 1.0)
            values = (getattr(c, term) for c in (fitted.value, fitted.lower, fitted.upper))
            out[name] = CoefficientInterval(
                unit + per_hour, *(from_si(v, unit) * factor for v in values)
            )
    return out


def triad_errors(fitted: AllanFit, correlation_time_s: float | None = None) -> TriadErrors:
    """White noise, random walk, ramp, quantisation and Markov bias of a triad from its Allan fit.

    Terms whose interval reaches zero are not resolved by the data and omitted. Flicker noise has no
    finite-order model: if a correlation time is given, the bias instability becomes a Gauss-Markov
    process whose Allan deviation peaks at the flat part of the fit.

    Raises:
        ValueError: a fit of other than three axes; a correlation time that is not positive.
    """
    if np.shape(fitted.value.N) != (3,):
        raise ValueError(f"a triad has three axes, the fit has {np.size(fitted.value.N)}")

    def resolved(term: str, factor: float) -> np.ndarray | None:
        seen = getattr(fitted.lower, term) > 0.0
        return np.where(seen, getattr(fitted.value, term) * factor, 0.0) if seen.any() else None

    flicker = None
    if correlation_time_s is not None:
        flicker = resolved("B", FLICKER_FLAT / MARKOV_PEAK)
    return TriadErrors(
        white=resolved("N", 1.0),
        walk=resolved("K", 1.0),
        ramp=resolved("R", 1.0),
        quantum=resolved("Q", np.sqrt(12.0)),  # rounding errors are uniform over a quantum
        markov_sigma=flicker,
        markov_tau_s=None if flicker is None else correlation_time_s,
    )


def _explained(
    variance: np.ndarray, expected: Moments, index: np.ndarray, least: int
) -> tuple[np.ndarray, np.ndarray, float, int, int]:
    """`_fit_axis` of the curve, or of its explained part; degrees of freedom, and first point.

    At least `least` points are fitted.
    """
    points, count = len(variance), len(index)

    @cache
    def tried(first: int, coloured: bool = True) -> tuple | None:
        rest = Moments(*(part[first:] for part in expected))
        rest = Moments(rest.mean, rest.quadratic[:, first:], rest.ramp[:, first:])
        try:
            found = _fit_axis(variance[first:], rest, index, coloured)
        except (ArithmeticError, ValueError):  # the terms do not fit the rest
            return None
        return *found, points - first - count - coloured, first

    def unlikely(found: tuple | None) -> float:
        """p-value of the residual; 0 without a fit."""
        return 0.0 if found is None else float(chdtrc(found[3], found[2]))

    whole = tried(0, coloured=False)
    if whole is not None and unlikely(whole) >= _DOUBTED:
        return whole
    parts = range(points - least)
    for enough in (_EXPLAINED, _BARELY):
        for first in parts:
            if unlikely(tried(first)) >= enough:
                # An undetected error may remain: the effect of colour beyond C / tau^2 decays, so
                # omit points up to more than twice the time.
                further = tried(min(first + _FURTHER, parts[-1]))
                if further is not None:
                    return further
    # without a fit, for its diagnostics
    return whole or (*_fit_axis(variance, expected, index), points - count, 0)


def _fit_axis(
    variance: np.ndarray, expected: Moments, index: np.ndarray, coloured: bool = False
) -> tuple[np.ndarray, np.ndarray, float]:
    """Squared coefficients (5,), their sigmas (5,) and the weighted squared residual."""
    white = expected.degrees_of_freedom(_WHITE)
    p = _rough_mix(variance, expected.mean, white, index)
    for _ in range(100):
        before = expected.mean @ p
        p, sigma, chi2 = _weighted_fit(variance, expected, index, p, coloured)
        _refuse_no_noise(p)
        # far below the resolution of the data; reached in ten to thirty passes
        if np.all(np.abs(expected.mean @ p - before) <= 1e-6 * before):
            return p, sigma, chi2
    raise ArithmeticError(
        f"the fit of terms {[TERMS[i] for i in index]} does not settle: the curve is none of "
        "theirs; look at it, and ask for other terms"
    )


def _weighted_fit(
    variance: np.ndarray, expected: Moments, index: np.ndarray, p: np.ndarray, coloured: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """One pass of `_fit_axis`, weighted by the covariance under the mix p.

    If coloured, with -C / tau^2, which does not enter that covariance.
    """
    root = np.linalg.cholesky(expected.covariance(p))
    colour = [-expected.mean[:, 0]] if coloured else []
    system = np.column_stack([expected.mean[:, index], *colour, variance])
    whitened = solve_triangular(root, system, lower=True)
    size = np.linalg.norm(whitened[:, :-1], axis=0)
    design = whitened[:, :-1] / size
    solution, residual = nnls(design, whitened[:, -1])
    squares, sigma = np.zeros(5), np.zeros(5)
    # Q and C are one term with two signs: with both requested, the one that is zero is left out
    free = np.ones(len(size), bool)
    if coloured and 0 in index:
        free[0 if solution[-1] > 0.0 else -1] = False
    spread = np.full(len(size), np.inf)
    spread[free] = np.sqrt(np.diag(np.linalg.inv(design[:, free].T @ design[:, free])))
    count = len(index)
    squares[index] = (solution / size)[:count]
    sigma[index] = np.where(free, spread / size, 0.0)[:count]
    return squares, sigma, residual**2


def _rough_mix(
    variance: np.ndarray, mean: np.ndarray, edf: np.ndarray, index: np.ndarray
) -> np.ndarray:
    """Nonnegative squared coefficients (5,), fitted with relative weights from edf only."""
    design = mean[:, index] * (np.sqrt(edf) / variance)[:, None]
    size = np.linalg.norm(design, axis=0)
    p = np.zeros(5)
    p[index] = nnls(design / size, np.sqrt(edf))[0] / size
    _refuse_no_noise(p)
    return p


def _refuse_no_noise(p: np.ndarray) -> None:
    if not p[:4].any():
        raise ValueError(
            "there is no noise in the terms that fit best, only a ramp: the data are a drift, or "
            "the terms asked for are not the ones in the data"
        )


def _cluster_sizes(clusters: ArrayLike | None, lengths: np.ndarray) -> np.ndarray:
    if clusters is None:
        longest = _longest(lengths)
        count = 1 + int(np.ceil(_PER_DECADE * np.log10(longest))) if longest > 1 else 1
        return np.unique(np.rint(np.geomspace(1, longest, count)).astype(np.int64))
    sizes, most = np.unique(np.asarray(clusters)), int(lengths.max()) // 2
    whole = np.issubdtype(sizes.dtype, np.integer)
    if sizes.size == 0 or not whole or sizes[0] < 1 or sizes[-1] > most:
        raise ValueError(
            f"clusters must be whole numbers of samples from 1 to {most}, half of the "
            f"{lengths.max()} samples without a gap, got {np.asarray(clusters)}"
        )
    return sizes.astype(np.int64)


def _longest(lengths: np.ndarray) -> int:
    """Largest cluster size of which stretches long enough for a difference contain enough."""
    # at least half of the steps are no gaps, so there are enough clusters of one sample
    larger = range(2, int(lengths.sum()) // _FEWEST_CLUSTERS + 1)
    return 1 + bisect(
        larger, -_FEWEST_CLUSTERS, key=lambda m: -int(np.sum(lengths[lengths >= 2 * m] // m))
    )


def _interval(dt_s: float | None, time_ns: ArrayLike | None, n: int) -> tuple[float, np.ndarray]:
    """Sampling interval [s], and the bounds of the stretches between gaps."""
    if (dt_s is None) == (time_ns is None):
        raise ValueError("give either dt_s, the sampling interval, or time_ns, the sampling times")
    if dt_s is not None:
        require(np.isfinite(dt_s) and dt_s > 0.0, "dt_s must be a positive number of seconds", dt_s)
        return float(dt_s), np.array([0, n])
    time = np.asarray(time_ns)
    if time.shape != (n,) or not np.issubdtype(time.dtype, np.integer):
        raise ValueError(f"time_ns must be {n} integers, got {time.dtype} of shape {time.shape}")
    step = np.diff(time)
    back = np.flatnonzero(step <= 0)
    if back.size:
        row = int(back[0]) + 1
        raise ValueError(
            f"time does not go forward at row {row} (step {step[row - 1] * 1e-9:g} s): remove "
            "repeated and misplaced rows before the Allan analysis"
        )
    bounds = stretches(time)
    lasted = int(time[-1]) - int(time[0]) - int(np.sum(step[bounds[1:-1] - 1]))
    within = n + 1 - len(bounds)
    return lasted * 1e-9 / within if within else float(np.median(step)) * 1e-9, bounds


def _refuse_bad_values(x: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(x))
    if bad.size:
        row, axis = bad[0]
        raise ValueError(
            f"{len(bad)} value(s) are not finite, the first at row {row}, axis {axis} "
            f"({x[row, axis]}): an Allan deviation needs whole data; use a part without them"
        )
    still = np.flatnonzero(np.ptp(x, axis=0) == 0.0)
    if still.size:
        raise ValueError(
            f"axis {still[0]} is constant at {x[0, still[0]]:g}: there is no noise to analyse; is "
            "the sensor stuck or the noise below its resolution?"
        )
    largest, spread = np.max(np.abs(x), axis=0), np.ptp(x, axis=0)
    if np.any(away := (largest > _HUGE) | (spread < 1.0 / _HUGE)):
        k = int(np.argmax(away))
        raise ValueError(
            f"axis {k} is up to {largest[k]:g} and changes by {spread[k]:g}: outside of 1e-100 to "
            "1e100 squares are no numbers; is the unit right?"
        )


def _refuse_short_curve(allan: Allan, terms: str) -> None:
    # terms are separated by the slope of the curve: a decade for each but the first
    needed = 10 ** (len(terms) - 1)
    have = allan.clusters[-1] / allan.clusters[0]
    if have < needed or len(allan.clusters) < len(terms) + 2:
        record = _FEWEST_CLUSTERS * needed * allan.clusters[0] * allan.dt_s
        raise ValueError(
            f"too short for the {len(terms)} terms {terms}: the cluster times span a factor of "
            f"{have:g} with {len(allan.clusters)} points, and the fit needs a factor of {needed} "
            f"and {len(terms) + 2} points, that is at least {record:g} s of data at this rate "
            f"(this record has {allan.n_samples * allan.dt_s:g} s); record longer or ask for fewer "
            "terms"
        )
