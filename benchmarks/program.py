"""Steps of filters as programs: what it takes to make them, and how long one step takes.

Nine states, three measurements, ``A x + 0.01 sin x`` with a full A, square-root form, complete
steps with checks, codes and NIS; the EKF of `ins-gnss/drive` with 15 states, a second of inertial
samples and two fixes a step; strapdown mechanisation alone. JAX steps a batch of 256 runs, and so
does the machine, an interpreter; C steps one run, or as many as the processor has lanes. Beside
them, for the filters that they have: C++ with Eigen's matrices of fixed size (`benchmarks/cpp`),
and filterpy. All on one core, in one go, in turn: time of the processor, the best of some rounds.

    python benchmarks/program.py [EKF-9] [UKF-9] [H-infinity-9] [INS/GNSS-15] [strapdown]

Eigen is looked for in /usr/include/eigen3 (Debian: `apt install libeigen3-dev`) and in the folder
that EIGEN names; where it is not, its column is empty.
"""

import ctypes
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import filterpy.kalman
import jax
import jax.numpy as jnp
import numpy as np
from timing import best_of

from robins import scenario
from robins.dataset import ImuTable
from robins.earth import Geodetic
from robins.filters import Belief, Model, Motion, Sensor, filter_step, kalman, taylor, unscented
from robins.filters.rules import h_infinity
from robins.ins.increments import from_imu
from robins.ins.mechanise import Nav
from robins.ins.mechanise import step as mechanise
from robins.program import CPP, LANE_FLAGS, build, function, header, to_c, trace_step
from robins.program.interpreter import interpreted_rounds
from robins.program.lanes import CompiledRounds
from robins.rotation import Rotation
from robins.systems.ins_gnss import SYSTEM, Drive

N, M, BATCH, STEPS = 9, 3, 256, 200
EPOCHS, SAMPLES, RATE = 20, 1000, 100  # of the drive; of strapdown; samples in an epoch
EIGEN = Path(os.environ.get("EIGEN", "/usr/include/eigen3"))
EIGEN_FLAGS = ("-std=gnu++17", "-O3", "-march=native", "-DNDEBUG", f"-isystem{EIGEN}")

# Steps from state to state. Reals and counts of the state come first among arguments and results,
# and behind those of the state what the step is given.
REPEAT = """
void repeat(int steps, int reals, int counts, int row, int row_counts, const real *rows,
            const whole *count_rows, real *x, whole *k, real *y, whole *m)
{
    for (int s = 0; s < steps; ++s) {
        memcpy(x + reals, rows + (size_t)s * row, (size_t)row * sizeof(real));
        memcpy(k + counts, count_rows + (size_t)s * row_counts, (size_t)row_counts * sizeof(whole));
        robins_step(x, k, y, m);
        memcpy(x, y, (size_t)reals * sizeof(real));
        memcpy(k, m, (size_t)counts * sizeof(whole));
    }
}
"""


class Case(NamedTuple):
    """A step, the states of a batch of runs, and what their steps are given."""

    step: Callable[[Any, Any], tuple[Any, Any]]
    states: Any  # (BATCH, ...)
    rows: Any  # (steps, BATCH, ...)
    steps: int
    unrolls: tuple[int, ...]
    unit: int = 1  # into how many parts a step is divided in the table
    peers: Callable[[Any], dict[str, Callable[[], np.ndarray]]] = lambda end: {}


IN_CPP = {"EKF-9": "ekf", "UKF-9": "ukf", "H-infinity-9": "hinf"}

# ------------------------------------------------------------------------------------- the cases


def nine(name: str, filter_) -> Case:
    rng = np.random.default_rng(0)
    A = np.eye(N) + 0.01 * rng.normal(size=(N, N))
    A /= max(1.0, np.abs(np.linalg.eigvals(A)).max())
    H = rng.normal(size=(M, N))
    P0 = np.array([np.diag(rng.uniform(0.5, 2.0, N)) for _ in range(BATCH)])
    y = rng.normal(size=(STEPS, M))
    y[40], y[80, 1], y[120, 2] = np.nan, np.nan, np.inf  # gaps
    motion = Motion(lambda x, u: jnp.asarray(A) @ x + 0.01 * jnp.sin(x), 0.1 * np.ones(N))
    model = Model(motion, (Sensor(lambda x, aux: jnp.asarray(H) @ x, np.ones(M), M),))
    states = stacked([filter_.init(Belief.of(jnp.zeros(N), P), model.dims) for P in P0])

    def step(state, row):
        state, done = filter_step(filter_, model, state, None, {"y": row}, {})
        return state, (done.info["y"].nis, done.info["y"].code)

    def peers(end):
        found = {}
        if (EIGEN / "Eigen").is_dir():
            first = jax.tree.map(lambda x: x[0], states)
            log = jax.jit(lambda rows: jax.lax.scan(step, first, rows)[1])(jnp.asarray(y))
            found["Eigen"] = by_eigen(IN_CPP[name], A, H, y, P0, end, log)
        if name == "UKF-9":
            found["filterpy"] = by_filterpy(A, H, np.where(np.isfinite(y), y, 0.0), P0[0])
        return found

    rows = jnp.broadcast_to(jnp.asarray(y)[:, None], (STEPS, BATCH, M))
    return Case(step, states, rows, STEPS, (10_000, 300), peers=peers)


def drive() -> Case:
    """The EKF of the drive: a second of samples, position and velocity; per sample."""
    settings = ["update.longest_block=1 s", 'outages.first="1000 s"']
    d = scenario.parse(Drive, SYSTEM.scenarios["drive"].read_text(), settings)
    problem = SYSTEM.studies["drive"].problem(d, ("ekf",), 0)
    cases = jax.jit(jax.vmap(problem.simulate))(jnp.arange(BATCH))
    one = problem.contenders["ekf"]
    made = jax.vmap(one.case)(cases)
    rows = jax.tree.map(
        lambda x: jnp.swapaxes(x[:, :EPOCHS], 0, 1), (made.u, dict(made.y), dict(made.aux))
    )
    states = jax.vmap(lambda start: one.filter.init(start, one.model.dims))(made.start)

    def step(state, row):
        state, done = filter_step(one.filter, one.model, state, *row)
        return state, [(i.nis, i.code) for i in done.info.values()]

    return Case(step, states, rows, EPOCHS, (300,), RATE)


def strapdown() -> Case:
    rng = np.random.default_rng(0)
    time_ns = np.arange(SAMPLES + 1, dtype=np.int64) * 5_000_000
    gyro = rng.normal(0.0, 5e-6, (SAMPLES + 1, 3))
    accel = rng.normal([0.0, 0.0, -0.049], 5e-5, (SAMPLES + 1, 3))
    increments = from_imu(ImuTable(time_ns, gyro, accel, "increment"))[0]
    scale = 1.0 + 1e-6 * np.arange(BATCH)  # runs that differ
    rows = jax.tree.map(
        lambda x: jnp.asarray(x[:, None] * scale.reshape(-1, *[1] * (x.ndim - 1))), increments
    )
    start = Nav(
        Rotation.from_euler(0.01, 0.02, 0.5),
        jnp.array([1.0, 2.0, 0.0]),
        Geodetic.from_degrees(55.0, 37.0, 150.0),
    )
    states = stacked([start] * BATCH)
    return Case(lambda nav, inc: (mechanise(nav, inc), ()), states, rows, SAMPLES, (10_000,))


CASES: dict[str, Callable[[], Case]] = {
    "EKF-9": lambda: nine("EKF-9", kalman(taylor())),
    "UKF-9": lambda: nine("UKF-9", kalman(unscented())),
    "H-infinity-9": lambda: nine("H-infinity-9", kalman(rules=[h_infinity(50.0, np.eye(N))])),
    "INS/GNSS-15": drive,
    "strapdown": strapdown,
}


def stacked(trees):
    return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *trees)


# --------------------------------------------------------------------------------- the contenders


def by_jax(case: Case) -> Callable[[], Any]:
    """All runs as one batch, from the first state to the last."""

    def one(state, rows):
        return jax.lax.scan(lambda s, row: (case.step(s, row)[0], None), state, rows)[0]

    go = jax.jit(jax.vmap(one, in_axes=(0, 1)))
    return lambda: go(case.states, case.rows)


class Pools(NamedTuple):
    """Reals, and all else, of arrays (*lead, runs, ...): (*lead, numbers, runs)."""

    reals: np.ndarray
    counts: np.ndarray

    @classmethod
    def of(cls, tree: Any, runs: int, lead: int = 0) -> "Pools":
        """Arrays of some runs, where so many axes come before that of runs."""
        found = []
        for leaf in map(np.asarray, jax.tree.leaves(tree)):
            x = np.moveaxis(leaf, lead, -1)[..., :runs]
            found.append(x.reshape(*leaf.shape[:lead], -1, runs))
        front = np.shape(jax.tree.leaves(tree)[0])[:lead]
        reals = [x for x in found if x.dtype == float]
        counts = [x.astype(np.int64) for x in found if x.dtype != float]
        return cls(
            np.concatenate([*reals, np.zeros((*front, 0, runs))], axis=-2),
            np.concatenate([*counts, np.zeros((*front, 0, runs), np.int64)], axis=-2),
        )


def lanes_here() -> int:
    """Number of runs that the processor takes at a time."""
    text = header("lanes.h") + 'extern "C" int lanes(void) { return LANES; }\n'
    return ctypes.CDLL(str(build(text, LANE_FLAGS, CPP))).lanes()


LANES = lanes_here()


def in_c(program, case: Case, runs: int) -> Callable[[], np.ndarray]:
    """One run, or as many as there are lanes; gives the reals of the state in the end."""
    if runs > 1:
        text = header("lanes.h") + 'extern "C" {\n' + function(program) + REPEAT + "}\n"
        library = ctypes.CDLL(str(build(text, LANE_FLAGS, CPP)))
    else:
        library = ctypes.CDLL(str(build(to_c(program) + REPEAT)))
    state, rows = Pools.of(case.states, runs), Pools.of(case.rows, runs, 1)
    sizes = [len(state.reals), len(state.counts), rows.reals.shape[1], rows.counts.shape[1]]
    made = [0, 0]
    for leaf in program.results:
        made[leaf.kind != "real"] += int(np.prod(leaf.shape))
    x, k = np.zeros((sizes[0] + sizes[2], runs)), np.zeros((sizes[1] + sizes[3], runs), np.int64)
    y, m = np.zeros((made[0] + 1, runs)), np.zeros((made[1] + 1, runs), np.int64)
    arrays = [np.ascontiguousarray(a) for a in rows] + [x, k, y, m]
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in arrays]

    def go(keep=arrays):
        x[: sizes[0]], k[: sizes[1]] = state
        library.repeat(case.steps, *sizes, *pointers)
        return x[: sizes[0]]

    return go


def by_machine(program, case: Case) -> Callable[[], list[np.ndarray]]:
    """All runs by the interpreter; gives the leaves of the state in the end, for each run."""
    states, rows = jax.tree.leaves(case.states), jax.tree.leaves(case.rows)
    rounds = CompiledRounds(program, case.steps, len(states), 0, engine=interpreted_rounds)
    given = [(np.asarray(x), True) for x in states]
    given += [(np.ascontiguousarray(np.moveaxis(np.asarray(x), 0, 1)), True) for x in rows]
    return lambda: rounds(BATCH, given)[: len(states)]


def by_eigen(name, A, H, y, P0, end, log) -> Callable[[], np.ndarray]:
    """One run; checked on as many as there are lanes, NIS and codes on the first: to 1e-10."""
    text = (Path(__file__).parent / "cpp" / "filters.cc").read_text("utf-8")
    step = getattr(ctypes.CDLL(str(build(text, EIGEN_FLAGS, CPP))), f"run_{name}")
    mean, factor, nis = np.zeros(N), np.zeros((N, N)), np.zeros(STEPS)
    code = np.zeros(STEPS, np.int32)
    arrays = (A, H, y, mean, factor, nis, code)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in arrays]

    def go(run=0, keep=arrays):
        mean[:], factor[:] = 0.0, np.sqrt(P0[run])
        step(STEPS, *pointers)
        return mean

    for run in reversed(range(LANES)):
        assert np.max(np.abs(go(run) - end.belief.mean[run])) < 1e-10
        assert np.max(np.abs(factor - end.belief.factor[run])) < 1e-10
    assert np.allclose(nis, log[0], rtol=1e-10, atol=1e-10)
    assert np.array_equal(code, log[1])
    return go


def by_filterpy(A, H, y, P0) -> Callable[[], np.ndarray]:
    points = filterpy.kalman.MerweScaledSigmaPoints(N, 1.0, 2.0, 0.0)
    f = filterpy.kalman.UnscentedKalmanFilter(
        N, M, 1.0, hx=lambda x: H @ x, fx=lambda x, dt: A @ x + 0.01 * np.sin(x), points=points
    )
    f.Q, f.R = 0.01 * np.eye(N), np.eye(M)

    def go():
        f.x, f.P = np.zeros(N), P0
        for row in y:
            f.predict()
            f.update(row)
        return f.x

    return go


# -------------------------------------------------------------------------------------- the table

HEAD = ("unroll", "nodes", "trace s", "tape s", "C s", "C++ s", "off JAX")
TIMES = ("C ns", "machine ns", "lanes ns", "JAX ns", "machine/lanes")
PEERS = (
    "JAX/lanes",
    "Eigen ns",
    "lanes/Eigen",
    "filterpy ns",
    "filterpy/lanes",
)


def timed(make):
    begun = time.perf_counter()
    made = make()
    return made, time.perf_counter() - begun


def row(case: Case, unroll: int) -> list[str]:
    """Times of a case, and how far lanes and JAX are apart, in parts of a field's largest."""
    first = jax.tree.map(lambda x: x[0], case.states)
    given = jax.tree.map(lambda x: x[0, 0], case.rows)
    program, traced = timed(lambda: trace_step(case.step, first, given, unroll=unroll))
    machine, tape_s = timed(lambda: by_machine(program, case))
    one, c_s = timed(lambda: in_c(program, case, 1))
    lanes, cpp_s = timed(lambda: in_c(program, case, LANES))
    reference = by_jax(case)
    end = jax.block_until_ready(reference())
    assert np.array_equal(one()[:, 0], lanes()[:, 0], equal_nan=True)
    off, at = 0.0, 0
    for leaf, interpreted in zip(map(np.asarray, jax.tree.leaves(end)), machine(), strict=True):
        if leaf.dtype == float:
            want = leaf[:LANES].reshape(LANES, -1).T
            got = lanes()[at : at + len(want)]
            same = interpreted[:LANES].reshape(LANES, -1).T
            assert np.array_equal(got, same, equal_nan=True)
            at += len(want)
            off = max(off, np.max(np.abs(got - want)) / max(np.max(np.abs(want)), 1e-300))
    assert off < 1e-11, off
    contenders = {"C": one, "machine": machine, "lanes": lanes, "JAX": reference, **case.peers(end)}
    # C and its peers take milliseconds where JAX takes a second: many rounds cost nothing there.
    seconds = best_of(contenders, 2, time.process_time)
    quick = {k: v for k, v in contenders.items() if k not in ("JAX", "filterpy")}
    for name, best in best_of(quick, 20, time.process_time).items():
        seconds[name] = min(seconds[name], best)
    runs = {"lanes": LANES, "machine": BATCH, "JAX": BATCH}
    ns = {
        name: best / runs.get(name, 1) / case.steps / case.unit * 1e9
        for name, best in seconds.items()
    }
    made = [
        str(unroll),
        str(len(program.live)),
        *(f"{x:.1f}" for x in (traced, tape_s, c_s, cpp_s)),
    ]
    made += [f"{off:.0e}", *(f"{ns[name]:.0f}" for name in ("C", "machine", "lanes", "JAX"))]
    made += [f"{ns['machine'] / ns['lanes']:.2f}", f"{ns['JAX'] / ns['lanes']:.1f}"]
    made += (
        [f"{ns['Eigen']:.0f}", f"{ns['lanes'] / ns['Eigen']:.2f}"] if "Eigen" in ns else ["", ""]
    )
    if "filterpy" in ns:
        made += [f"{ns['filterpy']:.0f}", f"{ns['filterpy'] / ns['lanes']:.0f}"]
    return made


def main():
    wanted = [name for name in CASES if name in sys.argv[1:]] or list(CASES)
    if not (EIGEN / "Eigen").is_dir():
        print(f"no Eigen in {EIGEN}: `apt install libeigen3-dev`, or name its folder in EIGEN")
    print(f"load of the machine: {os.getloadavg()[0]:.1f}")
    columns = HEAD + TIMES + PEERS
    print(f"{'':14s}" + "".join(f"{name:>{max(9, len(name) + 2)}s}" for name in columns))
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as cache:
        warnings.simplefilter("ignore")
        # What earlier runs compiled is not used: the table says how long compilers take.
        os.environ["XDG_CACHE_HOME"] = cache
        for name in wanted:
            case = CASES[name]()
            for unroll in case.unrolls:
                cells = row(case, unroll)
                line = [f"{c:>{max(9, len(h) + 2)}s}" for c, h in zip(cells, columns, strict=False)]
                print(f"{name:14s}" + "".join(line), flush=True)


if __name__ == "__main__":
    main()
