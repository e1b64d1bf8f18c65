"""Steps of filters as programs: what it takes to make them, and how long one step takes.

Nine states, three measurements, ``A x + 0.01 sin x`` with a full A, square-root form; complete
steps with checks, codes and NIS. JAX steps a batch of 256 runs, each with its own P0; C steps one
run, or eight in lanes. All on one core of this machine, in one go; the best of some rounds.

    python benchmarks/program.py [EKF] [UKF] [H-infinity]
"""

import ctypes
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor, filter_step, kalman, taylor, unscented
from robins.filters.rules import h_infinity
from robins.program import CPP, LANE_FLAGS, build, function, header, to_c, trace_step

N, M, BATCH, STEPS, LANES = 9, 3, 256, 200, 8
UNROLLED = (10_000, 300)

# Steps a filter: reals and counts of the state come first among arguments and results, and behind
# those of the state the measurement.
REPEAT = """
void repeat(int steps, int reals, int counts, const double *rows, real *x, whole *k, real *y,
            whole *m)
{
    for (int s = 0; s < steps; ++s) {
        for (int j = 0; j < 3; ++j) { x[reals + j] = REAL(rows[s * 3 + j]); }
        robins_step(x, k, y, m);
        memcpy(x, y, (size_t)reals * sizeof(real));
        memcpy(k, m, (size_t)counts * sizeof(whole));
    }
}
"""

FILTERS = {
    "EKF": kalman(taylor()),
    "UKF": kalman(unscented()),
    "H-infinity": kalman(taylor(), [h_infinity(50.0, np.eye(N))]),
}


def problem():
    """The model, a P0 for each run, measurements."""
    rng = np.random.default_rng(0)
    A = np.eye(N) + 0.01 * rng.normal(size=(N, N))
    A /= max(1.0, np.abs(np.linalg.eigvals(A)).max())
    H = rng.normal(size=(M, N))
    P0 = np.array([np.diag(rng.uniform(0.5, 2.0, N)) for _ in range(BATCH)])
    motion = Motion(lambda x, u: jnp.asarray(A) @ x + 0.01 * jnp.sin(x), 0.1 * np.ones(N))
    model = Model(motion, (Sensor(lambda x, aux: jnp.asarray(H) @ x, np.ones(M), M),))
    return model, P0, rng.normal(size=(STEPS, M))


def best(go, rounds=5):
    """Seconds of the fastest of some rounds."""
    taken = []
    for _ in range(rounds):
        begun = time.perf_counter()
        go()
        taken.append(time.perf_counter() - begun)
    return min(taken)


def by_jax(step, states, y):
    """Nanoseconds a step and run in a batch, and the mean of each run in the end."""

    def one(state):
        return jax.lax.scan(lambda s, row: (step(s, row)[0], None), state, y)[0]

    go = jax.jit(jax.vmap(one))
    end = np.asarray(jax.block_until_ready(go(states)).belief.mean)
    return best(lambda: jax.block_until_ready(go(states))) / (STEPS * BATCH) * 1e9, end


def in_c(program, states, y, lanes):
    """Nanoseconds a step and run, seconds of the compiler, and the mean of each run in the end."""
    begun = time.perf_counter()
    if lanes:
        text = header("lanes.h") + 'extern "C" {\n' + function(program) + REPEAT + "}\n"
        library = ctypes.CDLL(str(build(text, LANE_FLAGS, CPP)))
    else:
        library = ctypes.CDLL(str(build(to_c(program) + REPEAT)))
    built = time.perf_counter() - begun
    runs = LANES if lanes else 1
    rows = [np.asarray(x)[:runs].reshape(runs, -1).T for x in jax.tree.leaves(states)]
    reals = np.concatenate([r for r in rows if r.dtype == float])
    counts = np.concatenate([r.astype(np.int64) for r in rows if r.dtype != float])
    sizes = [0, 0]
    for leaf in program.results:
        sizes[leaf.kind != "real"] += int(np.prod(leaf.shape))
    x, k = np.zeros((len(reals) + M, runs)), np.zeros(counts.shape, np.int64)
    out, m = np.zeros((sizes[0], runs)), np.zeros((sizes[1], runs), np.int64)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (y, x, k, out, m)]

    def go():
        x[: len(reals)], k[:] = reals, counts
        library.repeat(STEPS, len(reals), len(counts), *pointers)

    return best(go, 20) / STEPS / runs * 1e9, built, out[:N].T


def main():
    model, P0, y = problem()
    names = [name for name in FILTERS if name in sys.argv[1:]] or list(FILTERS)
    head = ("filter", "unroll", "nodes", "trace s", "C s", "C++ s", "C ns", "8 lanes ns", "JAX ns")
    print(("{:12s}" + "{:>11s}" * 9).format(*head, "JAX/lanes"))
    for name in names:
        starts = [FILTERS[name].init(Belief.of(jnp.zeros(N), P), model.dims) for P in P0]
        states = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *starts)
        first = jax.tree.map(lambda x: x[0], states)

        def step(state, row, filter_=FILTERS[name]):
            state, done = filter_step(filter_, model, state, None, {"y": row}, {})
            return state, (done.info["y"].nis, done.info["y"].code)

        reference, end = by_jax(step, states, y)
        for unroll in UNROLLED:
            begun = time.perf_counter()
            program = trace_step(step, first, jnp.asarray(y[0]), unroll=unroll)
            traced = time.perf_counter() - begun
            one, c_s, alone = in_c(program, states, y, False)
            eight, cpp_s, together = in_c(program, states, y, True)
            assert np.array_equal(alone[0], together[0])
            assert np.allclose(together, end[:LANES], rtol=1e-12, atol=1e-13)
            told = "all" if unroll is None else str(unroll)
            numbers = (traced, c_s, cpp_s)
            print(
                f"{name:12s}{told:>11s}{len(program.live):11d}"
                + "".join(f"{x:11.2f}" for x in numbers)
                + f"{one:11.0f}{eight:11.0f}{reference:11.0f}{reference / eight:11.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
