"""Filters and posteriors written down plainly in NumPy, to check the package against.

No function here shares a formula with the package: covariances are formed and inverted, missing
rows are dropped, and a run's posterior comes from one Gaussian over all states at once.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.filters import Belief, Model, Motion, Sensor


class System(NamedTuple):
    """A linear system, with factors of its noise: x' = F x + G w, y = H x + W v."""

    F: np.ndarray
    G: np.ndarray
    H: np.ndarray
    W: np.ndarray
    m0: np.ndarray
    P0: np.ndarray

    @property
    def Q(self):
        return self.G @ self.G.T

    @property
    def R(self):
        return self.W @ self.W.T

    def model(self) -> Model:
        # Matrices are data, so that systems of one size share one compilation.
        F, G, H, W = (jnp.array(a) for a in self[:4])
        sensor = Sensor(Partial(times, H), W, len(self.H))
        return Model(Motion(Partial(times, F), G), (sensor,))

    def start(self) -> Belief:
        return Belief.of(jnp.array(self.m0), self.P0)


def times(A, x, unused):
    """A linear motion or reading."""
    return A @ x


def random_system(seed: int, n: int = 4, m: int = 3, q: int | None = None) -> System:
    """A random, nearly stable system with correlated measurement noise."""
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(n, n))
    F *= 0.98 / np.max(np.abs(np.linalg.eigvals(F)))
    A = rng.normal(size=(n, n))
    W = np.tril(rng.normal(size=(m, m))) + np.eye(m)
    G = 0.3 * rng.normal(size=(n, n if q is None else q))
    return System(F, G, rng.normal(size=(m, n)), W, rng.normal(size=n), A @ A.T)


def simulate(system: System, seed: int, steps: int, missing: float = 0.0) -> tuple:
    """States (T, n) and measurements (T, m), NaN where missing."""
    rng = np.random.default_rng(seed)
    x = system.m0 + np.linalg.cholesky(system.P0 + 1e-300 * np.eye(len(system.m0))) @ (
        rng.normal(size=len(system.m0))
    )
    states, y = [], []
    for _ in range(steps):
        x = system.F @ x + system.G @ rng.normal(size=system.G.shape[1])
        states.append(x)
        y.append(system.H @ x + system.W @ rng.normal(size=len(system.H)))
    y = np.array(y)
    return np.array(states), np.where(rng.random(y.shape) < missing, np.nan, y)


def kalman_filter(s: System, y: np.ndarray) -> tuple:
    """Means (T, n), covariances (T, n, n), log-likelihood (T,), NIS (T,) by the book."""
    m, P = s.m0, s.P0
    means, covariances, log_likelihood, nis = [], [], [], []
    for row in y:
        m, P = s.F @ m, s.F @ P @ s.F.T + s.Q
        here = np.isfinite(row)
        H, R, z = s.H[here], s.R[np.ix_(here, here)], row[here]
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        r = z - H @ m
        m, P = m + K @ r, P - K @ S @ K.T
        nis.append(r @ np.linalg.solve(S, r))
        log_likelihood.append(-0.5 * (nis[-1] + np.linalg.slogdet(2 * np.pi * S)[1]))
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances), np.array(log_likelihood), np.array(nis)


def stacked(F, Q, H, R, m0, P0) -> tuple:
    """Mean and covariance of all states x_1..x_T and all measurements y_1..y_T of an LTV system."""
    T, n = len(F), len(m0)
    start = np.zeros((T * n, (T + 1) * n))  # x = start @ (x_0, w_1, ..., w_T)
    row = np.concatenate([np.eye(n), np.zeros((n, T * n))], axis=1)
    for k in range(T):
        row = F[k] @ row
        row[:, (k + 1) * n : (k + 2) * n] = np.eye(n)
        start[k * n : (k + 1) * n] = row
    noise = np.zeros(((T + 1) * n, (T + 1) * n))
    for k, block in enumerate([P0, *Q]):
        noise[k * n : (k + 1) * n, k * n : (k + 1) * n] = block
    mean_x, P_x = start[:, :n] @ m0, start @ noise @ start.T
    m = len(H[0])
    big_H, big_R = np.zeros((T * m, T * n)), np.zeros((T * m, T * m))
    for k in range(T):
        big_H[k * m : (k + 1) * m, k * n : (k + 1) * n] = H[k]
        big_R[k * m : (k + 1) * m, k * m : (k + 1) * m] = R[k]
    return mean_x, P_x, big_H, big_R


def posterior(F, Q, H, R, m0, P0, y) -> tuple:
    """Means (T, n) and covariances (T, n, n) of all states given all that was measured."""
    mean, P, big_H, big_R = stacked(F, Q, H, R, m0, P0)
    T, n = len(F), len(m0)
    here = np.isfinite(y.ravel())
    big_H, big_R = big_H[here], big_R[np.ix_(here, here)]
    S = big_H @ P @ big_H.T + big_R
    K = np.linalg.solve(S, big_H @ P).T
    mean = mean + K @ (y.ravel()[here] - big_H @ mean)
    P = P - K @ S @ K.T
    blocks = np.stack([P[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(T)])
    return mean.reshape(T, n), blocks


SPLIT_W = np.diag([0.5, 0.7, 2.0])


def split(system: System) -> Model:
    """A system of three measurements as two sensors, near and far, of the noise `SPLIT_W`."""
    F, G, H = (jnp.array(a) for a in system[:3])
    near = Sensor(Partial(times, H[:2]), jnp.array([0.5, 0.7]), 2, "near")
    far = Sensor(Partial(times, H[2:]), jnp.array([2.0]), 1, "far")
    return Model(Motion(Partial(times, F), G), (near, far))
