"""Robust rules by kinds of faults: the table of docs/filters/gate.md.

python docs/studies/robust_rules.py

A point is tracked in a plane. The error of each filter with each fault is divided by that of the
Kalman filter on clean data.
"""

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor, kalman, run
from robins.filters.rules import correntropy, discriminator, gate, huber, igg3, student_t

SEED, RUNS, STEPS, HALF = 5, 64, 150, 75
SETTLED = 10  # steps that are not counted
F = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2))
G = 0.03 * np.kron([[0.5], [1.0]], np.eye(2))
CHAINS = {
    "KF": [],
    "gate": [gate()],
    "gate, 0.99": [gate(0.99)],
    "gate, `accept`": [gate(recovery="accept")],
    "gate, `reinitialise`": [gate(recovery="reinitialise")],
    "Huber": [huber()],
    "Huber, 0.9": [huber(0.9)],
    "IGG-III": [igg3()],
    "IGG-III, `floor=0`": [igg3(floor=0.0)],
    "Student's t": [student_t()],
    "Student's t, 3": [student_t(3.0)],
    "Student's t, `both`": [student_t(whose="both")],
    "correntropy, 2": [correntropy(2.0, 5)],
    "correntropy": [correntropy()],
    "correntropy, 5": [correntropy(5.0, 5)],
    "discriminator": [discriminator()],
}


def moved(rng: np.random.Generator) -> np.ndarray:
    """(RUNS, STEPS, 2) true positions."""
    x, truth = rng.normal(size=(RUNS, 4)), []
    for _ in range(STEPS):
        x = x @ F.T + rng.normal(size=(RUNS, 2)) @ G.T
        truth.append(x[:, :2])
    return np.stack(truth, axis=1)


def faults(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Faults (RUNS, STEPS, 2) by name, in standard deviations of the noise."""

    def towards(count: int) -> np.ndarray:
        """Directions: one for a run, or one for each measurement."""
        angle = rng.uniform(0.0, 2.0 * np.pi, size=(RUNS, count))
        return np.stack([np.cos(angle), np.sin(angle)], axis=2)

    def of_each(size: float, share: float) -> np.ndarray:
        signs = rng.choice([-1.0, 1.0], size=(RUNS, STEPS, 2))
        return size * signs * (rng.random((RUNS, STEPS, 2)) < share)

    def of_all(size: float, share: float) -> np.ndarray:
        return size * towards(STEPS) * (rng.random((RUNS, STEPS, 1)) < share)

    k = np.arange(STEPS)[:, None]
    for_15, since = (k >= HALF) & (k < HALF + 15), np.maximum(k - HALF, 0)
    return {
        "clean": np.zeros((RUNS, STEPS, 2)),
        "1e9 once": 1e9 * towards(1) * (k == HALF),
        "5 % at 10": of_all(10.0, 0.05),
        "30 % at 5": of_all(5.0, 0.3),
        "5 % of each at 10": of_each(10.0, 0.05),
        "30 % of each at 5": of_each(5.0, 0.3),
        "8 for 15": 8.0 * towards(1) * for_15,
        "ramp, 75": 0.2 * towards(1) * since,
        "ramp, 30": 0.2 * towards(1) * since * (k < HALF + 30),
        "30 for 15": 30.0 * towards(1) * for_15,
        "100 for 15": 100.0 * towards(1) * for_15,
    }


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(SEED)
    truth, wrong = moved(rng), faults(rng)
    y = truth + rng.normal(size=truth.shape) + np.stack(list(wrong.values()))
    model = Model(
        Motion(lambda x, u: jnp.asarray(F) @ x, jnp.asarray(G)),
        (Sensor(lambda x, aux: x[:2], jnp.ones(2), 2),),
    )
    start = Belief.of(jnp.zeros(4), np.eye(4))
    print("| | " + " | ".join(wrong) + " |", "|---" * (1 + len(wrong)) + "|", sep="\n")
    clean = 0.0
    for name, rules in CHAINS.items():
        one = kalman(rules=rules)
        solve = jax.vmap(jax.vmap(lambda y, one=one: run(one, model, start, y).mean))
        error = np.asarray(jax.jit(solve)(y))[:, :, SETTLED:, :2] - truth[:, SETTLED:]
        rms = np.sqrt(np.mean(np.sum(error**2, axis=3), axis=(1, 2)))
        clean = clean or rms[0]
        print(f"| {name} |", " | ".join(f"{ratio:.3g}" for ratio in rms / clean), "|")


if __name__ == "__main__":
    main()
