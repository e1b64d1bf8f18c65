"""The text: what compilers say of it, its own functions, and what it promises of memory."""

import ctypes
import re
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import QUICK, in_c, stepping
from rule_table import ACTING, START, Y, line

from robins.filters import kalman, unscented
from robins.program import build, compiler, function, header, to_c, trace

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wvla", "-Werror")


# Written out every number is named where it is computed; how the entries of arrays are filled is
# known to a compiler that optimises.
@pytest.mark.parametrize(
    ("unroll", "level"), [(None, "-O0"), (100, "-O1")], ids=["written out", "in loops"]
)
def test_no_compiler_has_anything_to_say(tmp_path, unroll, level):
    model = line()
    one = kalman(unscented(), [*ACTING["gated"], *ACTING["h_infinity"]])
    state = jax.tree.map(jnp.asarray, one.init(START, model.dims))
    program = trace(stepping(one, model), state, None, {"y": Y[0]}, {}, unroll=unroll)
    source = tmp_path / "step.c"
    source.write_text(to_c(program))
    line_ = [*compiler(), *STRICT, level, "-c", str(source), "-o", str(tmp_path / "step.o")]
    done = subprocess.run(line_, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    text = function(program)
    assert not re.search(r"malloc|static|goto|\bif \((?!!ANY)", text)


def test_an_infinite_number_is_a_real_and_no_float(tmp_path):
    program = trace(lambda x: x + jnp.array([-jnp.inf, jnp.nan]), jnp.zeros(2))
    source = tmp_path / "step.c"
    source.write_text(to_c(program))
    line_ = [*compiler(), *STRICT, "-Wdouble-promotion", "-fsyntax-only", str(source)]
    done = subprocess.run(line_, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def libm(x, name):
    """The function in extended precision, rounded once."""
    return getattr(np, name)(x.astype(np.longdouble))


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_sine_and_cosine_are_within_what_they_state(name):
    rng = np.random.default_rng(0)
    near = np.arange(-64, 65) * (np.pi / 4)
    x = np.concatenate([
        rng.uniform(-7, 7, 20000), rng.uniform(-1e6, 1e6, 20000), near, np.nextafter(near, 9e9),
        np.array([0.0, -0.0, 1e-300, 1e-8, -1e-8]),
    ])  # fmt: skip
    rows = x.reshape(-1, 13) if x.size % 13 == 0 else x[: x.size // 13 * 13].reshape(-1, 13)
    one = in_c(getattr(jnp, name), rows[0])
    got = np.array([one(row) for row in rows])
    assert np.max(np.abs(got - libm(rows, name))) < 1.7e-16
    # Beyond a million radians it is the C library's.
    far = np.array([1e7, -3e12, 1e300, np.inf, np.nan, -np.inf, 0, 0, 0, 0, 0, 0, 0], dtype=float)
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(one(far), getattr(np, name)(far), rtol=1e-15)


def test_results_may_lie_where_the_arguments_do():
    program = trace(lambda a, b: (b + a, a, b), jnp.zeros(3), jnp.zeros(3))
    step = ctypes.CDLL(str(build(to_c(program), QUICK))).robins_step
    x = np.array([1.0, 2.0, 3.0, 10.0, 20.0, 30.0, 0.0, 0.0, 0.0])
    k = np.zeros(1, dtype=np.int64)
    told = [ctypes.c_void_p(a.ctypes.data) for a in (x, k, x, k)]
    step(*told)
    assert x.tolist() == [11.0, 22.0, 33.0, 1.0, 2.0, 3.0, 10.0, 20.0, 30.0]


def test_numbers_are_written_to_the_last_bit():
    rng = np.random.default_rng(0)
    odd = [0.1, -0.0, 1e-310, np.inf, -np.inf, np.nan, 1.7976931348623157e308, 5e-324]
    known = np.array([*rng.normal(size=50) * 10.0 ** rng.integers(-300, 300, 50), *odd])
    whole = np.array([0, -1, 2**62, -(2**63), 2**63 - 1])
    got = in_c(lambda c: (jnp.where(c, known, 7.0), jnp.where(c, whole, 7)), True)(True)
    assert got[0].tobytes() == known.tobytes()
    assert got[1].tolist() == whole.tolist()


def test_bits_do_not_depend_on_how_the_compiler_was_told_to_hurry():
    def f(x):
        return jnp.sum(jnp.sin(x) * x[::-1] + 1.0 / x) + jnp.cos(x)

    x = np.random.default_rng(0).normal(size=9)
    program = trace(f, x)
    found = []
    for flags in ("-O0", "-O2", "-O3"):
        step = ctypes.CDLL(str(build(to_c(program), (*QUICK, flags)))).robins_step
        y, k = np.zeros(9), np.zeros(1, dtype=np.int64)
        step(*(ctypes.c_void_p(a.ctypes.data) for a in (x, k, y, k)))
        found.append(y.tobytes())
    assert len(set(found)) == 1


def test_the_header_is_in_the_text():
    program = trace(lambda x: x, 1.0)
    assert to_c(program) == header() + "\n" + function(program)
