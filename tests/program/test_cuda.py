"""The CUDA text, run on the CPU: each thread gives its run the bits of the C.

No test here runs on a GPU. The text is compiled as C++, with the words that CUDA adds to C defined,
and its kernel called for all threads by a library that has the functions of the CUDA driver.
"""

import ctypes
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import QUICK, stepping
from rule_table import RULES, START, Y, line

from robins.filters import kalman
from robins.program import CPP, BuildError, Native, ProgramError, build, trace, trace_step
from robins.program.cuda import to_cuda
from robins.program.kernel import Kernel, Machine, launcher
from robins.program.nvrtc import compile_cuda, found

FOUND = any(map(shutil.which, CPP.names))
pytestmark = pytest.mark.skipif(not FOUND, reason="the emulation needs a C++ compiler")

WORDS = """
#define __global__
#define __device__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(threads)
struct Place { unsigned x; };
static Place threadIdx, blockIdx, blockDim;
#include <cstddef>
"""

DRIVER = """
#define API extern "C" int
API cuInit(unsigned) { return 0; }
API cuLibraryLoadData(void **to, const void *, void *, void *, unsigned, void *, void *, unsigned)
{
    *to = (void *)&blockIdx;
    return 0;
}
API cuLibraryGetKernel(void **to, void *library, const char *name)
{
    const bool known = library == (void *)&blockIdx && strcmp(name, "robins_steps") == 0;
    *to = known ? (void *)robins_steps : nullptr;
    return known ? 0 : 500;
}
API cuLaunchKernel(void *kernel, unsigned grid, unsigned, unsigned, unsigned block, unsigned,
                   unsigned, unsigned, void *, void **told, void **)
{
    if (kernel != (void *)robins_steps || block > BLOCK) { return 1; }
    blockDim.x = block;
    for (blockIdx.x = 0; blockIdx.x < grid; ++blockIdx.x) {
        for (threadIdx.x = 0; threadIdx.x < block; ++threadIdx.x) {
            robins_steps(*(int *)told[0], *(int *)told[1], *(int *)told[2], *(int *)told[3],
                         *(real **)told[4], *(whole **)told[5], *(const real **)told[6],
                         *(const whole **)told[7], *(real **)told[8], *(whole **)told[9]);
        }
    }
    return 0;
}
"""
EMULATED = ("-std=gnu++17", "-Wno-unknown-pragmas", *QUICK[1:])


def emulated(program, block=4):
    """The kernel of a program on this CPU."""
    driver = build(WORDS + to_cuda(program, block) + DRIVER, EMULATED, CPP)
    here = Machine("cpu", str(driver), lambda text: b"", ("-DNO_STREAM",))
    return Kernel(program, here, block)


def one_by_one(program, states, rows, runs, steps, every=1):
    """What the kernel gives, by the C of one run after the other."""
    native = Native(program, QUICK)
    ends, logs = [], []
    for run in range(runs):
        state, log = jax.tree.map(lambda x, run=run: x[run], states), []
        for s in range(steps):
            row = jax.tree.map(lambda x, s=s, run=run: x[s, run % x.shape[1]], rows)
            state, kept = native(state, *row)
            if (s + 1) % every == 0:
                log.append(kept)
        ends.append(state)
        logs.append(jax.tree.map(lambda *x: np.stack(x), *log))
    return (
        jax.tree.map(lambda *x: np.stack(x), *ends),
        jax.tree.map(lambda *x: np.stack(x, axis=1), *logs),
    )


def check(program, states, rows, runs, steps, every=1, make=emulated):
    got = make(program)(states, *rows, every=every)
    want = one_by_one(program, states, rows, runs, steps, every)
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    return got


def filtered(runs):
    """A filter with two rules; states that differ, measurements with gaps, outliers, infinities."""
    model, one = line(), kalman(rules=[RULES["gate"], RULES["h_infinity"]])
    state = jax.tree.map(jnp.asarray, one.init(START, model.dims))
    spread = jnp.linspace(0.5, 2.0, runs)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (runs, *x.shape)), state)
    belief = states.belief
    states = states._replace(
        belief=belief._replace(
            mean=belief.mean + 0.1 * spread[:, None], factor=belief.factor * spread[:, None, None]
        )
    )
    y = Y[:, None] + 0.1 * np.arange(runs)[:, None]
    y[5, 1 % runs], y[6, 2 % runs, 1] = np.inf, -np.inf
    return stepping(one, model), state, states, (None, {"y": jnp.asarray(y)}, {})


@pytest.mark.parametrize("unroll", [None, 200])
def test_each_thread_gives_its_run_the_bits_of_c(unroll):
    runs = 6  # a block and a half
    step, state, states, rows = filtered(runs)
    first = jax.tree.map(lambda x: x[0, 0], rows)
    program = trace_step(step, state, *first, unroll=unroll)
    _, (after, info, _) = check(program, states, rows, runs, len(Y))
    codes = np.asarray(info["y"].code)
    assert len(np.unique(codes)) >= 3  # done, missing, refused
    assert not np.array_equal(after.belief.mean[-1, 0], after.belief.mean[-1, 1])


def on_a_gpu():
    try:
        return bool(jax.devices("cuda"))
    except RuntimeError:
        return False


@pytest.mark.skipif(not on_a_gpu(), reason="needs a GPU")
def test_on_a_gpu():
    step, state, states, rows = filtered(6)
    program = trace_step(step, state, *jax.tree.map(lambda x: x[0, 0], rows))
    check(program, states, rows, 6, len(Y), make=Kernel)


def counting(state, row):
    """Numbers of all kinds in state and rows."""
    new = {
        "word": state["word"] * 3 + row["u"].astype(jnp.uint32),
        "wide": state["wide"] ^ (state["wide"] << 3),
        "flag": state["flag"] ^ (row["x"][0] > 0.0),
        "real": jnp.where(state["flag"], jnp.sin(row["x"]), state["real"]),
        "whole": state["whole"] - row["u"],
    }
    return new, (3.0 * new["real"], new["flag"], new["wide"] >> 1)


def counted(runs, steps, width):
    rng = np.random.default_rng(0)
    states = {
        "word": jnp.asarray(rng.integers(0, 2**32, runs), jnp.uint32),
        "wide": jnp.asarray(rng.integers(2**62, 2**64, runs, np.uint64)),
        "flag": jnp.asarray(rng.integers(0, 2, runs), bool),
        "real": jnp.asarray(rng.normal(size=(runs, 2))),
        "whole": jnp.asarray(rng.integers(-5, 5, runs), jnp.int32),
    }
    rows = {
        "x": jnp.asarray(1e3 * rng.normal(size=(steps, width, 2))),
        "u": jnp.asarray(rng.integers(0, 9, (steps, width)), jnp.int32),
    }
    return states, rows


@pytest.mark.parametrize(("width", "every"), [(5, 3), (1, 1)])
def test_all_kinds_of_numbers(width, every):
    runs, steps = 5, 7
    states, rows = counted(runs, steps, width)
    one = jax.tree.map(lambda x: x[0], (states, jax.tree.map(lambda x: x[0], rows)))
    program = trace(counting, *one)
    _, kept = check(program, states, (rows,), runs, steps, every)
    assert kept[0].shape == (steps // every, runs, 2)


def test_random_numbers_are_those_of_jax():
    """A walk with a key in its state: whole words and shifts, in threads as by JAX."""

    def step(state, row):
        key, draw = jax.random.split(jax.random.wrap_key_data(state["key"], impl="threefry2x32"))
        moved = state["at"] + row + jax.random.uniform(draw, (2,))
        return {"key": jax.random.key_data(key), "at": moved}, jax.random.bits(draw)

    runs, steps = 5, 4
    keys = jax.random.key_data(jax.random.split(jax.random.key(0), runs))
    states, rows = {"key": keys, "at": jnp.zeros((runs, 2))}, jnp.ones((steps, 1, 2))
    program = trace(step, jax.tree.map(lambda x: x[0], states), rows[0, 0])
    end, kept = emulated(program)(states, rows)
    want, drawn = jax.vmap(lambda s: jax.lax.scan(step, s, rows[:, 0]))(states)
    np.testing.assert_array_equal(end["key"], want["key"])
    np.testing.assert_array_equal(kept.T, drawn)
    np.testing.assert_array_equal(end["at"], want["at"])


def test_nothing_is_kept_but_the_end():
    states, rows = counted(3, 4, 3)
    one = jax.tree.map(lambda x: x[0], (states, jax.tree.map(lambda x: x[0], rows)))
    kernel = emulated(trace(counting, *one))
    end, kept = kernel(states, rows, every=0)
    np.testing.assert_array_equal(end["real"], kernel(states, rows)[0]["real"])
    assert [x.shape for x in kept] == [(0, 3, 2), (0, 3), (0, 3)]


def test_what_does_not_fit_is_refused():
    states, rows = counted(3, 4, 3)
    one = jax.tree.map(lambda x: x[0], (states, jax.tree.map(lambda x: x[0], rows)))
    kernel = emulated(trace(counting, *one))
    with pytest.raises(ProgramError, match="another structure"):
        kernel(states)
    with pytest.raises(ProgramError, match=r"real.*\(3, 3\) was given where \(2,\)"):
        kernel({**states, "real": jnp.zeros((3, 3))}, rows)
    with pytest.raises(ProgramError, match=r"runs \[3\] in the state.* runs \[2\] in the rows"):
        kernel(states, jax.tree.map(lambda x: x[:, :2], rows))
    alone = emulated(trace(lambda s: (s + 1.0, s), np.ones(2)))
    with pytest.raises(ProgramError, match="how many steps"):
        alone(jnp.ones((3, 2)))
    with pytest.raises(ProgramError, match="not a state"):
        to_cuda(trace(lambda s, x: s + x, np.ones(2), np.ones(2)))


def test_a_zero_that_the_step_relies_on_is_looked_for():
    def step(state, x):
        return {"a": state["a"] + x, "zero": 2.0 * state["zero"]}, x

    first = {"a": np.ones(1), "zero": np.zeros(1)}
    kernel = emulated(trace_step(step, first, np.ones(1)))
    states = {"a": jnp.ones((2, 1)), "zero": jnp.zeros((2, 1))}
    kernel(states, jnp.ones((1, 2, 1)))
    with pytest.raises(ProgramError, match=r"zero.*: a number is not zero"):
        kernel({**states, "zero": jnp.array([[0.0], [1.0]])}, jnp.ones((1, 2, 1)))


def test_the_launcher_for_a_stream_compiles():
    assert hasattr(ctypes.CDLL(str(launcher())), "robins_steps_target")


def test_a_driver_that_is_not_there_is_named():
    program = trace(lambda s, x: (s + x, x), np.ones(2), np.ones(2))
    with pytest.raises(BuildError, match=r"no-such-driver.*does not load the kernel"):
        Kernel(program, Machine("cpu", "no-such-driver.so", lambda text: b"", ("-DNO_STREAM",)))


def test_without_a_gpu_it_says_so(monkeypatch):
    def none(name):
        raise RuntimeError

    monkeypatch.setattr("jax.devices", none)
    with pytest.raises(BuildError, match="finds no GPU"):
        Kernel(trace(lambda s, x: (s + x, x), np.ones(2), np.ones(2)))


def test_without_nvrtc_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BuildError, match=r"NVRTC.*not installed.*jax\[cuda"):
        compile_cuda("", "sm_90")


@pytest.mark.skipif(found() is None, reason="needs the wheel nvidia-cuda-nvrtc")
def test_nvrtc_accepts_the_text():
    step, state, _, rows = filtered(2)
    program = trace_step(step, state, *jax.tree.map(lambda x: x[0, 0], rows))
    text = to_cuda(program)
    assert text.count("__noinline__") == 2
    made = compile_cuda(text, "sm_90")
    assert made.code[:4] == b"\x7fELF"
    assert "registers" in made.log
    with pytest.raises(BuildError, match=r"does not accept a program: .*error"):
        compile_cuda("__global__ void f() { int one = ; }", "sm_90")
