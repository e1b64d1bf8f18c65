"""Filters of full order by LMI, x^(k+1) = Ah x^ + Bh y, z^ = Gh x^, for plants that are stable.

Nothing ties such a filter to the plant, so its error depends on the plant's state, which must decay
by itself: R - A'RA > 0 is part of the inequality. Every filter found contains an observer with the
same bound (docs/filters/mixed.md), so nothing is lost by `robins.filters.synthesis.lmi.observer`,
which needs no stable plant; the form is here to judge published designs by.
"""

from __future__ import annotations

import time

import numpy as np

from robins.filters.synthesis.attempts import attempt
from robins.filters.synthesis.design import Design, NotCertified, certify_full
from robins.filters.synthesis.norms import Number, spectral_radius
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.programs import Answer
from robins.filters.synthesis.riccati import check_gamma
from robins.filters.synthesis.scaling import Scales

METHOD = "full-order"


def full(plant: Plant, gamma: Number) -> Design:
    """The full-order filter of least bound on the H2 norm among those proved to meet gamma.

    (6) and (7) are solved for R, P, S, Q and U; then

        Ah = (R - P)^-1 S,   Bh = (R - P)^-1 Q,   Gh = U.                                       (8)

    The best R is at the edge of its cone, R -> 0, where solvers stop with some R of 1e-9 of either
    sign. R - P stays regular, so (8) is well defined, but what it makes need not be a filter. The
    true norms of plant and filter together decide; where they speak against (8), the limit itself
    is taken: S = -(P A + Q C), U = L.

    Args:
        plant: what is filtered, spectral radius of A below one.
        gamma: bound on the H-infinity norm.

    Raises:
        ValueError: the spectral radius of A is one or more (the solver is not called), or gamma is
            not a positive number.
        Unreachable: gamma is below the least one, which the message names.
        NotCertified: no answer of the solver passed the test of its true norms.
        MissingExtra: cvxpy or Clarabel is not installed.
    """
    check_gamma(gamma)
    refuse_unstable(plant)
    began = time.perf_counter()

    def certified(answer: Answer, scales: Scales) -> Design:
        failed: list[str] = []
        for made in (_of_variables, _in_the_limit):
            try:
                return certify_full(
                    plant,
                    _unscaled(made(answer, scales.plant(plant)), scales),
                    method=METHOD,
                    gamma=gamma,
                    bound=scales.h2(np.sqrt(max(answer.value, 0.0))),
                    status=answer.status,
                    seconds=time.perf_counter() - began,
                )
            except NotCertified as error:
                failed.append(str(error))
        raise NotCertified("; in the limit of R -> 0: ".join(failed))

    return attempt(plant, "full", "mixed", float(gamma), certified)


def refuse_unstable(plant: Plant) -> None:
    """Raise a ValueError where the full-order inequality can have no solution."""
    if (radius := spectral_radius(plant.A)) >= 1.0:
        raise ValueError(
            f"no filter of full order: A has spectral radius {radius:.9g}, and the LMI asks for "
            "R - A'RA > 0, which no R > 0 meets from 1 on, whatever gamma is. Take the observer "
            "form, robins.filters.synthesis.lmi.observer, which needs detectability only"
        )


def _of_variables(answer: Answer, plant: Plant) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(8)."""
    R, P, S, Q, U = (answer.unknowns[name] for name in "RPSQU")
    return np.linalg.solve(R - P, S), np.linalg.solve(R - P, Q), U


def _in_the_limit(answer: Answer, plant: Plant) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(8) for R = 0, where (7) is the observer's inequality."""
    Bh = -np.linalg.solve(answer.unknowns["P"], answer.unknowns["Q"])
    return plant.A - Bh @ plant.C, Bh, plant.L


def _unscaled(
    filter_: tuple[np.ndarray, np.ndarray, np.ndarray], scales: Scales
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    Ah, Bh, Gh = filter_
    x = scales.x
    return Ah * x[:, None] / x, Bh * x[:, None] / scales.y, Gh / x * scales.z
