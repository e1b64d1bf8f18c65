"""H-infinity filters written down plainly in NumPy: covariances, inverses, Krein-space Riccati."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Dense(NamedTuple):
    """A run; every field has a leading axis of T steps."""

    m_pred: np.ndarray
    P_pred: np.ndarray
    m: np.ndarray
    P: np.ndarray  # after the measurement
    P_wide: np.ndarray  # what the next prediction begins with
    bound: np.ndarray  # sqrt(lambda_max(L P L')) of the estimate whose error counts
    gamma: np.ndarray  # in force


def greatest(P):
    return np.sqrt(max(np.linalg.eigvalsh(P)[-1], 0.0))


def compensated(P, L, gamma, share=0.95):
    """P with what is too large for gamma cut from the singular values of L times a factor."""
    W = np.linalg.cholesky(P)
    _, s, Vt = np.linalg.svd(L @ W)
    a = np.zeros(len(P))
    a[: len(s)] = s**2
    kept = np.minimum(1.0, share * gamma**2 / np.maximum(a, 1e-300))
    return W @ Vt.T @ np.diag(kept) @ Vt @ W.T


def h_infinity_filter(
    system,
    y: np.ndarray,
    L: np.ndarray | Callable,
    gamma: float | Callable,
    estimate: str = "a-posteriori",
    count_missing: bool = False,
    mend: Callable | None = None,
) -> Dense:
    """The central filter, F x + G w and H x + W v being those of a `dense_kalman.System`.

    Args:
        system: of constant matrices.
        y: (T, m), NaN where missing.
        L: weight, or a function of the mean.
        gamma: bound, or ``(k, P that counts, L, NIS, dof) -> gamma``.
        estimate: as the rule takes it.
        count_missing: as the rule takes it.
        mend: ``(P, L, gamma) -> P`` before the inflation.
    """
    F, Q, R = system.F, system.Q, system.R
    m, P, d = system.m0, system.P0, np.zeros(len(system.m0))
    rows = []
    for k, z in enumerate(y):
        m_pred = F @ m
        P_pred = F @ P @ F.T + Q
        here = np.isfinite(z)
        H, Rk = system.H[here], R[np.ix_(here, here)]
        S = H @ P_pred @ H.T + Rk
        nu = z[here] - H @ m_pred
        d = P_pred @ H.T @ np.linalg.solve(S, nu)
        m_post = m_pred + d
        Pf = np.linalg.inv(np.linalg.inv(P_pred) + H.T @ np.linalg.inv(Rk) @ H)
        rows_L = L(m_post) if callable(L) else L
        counted = P_pred if estimate == "a-priori" else Pf
        nis = float(nu @ np.linalg.solve(S, nu))
        g = gamma(k, counted, rows_L, nis, len(nu)) if callable(gamma) else gamma
        wide, m_next = Pf, m_post
        if np.any(here) or count_missing:
            base = Pf if mend is None else mend(Pf, rows_L, g)
            wide = np.linalg.inv(np.linalg.inv(base) - rows_L.T @ rows_L / g**2)
            if estimate != "a-posteriori":
                m_next = m_pred + wide @ H.T @ np.linalg.solve(Rk, nu)
        bound = greatest(rows_L @ counted @ rows_L.T)
        rows.append((m_pred, P_pred, m_post, Pf, wide, bound, g))
        m, P = m_next, wide
    return Dense(*(np.array(column) for column in zip(*rows, strict=True)))


def least_gamma(system, y, L, estimate="a-posteriori", count_missing=False) -> float:
    """For which the filter exists at every step that counts, by bisection to 1e-9."""
    here = np.isfinite(y).any(axis=1) | count_missing

    def exists(gamma):
        done = h_infinity_filter(system, y, L, gamma, estimate, count_missing)
        positive = np.linalg.eigvalsh(done.P_wide)[:, 0] > 0.0
        return np.all(done.bound[here] < gamma) and np.all(positive)

    low, high = 1e-3, 1e3
    while high > low * (1.0 + 1e-9):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if exists(middle) else (middle, high)
    return high


def joseph_riccati(F, Q, H, R, P0, L, gamma) -> np.ndarray:
    """(T, n, n) predicted P of a time-varying system: Joseph update, inflation, prediction."""
    P, n, out = P0, len(P0), []
    for Fk, Hk in zip(F, H, strict=True):
        P = Fk @ P @ Fk.T + Q
        out.append(P)
        K = np.linalg.solve(Hk @ P @ Hk.T + R, Hk @ P).T
        A = np.eye(n) - K @ Hk
        Pf = A @ P @ A.T + K @ R @ K.T
        inner = gamma**2 * np.eye(len(L)) - L @ Pf @ L.T
        P = Pf + Pf @ L.T @ np.linalg.solve(inner, L @ Pf)
    return np.array(out)


def krein_riccati(F, Q, H, R, P0, L, gamma) -> np.ndarray:
    """The same from the indefinite innovation covariance of [H; L] (Hassibi et al. 1999)."""
    P, out = P0, []
    q = len(L)
    for Fk, Hk in zip(F, H, strict=True):
        P = Fk @ P @ Fk.T + Q
        out.append(P)
        C = np.concatenate([Hk, L])
        m = len(Hk)
        Re = C @ P @ C.T
        Re[:m, :m] += R
        Re[m:, m:] -= gamma**2 * np.eye(q)
        # the filter exists where this has m positive and q negative eigenvalues
        assert np.sum(np.linalg.eigvalsh(Re) > 0.0) == m
        P = P - P @ C.T @ np.linalg.solve(Re, C @ P)
    return np.array(out)
