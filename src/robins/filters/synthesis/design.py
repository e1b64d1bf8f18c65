"""A designed filter with its true norms, which check every answer of a solver."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from robins.errors import RobinsError
from robins.filters.synthesis import norms
from robins.filters.synthesis.plant import ErrorSystem, Plant, error_system

_BOUND = 1e-3  # by how much, relatively, a solver's bound may lie below the true H2 norm
_GAMMA = 1e-6  # by how much the true H-infinity norm may exceed gamma
_AGREE = 1e-6  # and differ from the sweep


class NotCertified(RobinsError, ValueError):
    """The true norms of a filter are not what its design promised."""


class Unreachable(RobinsError, ValueError):
    """No filter of the form asked for meets gamma; the message names the least one can have.

    Attributes:
        least: that gamma, nan where it is not known.
    """

    def __init__(self, message: str, least: norms.Number = np.nan):
        super().__init__(message)
        self.least = float(least)


class Design(NamedTuple):
    """A filter with constant gains.

    Norms are those of the error z - z^, in the units of the plant.
    """

    method: str  # how it was found
    gamma: float  # bound on the H-infinity norm that was asked for; inf for none
    gain: np.ndarray  # (n, m) K of the observer; Bh of a full-order filter
    order: Literal["observer", "full"]
    filter: tuple[np.ndarray, np.ndarray, np.ndarray] | None  # (Ah, Bh, Gh) where order is "full"
    bound: float  # what the solver promised for the H2 norm; nan where it promised nothing
    h2: float  # true, by the Gramian
    hinf: float  # true, by tests of levels (`hinf_norm`)
    hinf_sweep: float  # the same, by a sweep of the frequency
    radius: float  # spectral radius of the error, or of plant and full-order filter together
    lambda_: float  # by how much n was made noise; nan where no Riccati equation was solved
    status: str  # the solver's own words
    seconds: float  # time the design took; nan where it was not measured


def certify(plant: Plant, K: Any, *, method: str, **told: Any) -> Design:
    """The design of an observer gain, if its true norms are what was asked and promised.

    Args:
        plant: what it was designed for.
        K: (n, m) gain.
        method: as in `Design`.
        told: ``gamma``, ``bound``, ``lambda_``, ``status`` and ``seconds``, as in `Design`, of
            those that there are.

    Raises:
        NotCertified: the error does not decay, H2 > bound (1 + 1e-3), Hinf > gamma (1 + 1e-6), or
            the two computations of Hinf differ by more than 1e-6.
        ValueError: K is not (n, m) or not finite.
    """
    return _certified(error_system(plant, K), np.array(K, float), None, method, **told)


def certify_full(
    plant: Plant, filter_: tuple[Any, Any, Any], *, method: str, **told: Any
) -> Design:
    """The same for a full-order filter x^(k+1) = Ah x^ + Bh y, z^ = Gh x^.

    Its error depends on the state of the plant, which must therefore decay by itself.

    Args:
        plant: what it was designed for.
        filter_: Ah (n, n), Bh (n, m), Gh (r, n).
        method: as in `Design`.
        told: as `certify` takes it.

    Raises:
        NotCertified: as `certify`.
    """
    Ah, Bh, Gh = (np.array(matrix, float) for matrix in filter_)
    zero = np.zeros((len(plant.A), len(Ah)))
    error = ErrorSystem(
        np.block([[plant.A, zero], [Bh @ plant.C, Ah]]),
        np.vstack([plant.Bw, Bh @ plant.Dw]),
        np.vstack([plant.Bn, Bh @ plant.Dn]),
        np.hstack([plant.L, -Gh]),
    )
    return _certified(error, Bh, (Ah, Bh, Gh), method, **told)


def _certified(
    error: ErrorSystem,
    gain: np.ndarray,
    filter_: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
    method: str,
    gamma: norms.Number = np.inf,
    bound: norms.Number = np.nan,
    lambda_: norms.Number = np.nan,
    status: str = "",
    seconds: norms.Number = np.nan,
) -> Design:
    """The design, if no promise is broken; else the error names which."""
    design = Design(
        method, float(gamma), gain, "full" if filter_ else "observer", filter_, float(bound),
        norms.h2_norm(error.A, error.Bw, error.L),
        norms.hinf_norm(error.A, error.Bn, error.L),
        norms.peak_gain(error.A, error.Bn, error.L),
        norms.spectral_radius(error.A), float(lambda_), status, float(seconds),
    )  # fmt: skip
    said = f" (the solver said {status!r})" if status else ""
    promises = (
        (design.radius < 1.0, f"its error does not decay, spectral radius {design.radius:.9g}"),
        (
            not design.h2 > design.bound * (1.0 + _BOUND),
            f"true H2 norm {design.h2:.6g} above the promised {design.bound:.6g}",
        ),
        (
            not design.hinf > design.gamma * (1.0 + _GAMMA),
            f"true H-infinity norm {design.hinf:.9g} above gamma {design.gamma:.9g}",
        ),
        (
            not abs(design.hinf - design.hinf_sweep) > _AGREE * design.hinf,
            f"H-infinity norm {design.hinf:.9g} by levels but {design.hinf_sweep:.9g} by a sweep "
            "of the frequency",
        ),
    )
    for kept, why in promises:
        if not kept:
            raise NotCertified(f"{method}: the answer is not certified: {why}{said}")
    return design
