"""Constant gains of the filters, designed axis by axis.

Per axis and from star frame to star frame (period Ts) the error of attitude and bias is

    A = [1 -Ts; 0 1],   Q of the gyro over Ts,   y = dtheta + star noise,   z = dtheta,

and the modelling error n is a rate, Bn = [Ts; 0], or a drift of the bias, Bn = [-Ts^2/2; Ts].
Between frames the filter propagates with the gyro, so one design holds at any angular rate.
Internal units are arcsec and s: in radians variances would be 1e-10, below a solver's tolerances.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from robins.filters.synthesis import Design, Plant, current_form, kalman_design, observer, riccati
from robins.systems.satellite.gyro import ARCSEC, walk_covariance


class GainSpec(NamedTuple):
    """Design method of the gain of an axis."""

    method: Literal["raw", "h2", "lmi", "riccati"]
    share: float = 1.0  # gamma over the H-infinity norm of the Kalman filter of the axis
    enters: Literal["rate", "bias"] = "rate"  # where the modelling error n does


class SensorNoise(NamedTuple):
    """Assumed noise of gyro and star sensor, SI; hashable, because gains are cached."""

    random_walk: float
    rate_walk: float
    period_s: float
    star_rad: tuple[float, float, float]


def axis_plant(b: SensorNoise, star_rad: float, enters: str) -> Plant:
    """Plant of one axis, in current form, arcsec and s."""
    T = b.period_s
    Q = walk_covariance(b.random_walk / ARCSEC, b.rate_walk / ARCSEC, T)
    Bn = {"rate": [[T], [0.0]], "bias": [[-0.5 * T**2], [T]]}[enters]
    return current_form(
        np.array([[1.0, -T], [0.0, 1.0]]),
        np.linalg.cholesky(Q),
        np.array(Bn),
        np.array([[1.0, 0.0]]),
        np.array([[star_rad / ARCSEC]]),
        L=np.array([[1.0, 0.0]]),
    )


@cache
def axis_design(b: SensorNoise, star_rad: float, spec: GainSpec) -> Design:
    """Gain and certified norms of one axis.

    Raises:
        robins.filters.synthesis.programs.MissingExtra: a design by LMI without the extra "design".
        robins.filters.synthesis.Unreachable: no gain of this method meets the bound.
    """
    plant = axis_plant(b, star_rad, spec.enters)
    best = kalman_design(plant)
    if spec.method == "h2":
        return best
    gamma = spec.share * best.hinf
    if spec.method == "riccati":
        return riccati(plant, gamma)
    return observer(plant, gamma, "common")


def gain(b: SensorNoise, spec: GainSpec) -> np.ndarray:
    """(6, 3) gain of attitude and bias [1, 1/s] from the star sensor's measurement."""
    K = np.zeros((6, 3))
    for i, star_rad in enumerate(b.star_rad):
        one = np.array([1.0, 0.0])
        if spec.method != "raw":
            one = axis_design(b, star_rad, spec).gain[:, 0]
        K[i, i], K[3 + i, i] = one
    return K


def inflation(b: SensorNoise, spec: GainSpec) -> np.ndarray:
    """(6, 3) factor of added noise per frame with which a Kalman filter has these gains, SI.

    sqrt(lambda) Bn of each axis, for a Riccati design.
    """
    B = np.zeros((6, 3))
    for i, star_rad in enumerate(b.star_rad):
        lambda_ = axis_design(b, star_rad, spec).lambda_
        column = axis_plant(b, star_rad, spec.enters).Bn[:, 0]
        B[[i, 3 + i], i] = math.sqrt(lambda_) * column * ARCSEC
    return B


def facts(b: SensorNoise, spec: GainSpec) -> Mapping[str, float]:
    """Figures of a filter from its certified norms, for its metrics.

    ``predicted_rms_arcsec``: root sum square of the H2 norms of the three axes, the error at star
    frames under the assumed noise. ``worst_case_share``: the H-infinity norm over that of the
    Kalman filter, for the worst axis.
    """
    if spec.method == "raw":
        return {}
    designs = [axis_design(b, star_rad, spec) for star_rad in b.star_rad]
    best = [kalman_design(axis_plant(b, star_rad, spec.enters)) for star_rad in b.star_rad]
    return {
        "predicted_rms_arcsec": float(np.sqrt(sum(d.h2**2 for d in designs))),
        "worst_case_share": max(d.hinf / k.hinf for d, k in zip(designs, best, strict=True)),
    }
