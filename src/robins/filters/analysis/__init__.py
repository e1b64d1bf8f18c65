"""Accuracy of filters: consistency, covariance bound, observability, worst case."""

from robins.errors import moved
from robins.filters.analysis.bound import (
    Bound,
    bound_along,
    covariance_bound,
    linearised,
    used_sensors,
)
from robins.filters.analysis.consistency import (
    Verdict,
    anees,
    grand_mean_nis,
    nees,
    normalised_sq,
    whitened_innovations,
    whiteness,
)
from robins.filters.analysis.observability import (
    bits,
    direction_in_words,
    gramian,
    observability,
    observability_along,
    spectrum,
    unobservable,
)
from robins.filters.analysis.worst_case import (
    gamma_min,
    steady_h_infinity,
    steady_kalman,
    worst_case_gain,
)

__all__ = [
    "Bound",
    "Verdict",
    "anees",
    "bits",
    "bound_along",
    "covariance_bound",
    "direction_in_words",
    "gamma_min",
    "gramian",
    "grand_mean_nis",
    "linearised",
    "nees",
    "normalised_sq",
    "observability",
    "observability_along",
    "spectrum",
    "steady_h_infinity",
    "steady_kalman",
    "unobservable",
    "used_sensors",
    "whitened_innovations",
    "whiteness",
    "worst_case_gain",
]

__getattr__ = moved(__name__)
