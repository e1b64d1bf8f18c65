"""Time that each rule adds to a step of a 9-state filter, taken in turns with the bare filter."""

import time

import jax.numpy as jnp
import numpy as np
from filters import STEPS, M, N, problem
from timing import best_of

from robins.filters import Belief, Model, Motion, Sensor, kalman, run, taylor, unscented
from robins.filters.rules import (
    adaptive_h_infinity,
    consider,
    correntropy,
    discriminator,
    equality,
    fading_memory,
    gate,
    h_infinity,
    huber,
    igg3,
    inequality,
    innovation_fading,
    sage_husa,
    strong_tracking,
    student_t,
    variational_bayes,
)

RULES = {
    "gate": gate(),
    "huber": huber(),
    "igg3": igg3(),
    "student_t": student_t(),
    "correntropy": correntropy(),
    "sage_husa": sage_husa(),
    "innovation_fading": innovation_fading(),
    "fading_memory": fading_memory(),
    "variational_bayes": variational_bayes(),
    **{
        f"strong_tracking, {form}": strong_tracking(form=form)
        for form in ("outside", "lumped", "multiple", "projected")
    },
    "discriminator": discriminator(),
    "h_infinity, 3 rows": h_infinity(1e3, jnp.eye(N)[:3]),
    "h_infinity, 9 rows": h_infinity(1e3, jnp.eye(N)),
    "adaptive_h_infinity, 3 rows": adaptive_h_infinity(jnp.eye(N)[:3]),
    "equality": equality(jnp.eye(N)[:1], jnp.zeros(1), noise=jnp.ones(1)),
    "inequality": inequality(jnp.eye(N)[:1], [-1.0], [1.0]),
    "consider": consider([N - 1]),
}


def main():
    A, H, y = problem()
    A_, H_ = jnp.asarray(A), jnp.asarray(H)
    model = Model(
        Motion(lambda x, u: A_ @ x + 0.01 * jnp.sin(x), jnp.full(N, 0.1)),
        (Sensor(lambda x, a: H_ @ x, jnp.ones(M), M),),
    )
    start = Belief.of(jnp.zeros(N), np.eye(N))
    mean = lambda step: step.posterior.mean  # noqa: E731
    ways = {"ekf": taylor(), "ukf": unscented()}
    contenders = {}
    for way, linearise in ways.items():
        for name, rules in {"": (), **{f" + {n}": (r,) for n, r in RULES.items()}}.items():
            one = kalman(linearise, rules)
            contenders[way + name] = lambda f=one: run(f, model, start, y, keep=mean)
    seconds = best_of(contenders, rounds=9, clock=time.process_time)
    print(f"{'':34s}{'us a step':>12s}{'added':>9s}")
    for name, total in seconds.items():
        base = seconds[name.split(" ")[0]]
        print(f"{name:34s}{1e6 * total / STEPS:12.2f}{100 * (total / base - 1):8.0f} %")


if __name__ == "__main__":
    main()
