"""What the proof of an LMI costs, taken back."""

from __future__ import annotations

import time

import numpy as np
import scipy.optimize

from robins.filters.synthesis.design import Design, certify
from robins.filters.synthesis.lmi import ObserverForm, check_form, observer
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.riccati import check_gamma

_WIDER = 1.5  # factor of gamma' from one trial to the next
_FARTHEST = 1e3  # gamma' over gamma where it makes no difference any more
_RTOL = 1e-6  # of gamma', and by how much the true norm may exceed gamma in a certified design


def retuned(plant: Plant, gamma: Number, form: ObserverForm = "slack") -> Design:
    """The observer of `lmi.observer` for the gamma' >= gamma at which the true norm is gamma.

    An LMI proves more than is asked: the true norm of its answer lies below its gamma, and what it
    gives away there costs H2. A search for gamma' takes it back, in some ten solves. Where the
    Kalman filter meets gamma, it is that filter.

    Args:
        plant: what is filtered.
        gamma: bound on the true H-infinity norm.
        form: "common" or "slack".

    Returns:
        The best design on the way that meets gamma. Its `bound` holds for it as well, and `status`
        tells gamma'.

    Raises:
        Unreachable: gamma is below the least one, which the message names.
        NotCertified: a solve on the way had no answer that passed.
        MissingExtra: cvxpy or Clarabel is not installed.
        ValueError: gamma is not positive, or the form is not known.
    """
    check_gamma(gamma)
    check_form(form)
    began = time.perf_counter()
    gamma = float(gamma)
    tried = [observer(plant, np.inf, form)]
    if tried[0].hinf > gamma:
        _search(plant, gamma, form, tried)
    best = min((d for d in tried if d.hinf <= gamma * (1.0 + _RTOL)), key=lambda d: d.h2)
    return certify(
        plant,
        best.gain,
        method=f"retuned-{form}",
        gamma=gamma,
        bound=best.bound,
        status=f"{best.status} at gamma' = {best.gamma:.7g}",
        seconds=time.perf_counter() - began,
    )


def _search(plant: Plant, gamma: float, form: ObserverForm, tried: list[Design]) -> None:
    """Add designs to those tried, up to one whose true norm is gamma."""

    def excess(log: float) -> float:
        tried.append(observer(plant, float(np.exp(log)), form))
        return float(np.log(tried[-1].hinf / gamma))

    low = np.log(gamma)
    if excess(low) >= 0.0:
        return
    high = low + np.log(_WIDER)
    while excess(high) < 0.0:
        if high > np.log(_FARTHEST * gamma):
            return
        low, high = high, high + np.log(_WIDER)
    scipy.optimize.brentq(excess, low, high, xtol=_RTOL)
