"""Arrays that routines and loops of C read in place, and those copied for them."""

import re
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import apart, quickly

from robins import linalg
from robins.program import Native, compiler, function, interpreted_step, to_c, trace

N, ROUNDS = 5, 6
A = np.random.default_rng(0).normal(size=(ROUNDS, N, N))


def rows_of(scale):
    """Rows (ROUNDS, N, N) of a loop, upper triangles known to be zero."""
    return jax.lax.map(lambda a: jnp.tril(scale * a @ a), jnp.asarray(A))


def factor(rows):
    return linalg.tria(rows.reshape(-1, N).T)


def all_of_it(x):
    return factor(rows_of(x[0]))


def read_elsewhere(x):
    rows = rows_of(x[0])
    return factor(rows), rows[1:3] * x[1]


def a_result(x):
    rows = rows_of(x[0])
    return factor(rows), rows


def in_each_round(x):
    """Factors of each row, in a loop that is in another one."""
    rows = jax.lax.map(lambda a: x[0] * a @ a, jnp.asarray(A))

    def outer(total, a):
        return jax.lax.scan(lambda s, row: (s * a + linalg.tria(row.T), None), total, rows)[0], None

    return jax.lax.scan(outer, jnp.zeros((N, N)), jnp.linspace(0.5, 0.9, 3))[0]


def of_two_operands(x):
    """Products of what lies in one array, and of what is scattered, with known zeros in it."""
    one, other = rows_of(x[0])[0], jnp.diag(x[0] + jnp.arange(5.0))
    L = factor(rows_of(x[1]))
    solved = jax.scipy.linalg.solve_triangular(L, one, lower=True)
    return L @ one, L @ L.T, one @ other, L @ jnp.cos(L).T, solved


def picked_in_loops(x):
    """Rows of rows, picked by the rounds of two loops, and by a number that is computed."""
    rows = jax.lax.map(lambda a: jnp.sin(a) * x, jnp.asarray(A[:, 0, :2].ravel()))
    pairs = rows.reshape(4, 3, -1)

    def outer(total, block):
        def inner(total, row):
            return total * 0.9 + row * x[::-1], jnp.sum(row)

        total, sums = jax.lax.scan(inner, total, block, reverse=True)
        where = jnp.clip(jnp.asarray(10.0 * sums[0], int), 0, 2)
        return total, (sums, block[where])

    return jax.lax.scan(outer, x, pairs)


CASES = all_of_it, read_elsewhere, a_result, in_each_round, of_two_operands, picked_in_loops
X = jnp.array([0.7, 1.3])
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")


def all_cases(x):
    """Results of all cases, each for numbers of its own, so that they share nothing."""
    return {case.__name__: case(x + 0.1 * k) for k, case in enumerate(CASES)}


@pytest.fixture(scope="module")
def found():
    program = trace(all_cases, X, unroll=20)
    return {
        "jax": jax.jit(all_cases)(X),
        "c": Native(program, quickly)(X),
        "interpreter": Native(program, interpreted_step)(X),
    }


@pytest.mark.parametrize("case", CASES, ids=lambda f: f.__name__)
def test_c_and_the_interpreter_give_what_jax_gives(case, found):
    leaves = (jax.tree.leaves(found[by][case.__name__]) for by in ("jax", "c", "interpreter"))
    for want, compiled, interpreted in zip(*leaves, strict=True):
        assert apart(want, compiled) < 1e-13
        assert compiled.tobytes() == interpreted.tobytes()


def test_a_compiler_has_nothing_to_say(tmp_path):
    source = tmp_path / "step.c"
    source.write_text(to_c(trace(all_cases, X, unroll=20)))
    strictly = [*compiler(), *STRICT, "-fsyntax-only", str(source)]
    assert subprocess.run(strictly, capture_output=True, text=True).stderr == ""


LEAST = ROUNDS * N * N  # numbers of all rows


def copied(case):
    """Number of copied numbers for each factorisation of rows."""
    text = function(trace(case, X, unroll=20))
    found = map(int, re.findall(r"real in\d+_\d\[(\d+)\] = ", text))
    return [n for n in found if n >= LEAST]


def test_a_factorisation_takes_the_rows_of_a_loop_as_they_lie():
    assert copied(all_of_it) == []
    assert "triangle(30, 5, 5, k1_0, " in function(trace(all_of_it, X, unroll=20))
    assert copied(read_elsewhere) == [LEAST]  # in place it would change what is read
    assert copied(a_result) == [LEAST]


def test_rows_of_two_loops_are_read_in_place():
    text = function(trace(picked_in_loops, X, unroll=20))
    assert "k1_0[4 + 6 * n2 - 2 * n3]" in text
    # the only array that is copied is of numbers that are known
    assert re.findall(r"const real a\d+\[(\d+)\]", text) == ["12"]
