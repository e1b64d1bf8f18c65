"""Linear systems: discretisation and the steady state of the Kalman filter."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.scipy.linalg import expm
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401

_DOUBLINGS = 20  # halves of a step tried at most: enough for |A| dt = 1e6


def van_loan(
    A: Float[Array, "n n"], Qc: Float[Array, "n n"], dt: float | Float[Array, ""]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Discretise ``dx = A x dt + dw``, ``E[dw dw'] = Qc dt`` over a step (Van Loan 1978).

    His exponential holds exp(-A dt) too, which drowns the rest where A dt is large (a fast sensor
    over a long step). So it is taken over a step with |A| h of order one, and doubled:
    Q(2h) = Q(h) + Phi(h) Q(h) Phi(h)'.

    Returns:
        Phi = exp(A dt), and Qd, the covariance the noise adds over dt [s].
    """
    n = A.shape[0]
    size = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), axis=0)) * jnp.abs(dt))
    halvings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 1.0))), 0, _DOUBLINGS)
    top = jnp.concatenate([-A, Qc], axis=1)
    bottom = jnp.concatenate([jnp.zeros((n, n)), A.T], axis=1)
    G = expm(jnp.concatenate([top, bottom], axis=0) * (dt * 2.0**-halvings))
    Phi = G[n:, n:].T
    Qd = Phi @ G[:n, n:]

    def double(i, pair):
        Phi, Qd = pair
        wanted = i < halvings
        longer = Qd + Phi @ Qd @ Phi.T
        return jnp.where(wanted, Phi @ Phi, Phi), jnp.where(wanted, longer, Qd)

    Phi, Qd = jax.lax.fori_loop(0, _DOUBLINGS, double, (Phi, Qd))
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
    advice = "some mode of F is not observed through H or not driven by Q"
    try:
        P_s = scipy.linalg.solve_discrete_are(F_s.T, H_s.T, Q_s, R_)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"the Riccati equation has no stabilising solution: {advice} ({error})"
        ) from error
    P_pred = P_s * np.outer(scale, scale)
    S = H_ @ P_pred @ H_.T + R_
    K = scipy.linalg.solve(S, H_ @ P_pred, assume_a="pos").T
    A = np.eye(len(F_)) - K @ H_
    slowest = float(np.max(np.abs(np.linalg.eigvals(F_ @ A))))
    if not slowest < 1.0:
        raise ValueError(
            f"the filter has no steady state, its error decays by {slowest:.9g} a step: {advice}"
        )
    return SteadyState(P_pred, A @ P_pred @ A.T + K @ R_ @ K.T, K)
