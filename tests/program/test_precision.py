"""Single precision: how numbers are written, and that what is computed is right for floats."""

import ctypes
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from machines import QUICK

from robins.program import DOUBLE, SINGLE, build, function, header, trace, trace_steps

STRICT = ("-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wdouble-promotion", "-Werror")


def in_floats(step, *args, unroll=None):
    """A function of arrays of reals, as a function of floats."""
    program = trace(step, *args, unroll=unroll)
    text = header(precision=SINGLE) + function(program, precision=SINGLE)
    one = ctypes.CDLL(str(build(text, QUICK))).robins_step
    out = np.zeros(sum(int(np.prod(leaf.shape)) for leaf in program.results), np.float32)

    def call(*args):
        x = np.concatenate([np.ravel(a) for a in args]).astype(np.float32)
        one(ctypes.c_void_p(x.ctypes.data), None, ctypes.c_void_p(out.ctypes.data), None)
        return out.copy()

    return call


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (0.1, "0.1f"),
        (1 / 3, "0.33333334f"),
        (-2.0, "-2.0f"),
        (0.0, "0.0f"),
        (-0.0, "-0.0f"),
        (1e16, "1e+16f"),
        (np.nan, "NAN"),
        (-np.inf, "-INFINITY"),
        (np.finfo(float).max, "3.4028235e+38f"),  # a bound stays finite
        (-1e300, "-3.4028235e+38f"),
        (1e-290, "1.1754944e-38f"),  # what guards a division stays above zero
        (-1e-300, "-1.1754944e-38f"),
    ],
)
def test_numbers(value, told):
    assert SINGLE.number(value) == told
    rounded = np.float32(float(told.rstrip("f").replace("INFINITY", "inf")))
    if abs(value) < 3e38 and not 0 < abs(value) < 2e-38:
        np.testing.assert_array_equal(rounded, np.float32(value))


def test_a_text_keeps_its_comments_and_words():
    text = "/* 0.5 of DBL_MAX, sec. 5.1 */ typedef double real; a1.5 x = 0.5 + 1e-300 * n[2];"
    told = SINGLE.text(text)
    assert told == (
        "/* 0.5 of DBL_MAX, sec. 5.1 */ typedef float real; a1.5 x = 0.5f + 1.1754944e-38f * n[2];"
    )
    assert DOUBLE.text(text) == text


def test_nothing_is_computed_in_doubles(tmp_path):
    """Not by a literal, a function or a promotion: the compiler would say so."""

    def everything(x, k):
        return (
            jnp.sin(x), jnp.arctan2(x, x[::-1]), x**2.5, jnp.exp(x) * 0.1, jnp.fmod(x, 0.3),
            jnp.round(x), jnp.linalg.qr(jnp.outer(x, x) + jnp.eye(4)), jnp.linalg.eigh(
                jnp.outer(x, x)), jnp.linalg.inv(jnp.outer(x, x) + jnp.eye(4)), jnp.sign(x),
            jnp.where(jnp.isfinite(x), x, 1e300), x.astype(int), k.astype(float), jnp.cbrt(x),
            jnp.nextafter(x, 1.0), jnp.linalg.cholesky(jnp.outer(x, x) + jnp.eye(4)),
        )  # fmt: skip

    for unroll in (None, 0):
        program = trace(everything, np.ones(4), np.int64(3), unroll=unroll)
        text = header(precision=SINGLE) + function(program, precision=SINGLE)
        (tmp_path / "all.c").write_text(text)
        flags = (*STRICT, "-Wunsuffixed-float-constants", "-Wno-unused-function")
        line = ["gcc", "-std=c99", *flags, "-c", "all.c"]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_sine_and_cosine_err_by_a_rounding():
    rng = np.random.default_rng(0)
    both = in_floats(lambda x: (jnp.sin(x), jnp.cos(x)), np.zeros(20), unroll=0)
    for top in (0.8, 10.0, 1e4, 1e6):
        for x in rng.uniform(-top, top, (200, 20)).astype(np.float32):
            want = np.concatenate([np.sin(x.astype(float)), np.cos(x.astype(float))])
            assert np.max(np.abs(both(x) - want)) < 7e-8


@pytest.mark.parametrize("unroll", [None, 0])
@pytest.mark.parametrize("tail", [1.0, 1e-6, 1e-15, 1e-18, 1e-30])
def test_a_triangle_keeps_small_columns(unroll, tail):
    """R' R = A' A, where the squares of a column reach the end of the range, and beyond it."""
    A = np.random.default_rng(1).normal(size=(5, 3))
    A[:, 0] *= tail
    got = in_floats(lambda A: jnp.linalg.qr(A)[1], A, unroll=unroll)(A).reshape(3, 3)
    want = np.linalg.qr(A)[1]
    size = np.sqrt(np.sum(A**2, axis=0))  # a column is what it was, whatever the others are
    off = np.abs(np.abs(got) - np.abs(want)) / size
    if tail > 3e-19:  # the root of the least normal float
        assert np.max(off) < 4e-6
    else:  # the column is taken to have nothing below the diagonal
        np.testing.assert_allclose(
            np.abs(got[1:, 1:].T @ got[1:, 1:]).diagonal().sum(),
            np.sum(A[:, 1:] ** 2) - np.sum(got[0, 1:] ** 2),
            rtol=1e-5,
        )


def test_words_keep_the_bits_of_doubles():
    def step(x):
        from jax.lax import bitcast_convert_type

        bits = bitcast_convert_type(x, jnp.uint64)
        return bitcast_convert_type(bits | jnp.uint64(2**51), jnp.float64)

    # The highest bit of the mantissa is half of the leading one.
    np.testing.assert_array_equal(in_floats(step, np.ones(2))(np.array([1.25, 4.0])), [1.75, 6.0])


def test_zeros_are_those_that_every_step_keeps():
    def one(S, u):
        return S * u, u

    def other(S, u):
        return S.at[0, 1].add(u), u

    def third(S, u):
        return S.T @ S, u

    S = np.array([[1.0, 0.0, 0.0], [2.0, 3.0, 0.0], [0.0, 0.0, 4.0]])

    def kept(*steps):
        programs = trace_steps([(step, (0.5,)) for step in steps], S)
        assert all(np.array_equal(p.zeros[0], programs[0].zeros[0]) for p in programs)
        return programs[0].zeros[0].astype(int).tolist()

    assert kept(one) == (S == 0).astype(int).tolist()
    assert kept(one, other) == [[0, 0, 1], [0, 0, 1], [1, 1, 0]]
    assert kept(other, one) == kept(one, other)
    assert kept(one, third) == [[0, 0, 1], [0, 0, 1], [1, 1, 0]]
