"""A linear system with two sensors, and what a dense centralised filter makes of it."""

import jax.numpy as jnp
import numpy as np
from dense_kalman import System, times
from interpreted import run
from jax.tree_util import Partial

from robins import linalg
from robins.filters import Belief, Model, Motion, Sensor
from robins.filters.composite.channels import channel

N, SEEDS, STEPS = 4, 5, 200
ROWS = {"a": slice(0, 2), "b": slice(2, 3)}
CHANNELS = [channel("a"), channel("b")]


def two_sensors(seed: int) -> System:
    """A random system; its first two measurements are of one sensor, the third of another."""
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(N, N))
    F *= 0.98 / np.max(np.abs(np.linalg.eigvals(F)))
    A, W = rng.normal(size=(N, N)), np.zeros((3, 3))
    W[:2, :2] = [[0.5, 0.0], [0.3, 0.8]]
    W[2, 2] = 0.4
    return System(F, 0.3 * rng.normal(size=(N, N)), rng.normal(size=(3, N)), W, A[0], A @ A.T)


def measured(s: System, seed: int, steps: int) -> np.ndarray:
    """(steps, 3), with components missing here and there and sensor b silent for 70 steps."""
    rng = np.random.default_rng(seed)
    x, y = s.m0 + np.linalg.cholesky(s.P0) @ rng.normal(size=N), []
    for _ in range(steps):
        x = s.F @ x + s.G @ rng.normal(size=N)
        y.append(s.H @ x + s.W @ rng.normal(size=3))
    y = np.where(rng.random((steps, 3)) < 0.05, np.nan, np.array(y))
    y[60:130, 2] = np.nan
    return y


SYSTEMS = [two_sensors(seed) for seed in range(SEEDS)]
Y = np.array([measured(s, 100 + i, STEPS) for i, s in enumerate(SYSTEMS)])
STACKED = System(*(np.array(part) for part in zip(*SYSTEMS, strict=True)))
START = Belief(jnp.array(STACKED.m0), jnp.array([linalg.factor(s.P0) for s in SYSTEMS]))


def model_of(F, G, H, W) -> Model:
    sensors = (Sensor(Partial(times, H[r]), W[r], r.stop - r.start, k) for k, r in ROWS.items())
    return Model(Motion(Partial(times, F), G), tuple(sensors))


def split(s: System) -> Model:
    """The model of a system whose measurement is of two sensors."""
    return model_of(*(jnp.array(part) for part in s[:4]))


def by_sensor(y):
    return {k: y[..., r] for k, r in ROWS.items()}


def answer(filter_, parts, start, y):
    """Posteriors of a run; the log-likelihoods of a and b are not looked at here."""
    solution = run(filter_, model_of(*parts), start, by_sensor(y), keep=lambda s: s.posterior)
    return solution.steps


def one_run(filter_, steps: int = 40, y=None):
    """Means and covariances of the first system."""
    s = SYSTEMS[0]
    parts = [jnp.array(part) for part in s[:4]]
    got = answer(filter_, parts, s.start(), jnp.array(Y[0, :steps] if y is None else y))
    return got.mean, got.covariance


def centralised(s: System, y) -> tuple:
    """All measurements of a step at once, in Joseph's form: 1e-11 over 200 steps asks for it."""
    m, P, means, covariances = s.m0, s.P0, [], []
    for row in y:
        m, P = s.F @ m, s.F @ P @ s.F.T + s.Q
        here = np.isfinite(row)
        H, R = s.H[here], s.R[np.ix_(here, here)]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        A = np.eye(N) - K @ H
        m, P = m + K @ (row[here] - H @ m), A @ P @ A.T + K @ R @ K.T
        P = (P + P.T) / 2
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances)


def added(members):
    Y = [np.linalg.inv(P) for _, P in members]
    P = np.linalg.inv(sum(Y))
    return P @ sum(y @ x for y, (x, _) in zip(Y, members, strict=True)), P


def corrected(s: System, member, row, rows):
    """A Kalman update by some rows of the system's measurement."""
    x, P = member
    here = np.zeros(3, dtype=bool)
    here[rows] = np.isfinite(row[rows])
    H, R = s.H[here], s.R[np.ix_(here, here)]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ (row[here] - H @ x), P - K @ H @ P
