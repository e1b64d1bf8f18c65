"""Calls of one form are written from a template: the same nodes as those of a walk."""

import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.program import Graph, Native, calls, interpreted_step, trace, trace_steps
from robins.program.nodes import COMMUTING
from robins.program.walk import JaxprWriter


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
def greater(a, b, c):
    return jnp.maximum(a, b) * jnp.maximum(a, c) - b + a


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
def chosen(a, b, c):
    return jnp.where(c > 0.0, a, jnp.sin(b) * 2.0) + c


@jax.jit
def used(every, fine, inside, x):
    return jnp.where(every & (fine & inside), x, 0.0) + x


@jax.jit
def picked(a, k):
    return a[k] * a[1] + jnp.sum(a)


@jax.jit
def gain(S, H):
    L = jnp.linalg.cholesky(S)
    return jax.scipy.linalg.solve_triangular(L, H, lower=True)


def with_numbers(x):
    return [negated(x[0], x[1]), negated(x[1], x[0]), negated(x[1], 0.0), negated(2.0, x[1])]


def with_negatives(x):
    return [negated(x[0], -x[0]), negated(x[1], -x[1]), negated(x[0], x[1]), negated(-x[2], x[2])]


def with_one_node(x):
    a, b, c = x
    return [greater(a, b, a), greater(b, c, b), greater(a, b, b), greater(a, b, c)]


def with_same(x):
    a = jnp.outer(x, jnp.arange(3.0))
    return [places(a), places(a.at[1, 2].set(x[0])), places(a.T), places(a[::-1]), places(a)]


def with_flags(x):
    on = x > 0.5
    return [flags(x, on), flags(x, ~on), flags(2.0 * x, ~on), flags(-x, on), flags(x, on[::-1])]


def with_finite(x):
    fine = jnp.isfinite(x)
    return [finite(fine, x), finite(jnp.isfinite(x + x), x + x), finite(x > 0, x), finite(fine, -x)]


def made_of_one_another(x):
    """An argument that the first call makes again is not that of the others."""
    first = chosen(jnp.sin(x[1]) * 2.0, x[1], -x[2])
    return [first, chosen(x[0], x[2], -x[1]), chosen(x[1], x[0], -x[2])]


def flags_made_of_one_another(x):
    fine, inside, last = x[0] > 1.0, x[1] > 0.2, x[2] > 0.1
    first = used(fine & inside, fine, inside, x[0])
    return [first, used(last, inside, last, x[1]), used(inside, last, fine, x[2])]


def with_places(x):
    k = jnp.asarray(4.0 * x[0], int)
    long = jnp.concatenate([x, 2.0 * x])
    return [picked(long, k), picked(long[::-1], k), picked(jnp.full(6, x[1]), k)]


def with_matrices(x):
    S = jnp.eye(3) + jnp.outer(x, x)
    return [gain(S, S[:, :1]), gain(jnp.diag(x), S[:, :1]), gain(S + 1.0, S[:, 1:2]), gain(S, S)]


@pytest.mark.parametrize(
    ("function", "templates"),
    [
        (with_numbers, 1),
        (with_negatives, 1),
        (with_one_node, 1),
        (with_same, 1),
        (with_flags, 2),
        (with_finite, 1),
        (with_places, 1),
        (with_matrices, 1),
        (made_of_one_another, 0),
        (flags_made_of_one_another, 0),
    ],
)
def test_what_a_template_writes_has_the_nodes_of_a_walk(function, templates, monkeypatch):
    x, written = np.array([0.3, 0.7, 1.9]), []
    write = calls.write_template
    monkeypatch.setattr(calls, "write_template", lambda *all_: written.append(1) or write(*all_))
    program = trace(function, x)
    assert len(written) >= templates
    for found, wanted in zip(Native(program, interpreted_step)(x), function(x), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-15)
    monkeypatch.setattr(calls, "WORTH", 10**9)
    assert trees(program) == trees(trace(function, x))


def test_graphs_of_earlier_attempts_are_not_held():
    held, graph, other = {}, Graph(), Graph()
    jaxpr = jax.make_jaxpr(lambda x: jnp.sin(x) * jnp.cos(x) + x * x)(1.0).jaxpr
    given = [np.array(graph.input(0, "real"))]
    calls.results_of(held, graph, jaxpr, given, lambda: given)
    gone = weakref.ref(graph)
    calls.drop_templates(held, [graph])
    del graph
    gc.collect()
    assert gone() is not None
    calls.drop_templates(held, [other])
    gc.collect()
    assert gone() is None


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
    written = JaxprWriter._written
    monkeypatch.setattr(JaxprWriter, "_written", lambda *all_: walks.append(1) or written(*all_))

    def step(x, u):
        return jnp.concatenate([u[None], x[:-1]]), negated(u, 3.0)

    (program,) = trace_steps([(step, (np.float64(1.0),))], np.zeros(4))
    assert len(walks) == 5 + 2  # the step in each, the call and the `where` in it once
    assert not program.zeros[0].any()
