"""Steps of filters as programs: what it takes to make them, and how long one step takes in C.

Nine states, three measurements, ``A x + 0.01 sin x`` with a full A, square-root form; complete
steps with checks, codes and NIS. JAX steps a batch of 256 runs, each with its own P0; C steps one
run in one lane. All is timed on this machine in one go; the best of some rounds.
"""

import ctypes
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor, filter_step, kalman, taylor, unscented
from robins.filters.rules import h_infinity
from robins.program import FLAGS, build, to_c, trace

N, M, BATCH, STEPS = 9, 3, 256, 200
UNROLLED = (None, 1000, 100)

# Steps a filter in C: reals and counts of the state come first among arguments and results.
REPEAT = """
void repeat(int steps, int reals, int counts, int width, const real *rows, real *x, whole *k,
            real *y, whole *m, int at)
{
    for (int s = 0; s < steps; ++s) {
        memcpy(x + at, rows + s * width, (size_t)width * sizeof(real));
        robins_step(x, k, y, m);
        memcpy(x, y, (size_t)reals * sizeof(real));
        memcpy(k, m, (size_t)counts * sizeof(whole));
    }
}
"""


def problem():
    rng = np.random.default_rng(0)
    A = np.eye(N) + 0.01 * rng.normal(size=(N, N))
    A /= max(1.0, np.abs(np.linalg.eigvals(A)).max())
    H = rng.normal(size=(M, N))
    P0 = np.array([np.diag(rng.uniform(0.5, 2.0, N)) for _ in range(BATCH)])
    motion = Motion(lambda x, u: jnp.asarray(A) @ x + 0.01 * jnp.sin(x), 0.1 * np.ones(N))
    model = Model(motion, (Sensor(lambda x, aux: jnp.asarray(H) @ x, np.ones(M), M),))
    return model, P0, rng.normal(size=(STEPS, M))


FILTERS = {
    "EKF": kalman(taylor()),
    "UKF": kalman(unscented()),
    "H-infinity": kalman(taylor(), [h_infinity(50.0, np.eye(N))]),
}


def best(function, rounds=5):
    """Seconds of the fastest of some rounds."""
    taken = []
    for _ in range(rounds):
        begun = time.perf_counter()
        function()
        taken.append(time.perf_counter() - begun)
    return min(taken)


def by_jax(step, states, y):
    """Nanoseconds a step and run in a batch."""

    def one(state):
        return jax.lax.scan(lambda s, row: (step(s, row)[0], None), state, y)[0]

    go = jax.jit(jax.vmap(one))
    jax.block_until_ready(go(states))
    return best(lambda: jax.block_until_ready(go(states))) / (STEPS * BATCH) * 1e9


def in_c(program, state, y):
    """Nanoseconds a step of one run, and the seconds of the compiler."""
    begun = time.perf_counter()
    library = ctypes.CDLL(str(build(to_c(program) + REPEAT, FLAGS)))
    built = time.perf_counter() - begun
    leaves = [np.asarray(x) for x in jax.tree.leaves(state)]
    reals = np.concatenate([x.ravel() for x in leaves if x.dtype == float])
    others = [x.ravel().astype(np.int64) for x in leaves if x.dtype != float]
    counts = np.concatenate(others) if others else np.zeros(0, np.int64)
    sizes = [0, 0]
    for leaf in program.results:
        sizes[leaf.kind != "real"] += int(np.prod(leaf.shape))
    x, k = np.zeros(len(reals) + M), np.zeros(max(1, len(counts)), np.int64)
    out, m = np.zeros(sizes[0]), np.zeros(max(1, sizes[1]), np.int64)
    told = [len(reals), len(counts), M]

    def go():
        x[: len(reals)], k[: len(counts)] = reals, counts
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (y, x, k, out, m)]
        library.repeat(STEPS, *told, *pointers, len(reals))

    return best(go, 20) / STEPS * 1e9, built


def main():
    model, P0, y = problem()
    print(
        f"{'filter':12s} {'unroll':>8s} {'nodes':>7s} {'trace s':>8s} {'build s':>8s}"
        f" {'C ns':>8s} {'JAX ns':>8s}"
    )
    for name, filter_ in FILTERS.items():
        if len(sys.argv) > 1 and name not in sys.argv[1:]:
            continue
        starts = [filter_.init(Belief.of(jnp.zeros(N), P), model.dims) for P in P0]
        states = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *starts)
        first = jax.tree.map(lambda x: x[0], states)

        def step(state, row, filter_=filter_):
            state, done = filter_step(filter_, model, state, None, {"y": row}, {})
            return state, (done.info["y"].nis, done.info["y"].code)

        reference = by_jax(step, states, y)
        for unroll in UNROLLED:
            begun = time.perf_counter()
            program = trace(step, first, jnp.asarray(y[0]), unroll=unroll)
            traced = time.perf_counter() - begun
            ns, built = in_c(program, first, y)
            told = "all" if unroll is None else str(unroll)
            print(
                f"{name:12s} {told:>8s} {len(program.live):7d} {traced:8.2f} {built:8.2f}"
                f" {ns:8.0f} {reference:8.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
