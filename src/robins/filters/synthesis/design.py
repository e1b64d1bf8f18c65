"""Designed filters with their true norms, by which every answer of a solver is checked."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from robins.errors import RobinsError
from robins.filters.checks import Matrix
from robins.filters.synthesis import norms
from robins.filters.synthesis.plant import ErrorSystem, Plant, error_system

BOUND = 1e-3  # largest relative excess of the true H2 norm over a solver's bound
GAMMA = 1e-6  # largest relative excess of the true H-infinity norm over gamma
_AGREE = 1e-6  # largest relative difference of the two computations of the H-infinity norm
FullOrder = tuple[np.ndarray, np.ndarray, np.ndarray]  # Ah (n, n), Bh (n, m), Gh (r, n)


class NotCertified(RobinsError, ValueError):
    """The true norms of a filter exceed the bounds of its design."""


class Unreachable(RobinsError, ValueError):
    """No filter of the form meets gamma; the message states the least feasible gamma.

    Attributes:
        least: least feasible gamma; nan if unknown.
    """

    def __init__(self, message: str, least: norms.Number = np.nan):
        super().__init__(message)
        self.least = float(least)


class Design(NamedTuple):
    """Filter with constant gains; norms are of the error z - z^, in units of the plant."""

    method: str
    gamma: float  # requested bound on the H-infinity norm; inf for none
    gain: np.ndarray  # (n, m) K of the observer; Bh of a full-order filter
    order: Literal["observer", "full"]
    filter: FullOrder | None  # where order is "full"
    bound: float  # the solver's bound on the H2 norm; nan for none
    h2: float  # true, by the Gramian
    hinf: float  # true, by level tests (`hinf_norm`)
    hinf_sweep: float  # true, by a frequency sweep (`peak_gain`)
    radius: float  # spectral radius of the error system, or of plant and full-order filter together
    lambda_: float  # variance of n taken as noise; nan if no Riccati equation was solved
    status: str  # of the solver
    seconds: float  # computing time of the design [s]; nan if not measured


def certify(plant: Plant, K: Matrix, *, method: str, **fields: Any) -> Design:
    """Design of an observer gain K (n, m), if its true norms meet the bounds.

    `fields` are ``gamma``, ``bound``, ``lambda_``, ``status`` and ``seconds`` of `Design`.

    Raises:
        NotCertified: the error does not decay, H2 > bound (1 + 1e-3), Hinf > gamma (1 + 1e-6), or
            the two computations of Hinf differ by more than 1e-6.
        ValueError: K is not (n, m) or not finite.
    """
    return _certified(error_system(plant, K), np.array(K, float), None, method, **fields)


def certify_full(plant: Plant, filter_: FullOrder, *, method: str, **fields: Any) -> Design:
    """Design of a full-order filter x^(k+1) = Ah x^ + Bh y, z^ = Gh x^, checked as by `certify`.

    Its error depends on the state of the plant, which must therefore be stable.
    """
    Ah, Bh, Gh = (np.array(matrix, float) for matrix in filter_)
    zero = np.zeros((len(plant.A), len(Ah)))
    error = ErrorSystem(
        np.block([[plant.A, zero], [Bh @ plant.C, Ah]]),
        np.vstack([plant.Bw, Bh @ plant.Dw]),
        np.vstack([plant.Bn, Bh @ plant.Dn]),
        np.hstack([plant.L, -Gh]),
    )
    return _certified(error, Bh, (Ah, Bh, Gh), method, **fields)


def _certified(
    error: ErrorSystem,
    gain: np.ndarray,
    filter_: FullOrder | None,
    method: str,
    gamma: norms.Number = np.inf,
    bound: norms.Number = np.nan,
    lambda_: norms.Number = np.nan,
    status: str = "",
    seconds: norms.Number = np.nan,
) -> Design:
    design = Design(
        method, float(gamma), gain, "full" if filter_ else "observer", filter_, float(bound),
        norms.h2_norm(error.A, error.Bw, error.L),
        norms.hinf_norm(error.A, error.Bn, error.L),
        norms.peak_gain(error.A, error.Bn, error.L),
        norms.spectral_radius(error.A), float(lambda_), status, float(seconds),
    )  # fmt: skip
    h2, hinf, sweep = design.h2, design.hinf, design.hinf_sweep
    if not design.radius < 1.0:
        why = f"its error does not decay, spectral radius {design.radius:.9g}"
    elif h2 > design.bound * (1.0 + BOUND):
        why = f"true H2 norm {h2:.6g} above the promised {design.bound:.6g}"
    elif hinf > design.gamma * (1.0 + GAMMA):
        why = f"true H-infinity norm {hinf:.9g} above gamma {design.gamma:.9g}"
    elif abs(hinf - sweep) > _AGREE * hinf:
        why = f"H-infinity norm {hinf:.9g} by levels but {sweep:.9g} by a sweep of the frequency"
    else:
        return design
    by = f" (the solver said {status!r})" if status else ""
    raise NotCertified(f"{method}: the answer is not certified: {why}{by}")
