"""Random numbers in C: the bits of JAX, and normal numbers within three units of the last place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.random import threefry_2x32
from machines import in_c, quickly, same_in_c
from test_lanes import FOUND, check

from robins.program import Native, ProgramError, trace, trace_step
from robins.sim.random import stream

RAW = np.array([7, 4_000_000_000], np.uint32)


def units_apart(got, want):
    """The largest difference in units of the last place; NaN and infinities must be the same."""
    got, want = np.asarray(got), np.asarray(want)
    np.testing.assert_array_equal(np.isfinite(got), np.isfinite(want))
    some = np.isfinite(want)
    np.testing.assert_array_equal(got[~some], want[~some])
    return np.max(np.abs(got[some] - want[some]) / np.spacing(np.abs(want[some])), initial=0.0)


def drawn(key, seed, number):
    """All that a key is good for, as numbers."""
    one, other = jax.random.split(jax.random.fold_in(key, number))
    some = jax.random.split(other, (2, 3))
    return {
        "bits": [jax.random.bits(one, (3, 2), dtype) for dtype in (jnp.uint32, jnp.uint64)],
        "uniform": (jax.random.uniform(one, (5,)), jax.random.uniform(other, minval=-2.0)),
        "seeds": jax.random.key_data(jax.random.key(seed)),
        "keys": jax.random.key_data(some),
        "in a batch": jax.vmap(jax.vmap(jax.random.uniform))(some),
        "whole": jax.random.randint(other, (4,), -5, 100),
        "flags": jax.random.bernoulli(one, 0.3, (4,)),
        "order": jax.random.permutation(other, 5),
        "known": jax.random.key_data(jax.random.split(jax.random.key(7))[1]),
        "stream": jax.random.uniform(stream(2**40 + 3, number, 5), (2,)),
    }


def with_words(words, seed, number):
    """The same of the two words of a key."""
    return drawn(jax.random.wrap_key_data(words, impl="threefry2x32"), seed, number)


@pytest.mark.parametrize("seed", [np.int64(-(2**40) - 3), np.int32(-5), np.uint32(2**31 + 1)])
@pytest.mark.parametrize("unroll", [None, 0])
def test_bits_are_those_of_jax(seed, unroll):
    same_in_c(with_words, RAW, seed, np.int64(2**32 + 3), unroll=unroll)


@pytest.mark.skipif(not FOUND, reason="lanes need a C++ compiler")
def test_bits_are_those_of_jax_in_lanes():
    cases = [(RAW + np.uint32(k), np.int64(3 * k - 9), np.int64(k)) for k in range(8)]
    check(lambda *args: (with_words(*args), lax.erf_inv(args[1].astype(float) / 13.0)), cases)


def test_the_generator_itself():
    same_in_c(threefry_2x32, RAW, np.arange(6, dtype=np.uint32))
    folded = np.asarray(threefry_2x32(RAW, np.arange(6, dtype=np.uint32)))
    known = in_c(lambda: threefry_2x32(jnp.asarray(RAW), jnp.arange(6, dtype=jnp.uint32)))
    np.testing.assert_array_equal(known(), folded)


def test_keys_are_taken_and_given_as_keys():
    def step(state, number):
        key, total = state
        key, now = jax.random.split(jax.random.fold_in(key, number))
        return (key, total + jax.random.uniform(now)), now

    state = (jax.random.split(jax.random.key(3), 2)[1], 0.0)
    program = trace_step(step, state, 0)
    one, by_jax, in_c_ = Native(program, quickly), state, state
    for number in range(5):
        by_jax, want = jax.jit(step)(by_jax, number)
        in_c_, got = one(in_c_, number)
        assert got.dtype == want.dtype
        assert jax.random.key_data(got).tolist() == jax.random.key_data(want).tolist()
    assert jax.random.key_data(in_c_[0]).tolist() == jax.random.key_data(by_jax[0]).tolist()
    assert in_c_[1] == by_jax[1]


COUNT = 4000
RNG = np.random.default_rng(0)
MIDDLE = RNG.uniform(-1.0, 1.0, COUNT)
SMALL = RNG.choice([-1, 1], COUNT) * 10.0 ** RNG.uniform(-300, 0, COUNT)
TAILS = RNG.choice([-1, 1], COUNT) * (1 - 10.0 ** RNG.uniform(-16, -0.5, COUNT))
ODD = np.resize([0.0, -0.0, 1.0, -1.0, np.nan, 1.5, -1.5, np.inf, -np.inf, 1e-300], COUNT)
SWITCH = np.sqrt(np.sqrt(2.0) - 1) + np.arange(-COUNT // 2, COUNT // 2) * 1e-9


def test_the_inverse_of_the_error_function_is_that_of_jax():
    one, by_jax = in_c(lax.erf_inv, MIDDLE, unroll=0), jax.jit(lax.erf_inv)
    for x in (MIDDLE, SMALL, TAILS, ODD, SWITCH):
        assert units_apart(one(x), by_jax(x)) <= 2


def test_normal_numbers_are_those_of_jax():
    def normal(words):
        return jax.random.normal(jax.random.wrap_key_data(words, impl="threefry2x32"), (400,))

    one, by_jax = in_c(normal, RAW, unroll=0), jax.jit(normal)
    for k in range(30):
        words = RAW + np.uint32(k)
        assert units_apart(one(words), by_jax(words)) <= 3  # two, times the root of two


def test_other_generators_are_refused():
    with pytest.raises(ProgramError, match=r"arguments\[0\]: keys of type key<rbg>"):
        trace(jax.random.uniform, jax.random.key(0, impl="rbg"))
    with pytest.raises(ProgramError, match=r"keys of type key<rbg>"):
        trace(lambda seed: jax.random.uniform(jax.random.key(seed, impl="rbg")), 3)
    with jax.threefry_partitionable(False), pytest.raises(ProgramError, match="older scheme"):
        trace(jax.random.uniform, jax.random.key(0))
