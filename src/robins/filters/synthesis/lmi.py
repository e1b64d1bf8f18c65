"""Observers designed by linear matrix inequalities: little noise, and a bound on the worst case.

    min Trace(H):  [H  (X Bw - Y Dw)'; * X] > 0                                                 (9)
    [X  XA - YC  X Bn - Y Dn  0; *  X  0  L'; *  *  g^2 I  0; *  *  *  I] > 0                  (10)
    x^(k+1) = A x^ + K (y - C x^),  K = X^-1 Y,  H2^2 <= Trace(H),  Hinf < g

The slack form replaces the one X of both channels by X2 and Xi, joined by a matrix G that need not
be symmetric (de Oliveira, Geromel & Bernussou, *Extended H2 and H-infinity norm characterizations
and controller parametrizations for discrete-time systems*, Int. J. Control 75, 2002); its bound is
never above that of (9)-(10). (A, C) must be detectable, A need not be stable. A bound lies above
the true norm, often by some per cent: what a filter does is `Design.h2`, not `Design.bound`.
"""

from __future__ import annotations

import time
from typing import Literal

import numpy as np

from robins.filters.checks import one_of
from robins.filters.synthesis.attempts import attempt
from robins.filters.synthesis.design import Design, certify
from robins.filters.synthesis.inequalities import Aim
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.programs import Answer
from robins.filters.synthesis.riccati import check_gamma
from robins.filters.synthesis.scaling import Scales

ObserverForm = Literal["common", "slack"]


def observer(plant: Plant, gamma: Number, form: ObserverForm = "common") -> Design:
    """The observer whose bound on the H2 norm is least among those the LMI proves to meet gamma.

    Args:
        plant: what is filtered; made by `current_form`, K is the gain of the correction.
        gamma: bound on the H-infinity norm; inf leaves the modelling error out, as `h2` does.
        form: "common" for one Lyapunov matrix, "slack" for one a channel.

    Raises:
        Unreachable: gamma is below the least one, which the message names.
        NotCertified: no answer of the solver passed the test of its true norms.
        MissingExtra: cvxpy or Clarabel is not installed.
        ValueError: gamma is not positive, or the form is not known.
    """
    check_gamma(gamma)
    check_form(form)
    return _designed(plant, float(gamma), form, f"lmi-{form}")


def h2(plant: Plant) -> Design:
    """The observer of least H2 norm by LMI: the Kalman filter, found by another computation.

    Raises:
        NotCertified: as `observer`.
        MissingExtra: cvxpy or Clarabel is not installed.
    """
    return _designed(plant, np.inf, "common", "lmi-h2")


def check_form(form: str) -> None:
    """Raise a ValueError unless the form is "common" or "slack"."""
    one_of("form", form, ObserverForm)


def gain_of(answer: Answer, scales: Scales) -> np.ndarray:
    """K = X^-1 Y or G^-1 Y, in the plant's units."""
    found = answer.unknowns
    return scales.gain(np.linalg.solve(found["X" if "X" in found else "G"], found["Y"]))


def _designed(plant: Plant, gamma: float, form: ObserverForm, method: str) -> Design:
    began = time.perf_counter()
    aim: Aim = "h2" if np.isinf(gamma) else "mixed"

    def certified(answer: Answer, scales: Scales) -> Design:
        return certify(
            plant,
            gain_of(answer, scales),
            method=method,
            gamma=gamma,
            bound=scales.h2(np.sqrt(max(answer.value, 0.0))),
            status=answer.status,
            seconds=time.perf_counter() - began,
        )

    return attempt(plant, form, aim, gamma, certified)
