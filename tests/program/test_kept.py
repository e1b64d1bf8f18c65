"""Tapes from the cache: the same bits without writing a program, and never those of another."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from robins.program import CPP, LANE_FLAGS, kept, stages
from robins.program.stages import StagedFunction

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, CPP.names)), reason="the interpreter needs a C++ compiler"
)
X = np.random.default_rng(0).normal(size=(3, 50, 2))
SHAPE = jax.ShapeDtypeStruct((50, 2), float)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own, of programs of any size; no loop is worth a compiler."""
    for name, value in (("WORTH", 0), ("cache_folder", lambda: tmp_path)):
        monkeypatch.setattr(kept, name, value)
    monkeypatch.setattr(stages, "WORTH", 10**9)
    return tmp_path


def function(gain, x, reverse=False):
    """A walk whose cross terms stay zero, and a draw by it."""

    def step(s, row):
        s = jnp.stack([0.9 * s[0] + jnp.sin(row[0]), gain * s[1]])
        return s, jax.random.normal(jax.random.fold_in(jax.random.key(3), 7), (2,)) * s

    return lax.scan(step, jnp.zeros(2), x, reverse=reverse)


def of(gain, reverse=False):
    one = StagedFunction(lambda x: function(gain, x, reverse), SHAPE)
    return jax.tree.leaves(one(X)), one


def never(*_):
    raise AssertionError("a program was written")


def test_nothing_is_kept_of_code_that_changed_since_the_process_began(cache, monkeypatch):
    monkeypatch.setattr(kept, "_BEGAN_S", 0.0)
    kept._code.cache_clear()
    try:
        of(0.5)
        assert not list(cache.glob("*.npz"))
    finally:
        kept._code.cache_clear()


def test_the_second_time_no_program_is_written(cache, monkeypatch):
    want, first = of(0.5)
    files = sorted(cache.iterdir())
    assert files
    monkeypatch.setattr("robins.program.loops.LoopBody.program", never)
    monkeypatch.setattr("robins.program.arrays.ArrayProgram._program", never)
    found, second = of(0.5)
    for a, b in zip(want, found, strict=True):
        np.testing.assert_array_equal(a, b)
    assert sorted(cache.iterdir()) == files
    (a,), (b,) = first.loops, second.loops
    assert a.nodes == b.nodes > 0
    assert [list(mask) for mask in b.rounds.program.zeros.values()] == [[False, True]]


def test_what_is_kept_can_be_compiled(monkeypatch):
    want, _ = of(0.5)
    _, one = of(0.5)
    flags = tuple("-O0" if flag == "-O2" else flag for flag in LANE_FLAGS)
    monkeypatch.setattr("robins.program.lanes.LANE_FLAGS", flags)
    (loop,) = one.loops
    loop.hand_over()
    assert loop.rounds.lanes < 64
    for a, b in zip(want, jax.tree.leaves(one(X)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_another_number_or_direction_is_another_program(cache):
    of(0.5)
    before = len(list(cache.iterdir()))
    want = jax.vmap(lambda x: function(0.25, x)[1])(X)
    np.testing.assert_allclose(of(0.25)[0][1], want, rtol=1e-13)
    between = len(list(cache.iterdir()))
    want = jax.vmap(lambda x: function(0.25, x, True)[1])(X)
    np.testing.assert_allclose(of(0.25, True)[0][1], want, rtol=1e-13)
    assert before < between < len(list(cache.iterdir()))


def test_what_other_packages_made_serves_from_a_wheel_alone(cache, monkeypatch):
    want, _ = of(0.5)
    files = list(cache.iterdir())
    monkeypatch.setattr(kept, "_packages", lambda: "0.0.0")
    written = []
    monkeypatch.setattr(kept, "_write", lambda path, *_: written.append(path.name))
    of(0.5)
    assert len(written) == len(files)
    for file in files:
        file.rename(cache / f"{file.name.partition('.')[0]}.npz")
    monkeypatch.setattr(kept, "IN_WHEEL", cache)
    monkeypatch.setattr("robins.program.loops.LoopBody.program", never)
    for a, b in zip(want, of(0.5)[0], strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("damage", [b"", b"PK nothing", None])
def test_what_is_damaged_is_made_again(cache, damage):
    want, _ = of(0.5)
    for file in cache.iterdir():
        file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    found, _ = of(0.5)
    for a, b in zip(want, found, strict=True):
        np.testing.assert_array_equal(a, b)
    assert kept._read(next(cache.iterdir()))


def test_a_digest_tells_structures_and_numbers_apart():
    def jaxpr(function, *like):
        return jax.make_jaxpr(function)(*like)

    def twice(function):
        inner = jax.jit(function)
        return lambda a: inner(a) * inner(a + 1.0)

    table = np.arange(3.0)
    different = [
        jaxpr(lambda a, b: a + b, 1.0, 2.0),
        jaxpr(lambda a, b: a - b, 1.0, 2.0),
        jaxpr(lambda a, b: b + a, 1.0, 2.0),
        jaxpr(lambda a, b: a + 2.0 * b, 1.0, 2.0),
        jaxpr(lambda a, b: a + 3.0 * b, 1.0, 2.0),
        jaxpr(lambda a, b: a + b, np.ones(2), np.ones(2)),
        jaxpr(lambda a: a + table, np.ones(3)),
        jaxpr(lambda a: a + (table + 1.0), np.ones(3)),
        jaxpr(lambda a: jnp.sum(a, 0), np.ones((2, 2))),
        jaxpr(lambda a: jnp.sum(a, 1), np.ones((2, 2))),
        jaxpr(twice(lambda a: a * 2.0 + 1.0), 1.0),
        jaxpr(twice(lambda a: a * 2.0 - 1.0), 1.0),
        {"a": np.float64(1.0)},
        {"a": 1},
        [np.zeros(2), None],
        [None, np.zeros(2)],
        [np.zeros(2, bool)],
    ]
    digests = [kept.digest([one]) for one in different]
    assert digests == [kept.digest([one]) for one in different]
    assert len(set(digests)) == len(digests)
    named = jaxpr(jax.jit(lambda first, other: first + other), 5.0, 6.0)
    called = jaxpr(jax.jit(lambda a, b: a + b), 1.0, 2.0)
    assert kept.digest([named]) == kept.digest([called])
