"""Least H-infinity norm from n to the error of any filter, and an observer gain that attains it.

Both come from the Riccati recursion of the game of n against the estimator (Hassibi, Sayed &
Kailath, *Indefinite-Quadratic Estimation and Control*, SIAM 1999, ch. 4), from P = 0:

    P~ = P + P L' (g^2 I - L P L')^-1 L P,
    P <- (A - K C) P~ (A - K C)' + (Bn - K Dn)(Bn - K Dn)',  K = (A P~ C' + Bn Dn') R^-1,
    R = C P~ C' + Dn Dn'.

e' P^-1 e is the least energy of n, net of the past cost of the error, that causes the error e while
y is zero. So if the greatest eigenvalue of L P L' reaches g^2 at some step, no causal filter,
linear or not, has a norm below g: that is the proof. If it never does, the K of some step may have
a norm below g, which is checked by its true norms. Factors of P are propagated, P = S S', and
nothing is subtracted. For a plant with unstable modes that n does not drive the least norm may be
greater than the proved bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.filters.synthesis.design import Design, NotCertified, Unreachable, certify
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.riccati import kalman_design
from robins.filters.synthesis.scaling import balanced

_STEPS = 1000  # greatest number of steps of a proof
_TRIAL = 200  # greatest number of steps of a search for a gain
_SETTLED = 1e-13  # relative growth of P in a step at which the recursion ends
_NOTHING = 1e-6  # norm in units of scaled gamma that counts as zero
_RTOL = 1e-7  # relative tolerance of the refuted gamma
_REACHED = 1e-5  # relative distance to it at which a gain is good enough
_ROUGHLY = 1e-3  # relative tolerance of gamma in a search for a gain
_NOISES = (0.0, *(10.0**k for k in range(-9, 0, 2)))  # share of w added to n for stable gains
_UNSEEN = 1e-14  # relative singular value of y that counts as zero


class LeastGamma(NamedTuple):
    """Bounds of the least gamma, with their proofs."""

    proved: float  # lower bound: no causal filter has a smaller norm
    step: int  # of the recursion that proves it; 0 without a proof
    reached: float  # upper bound: H-infinity norm of `design`; 0 if negligible
    design: Design  # certified

    def refuse(self, gamma: Number) -> None:
        """Raise `Unreachable` for a gamma below the proved bound."""
        if gamma < self.proved:
            raise Unreachable(
                f"gamma {gamma:.6g} is below the least that any gain can have, {self.proved:.6g} "
                f"(below it the Riccati recursion of the game ends at step {self.step}); a gain "
                f"with {self.reached:.6g} was found: ask for more",
                self.reached,
            )

    def improved_by(self, design: Design) -> LeastGamma:
        """Bounds improved by another certified design, if its norm is less."""
        if design.hinf >= self.reached:
            return self
        return self._replace(reached=design.hinf, design=design)

    @property
    def exact(self) -> bool:
        """True if both bounds agree to three digits."""
        return self.reached <= self.proved * (1.0 + 1e-3)


def least_gamma(plant: Plant) -> LeastGamma:
    """Least H-infinity norm of any gain, with a proved lower and an attained upper bound.

    No LMI solver is needed. The proof holds to the rounding of the plant's numbers.

    Raises:
        ValueError: the plant has no steady Kalman filter.
        NotCertified: the norms of the Kalman filter cannot be computed.
    """
    best = kalman_design(plant)
    scales = balanced(plant)
    scaled, unit = scales.plant(plant), scales.hinf(1.0)
    low, above, step = _gamma_bracket(scaled, _NOTHING, best.hinf / unit)
    enough = max(low * (1.0 + _REACHED), _NOTHING) * unit
    for noise in _NOISES:
        if noise:
            _, above, _ = _gamma_bracket(scaled, max(low, _NOTHING), best.hinf / unit, noise)
        for gamma in (above * (1.0 + _RTOL), 1.01 * above, np.inf):
            if best.hinf <= enough:
                break
            K, failed = _last_gain(scaled, gamma, noise)
            if failed:
                continue
            try:
                found = certify(plant, scales.gain(K), method="game")
            except (NotCertified, ValueError, np.linalg.LinAlgError):
                continue
            best = min(best, found, key=lambda design: design.hinf)
    reached = best.hinf if best.hinf > _NOTHING * unit else 0.0
    return LeastGamma(min(low * unit, reached), step, reached, best)


def _gamma_bracket(
    plant: Plant, low: float, high: float, noise: float = 0.0
) -> tuple[float, float, int]:
    """Greatest gamma (or 0) at which the recursion ends, least at which it does not, end step."""
    step = _last_gain(plant, low, noise)[1] if low < high else 0
    if not step:
        return 0.0, low, 0
    rtol = _ROUGHLY if noise else _RTOL
    while high > low * (1.0 + rtol):
        middle = float(np.sqrt(low * high))
        if failed := _last_gain(plant, middle, noise)[1]:
            low, step = middle, failed
        else:
            high = middle
    return low, high, step


def _last_gain(plant: Plant, gamma: float, noise: float = 0.0) -> tuple[np.ndarray, int]:
    """Last gain (n, m) of the recursion, and the step at which L P L' reached gamma^2, or 0."""
    B = np.hstack([plant.Bn, noise * plant.Bw])
    D = np.hstack([plant.Dn, noise * plant.Dw])
    n = len(plant.A)
    S, K = np.zeros((n, n)), np.zeros((n, len(plant.C)))
    for step in range(1, (_TRIAL if noise else _STEPS) + 1):
        _, size, axes = np.linalg.svd(plant.L @ S)
        share = np.zeros(n)
        share[: len(size)] = size / gamma
        if share.max(initial=0.0) >= 1.0:
            return K, step
        played = S @ axes.T / np.sqrt(1.0 - share**2)
        measured, moved = np.hstack([plant.C @ played, D]), np.hstack([plant.A @ played, B])
        left, size, axes = np.linalg.svd(measured)
        rank = int(np.sum(size > _UNSEEN * size.max(initial=0.0)))
        K = moved @ axes[:rank].T / size[:rank] @ left[:, :rank].T
        before, S = S, _square(moved @ axes[rank:].T)
        power = np.sum(S**2, axis=1)
        if np.all(power - np.sum(before**2, axis=1) <= _SETTLED * power):
            break
    return K, 0


def _square(S: np.ndarray) -> np.ndarray:
    """(n, n) factor of S S'."""
    n = len(S)
    square = np.zeros((n, n))
    lower = np.asarray(np.linalg.qr(S.T, mode="r")).T
    square[:, : lower.shape[1]] = lower
    return square
