"""The interpreter: instructions with the bits of compiled C, for one run and for many."""

import inspect
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import quickly
from test_lanes import FOUND, check, flat, in_one_round

from robins.program import (
    CPP,
    BuildError,
    Graph,
    Native,
    Program,
    compiler,
    flags,
    interpreted_step,
    interpreter,
    trace,
)
from robins.program.interpreter import interpreter_of_many, interpreter_of_one
from robins.program.operations import KINDS, OPERATIONS
from robins.program.walk import Leaf

WHOLES = [0, 1, -1, 5, -7, 2**31, -(2**31), 2**40, 1 - 2**62, 3, 12, 63]
GIVEN = {
    "real": [0.0, -0.0, 1.0, -1.5, 0.3, 1e-310, 1e300, np.inf, -np.inf, np.nan, 3e6, 7.5, -2.5],
    "flag": [False, True],
    "whole": WHOLES,
    "word": [n % 2**32 for n in WHOLES],
    "word64": [n % 2**64 for n in WHOLES],
}
# Shifts by more bits than there are, and a modulus that is no power of two, mean nothing in C.
SECOND = {"shift_left": 3, "shift_right": 3, "wrap": 2**15}
SCALARS = {f"{kind}_{op}" for kind, op in itertools.product(KINDS, OPERATIONS)}
pytestmark = pytest.mark.skipif(not FOUND, reason="its bits are those of compiled programs")


def arity(op):
    fold = OPERATIONS[op].fold
    if isinstance(fold, np.ufunc):
        return fold.nin
    given = inspect.signature(fold).parameters.values()
    return sum(one.default is inspect.Parameter.empty for one in given)


def made_by(graph, code, a, b):
    """The node of an instruction on arguments of its kind; None of another instruction."""
    kind, _, op = code.partition("_")
    if "_of_" in code or "_bits_" in code:
        to, how, given = code.split("_")
        return (graph.convert if how == "of" else graph.bits)(a[given], to)
    if op == "select":
        return graph.select(a["flag"], a[kind], b[kind])
    if code not in SCALARS:
        return None
    second = graph.constant(SECOND[op], kind) if op in SECOND else b[kind]
    return graph.apply(op, a[kind], *[second][: arity(op) - 1])


def every_instruction():
    """A program that uses every instruction on scalars once."""
    graph, leaves, counted = Graph(), [], {"real": 0, "other": 0}
    given = {}, {}
    for kind, nodes in itertools.product(KINDS, given):
        pool = "real" if kind == "real" else "other"
        nodes[kind] = graph.input(counted[pool], kind)
        counted[pool] += 1
        leaves.append(Leaf((), np.dtype(KINDS[kind]), kind, kind))
    a, b = given
    made = [made_by(graph, code, a, b) for code in interpreter_of_one().codes]
    product = graph.apply("mul", a["real"], b["real"])
    made += [graph.apply("add", product, a["real"]), graph.apply("sub", b["real"], product)]
    made += [graph.apply("sub", graph.apply("mul", a["real"], a["real"]), b["real"])]
    made = [n for n in made if n is not None]
    results = [Leaf((), np.dtype(KINDS[graph.kind[n]]), graph.kind[n], "") for n in made]
    trees = [jax.tree.structure(tuple(leaf.dtype for leaf in some)) for some in (leaves, results)]
    return Program(graph, leaves, list(map(np.array, made)), results, tuple(trees))


def bits(leaves):
    reals, others = flat(leaves)
    return np.where(np.isnan(reals), 1.5, reals).view(np.int64), others


def test_each_instruction_has_the_bits_of_c():
    rng, program = np.random.default_rng(0), every_instruction()
    cases = [
        tuple(KINDS[k](GIVEN[k][rng.integers(len(GIVEN[k]))]) for k in KINDS for _ in "ab")
        for _ in range(130)
    ]
    compiled, one = Native(program, quickly), Native(program, interpreted_step)
    # in rows of 8, of 32 and of 64
    batches = [in_one_round(program, cases[:few]) for few in (10, 20, 130)]
    for k, case in enumerate(cases):
        want = bits(compiled(*case))
        for got in (
            one(*case),
            *([a[k, 0] for a in many] for many in batches[(k >= 10) + (k >= 20) :]),
        ):
            for x, y in zip(bits(got), want, strict=True):
                np.testing.assert_array_equal(x, y)


def test_zeros_keep_their_signs():
    program = trace(lambda x: (jnp.arctan2(0.0, x), jnp.arctan2(-0.0, x)), np.float64(1.0))
    for found in (Native(program, interpreted_step)(-2.0), in_one_round(program, [(-2.0,)] * 8)):
        assert [float(np.ravel(a)[0]) for a in found] == [np.pi, -np.pi]


def test_every_operation_is_an_instruction():
    codes = interpreter_of_one().codes
    assert codes == interpreter_of_many().codes
    assert {op for op in OPERATIONS if not any(f"{kind}_{op}" in codes for kind in KINDS)} == set()


def loops(x, k):
    """Loops in loops, rounds that end by numbers, rows that are kept, arrays with an index."""

    def inner(total, row):
        found = jax.lax.while_loop(
            lambda s: s[0] < 50.0, lambda s: jnp.abs(s) * 1.3 + 1.0 + row, total
        )
        return found - row[0], (found, jnp.sum(found) > k.astype(float))

    def outer(carry, row):
        last, kept = jax.lax.scan(inner, carry[0] + 1.0, jnp.outer(row, x))
        return (last[::-1], carry[0]), (kept[0][0], row * x[k % 3])

    return jax.lax.scan(outer, (x, 2.0 * x), jnp.arange(12.0).reshape(4, 3), reverse=True)


@pytest.mark.parametrize(("unroll", "runs"), [(0, 8), (500, 32)])
def test_loops(unroll, runs):
    rng = np.random.default_rng(1)
    check(loops, [(rng.uniform(1.0, 9.0, 3), np.int64(k)) for k in range(runs)], unroll)


def test_without_a_compiler_to_build_it_with_it_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(interpreter, "_loaded", interpreter._loaded.__wrapped__)  # forgets none
    with pytest.raises(BuildError, match="install one"):
        interpreter_of_one()


def test_a_wheel_carries_what_is_compiled_else(tmp_path, monkeypatch):
    quick = tuple("-O0" if flag == "-O2" else flag for flag in flags.INTERPRETER_FLAGS)
    monkeypatch.setattr(flags, "INTERPRETER_FLAGS", quick)
    (tmp_path / "built").mkdir()
    made = flags.compile_interpreters(compiler(CPP), tmp_path / "built")
    kind = str(interpreter_of_one().library.robins_generation())
    assert {one.stem for one in made} >= {flags.ONE, kind}
    monkeypatch.setattr(interpreter, "files", lambda room: tmp_path)
    for of, width in ((flags.ONE, 1), (kind, interpreter_of_many().width)):
        found = interpreter._loaded.__wrapped__(of)
        assert found.library._name == str(tmp_path / "built" / f"{of}.so")
        assert found.width == width
        assert found.codes == interpreter_of_one().codes
