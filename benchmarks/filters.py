"""One step of the filters on a 9-state nonlinear model, against filterpy in the same process."""

import warnings

import filterpy.kalman
import jax
import jax.numpy as jnp
import numpy as np
from timing import best_of, show

from robins.filters import (
    Belief,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    cubature,
    kalman,
    run,
    taylor,
    unscented,
)
from robins.filters.rules import gate

N, M, STEPS, PEER_STEPS, BATCH = 9, 3, 4000, 300, 64


def problem():
    rng = np.random.default_rng(0)
    A = np.eye(N) + 0.01 * rng.normal(size=(N, N))
    A /= max(1.0, np.abs(np.linalg.eigvals(A)).max())
    H = rng.normal(size=(M, N))
    return A, H, rng.normal(size=(STEPS, M))


def peer_ukf(A, H, y):
    points = filterpy.kalman.MerweScaledSigmaPoints(N, 1.0, 2.0, 0.0)
    f = filterpy.kalman.UnscentedKalmanFilter(
        N, M, 1.0, hx=lambda x: H @ x, fx=lambda x, dt: A @ x + 0.01 * np.sin(x), points=points
    )
    f.Q, f.R, f.P = 0.01 * np.eye(N), np.eye(M), np.eye(N)

    def go():
        for row in y[:PEER_STEPS]:
            f.predict()
            f.update(row)

    return go


def textbook_ukf(A, H, y):
    """The UKF of the textbook in JAX: covariances, one subtraction, nothing checked or missing."""
    Q, R = 0.01 * jnp.eye(N), jnp.eye(M)

    def points(m, P):
        L = np.sqrt(N) * jnp.linalg.cholesky(P)
        return jnp.concatenate([m[None], m + L.T, m - L.T])

    def moments(values, noise):
        mean = jnp.sum(values[1:], axis=0) / (2 * N)
        d = values - mean
        return mean, d, d[1:].T @ d[1:] / (2 * N) + 2.0 * d[:1].T @ d[:1] + noise

    def body(state, row):
        x = points(*state)
        m, _, P = moments(x @ A.T + 0.01 * jnp.sin(x), Q)
        x = points(m, P)
        z, e, S = moments(x @ H.T, R)
        cross = (x - m)[1:].T @ e[1:] / (2 * N)
        K = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(S), True), cross.T).T
        m = m + K @ (row - z)
        return (m, P - K @ S @ K.T), m

    start = jnp.zeros(N), jnp.eye(N)
    go = jax.jit(lambda rows: jax.lax.scan(body, start, rows)[1])
    return lambda: go(y)


def main():
    A, H, y = problem()
    A_, H_ = jnp.asarray(A), jnp.asarray(H)
    model = Model(
        Motion(lambda x, u: A_ @ x + 0.01 * jnp.sin(x), jnp.full(N, 0.1)),
        (Sensor(lambda x, a: H_ @ x, jnp.ones(M), M),),
    )
    start = Belief.of(jnp.zeros(N), np.eye(N))
    starts = Belief(
        jnp.zeros((BATCH, N)), jnp.eye(N) * jnp.linspace(0.9, 1.1, BATCH)[:, None, None]
    )
    mean = lambda step: step.posterior.mean  # noqa: E731
    kinds = {
        "ekf, square root": kalman(taylor()),
        "ekf, Joseph": kalman(taylor(), form="joseph"),
        "ukf, square root": kalman(unscented()),
        "ukf, Joseph": kalman(unscented(), form="joseph"),
        "ckf, square root": kalman(cubature()),
        "ukf, square root, gate": kalman(unscented(), (gate(),)),
    }
    contenders = {"filterpy ukf": peer_ukf(A, H, y)}
    contenders["textbook ukf in JAX"] = textbook_ukf(A_, H_, jnp.asarray(y))
    for name, f in kinds.items():
        contenders[name] = lambda f=f: run(f, model, start, y, keep=mean)
        batch = jax.jit(jax.vmap(lambda b, f=f: run(f, model, b, y, keep=mean).steps))
        contenders[f"{name}, batch of {BATCH}"] = lambda g=batch: g(starts)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        seconds = best_of(contenders, rounds=3)
    peer = seconds["filterpy ukf"] / PEER_STEPS
    show("filterpy ukf", peer, 1.0, "step")
    for name in contenders:
        if name == "filterpy ukf":
            continue
        runs = BATCH if "batch" in name else 1
        show(name, seconds[name] / runs / STEPS, 1.0, "step and run", peer)

    online = OnlineFilter(kinds["ukf, square root"], model, start)

    def streaming():
        for row in y[:PEER_STEPS]:
            online.predict()
            online.update(row)
        return online.belief

    show(
        "ukf streaming, predict and update",
        best_of({"s": streaming})["s"] / PEER_STEPS,
        1.0,
        "step",
    )


if __name__ == "__main__":
    main()
