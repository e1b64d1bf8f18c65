"""Functions computed without a compiler."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.program.evaluated import evaluated
from robins.rotation import Rotation

RNG = np.random.default_rng(0)
C = np.linalg.qr(RNG.normal(size=(3, 3)))[0]


def parts(x, n):
    return {
        "sum": jnp.sum(jnp.sin(x) / (1.0 + x * x)),
        "flags": x[::-1] > 0.5,
        "twice": (2 * n, None),
    }


def values(x, n):
    return jnp.linalg.eigh(x @ x.T)[0], n


def by_numpy(x, n):
    return jnp.asarray(np.linalg.norm(np.asarray(x)) + n)


def many(x, n):
    return jnp.sum(jnp.sin(jnp.outer(x, jnp.arange(1e4)))), n


@pytest.mark.parametrize("function", [parts, values, by_numpy, many])
def test_it_gives_what_jax_gives(function):
    x, n = RNG.normal(size=(3, 3)), np.int32(7)
    want, got = function(jnp.asarray(x), n), evaluated(function, x, n)
    assert jax.tree.structure(want) == jax.tree.structure(got)
    for a, b in zip(jax.tree.leaves(want), jax.tree.leaves(got), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-14)


def test_where_jax_traces_it_is_traced():
    found = jax.jit(lambda c: evaluated(Rotation.from_dcm, c).wxyz)(jnp.asarray(C))
    np.testing.assert_allclose(found, evaluated(Rotation.from_dcm, C).wxyz, atol=1e-15)


def test_nothing_is_compiled():
    compiled, ended = [], []

    def heard(event, duration, **about):
        if event.endswith("backend_compile_duration") and not ended:
            compiled.append(about)

    jax.monitoring.register_event_duration_secs_listener(heard)
    x = RNG.normal(size=(7, 11))  # a shape of which no other test has arrays
    found = evaluated(lambda x: jnp.hypot(jnp.tan(x[:5]), x[2:]) @ x.T, x)
    assert compiled == []
    want = jnp.hypot(jnp.tan(x[:5]), x[2:]) @ x.T
    assert compiled
    np.testing.assert_allclose(found, want, rtol=1e-14)
    ended.append(True)  # JAX keeps its listeners


def test_what_the_function_holds_may_be_traced():
    found = jax.jit(lambda t: evaluated(lambda x: x * t, np.ones(3)))(2.0)
    np.testing.assert_array_equal(found, 2.0 * np.ones(3))
