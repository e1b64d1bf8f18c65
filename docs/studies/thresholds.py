"""Error and NEES of every rule over its threshold: the figure of docs/filters/thresholds.md.

python docs/studies/thresholds.py [picture]

A point is tracked in a plane, once with clean measurements and once with 5 % of them off by ten
standard deviations. Each rule runs with a thousand values of its number as one batch.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from robins.filters import Belief, Model, Motion, Rule, Sensor, kalman, run
from robins.filters.analysis.consistency import normalised_sq
from robins.filters.rules import (
    adaptive_h_infinity,
    correntropy,
    discriminator,
    fading_memory,
    gate,
    h_infinity,
    huber,
    igg3,
    innovation_fading,
    sage_husa,
    strong_tracking,
    student_t,
    variational_bayes,
)

PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "thresholds.png"
SEED, RUNS, STEPS, COUNT = 11, 12, 120, 1000
SETTLED = 10  # steps that are not counted
OFF, SHARE = 10.0, 0.05  # size and share of what is wrong
F = jnp.kron(jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.eye(2))
G = 0.03 * jnp.kron(jnp.array([[0.5], [1.0]]), jnp.eye(2))


def probability(k: float) -> float:
    """Probability that both components of a measurement are within k standard deviations."""
    return -math.expm1(-0.5 * k**2)


class Swept(NamedTuple):
    """A rule of a number, and from where to where that goes."""

    make: Callable[[float], Rule]
    what: str
    low: float
    high: float


RULES = {
    "gate": Swept(lambda k: gate(probability(k)), "k, q = k²", 1.0, 8.0),
    "huber": Swept(lambda k: huber(threshold=k), "k", 0.3, 30.0),
    "igg3": Swept(lambda k: igg3(k, 2.67 * k), "k0, k1 = 2.67 k0", 0.3, 30.0),
    "student_t": Swept(student_t, "degrees of freedom", 0.5, 100.0),
    "correntropy": Swept(correntropy, "width of the kernel", 0.7, 30.0),
    "discriminator": Swept(
        lambda k: discriminator(probability=probability(k)), "k, q = k²", 1.0, 8.0
    ),
    "strong_tracking": Swept(
        lambda x: strong_tracking(threshold=x), "threshold, deviations", 0.1, 30.0
    ),
    "innovation_fading": Swept(lambda x: innovation_fading(limit=x), "limit of λ", 1.0, 100.0),
    "fading_memory": Swept(lambda x: fading_memory(1.0 + x), "factor - 1", 1e-3, 1.0),
    "sage_husa": Swept(lambda x: sage_husa(1.0 - x), "1 - forgetting", 1e-3, 0.5),
    "variational_bayes": Swept(lambda x: variational_bayes(1.0 - x), "1 - forgetting", 1e-3, 0.5),
    "h_infinity": Swept(
        lambda x: h_infinity(x, jnp.eye(4), policy="raise_gamma"), "gamma", 0.3, 30.0
    ),
    "adaptive_h_infinity": Swept(
        lambda x: adaptive_h_infinity(jnp.eye(4), zeta=x), "zeta", 0.1, 10.0
    ),
}
MODEL = Model(
    Motion(lambda x, u: F @ x, G),
    (Sensor(lambda x, aux: x[:2], jnp.ones(2), 2),),
)
START = Belief.of(jnp.zeros(4), jnp.eye(4))


def worlds() -> tuple[np.ndarray, np.ndarray]:
    """(RUNS, STEPS, 4) true states, and (2, RUNS, STEPS, 2) measurements, clean and faulty."""
    rng = np.random.default_rng(SEED)
    x, states = rng.normal(size=(RUNS, 4)), []
    for _ in range(STEPS):
        x = x @ np.asarray(F).T + rng.normal(size=(RUNS, 2)) @ np.asarray(G).T
        states.append(x)
    truth = np.stack(states, axis=1)
    angle = rng.uniform(0.0, 2.0 * np.pi, size=(RUNS, STEPS))
    wrong = OFF * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    clean = truth[..., :2] + rng.normal(size=(RUNS, STEPS, 2))
    return truth, np.stack([clean, clean + wrong * (rng.random((RUNS, STEPS, 1)) < SHARE)])


@jax.jit
def judged(rules: Rule, truth: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean square error of the position and mean NEES over 4, one for each of a stack of rules."""

    def one(rule: Rule, truth: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = run(kalman(rules=[rule]), MODEL, START, y, keep=lambda step: step.posterior).steps
        error = truth - found.mean
        square = jnp.sum(error[SETTLED:, :2] ** 2, axis=1)
        nees = jax.vmap(normalised_sq)(error, found.factor)[SETTLED:]
        return jnp.mean(square), jnp.mean(nees) / 4.0

    of_runs = jax.vmap(one, in_axes=(None, 0, 0))
    square, nees = jax.lax.map(lambda rule: of_runs(rule, truth, y), rules, batch_size=100)
    return jnp.mean(square, axis=1), jnp.mean(nees, axis=1)


def stacked(swept: Swept, values: np.ndarray) -> Rule:
    """Rules of many numbers as one, with a leading axis."""
    return jax.tree_util.tree_map(lambda *x: np.stack(x), *(swept.make(v) for v in values))


def draw(found: dict, least: np.ndarray, target: Path) -> None:
    """A row of two panels for each rule: error and NEES, clean and faulty."""
    size = 6.5, 1.75 * len(found)
    figure, axes = plt.subplots(len(found), 2, figsize=size, layout="constrained")
    colours, kinds = ("C0", "C3"), ("clean", f"{100 * SHARE:.0f} % at {OFF:.0f} σ")
    for row, (name, (values, each)) in zip(axes, found.items(), strict=True):
        for (square, nees), colour, label in zip(each, colours, kinds, strict=True):
            row[0].loglog(values, np.sqrt(square / least[0]), color=colour, label=label)
            row[1].loglog(values, nees, color=colour)
        row[0].axhline(np.sqrt(least[1] / least[0]), color="C3", ls=":", lw=1.0)
        row[0].set(ylim=(0.8, 6.0), ylabel="error / KF, clean")
        row[1].set(ylim=(0.05, 100.0), ylabel="NEES / 4")
        for one, what in zip(row, ("error", "NEES"), strict=True):
            one.axhline(1.0, color="0.5", lw=0.8)
            one.set_title(f"{name}: {what}", fontsize=10)
            one.set_xlabel(RULES[name].what)
            ticks = LogLocator(subs=(1.0, 2.0, 5.0) if values[-1] < 100.0 * values[0] else (1.0,))
            one.xaxis.set_major_locator(ticks)
            one.xaxis.set_major_formatter("{x:g}")
            one.xaxis.set_minor_formatter(NullFormatter())
        row[0].set_yticks([1, 2, 5], ["1", "2", "5"])
        row[0].yaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].legend(fontsize=8)
    figure.savefig(target, dpi=100)


def main(picture: Path) -> None:
    """Print the best number of each rule and the counts of programs, save the picture."""
    truth, y = worlds()
    plain = stacked(Swept(lambda k: huber(threshold=k), "", 1.0, 1.0), np.array([math.inf]))
    least = np.array([float(judged(plain, truth, one)[0][0]) for one in y])
    print("| rule | its number | best on faulty data | error there | on clean data | NEES there |")
    print("|---" * 6 + "|")
    found = {}
    for name, swept in RULES.items():
        values = np.geomspace(swept.low, swept.high, COUNT)
        rules = stacked(swept, values)
        each = [tuple(map(np.asarray, judged(rules, truth, one))) for one in y]
        found[name] = values, each
        best = int(np.nanargmin(each[1][0]))
        errors = [math.sqrt(square[best] / least[0]) for square, _ in each]
        print(
            f"| `{name}` | {swept.what} | {values[best]:.3g} | {errors[1]:.3g} | {errors[0]:.3g} "
            f"| {each[1][1][best]:.3g} |",
            flush=True,
        )
    print(f"Kalman filter on faulty data: {math.sqrt(least[1] / least[0]):.3g}")
    print(f"{judged._cache_size()} programs for {len(RULES)} rules of {COUNT} numbers")
    draw(found, least, picture)


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    plt.switch_backend("agg")
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE)
