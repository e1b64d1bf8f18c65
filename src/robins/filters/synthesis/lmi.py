"""Observers by linear matrix inequalities: least H2 norm under a bound on the H-infinity norm.

    min Trace(H):  [H  (X Bw - Y Dw)'; * X] > 0                                                 (9)
    [X  XA - YC  X Bn - Y Dn  0; *  X  0  L'; *  *  g^2 I  0; *  *  *  I] > 0                  (10)
    x^(k+1) = A x^ + K (y - C x^),  K = X^-1 Y,  H2^2 <= Trace(H),  Hinf < g

The slack form replaces the one X of both channels by X2 and Xi, joined by a matrix G that need not
be symmetric (de Oliveira, Geromel & Bernussou, *Extended H2 and H-infinity norm characterizations
and controller parametrizations for discrete-time systems*, Int. J. Control 75, 2002); its bound is
never above that of (9)-(10). (A, C) must be detectable, A need not be stable. A bound lies above
the true norm, `Design.h2`, often by some per cent.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import scipy.optimize

from robins.filters.checks import one_of
from robins.filters.synthesis.design import (
    BOUND,
    GAMMA,
    Design,
    FullOrder,
    NotCertified,
    certify,
    certify_full,
)
from robins.filters.synthesis.inequalities import Aim
from robins.filters.synthesis.least import least_gamma
from robins.filters.synthesis.norms import Number, h2_norm, meets, spectral_radius
from robins.filters.synthesis.plant import Plant, error_system
from robins.filters.synthesis.programs import Form, SolverAnswer, solve
from robins.filters.synthesis.riccati import check_gamma
from robins.filters.synthesis.scaling import Scales, balanced

ObserverForm = Literal["common", "slack"]
Reading = Callable[
    [SolverAnswer, Scales], np.ndarray | FullOrder
]  # a gain or filter, in plant units


def _attempt(
    plant: Plant, form: Form, aim: Aim, gamma: float, method: str, readings: Sequence[Reading]
) -> Design:
    """First certified design: scale, solve, check the true norms, else try other scales.

    The status of the solver is not used. An "inaccurate" answer is good if its true norms are, an
    "optimal" one may be wrong by orders of magnitude if numbers are badly scaled, and infeasible
    problems have half a dozen statuses.

    Raises:
        Unreachable: gamma is below the proved lower bound (`robins.filters.synthesis.least`).
        NotCertified: no answer passed; the message states each status and the failed test.
    """
    began = time.perf_counter()
    failures: list[str] = []
    ones = Scales(np.ones(len(plant.A)), np.ones(len(plant.C)), 1.0, 1.0, 1.0)
    plain = ones if np.isinf(gamma) else ones._replace(n=1.0 / gamma)
    for scales in (balanced(plant, gamma), plain):
        answer = solve(scales.plant(plant), form, aim)
        if not answer.unknowns:
            failures.append(f"the solver said {answer.status!r} and gave no answer")
            continue
        failed: list[str] = []
        for read in readings:
            found = read(answer, scales)
            fields: dict[str, Any] = {"bound": _bound(answer, scales), "status": answer.status}
            fields |= {"gamma": gamma, "seconds": time.perf_counter() - began}
            try:
                if isinstance(found, tuple):
                    return certify_full(plant, found, method=method, **fields)
                return certify(plant, found, method=method, **fields)
            except NotCertified as error:
                failed.append(str(error))
        failures.append("; in the limit of R -> 0: ".join(failed))
    why = f"no design by the {form} form of the LMI; " + "; then ".join(failures)
    if aim == "mixed":
        least = least_gamma(plant)
        least.refuse(gamma)
        why += f". No proof that gamma is out of reach: a gain has {least.reached:.6g}"
    raise NotCertified(why)


def _aim(gamma: Number) -> Aim:
    return "h2" if np.isinf(gamma) else "mixed"


def _bound(answer: SolverAnswer, scales: Scales) -> float:
    """Bound on the H2 norm, in the plant's units."""
    return scales.h2(np.sqrt(max(answer.value, 0.0)))


def observer(plant: Plant, gamma: Number, form: ObserverForm = "common") -> Design:
    """Observer of least bound on the H2 norm among those that meet gamma by the LMI.

    Args:
        plant: plant of the filter; if made by `current_form`, K is the gain of the correction.
        gamma: bound on the H-infinity norm; inf ignores the modelling error.
        form: "common" for one Lyapunov matrix, "slack" for one per channel.

    Raises:
        Unreachable: gamma is below the least feasible one, which the message states.
        NotCertified: no answer of the solver passed the test of its true norms.
        MissingExtra: cvxpy or Clarabel is not installed.
        ValueError: gamma is not positive, or the form is not known.
    """
    check_gamma(gamma)
    one_of("form", form, ObserverForm)
    return _attempt(plant, form, _aim(gamma), float(gamma), f"lmi-{form}", (gain_of,))


def gain_of(answer: SolverAnswer, scales: Scales) -> np.ndarray:
    """K = X^-1 Y or G^-1 Y, in the plant's units."""
    found = answer.unknowns
    return scales.gain(np.linalg.solve(found["X" if "X" in found else "G"], found["Y"]))


_WIDER = 1.5  # factor of gamma' from one trial to the next
_FARTHEST = 1e3  # gamma' over gamma at the end of the search
_RTOL = 1e-6  # relative tolerance of gamma'


def retuned(plant: Plant, gamma: Number, form: ObserverForm = "slack") -> Design:
    """Observer of `lmi.observer` for the gamma' >= gamma at which the true norm is gamma.

    LMIs are conservative: the true norm of the answer lies below its gamma, at the cost of a larger
    H2 norm. A search for gamma' recovers this loss in about ten solves. If the design without bound
    (the Kalman filter) meets gamma, it is the result. Arguments and errors are those of `observer`.

    Returns:
        The best design found that meets gamma. Its `bound` is valid; `status` states gamma'.
    """
    check_gamma(gamma)
    one_of("form", form, ObserverForm)
    began = time.perf_counter()
    gamma = float(gamma)
    tried = [observer(plant, np.inf, form)]
    if tried[0].hinf > gamma:
        _search(plant, gamma, form, tried)
    best = min((d for d in tried if d.hinf <= gamma * (1.0 + GAMMA)), key=lambda d: d.h2)
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
    """Append trials with rising gamma', up to a design with true norm gamma."""

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


class FrozenTimeWarning(UserWarning):
    """A filter redesigned at every sample has no guarantee for the time-varying plant."""


class EveryStep:
    """Design by `observer` at every sample, for the plant at that sample.

    Some published filters whose transition depends on a measured rate do this. It is slow, and it
    guarantees nothing: each inequality certifies the filter for a constant plant, and a product of
    stable error transitions need not decay. Prefer one design for the worst plant, or a Kalman
    filter with the modelling error as noise (`channel_inflation`), which follows a varying plant.
    A full-order design does not exist if A has spectral radius one, as every rotation has.

    The program is built at the first call. Its scales are those of the first plant until an answer
    fails; with `like` they are those of that plant, and a gain depends only on the plant of its
    step, bit for bit.

    Args:
        gamma: bound on the H-infinity norm of the frozen plant.
        form: "common" or "slack".
        like: plant whose scales are used at all steps.

    Raises:
        ValueError: gamma is not positive, or the form is not known.

    Warns:
        FrozenTimeWarning: once, when it is made.
    """

    def __init__(self, gamma: Number, form: ObserverForm = "common", like: Plant | None = None):
        check_gamma(gamma)
        one_of("form", form, ObserverForm)
        self.gamma = float(gamma)
        self.form: ObserverForm = form
        self._kept = like is not None
        self._scales = None if like is None else balanced(like, self.gamma)
        warnings.warn(
            "LMIs for the plant frozen at each sample guarantee nothing for a plant that varies: "
            "neither that errors decay nor gamma",
            FrozenTimeWarning,
            stacklevel=2,
        )

    def __call__(self, plant: Plant) -> np.ndarray:
        """Gain K (n, m), certified for this plant if it were constant; errors of `observer`."""
        sizes = (len(plant.A), len(plant.C))
        if self._scales is None or sizes != (len(self._scales.x), len(self._scales.y)):
            self._scales = balanced(plant, self.gamma)
        answer = solve(self._scales.plant(plant), self.form, _aim(self.gamma))
        if answer.unknowns:
            K = gain_of(answer, self._scales)
            if self._holds(plant, K, _bound(answer, self._scales)):
                return K
        if not self._kept:
            self._scales = None
        return observer(plant, self.gamma, self.form).gain

    def _holds(self, plant: Plant, K: np.ndarray, bound: float) -> bool:
        """True if K passes the tests of `certify`, gamma tested as a level without the norm."""
        e = error_system(plant, K)
        if h2_norm(e.A, e.Bw, e.L) > bound * (1.0 + BOUND):
            return False
        return meets(e.A, e.Bn, e.L, self.gamma * (1.0 + GAMMA))


def full(plant: Plant, gamma: Number) -> Design:
    """Full-order filter of least bound on the H2 norm among those that meet gamma by the LMI.

    The filter x^(k+1) = Ah x^ + Bh y, z^ = Gh x^ contains no model of the plant, so its error
    depends on the state of the plant, which must be stable: R - A'RA > 0 is part of the inequality.
    For every filter found there is an observer with the same bound (docs/filters/mixed.md), so
    `observer`, which needs no stable plant, loses nothing; this form is for checks of published
    designs.

    (6) and (7) are solved for R, P, S, Q and U; then

        Ah = (R - P)^-1 S,   Bh = (R - P)^-1 Q,   Gh = U.                                       (8)

    The optimal R is on the boundary of its cone, R -> 0, where solvers stop with an R of order 1e-9
    of either sign. R - P stays regular, so (8) is well defined, but need not give a stable filter.
    If the true norms refute (8), its limit is used: S = -(P A + Q C), U = L. Arguments and errors
    are those of `observer`; the spectral radius of A must be below one.
    """
    check_gamma(gamma)
    refuse_unstable(plant)
    readings = (_of_variables, partial(_in_the_limit, plant))
    return _attempt(plant, "full", "mixed", float(gamma), "full-order", readings)


def refuse_unstable(plant: Plant) -> None:
    """Raise a ValueError if A is not stable: the full-order inequality then has no solution."""
    if (radius := spectral_radius(plant.A)) >= 1.0:
        raise ValueError(
            f"no filter of full order: A has spectral radius {radius:.9g}, and the LMI asks for "
            "R - A'RA > 0, which no R > 0 meets from 1 on, whatever gamma is. Take the observer "
            "form, robins.filters.synthesis.lmi.observer, which needs detectability only"
        )


def _of_variables(answer: SolverAnswer, scales: Scales) -> FullOrder:
    """Full-order filter by (8)."""
    R, P, S, Q, U = (answer.unknowns[name] for name in "RPSQU")
    return scales.full_order(np.linalg.solve(R - P, S), np.linalg.solve(R - P, Q), U)


def _in_the_limit(plant: Plant, answer: SolverAnswer, scales: Scales) -> FullOrder:
    """Full-order filter by (8) for R = 0, where (7) is the observer's inequality."""
    scaled = scales.plant(plant)
    Bh = -np.linalg.solve(answer.unknowns["P"], answer.unknowns["Q"])
    return scales.full_order(scaled.A - Bh @ scaled.C, Bh, scaled.L)
