"""Offline design of filters with constant gains, for noise and for the worst case at once.

A plant has two inputs: white noise w and a modelling error n. A design minimises the H2 norm from w
to the error of the estimate while the H-infinity norm from n to it stays below gamma. NumPy only;
every answer carries its true norms.
"""

from robins.filters.synthesis.design import (
    Design,
    NotCertified,
    Unreachable,
    certify,
    certify_full,
)
from robins.filters.synthesis.norms import h2_norm, hinf_norm, peak_gain, spectral_radius
from robins.filters.synthesis.plant import (
    ErrorSystem,
    Plant,
    current_form,
    error_system,
    plant,
)

__all__ = [
    "Design",
    "ErrorSystem",
    "NotCertified",
    "Plant",
    "Unreachable",
    "certify",
    "certify_full",
    "current_form",
    "error_system",
    "h2_norm",
    "hinf_norm",
    "peak_gain",
    "plant",
    "spectral_radius",
]
