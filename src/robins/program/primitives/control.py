"""Primitives that contain jaxprs: calls, branches and loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend import core as jex

from robins.program.kinds import Equation
from robins.program.nodes import Node
from robins.program.primitives.reductions import fold
from robins.program.walk import JaxprWriter, Nodes, flat, rule, shaped

LONGEST = 100_000  # most rounds of a loop that are written out


CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"}


def called(equation: Equation) -> jex.ClosedJaxpr | None:
    """The closed jaxpr that an equation calls, if it is a plain call."""
    if equation.primitive.name not in CALLS:
        return None
    p = equation.params
    inner = next((p[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in p), None)
    return inner if hasattr(inner, "consts") else None


@rule("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat")
@rule("checkpoint", "custom_vjp_call_jaxpr", "custom_vmap_call", "custom_lin", "remat2")
def _call(walk: JaxprWriter, equation: Equation, *args: Nodes) -> list[Nodes]:
    """Inline the function that is called."""
    p = equation.params
    inner = next(p[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call") if k in p)
    return walk.closed(inner, *args) if hasattr(inner, "consts") else walk.open(inner, (), args)


@rule("custom_linear_solve")
def _linear_solve(walk: JaxprWriter, equation: Equation, *args: Nodes) -> list[Nodes]:
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    begin = lengths.matvec + lengths.vecmat
    consts = args[begin : begin + lengths.solve]
    return walk.closed(jaxprs.solve, *consts, *args[sum(lengths) :])


@rule("platform_index")
def _platform(walk: JaxprWriter, equation: Equation) -> Nodes:
    """Index of the branch for CPUs, of a function written for several platforms."""
    platforms = equation.params["platforms"]
    default = next((k for k, names in enumerate(platforms) if names is None), len(platforms) - 1)
    mine = (k for k, names in enumerate(platforms) if names is not None and "cpu" in names)
    return walk.constants(np.int32(next(mine, default)))


@rule("cond")
def _cond(walk: JaxprWriter, equation: Equation, index: Nodes, *args: Nodes) -> list[Nodes]:
    """Conditional: the branch of a known index; else all, and a choice of their results."""
    branches, graph = equation.params["branches"], walk.graph
    last = len(branches) - 1
    which: Node = index.item()
    if (value := graph.known(which)) is not None:
        return walk.closed(branches[min(max(int(value), 0), last)], *args)
    results = [walk.closed(branch, *args) for branch in branches]
    if graph.kind[which] == "flag":
        return [walk.select(index, new, old) for old, new in zip(*results, strict=True)]
    which = graph.apply("max", which, graph.constant(0, "whole"))
    which = graph.apply("min", which, graph.constant(last, "whole"))
    return [
        walk.each(lambda *nodes: graph.pick(nodes, which), *cases)
        for cases in zip(*results, strict=True)
    ]


def _converted(walk: JaxprWriter, arrays: list[Nodes], like: list[Nodes]) -> list[Nodes]:
    """Carried arrays after a round, converted to the kinds before it."""
    graph = walk.graph
    return [
        walk.each(lambda n, old: graph.convert(n, graph.kind[old]), a, b) if a.size else a
        for a, b in zip(arrays, like, strict=True)
    ]


@rule("scan")
def _scan(walk: JaxprWriter, equation: Equation, *args: Nodes) -> list[Nodes]:
    p = equation.params
    fixed, carried = p["num_consts"], p["num_carry"]
    consts, carry, rows = args[:fixed], list(args[fixed:][:carried]), args[fixed + carried :]
    order = range(p["length"])
    return _rounds(walk, p["jaxpr"], order[::-1] if p["reverse"] else order, consts, carry, rows)


@rule("each_row")
def _each_row(walk: JaxprWriter, equation: Equation, *args: Nodes) -> list[Nodes]:
    """A scan that carries nothing (`robins.linalg.rows`)."""
    p = equation.params
    shared, order = p["shared"], range(p["count"])
    return _rounds(walk, p["jaxpr"], order, args[:shared], [], args[shared:])


def _rounds(
    walk: JaxprWriter,
    body: jex.ClosedJaxpr,
    order: range,
    consts: Sequence[Nodes],
    carry: list[Nodes],
    rows: Sequence[Nodes],
) -> list[Nodes]:
    """Final carry of a body applied to each row, and arrays of the rows that it makes."""
    if len(order) > 1 and walk.stays_whole(len(order) * size_of(body.jaxpr)):
        return _rolled(walk, body, order, consts, carry, rows)
    kept: dict[int, list[Nodes]] = {}
    carried = len(carry)
    for k in order:
        found = walk.closed(body, *consts, *carry, *(np.asarray(row[k]) for row in rows))
        carry, kept[k] = found[:carried], found[carried:]
    if not kept:
        none = [np.zeros((0, *v.shape), dtype=np.int64) for v in body.out_avals[carried:]]
        return [*carry, *none]
    return [*carry, *map(np.stack, zip(*(kept[k] for k in sorted(kept)), strict=True))]


def _rolled(
    walk: JaxprWriter,
    body: jex.ClosedJaxpr,
    order: range,
    consts: Sequence[Nodes],
    carry: list[Nodes],
    rows: Sequence[Nodes],
) -> list[Nodes]:
    """A loop of C; the rows of its inputs are arrays, of which each round picks one."""
    graph, length = walk.graph, len(order)
    loop = graph.open(flat(carry), length)

    def row(a: Nodes) -> Nodes:
        columns = map(np.asarray, a[:: order.step])
        return walk.each(lambda *nodes: graph.pick(nodes, loop.index), *columns)

    now = shaped(loop.leaves, [a.shape for a in carry])
    found = walk.closed(body, *consts, *now, *map(row, rows))
    new, kept = found[: len(carry)], found[len(carry) :]
    loop.next, loop.kept = flat(_converted(walk, new, now)), flat(kept)
    loop.sizes = [a.size for a in kept]
    after, rounds = graph.close(loop)
    out, at = shaped(after, [a.shape for a in carry]), 0
    for a in kept:
        columns = np.array(rounds[at : at + a.size], dtype=np.int64).reshape(a.size, length)
        out.append(columns.T.reshape(length, *a.shape)[:: order.step])
        at += a.size
    return out


@rule("while")
def _while(walk: JaxprWriter, equation: Equation, *args: Nodes) -> list[Nodes]:
    """Write out a loop that is known to end soon; else write a loop of C.

    In a batch each member goes on for as long as its own condition holds.
    """
    p, graph = equation.params, walk.graph
    cond_consts = args[: p["cond_nconsts"]]
    body_consts = args[p["cond_nconsts"] :][: p["body_nconsts"]]
    begin = list(args[p["cond_nconsts"] + p["body_nconsts"] :])
    written, carry = 0, begin

    def round_of(going: Nodes, now: list[Nodes]) -> list[Nodes]:
        new = _converted(walk, walk.closed(p["body_jaxpr"], *body_consts, *now), now)
        if going.ndim == 0:
            return new
        wide = [
            np.broadcast_to(going.reshape(going.shape + (1,) * (a.ndim - going.ndim)), a.shape)
            for a in now
        ]
        return [walk.select(*each) for each in zip(wide, new, now, strict=True)]

    for _ in range(LONGEST):
        going = walk.closed(p["cond_jaxpr"], *cond_consts, *carry)[0]
        known = walk.known(going)
        if known is None or walk.stays_whole(written):
            break
        if not np.any(known):
            return carry
        carry = round_of(going, carry)
        written += size_of(p["body_jaxpr"].jaxpr)
    loop = graph.open(flat(begin), None)
    now = shaped(loop.leaves, [a.shape for a in begin])
    going = walk.closed(p["cond_jaxpr"], *cond_consts, *now)[0]
    loop.condition = fold(walk, "or", False, going, tuple(range(going.ndim)), "flag").item()
    loop.next = flat(round_of(going, now))
    return shaped(graph.close(loop)[0], [a.shape for a in begin])


FREE = {
    *("broadcast_in_dim", "reshape", "transpose", "squeeze", "slice", "concatenate", "stack"),
    *("split", "rev", "iota", "pad", "tile", "stop_gradient", "expand_dims", "gather", "copy"),
    *("unstack", "name"),
}


def size_of(jaxpr: Any) -> int:
    """Approximate number of scalar operations of a jaxpr, before anything is folded."""
    total = 0
    for equation in jaxpr.eqns:
        name, p = equation.primitive.name, equation.params
        inner = [
            getattr(x, "jaxpr", x)
            for value in p.values()
            for x in (value if isinstance(value, (tuple, list)) else [value])
            if hasattr(getattr(x, "jaxpr", x), "eqns")
        ]
        if inner:
            total += p.get("length", p.get("count", 1)) * sum(map(size_of, inner))
        elif name == "dot_general":
            ((axes, _), _) = p["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            depth = int(np.prod([shape[k] for k in axes]))
            total += 2 * depth * equation.outvars[0].aval.size
        elif name.startswith(("reduce", "cum", "arg")):
            total += equation.invars[0].aval.size
        elif name in ("qr", "cholesky", "triangular_solve", "lu", "eigh"):
            shape = equation.invars[0].aval.shape
            total += 2 * int(np.prod(shape)) * shape[-1]
        elif name not in FREE:
            total += sum(v.aval.size for v in equation.outvars)
    return total
