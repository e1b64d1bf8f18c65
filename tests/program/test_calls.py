"""Calls that were walked before are copied: the same nodes as those of a walk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.program import calls, trace, trace_steps
from robins.program.nodes import COMMUTING
from robins.program.trace import Walk


def trees(program):
    """Each output as a tree of operations, arguments of commuting ones in an order of their own."""
    graph, text = program.graph, {}
    for node in program.live:
        args = [text[a] for a in graph.args[node]]
        if graph.op[node] in COMMUTING:
            args.sort()
        text[node] = hash((graph.op[node], *args, graph.kind[node], str(graph.value[node])))
    return [[text[n] for n in array.ravel()] for array in program.outputs]


@jax.jit
def negated(a, b):
    return jnp.maximum(-a, b) * a - (-b) / a + jnp.where(a < b, -a, b)


@jax.jit
def places(a):
    return jnp.diagonal(a) + a[0] * a[:, 1] - a.T[1]


@jax.jit
def flags(a, on):
    return jnp.where(jnp.logical_not(on), a, 2.0 * a) + jnp.where(on & on[::-1], a, 0.0)


@jax.jit
def finite(fine, a):
    return jnp.where(jnp.all(fine), a, 0.0) + a * a - jnp.sum(a)


@jax.jit
def gain(S, H):
    L = jnp.linalg.cholesky(S)
    return jax.scipy.linalg.solve_triangular(L, H, lower=True)


def with_numbers(x):
    return [negated(x[0], x[1]), negated(x[1], x[0]), negated(x[1], 0.0), negated(2.0, x[1])]


def with_negatives(x):
    return [negated(x[0], -x[0]), negated(x[1], -x[1]), negated(x[0], x[1]), negated(-x[2], x[2])]


def with_same(x):
    a = jnp.outer(x, jnp.arange(3.0))
    return [places(a), places(a.at[1, 2].set(x[0])), places(a.T), places(a[::-1]), places(a)]


def with_flags(x):
    on = x > 0.5
    return [flags(x, on), flags(x, ~on), flags(2.0 * x, ~on), flags(-x, on), flags(x, on[::-1])]


def with_finite(x):
    fine = jnp.isfinite(x)
    return [finite(fine, x), finite(jnp.isfinite(x + x), x + x), finite(x > 0, x), finite(fine, -x)]


def with_matrices(x):
    S = jnp.eye(3) + jnp.outer(x, x)
    return [gain(S, S[:, :1]), gain(jnp.diag(x), S[:, :1]), gain(S + 1.0, S[:, 1:2]), gain(S, S)]


@pytest.mark.parametrize(
    "function",
    [with_numbers, with_negatives, with_same, with_flags, with_finite, with_matrices],
)
def test_a_copy_has_the_nodes_of_a_walk(function, monkeypatch):
    x, copies = np.array([0.3, 0.7, 1.9]), []
    into = calls.Copy.into
    monkeypatch.setattr(calls.Copy, "into", lambda *all_: copies.append(1) or into(*all_))
    found = trees(trace(function, x))
    assert copies
    monkeypatch.setattr(calls, "WORTH", 10**9)
    assert found == trees(trace(function, x))


def test_a_call_with_a_loop_is_walked_each_time():
    @jax.jit
    def halved(x):
        y = x + 1.0
        z = jax.lax.while_loop(lambda y: y > 1.0, lambda y: y / 2.0, y * y)
        return z - x + 3.0

    program = trace(lambda x: halved(x) + halved(2.0 * x) + halved(3.0 * x), np.float64(5.0))
    assert [program.graph.op[n] for n in program.live].count("loop") == 3


def test_attempts_share_their_calls(monkeypatch):
    """Zeros that a step loses one after another cost an attempt each, no walk through a call."""
    walks = []
    written = Walk._written
    monkeypatch.setattr(Walk, "_written", lambda *all_: walks.append(1) or written(*all_))

    def step(x, u):
        return jnp.concatenate([u[None], x[:-1]]), negated(u, 3.0)

    (program,) = trace_steps([(step, (np.float64(1.0),))], np.zeros(4))
    assert len(walks) == 5 + 2  # the step in each, the call and the `where` in it once
    assert not program.zeros[0].any()
