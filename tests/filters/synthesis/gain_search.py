"""The best gain of two numbers under a bound on its worst case, by searching all of them."""

import numpy as np
import scipy.linalg
import scipy.optimize

from robins.filters.synthesis import error_system, kalman_gain

CIRCLE = np.exp(1j * np.concatenate([[0.0], np.geomspace(1e-3, np.pi, 200)]))


def white(plant, K):
    """H2 norm by a Lyapunov equation; inf for a gain that lets errors grow."""
    e = error_system(plant, K)
    if np.abs(np.linalg.eigvals(e.A)).max() >= 1.0:
        return np.inf
    return np.sqrt(np.trace(e.L @ scipy.linalg.solve_discrete_lyapunov(e.A, e.Bw @ e.Bw.T) @ e.L.T))


def worst(plant, K):
    """Greatest gain from n on a fixed grid of frequencies; inf likewise."""
    e = error_system(plant, K)
    if np.abs(np.linalg.eigvals(e.A)).max() >= 1.0:
        return np.inf
    inner = np.linalg.solve(CIRCLE[:, None, None] * np.eye(len(e.A)) - e.A, e.Bn.astype(complex))
    return np.linalg.norm(e.L @ inner, ord=2, axis=(1, 2)).max()


def best_by_search(plant, gamma, start):
    """Least H2 norm of two-component gains with a worst gain of gamma: that is, on its contour.

    Rays from `start`, a gain inside the contour, meet it about the way to the Kalman filter, which
    lies outside and is what every gain on the contour wants to be near.
    """
    goal = kalman_gain(plant) - start
    size = np.abs(goal) + 0.05 * np.abs(start)

    def on_contour(angle):
        direction = np.cos(angle) * goal + np.sin(angle) * size * np.array([[-1.0], [1.0]])
        low, high = 0.0, 0.05
        while worst(plant, start + high * direction) <= gamma and high < 4.0:
            low, high = high, 1.5 * high
        for _ in range(30):
            middle = 0.5 * (low + high)
            inside = worst(plant, start + middle * direction) <= gamma
            low, high = (middle, high) if inside else (low, middle)
        return start + low * direction

    coarse = np.linspace(-1.5, 1.5, 25)
    costs = [white(plant, on_contour(a)) for a in coarse]
    middle, step = coarse[int(np.argmin(costs))], coarse[1] - coarse[0]
    fine = scipy.optimize.minimize_scalar(
        lambda a: white(plant, on_contour(a)), bounds=(middle - step, middle + step),
        method="bounded", options={"maxiter": 15},
    )  # fmt: skip
    return min(float(fine.fun), *costs)
