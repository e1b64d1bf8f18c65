"""Templates of jaxprs that were walked before, for further calls of the same form.

A jaxpr is walked once for each row of a batch, each sigma point, each hypothesis of a bank, and in
each attempt of `robins.program.trace.with_preserved_zeros`. What a walk writes depends on the form
of its arguments: which numbers are known, which nodes are the same, and what is negated or tested
to be finite. It may also depend on how arguments are computed from one another: if one is the sine
of another, and the jaxpr takes that sine too, both are one node. Such a call is not a template for
others.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np
from jax.extend import core as jex

from robins.program.nodes import ALIKE, Graph, Node

Nodes = np.ndarray

SEEN_THROUGH = {"neg", "not", "is_finite"}  # rules and folding look at the arguments of these
OWN = {"input", "leaf", "loop", "after"}  # of one graph: a call with these is not copied
WORTH = 4  # fewest equations of a jaxpr that is looked up

# A call as it was written: the graph, its arguments and its results.
Call = tuple[Graph, list[Node], list[Nodes]]
# Operation, kind, value and arguments of each node that is written, and results; a number counts
# the arguments of the call, then the nodes.
Template = tuple[list[tuple[str, str, Any, tuple[int, ...]]], list[np.ndarray]]
# By jaxpr and form, all with the same `unroll`; None of calls that are walked each time.
Calls = dict[Hashable, Call | Template | None]


def template_of(call: Call) -> Template | None:
    """Template of a call; None if it contains a loop or nodes of its own graph."""
    graph, given, outputs = call
    place = {n: k for k, n in enumerate(given)}
    ahead = [n for a in outputs for n in a.ravel().tolist()]
    seen = set(place)
    while ahead:
        node = ahead.pop()
        if node not in seen:
            if graph.op[node] in OWN:
                return None
            seen.add(node)
            ahead += graph.args[node]
    steps = []
    for node in sorted(seen.difference(place)):
        places = tuple([place[a] for a in graph.args[node]])
        steps.append((graph.op[node], graph.kind[node], graph.value[node], places))
        place[node] = len(place)
    shaped = [np.array([place[n] for n in a.flat], np.int64).reshape(a.shape) for a in outputs]
    return steps, shaped


def write_template(template: Template, graph: Graph, given: Sequence[Node]) -> list[Nodes]:
    """Results of a call with other arguments, written into a graph."""
    steps, outputs = template
    nodes = list(given)
    for op, kind, value, places in steps:
        args = tuple([nodes[k] for k in places])
        if op == "constant":
            node = graph.constant(value, kind)
        elif op == "select":
            node = graph.select(*args)
        elif op in ALIKE:
            node = graph.apply(op, *args)
        elif op == "pick":
            node = graph.pick(graph.args[args[0]], args[1])
        else:
            node = graph.ordered(op, args, kind, value)
        nodes.append(node)
    found = np.array(nodes, np.int64)
    return [np.asarray(found[a]) for a in outputs]


def results_of(
    calls: Calls,
    graph: Graph,
    jaxpr: jex.Jaxpr,
    args: Sequence[Nodes],
    write: Callable[[], list[Nodes]],
) -> list[Nodes]:
    """Results of a jaxpr on arrays of nodes, from a template where there is one.

    Args:
        calls: calls and templates so far.
        graph: into which it is written.
        jaxpr: of the call.
        args: arrays of nodes.
        write: walks through the jaxpr, where there is no template.
    """
    if len(jaxpr.eqns) < WORTH:
        return write()
    form, given = _form(graph, args)
    key = jaxpr, form  # a jaxpr equals itself alone
    is_known, found = key in calls, calls.get(key)
    if found is not None and len(found) == 3:
        found = calls[key] = template_of(found)
    if found is not None:
        return write_template(found, graph, given)
    met, outputs = len(graph.met), write()
    if not is_known:
        made = [n for n in given if graph.op[n] not in SEEN_THROUGH]
        is_free = set(made).isdisjoint(graph.met[met:])
        calls[key] = (graph, given, outputs) if is_free else None
    return outputs


def drop_templates(calls: Calls, graphs: Sequence[Graph]) -> None:
    """Drop the calls that hold other graphs than these."""
    for key, found in list(calls.items()):
        if found is not None and len(found) == 3 and all(found[0] is not g for g in graphs):
            del calls[key]


def _form(graph: Graph, args: Sequence[Nodes]) -> tuple[Hashable, list[Node]]:
    """Form of some arguments, and the nodes among them that are not known numbers."""
    place: dict[Node, int] = {}
    form: list[Hashable] = [a.shape for a in args]
    ahead = [n for a in args for n in a.ravel().tolist()]
    while ahead:
        inner: list[Node] = []
        for node in ahead:
            literal = graph.literal[node]
            if literal is None and node not in place:
                place[node] = len(place)
                if (op := graph.op[node]) in SEEN_THROUGH:
                    form.append(op)
                    inner += graph.args[node]
            form.append(place[node] if literal is None else literal)
        ahead = inner
    return (tuple(form), tuple([graph.kind[n] for n in place])), list(place)
