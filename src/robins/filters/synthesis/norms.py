"""Norms of a discrete-time system x(k+1) = A x + B u, z = C x + D u, and its spectral radius.

The H2 norm is the root mean square of z for white u of unit covariance, the H-infinity norm the
root of the greatest energy gain from u to z. The latter is computed in two independent ways:
`hinf_norm` finds the frequencies at which singular values of the frequency response cross a level
from an eigenvalue problem, `peak_gain` sweeps the frequency. All are inf for an unstable system.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from robins.errors import require
from robins.filters.checks import matrix, square

Number = float | int  # an int is no float at run time
System = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # A, B, C, D

_CIRCLE = 1e-6  # largest distance of an eigenvalue from the unit circle that may be a crossing
_RTOL = 1e-11  # relative tolerance of the H-infinity norm by levels
_STARTS = 65  # uniform samples of the half circle from which a search starts
_POINTS = 200  # uniform samples of the half circle in a sweep
_LARGEST = 1e70  # largest entry of a matrix: its fourth power is finite
_SQUARINGS = 64  # limit of the squarings of A: a spectral radius of 1 - eps needs 58


def _system(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray | None) -> System:
    """Matrices (n, n), (n, q), (r, n), (r, q) of a system, D zero by default.

    Raises:
        TypeError: one is not of real numbers.
        ValueError: one does not fit the shapes of the others, is not finite or exceeds 1e70.
    """
    A = square("A", A)
    B, C = matrix("B", B, len(A)), matrix("C", C, None, len(A))
    shape = len(C), B.shape[1]
    D = np.zeros(shape) if D is None else matrix("D", D, *shape)
    for name, block in (("A", A), ("B", B), ("C", C), ("D", D)):
        most = np.max(np.abs(block), initial=0.0)
        require(most <= _LARGEST, f"{name} holds {most:.3g}: give units of at most {_LARGEST:g}")
    return A, B, C, D


def spectral_radius(A: np.ndarray) -> float:
    """Greatest modulus of an eigenvalue of A; below one where the system is stable."""
    return float(np.max(np.abs(np.linalg.eigvals(square("A", A))), initial=0.0))


def gramian(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Covariance P = A P A' + B B' of the state under unit white noise (A must be stable).

    Computed by doubling (Smith 1968): P(2k) = P(k) + A^k P(k) A^k'. Only positive semidefinite
    terms are added, so that small and large states are equally accurate.
    """
    power, P = A, B @ B.T
    for squaring in range(_SQUARINGS):
        more = power @ P @ power.T
        P = P + more
        power = power @ power
        grows = np.any(np.diagonal(more) > 1e-17 * np.diagonal(P))
        if not grows and 2**squaring >= len(A):  # noise may take n steps to reach a state
            break
    return 0.5 * (P + P.T)


def h2_norm(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray | None = None) -> float:
    """sqrt(trace(C P C' + D D')), P the controllability Gramian; inf unless A is stable."""
    A, B, C, D = _system(A, B, C, D)
    if spectral_radius(A) >= 1.0:
        return np.inf
    direct = float(np.sum(D * D))
    power = np.einsum("ij,jk,ik->", C, gramian(A, B), C)
    return float(np.sqrt(max(float(power), 0.0) + direct))


def hinf_norm(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray | None = None) -> float:
    """Greatest singular value of C (zI - A)^-1 B + D on the unit circle, by level tests.

    A level is reached if its symplectic pencil has an eigenvalue on the unit circle (Boyd,
    Balakrishnan & Kabamba 1989, in discrete time). It is then raised to the highest response
    between such eigenvalues (Bruinsma & Steinbuch 1990), which converges quadratically; the first
    level that is not reached is the result. The search starts from the highest response at some
    frequencies, and is bounded by |D| + 2 sum(s) with the Hankel singular values s.

    Returns:
        The norm from above, within 1e-11 of the highest response; inf unless A is stable.
    """
    A, B, C, D = _system(A, B, C, D)
    if spectral_radius(A) >= 1.0:
        return np.inf
    levels = Levels.of(A, B, C, D)
    lower = levels.lower
    while lower > 0.0 and lower < levels.upper:
        above = lower * (1.0 + _RTOL)
        if (highest := levels.highest(above)) < above:
            return above
        lower = highest
    return lower


class Levels(NamedTuple):
    """Stable system, scaled, with bounds of the peak of its frequency response."""

    A: np.ndarray  # (n, n)
    B: np.ndarray  # (n, q)
    C: np.ndarray  # (r, n)
    D: np.ndarray  # (r, q)
    lower: float  # gain that is reached
    upper: float  # gain that is not exceeded

    @classmethod
    def of(cls, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray | None = None) -> Levels:
        """Scale the states so that both Gramians agree on the diagonal, and bound the norm."""
        D = np.zeros((len(C), B.shape[1])) if D is None else D
        Wc, Wo = gramian(A, B), gramian(A.T, C.T)
        control, observe = np.diagonal(Wc), np.diagonal(Wo)
        both = (control > 0.0) & (observe > 0.0)
        scale = np.ones(len(A))
        scale[both] = (control[both] / observe[both]) ** 0.25
        product = (Wc / np.outer(scale, scale)) @ (Wo * np.outer(scale, scale))
        hankel = np.sqrt(np.maximum(np.linalg.eigvals(product).real, 0.0))
        direct = float(np.linalg.norm(D, ord=2)) if D.size else 0.0
        blocks = A * scale / scale[:, None], B / scale[:, None], C * scale, D
        # The lower bound is not the greatest Hankel singular value, which is inaccurate if large
        # numbers cancel. Many frequencies, since rounding hides the crossings of a flat response.
        angle = np.append(np.angle(np.linalg.eigvals(A)), np.linspace(0.0, np.pi, _STARTS))
        lower = max(direct, float(np.max(_gains(*blocks, np.exp(1j * angle))))) * (1.0 - 1e-9)
        return cls(*blocks, lower, (direct + 2.0 * float(np.sum(hankel))) * (1.0 + 1e-9))

    def highest(self, gain: Number) -> float:
        """Highest response at z = 1, -1, where singular values cross this level, and between.

        It is below the level if and only if the level is reached nowhere: eigenvalues near the
        circle are checked by the response, and a response above the level everywhere is so at 1.
        The eigenvalue problem is z x = A x + B u, g v = C x + D u, with the adjoint equations
        l = z (A' l + C' v), g u = B' l + D' v, so nothing is inverted.
        """
        n, (r, q) = len(self.A), self.D.shape
        root = np.sqrt(gain)  # scales input and output so that the level is one
        B, C, D = self.B / root, self.C / root, self.D / gain
        M = np.block(
            [
                [self.A, np.zeros((n, n)), B, np.zeros((n, r))],
                [np.zeros((n, n)), np.eye(n), np.zeros((n, q)), np.zeros((n, r))],
                [C, np.zeros((r, n)), D, -np.eye(r)],
                [np.zeros((q, n)), B.T, -np.eye(q), D.T],
            ]
        )
        N = np.zeros_like(M)
        N[:n, :n] = np.eye(n)
        N[n : 2 * n, n : 2 * n] = self.A.T
        N[n : 2 * n, 2 * n + q :] = C.T
        above, below = np.asarray(scipy.linalg.eigvals(M, N, homogeneous_eigvals=True))
        size = np.maximum(np.abs(above), np.abs(below))
        near = (np.abs(np.abs(above) - np.abs(below)) <= _CIRCLE * size) & (size > 0.0)
        crossings = np.sort(np.abs(np.angle(above[near] * below[near].conj())))
        angle = np.concatenate([[0.0], crossings, [np.pi]])
        angle = np.concatenate([angle, 0.5 * (angle[1:] + angle[:-1])])
        return float(np.max(_gains(self.A, self.B, self.C, self.D, np.exp(1j * angle))))


def meets(A: np.ndarray, B: np.ndarray, C: np.ndarray, gamma: Number) -> bool:
    """True if a system is stable and its H-infinity norm is below gamma."""
    if spectral_radius(A) >= 1.0:
        return False
    if np.isinf(gamma):
        return True
    levels = Levels.of(A, B, C)
    return gamma > levels.lower and (gamma > levels.upper or levels.highest(gamma) < gamma)


def peak_gain(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray | None = None) -> float:
    """Greatest gain found by a frequency sweep, which never exceeds the H-infinity norm.

    The circle is sampled uniformly, more densely about the angle of each eigenvalue, and then
    repeatedly about the highest peaks.
    """
    A, B, C, D = _system(A, B, C, D)
    values = np.linalg.eigvals(A)
    if np.max(np.abs(values), initial=0.0) >= 1.0:
        return np.inf
    widths = np.maximum(1.0 - np.abs(values), 1e-15)[:, None] * np.logspace(-1.5, 2.0, 15)
    angles = np.angle(values)[:, None]
    about = np.concatenate([angles, angles - widths, angles + widths], axis=1).ravel()
    angle = np.concatenate([np.linspace(0.0, np.pi, _POINTS), np.abs(about)])
    angle = np.unique(angle[angle <= np.pi])

    def gains(angle: np.ndarray) -> np.ndarray:
        return _gains(A, B, C, D, np.exp(1j * angle))

    height = gains(angle)
    best = float(np.max(height))
    padded = np.concatenate([[-np.inf], height, [-np.inf]])
    peaks = np.flatnonzero((height >= padded[:-2]) & (height >= padded[2:]))
    peaks = peaks[np.argsort(height[peaks])[-4:]]
    left, right = angle[np.maximum(peaks - 1, 0)], angle[np.minimum(peaks + 1, len(angle) - 1)]
    for _ in range(20):
        fine = np.linspace(left, right, 9, axis=1)
        height = gains(fine.ravel()).reshape(fine.shape)
        top = np.argmax(height, axis=1)
        rows = np.arange(len(fine))
        best = max(best, float(np.max(height)))
        left, right = fine[rows, np.maximum(top - 1, 0)], fine[rows, np.minimum(top + 1, 8)]
    return best


def _gains(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Greatest singular value of C (zI - A)^-1 B + D for each z."""
    if B.shape[1] == 0 or len(C) == 0:
        return np.zeros(len(z))
    inner = np.linalg.solve(
        z[:, None, None] * np.eye(len(A)) - A, np.broadcast_to(B, (len(z), *B.shape))
    )
    return np.linalg.norm(C @ inner + D, ord=2, axis=(1, 2))
