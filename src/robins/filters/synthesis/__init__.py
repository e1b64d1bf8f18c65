"""Offline design of filters with constant gains: mixed H2 / H-infinity.

A plant has two inputs: white noise w and a modelling error n. A design minimises the H2 norm from w
to the estimation error while the H-infinity norm from n to it stays below gamma. Only NumPy and
SciPy are needed, except for designs by LMI, which import their solver when called; every design
states its true norms.
"""

from robins.filters.synthesis.closed_form import Isotropic, closed_form, isotropic
from robins.filters.synthesis.design import Design, NotCertified, Unreachable, certify, certify_full
from robins.filters.synthesis.least import LeastGamma, least_gamma
from robins.filters.synthesis.lmi import EveryStep, FrozenTimeWarning, full, observer, retuned
from robins.filters.synthesis.norms import h2_norm, hinf_norm, peak_gain, spectral_radius
from robins.filters.synthesis.plant import ErrorSystem, Plant, current_form, error_system, plant
from robins.filters.synthesis.programs import MissingExtra
from robins.filters.synthesis.riccati import (
    inflated_gain,
    kalman_design,
    kalman_gain,
    least_riccati_gamma,
    riccati,
)
from robins.filters.synthesis.trade_off import METHODS, Attempt, TradeOff, trade_off

__all__ = [
    "METHODS",
    "Attempt",
    "Design",
    "ErrorSystem",
    "EveryStep",
    "FrozenTimeWarning",
    "Isotropic",
    "LeastGamma",
    "MissingExtra",
    "NotCertified",
    "Plant",
    "TradeOff",
    "Unreachable",
    "certify",
    "certify_full",
    "closed_form",
    "current_form",
    "error_system",
    "full",
    "h2_norm",
    "hinf_norm",
    "inflated_gain",
    "isotropic",
    "kalman_design",
    "kalman_gain",
    "least_gamma",
    "least_riccati_gamma",
    "observer",
    "peak_gain",
    "plant",
    "retuned",
    "riccati",
    "spectral_radius",
    "trade_off",
]
