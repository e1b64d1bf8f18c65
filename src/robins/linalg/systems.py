"""Linear systems: discretisation and the steady state of the Kalman filter."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.scipy.linalg import expm
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401


def van_loan(
    A: Float[Array, "n n"], Qc: Float[Array, "n n"], dt: float | Float[Array, ""]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Discretise ``dx = A x dt + dw``, ``E[dw dw'] = Qc dt`` over a step (Van Loan 1978).

    Returns:
        Phi = exp(A dt), and Qd, the covariance the noise adds over dt [s].
    """
    n = A.shape[0]
    top = jnp.concatenate([-A, Qc], axis=1)
    bottom = jnp.concatenate([jnp.zeros((n, n)), A.T], axis=1)
    G = expm(jnp.concatenate([top, bottom], axis=0) * dt)
    Phi = G[n:, n:].T
    Qd = Phi @ G[:n, n:]
    return Phi, 0.5 * (Qd + Qd.T)


class SteadyState(NamedTuple):
    """The Kalman filter after the transient."""

    P_pred: np.ndarray  # (n, n) covariance before the update
    P: np.ndarray  # (n, n) covariance after the update
    K: np.ndarray  # (n, m) gain


def steady_state(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike) -> SteadyState:
    """Steady-state covariance and gain of ``x' = F x + w``, ``y = H x + v`` (offline, NumPy).

    SciPy's Riccati solver works on the problem scaled to unit noise, so that variances of 1e-15
    beside ones of 1e-8 (a gyro drift beside a star tracker) do not drown.

    Raises:
        ValueError: no stabilising solution exists (an unstable mode is not observed, or one on the
            unit circle is not driven by noise).
    """
    F_, Q_, H_, R_ = (np.asarray(a, dtype=float) for a in (F, Q, H, R))
    # unit of each state: the spread its noise and its coupling give it
    scale = np.sqrt(np.maximum(np.diag(Q_), np.finfo(float).tiny))
    scale = np.where(scale > 1e-150, scale, 1.0)
    F_s, H_s = F_ * scale[None, :] / scale[:, None], H_ * scale[None, :]
    Q_s = Q_ / np.outer(scale, scale)
    try:
        P_s = scipy.linalg.solve_discrete_are(F_s.T, H_s.T, Q_s, R_)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            "the Riccati equation has no stabilising solution: some mode of F is not observed "
            f"through H or not driven by Q ({error})"
        ) from error
    P_pred = P_s * np.outer(scale, scale)
    S = H_ @ P_pred @ H_.T + R_
    K = scipy.linalg.solve(S, H_ @ P_pred, assume_a="pos").T
    A = np.eye(len(F_)) - K @ H_
    return SteadyState(P_pred, A @ P_pred @ A.T + K @ R_ @ K.T, K)
