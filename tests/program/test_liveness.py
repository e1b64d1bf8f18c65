"""Bytes of values by their last uses, against counts by hand."""

import jax
import jax.numpy as jnp

from robins.program.liveness import StageMemory, bytes_of_jaxpr, last_uses, most_bytes
from robins.program.stages import as_jaxpr

ROW = jax.ShapeDtypeStruct((1000,), float)  # 8000 bytes


def chain(x):
    y = jnp.sin(x)
    z = jnp.cos(y)  # y is no longer needed
    return jnp.sum(z)


def test_a_value_is_dropped_after_its_last_use():
    flat = as_jaxpr(chain, ROW)[0].jaxpr
    stages = [StageMemory(e.invars, e.outvars) for e in flat.eqns]
    y, z = (e.outvars[0] for e in flat.eqns[:2])
    dropped = last_uses(stages, {*flat.invars, *flat.outvars})
    assert dropped == [[], [y], [z]]
    assert most_bytes(stages, flat.invars, flat.outvars) == 3 * 8000  # x, y and z
    assert most_bytes(stages, flat.invars, [y, *flat.outvars]) == 3 * 8000 + 8  # y stays


def test_what_nothing_needs_is_dropped_where_it_is_made():
    flat = as_jaxpr(lambda x: (jnp.sin(x), jnp.cos(x)), ROW)[0].jaxpr
    stages = [StageMemory(e.invars, e.outvars) for e in flat.eqns]
    sine, cosine = flat.outvars
    assert last_uses(stages, {cosine}) == [[sine], [*flat.invars]]
    assert most_bytes(stages, flat.invars, [cosine]) == 2 * 8000  # x and one of both


def test_calls_and_keys_are_counted():
    inner = jax.jit(lambda x: jnp.sum(chain(2.0 * x) * x))
    made = jax.make_jaxpr(lambda x: inner(x) + 1.0)(ROW)
    # within the call: x, 2 x, its sine, the cosine of that; never more than three rows at once
    assert bytes_of_jaxpr(made.jaxpr) == 3 * 8000
    keys = jax.make_jaxpr(lambda k: jax.random.fold_in(k, 1))(jax.random.key(0))
    assert 16 <= bytes_of_jaxpr(keys.jaxpr) <= 64
