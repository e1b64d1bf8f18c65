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
import warnings
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
import scipy.optimize

from robins.filters.checks import one_of
from robins.filters.synthesis.design import Design, NotCertified, certify, certify_full
from robins.filters.synthesis.inequalities import Aim
from robins.filters.synthesis.least import least_gamma
from robins.filters.synthesis.norms import Levels, Number, h2_norm, spectral_radius
from robins.filters.synthesis.plant import Plant, error_system
from robins.filters.synthesis.programs import Answer, Form, solve
from robins.filters.synthesis.riccati import check_gamma
from robins.filters.synthesis.scaling import Scales, balanced


def attempt(
    plant: Plant, form: Form, aim: Aim, gamma: Number, certified: Callable[[Answer, Scales], Design]
) -> Design:
    """The first answer whose true norms are what was asked: scale, solve, check, else try again.

    A status of the solver decides nothing. An answer it calls inaccurate is good if its true norms
    are, one that it calls optimal may be wrong by orders of magnitude where numbers are badly
    scaled, and what cannot be met at all it calls by half a dozen names.

    Args:
        plant: in its own units.
        form: of the inequalities.
        aim: "h2" or "mixed".
        gamma: bound on the H-infinity norm; inf with "h2".
        certified: makes the design of an answer in scaled units.

    Raises:
        Unreachable: it is proved that no filter meets gamma (`robins.filters.synthesis.least`).
        NotCertified: no answer passed; the message tells each status and the test it failed.
    """
    failures: list[str] = []
    for scales in _scalings(plant, gamma):
        answer = solve(scales.plant(plant), form, aim)
        if not answer.unknowns:
            failures.append(f"the solver said {answer.status!r} and gave no answer")
            continue
        try:
            return certified(answer, scales)
        except NotCertified as error:
            failures.append(str(error))
    failed = f"no design by the {form} form of the LMI; " + "; then ".join(failures)
    if aim == "mixed":
        least = least_gamma(plant)
        least.refuse(gamma)
        failed += f". No proof that gamma is out of reach: a gain has {least.reached:.6g}"
    raise NotCertified(failed)


def _scalings(plant: Plant, gamma: Number) -> Iterator[Scales]:
    """Units to try in turn."""
    yield balanced(plant, None if np.isinf(gamma) else float(gamma))
    ones = Scales(np.ones(len(plant.A)), np.ones(len(plant.C)), 1.0, 1.0, 1.0)
    yield ones if np.isinf(gamma) else ones._replace(n=1.0 / float(gamma))


ObserverForm = Literal["common", "slack"]


def observer(plant: Plant, gamma: Number, form: ObserverForm = "common") -> Design:
    """The observer whose bound on the H2 norm is least among those the LMI proves to meet gamma.

    Args:
        plant: what is filtered; made by `current_form`, K is the gain of the correction.
        gamma: bound on the H-infinity norm; inf leaves the modelling error out.
        form: "common" for one Lyapunov matrix, "slack" for one a channel.

    Raises:
        Unreachable: gamma is below the least one, which the message names.
        NotCertified: no answer of the solver passed the test of its true norms.
        MissingExtra: cvxpy or Clarabel is not installed.
        ValueError: gamma is not positive, or the form is not known.
    """
    check_gamma(gamma)
    one_of("form", form, ObserverForm)
    began = time.perf_counter()
    aim: Aim = "h2" if np.isinf(gamma) else "mixed"

    def certified(answer: Answer, scales: Scales) -> Design:
        return certify(
            plant,
            gain_of(answer, scales),
            method=f"lmi-{form}",
            gamma=gamma,
            bound=scales.h2(np.sqrt(max(answer.value, 0.0))),
            status=answer.status,
            seconds=time.perf_counter() - began,
        )

    return attempt(plant, form, aim, float(gamma), certified)


def gain_of(answer: Answer, scales: Scales) -> np.ndarray:
    """K = X^-1 Y or G^-1 Y, in the plant's units."""
    found = answer.unknowns
    return scales.gain(np.linalg.solve(found["X" if "X" in found else "G"], found["Y"]))


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
    one_of("form", form, ObserverForm)
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


_BOUND, _GAMMA = 1e-3, 1e-6  # relative tolerances of `certify`


class FrozenTimeWarning(UserWarning):
    """A filter designed anew at every sample carries no guarantee from one sample to the next."""


class EveryStep:
    """A new design by `observer` at every sample, for the plant as it is at that sample.

    Some published filters whose transition depends on a measured rate do this. It is slow, and it
    proves nothing: each inequality certifies the filter for a plant that stays as it is, and a
    product of error transitions each of which decays need not decay. Prefer one design for the
    worst plant, or a Kalman filter told of the modelling error (`channel_inflation`), which follows
    a plant that varies. The design is the observer's: the full-order one does not exist where A has
    spectral radius one, as every rotation has.

    The program is built at the first call and only filled in later; its units are those of the
    first plant, until an answer in them fails. Where they are those of a plant that is named, a
    gain depends on the plant of its step alone, to the last bit.

    Args:
        gamma: bound on the H-infinity norm of the plant frozen.
        form: "common" or "slack".
        like: a plant whose units serve at all steps.

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
        self._scales: Scales | None = None if like is None else self._units(like)
        warnings.warn(
            "LMIs for the plant frozen at each sample guarantee nothing for a plant that varies: "
            "neither that errors decay nor gamma",
            FrozenTimeWarning,
            stacklevel=2,
        )

    def __call__(self, plant: Plant) -> np.ndarray:
        """The gain K (n, m) for this plant, by its true norms good for it if it stayed so.

        Raises:
            Unreachable: gamma is below the least one of this plant.
            NotCertified: no answer of the solver passed the test of its true norms.
            MissingExtra: cvxpy or Clarabel is not installed.
        """
        sizes = (len(plant.A), len(plant.C))
        if self._scales is None or sizes != (len(self._scales.x), len(self._scales.y)):
            self._scales = self._units(plant)
        answer = solve(
            self._scales.plant(plant), self.form, "h2" if np.isinf(self.gamma) else "mixed"
        )
        if answer.unknowns:
            K = gain_of(answer, self._scales)
            if self._holds(plant, K, self._scales.h2(np.sqrt(max(answer.value, 0.0)))):
                return K
        if not self._kept:
            self._scales = None
        return observer(plant, self.gamma, self.form).gain

    def _units(self, plant: Plant) -> Scales:
        return balanced(plant, None if np.isinf(self.gamma) else self.gamma)

    def _holds(self, plant: Plant, K: np.ndarray, bound: float) -> bool:
        """The tests of `certify`, with gamma tested as a level instead of computing the norm."""
        e = error_system(plant, K)
        if spectral_radius(e.A) >= 1.0 or h2_norm(e.A, e.Bw, e.L) > bound * (1.0 + _BOUND):
            return False
        if np.isinf(self.gamma):
            return True
        return not Levels.of(e.A, e.Bn, e.L).reached(self.gamma * (1.0 + _GAMMA))


def full(plant: Plant, gamma: Number) -> Design:
    """The full-order filter of least bound on the H2 norm among those proved to meet gamma.

    Nothing ties x^(k+1) = Ah x^ + Bh y, z^ = Gh x^ to the plant, so its error depends on the state
    of the plant, which must decay by itself: R - A'RA > 0 is part of the inequality. Every filter
    found contains an observer with the same bound (docs/filters/mixed.md), so nothing is lost by
    `observer`, which needs no stable plant; the form is here to judge published designs by.

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
                    method="full-order",
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
