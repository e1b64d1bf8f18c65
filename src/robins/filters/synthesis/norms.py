"""Norms of a discrete-time system x(k+1) = A x + B u, z = C x + D u, and its spectral radius.

The H2 norm is the root mean square of z for white u of unit covariance, the H-infinity norm the
greatest energy gain from u to z. The latter is computed twice, in ways that err differently:
`hinf_norm` asks an eigenvalue problem whether a singular value of the frequency response crosses a
level, `peak_gain` sweeps the frequency. All are inf for a system that is not stable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Number = float | int  # where types are checked an int is no float

_AXIS = 1e-6  # of the size of the Hamiltonian: eigenvalues as near to the axis are looked at
_SQUARINGS = 64  # of A: a radius of 1 - eps needs 58


def spectral_radius(A: np.ndarray) -> float:
    """Greatest modulus of an eigenvalue of A; below one where the system is stable."""
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


def gramian(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Covariance P = A P A' + B B' of the state under unit white noise (A must be stable).

    By doubling (Smith 1968): P(2k) = P(k) + A^k P(k) A^k'. Only what is positive semidefinite is
    added, so that the result is as accurate in a state with small numbers as in one with large.
    """
    power, P = A, B @ B.T
    for squaring in range(_SQUARINGS):
        more = power @ P @ power.T
        P = P + more
        power = power @ power
        grows = np.any(np.diagonal(more) > 1e-17 * np.diagonal(P))
        if not grows and 2**squaring >= len(A):  # what takes n steps to be seen may still come
            break
    return 0.5 * (P + P.T)


def h2_norm(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray | None = None) -> float:
    """sqrt(trace(C P C' + D D')), P the controllability Gramian; inf unless A is stable."""
    if spectral_radius(A) >= 1.0:
        return np.inf
    direct = 0.0 if D is None else float(np.sum(D * D))
    power = np.einsum("ij,jk,ik->", C, gramian(A, B), C)
    return float(np.sqrt(max(float(power), 0.0) + direct))


def hinf_norm(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    D: np.ndarray | None = None,
    rtol: Number = 1e-11,
) -> float:
    """Greatest singular value of C (zI - A)^-1 B + D on the unit circle, by level tests.

    The circle is mapped to the imaginary axis; a level is reached where the Hamiltonian matrix of
    the level has an eigenvalue on that axis (Boyd, Balakrishnan & Kabamba 1989). A level that is
    reached is raised to the highest response between such eigenvalues (Bruinsma & Steinbuch 1990),
    which is a bisection that halves the error quadratically; the one that is not reached is the
    answer. The Hankel singular values s bound the norm, max(s_1, |D|) <= norm <= |D| + 2 sum(s).

    Args:
        A: (n, n).
        B: (n, q).
        C: (r, n).
        D: (r, q), zero by default.
        rtol: relative distance of the level that is not reached from a response that is.

    Returns:
        The norm, from above; inf unless A is stable.
    """
    if spectral_radius(A) >= 1.0:
        return np.inf
    D = np.zeros((len(C), B.shape[1])) if D is None else D
    levels = Levels.of(A, B, C, D)
    lower = levels.lower
    while lower > 0.0 and lower < levels.upper:
        above = lower * (1.0 + rtol)
        if (highest := levels.highest(above)) < above:
            return above
        lower = highest
    return lower


class Levels(NamedTuple):
    """A stable system mapped to continuous time, to be asked which gains it reaches."""

    A: np.ndarray  # (n, n) complex
    B: np.ndarray  # (n, q)
    C: np.ndarray  # (r, n)
    D: np.ndarray  # (r, q) response at the point of the circle that is mapped to infinity
    lower: float  # gain that is reached
    upper: float  # gain that is not exceeded

    @classmethod
    def of(cls, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> Levels:
        """Scale the states so that both Gramians agree on the diagonal, and map.

        z = -t (s + 1) / (s - 1) with t on the circle, far from all eigenvalues, keeps all singular
        values; s = j inf is z = -t.
        """
        n = len(A)
        Wc, Wo = gramian(A, B), gramian(A.T, C.T)
        control, observe = np.diagonal(Wc), np.diagonal(Wo)
        both = (control > 0.0) & (observe > 0.0)
        scale = np.ones(n)
        scale[both] = (control[both] / observe[both]) ** 0.25
        A, B, C = A * scale / scale[:, None], B / scale[:, None], C * scale
        product = (Wc / np.outer(scale, scale)) @ (Wo * np.outer(scale, scale))
        hankel = np.sqrt(np.maximum(np.linalg.eigvals(product).real, 0.0))
        direct = _largest(D)

        turns = np.exp(1j * np.pi * np.arange(8) / 4.0)
        distance = np.linalg.svd(A + turns[:, None, None] * np.eye(n), compute_uv=False)[:, -1]
        turn = turns[np.argmax(distance)]
        inverse = np.linalg.inv(A / turn + np.eye(n))
        B = B / turn
        return cls(
            inverse @ (A / turn - np.eye(n)),
            np.sqrt(2.0) * inverse @ B,
            np.sqrt(2.0) * C @ inverse,
            D - C @ inverse @ B,
            max(direct, float(np.max(hankel, initial=0.0))) * (1.0 - 1e-9),
            (direct + 2.0 * float(np.sum(hankel))) * (1.0 + 1e-9),
        )

    def reached(self, gain: Number) -> bool:
        """Whether some singular value of the frequency response is as large as this."""
        return self.highest(gain) >= gain

    def highest(self, gain: Number) -> float:
        """Highest response found where a singular value crosses this level and between; else 0.

        Below the level if it is not reached anywhere: eigenvalues near the axis are only believed
        for what the response is there.
        """
        A, B, C, D = self.A, self.B, self.C, self.D
        if gain <= (far := _largest(D)):
            return far
        R = gain**2 * np.eye(B.shape[1]) - D.conj().T @ D
        shift = np.linalg.solve(R, D.conj().T @ C)
        corner = A + B @ shift
        top = np.hstack([corner, gain * B @ np.linalg.solve(R, B.conj().T)])
        below = -(C.conj().T @ C + C.conj().T @ D @ shift) / gain
        found = np.linalg.eigvals(np.vstack([top, np.hstack([below, -corner.conj().T])]))
        near = found[np.abs(found.real) <= _AXIS * max(1.0, np.max(np.abs(found)))]
        if near.size == 0:
            return 0.0
        w = np.sort(near.imag)
        w = np.concatenate([w, 0.5 * (w[1:] + w[:-1])])
        return float(np.max(_gains(A, B, C, D, 1j * w)))


def peak_gain(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    D: np.ndarray | None = None,
    points: int = 200,
) -> float:
    """Greatest gain found by a sweep of the frequency: never more than the H-infinity norm.

    The circle is sampled evenly and, ever more densely, about the angle of each eigenvalue; then
    closer and closer about the highest peaks.

    Args:
        A: (n, n).
        B: (n, q).
        C: (r, n).
        D: (r, q), zero by default.
        points: even samples of the half circle.

    Returns:
        The gain; inf unless A is stable.
    """
    values = np.linalg.eigvals(A)
    if np.max(np.abs(values), initial=0.0) >= 1.0:
        return np.inf
    D = np.zeros((len(C), B.shape[1])) if D is None else D
    widths = np.maximum(1.0 - np.abs(values), 1e-15)[:, None] * np.logspace(-1.5, 2.0, 15)
    angles = np.angle(values)[:, None]
    about = np.concatenate([angles, angles - widths, angles + widths], axis=1).ravel()
    angle = np.concatenate([np.linspace(0.0, np.pi, points), np.abs(about)])
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


def _largest(D: np.ndarray) -> float:
    return float(np.linalg.norm(D, ord=2)) if D.size else 0.0
