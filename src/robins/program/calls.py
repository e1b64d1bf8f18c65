"""Jaxprs that were walked before: calls of one form are written from a template.

A jaxpr is walked once for each row of a batch, each sigma point, each hypothesis of a bank, and in
each attempt of `robins.program.trace.lasting`. What a walk writes depends on the form of its
arguments: which numbers are known, which nodes are the same, and what is negated or tested to be
finite. It may also depend on how arguments are made of one another: one that is the sine of another
is the node of a sine that the jaxpr takes itself. A call that met an argument in that way is no
template for others.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robins.program.nodes import ALIKE, Graph, Node

Nodes = np.ndarray

SEEN_THROUGH = {"neg", "not", "is_finite"}  # rules and folding look at the arguments of these
OWN = {"input", "leaf", "loop", "after"}  # of one graph: such a call is not copied
WORTH = 4  # equations of a jaxpr that is looked up


@dataclass(frozen=True)
class Template:
    """What calls of one form write; a place counts the arguments of the call, then the steps.

    Attributes:
        steps: operation, kind, value and places of the arguments of each.
        outputs: places, in the shapes of the results.
        alike: rows of places which may be computed in loops.
    """

    steps: list[tuple[str, str, Any, tuple[int, ...]]]
    outputs: list[np.ndarray]
    alike: list[tuple[int, ...]]

    def into(self, graph: Graph, given: Sequence[Node]) -> tuple[list[Nodes], list[tuple]]:
        """Results and rows of a call with other arguments, written into a graph."""
        nodes = list(given)
        for op, kind, value, places in self.steps:
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
        outputs = [np.asarray(found[a]) for a in self.outputs]
        return outputs, [tuple([nodes[k] for k in row]) for row in self.alike]


@dataclass(frozen=True)
class Call:
    """A call as it was written into a graph."""

    graph: Graph
    given: list[Node]
    outputs: list[Nodes]
    alike: list[tuple[Node, ...]]

    def template(self) -> Template | None:
        """What is needed to write it again; None if it contains a loop."""
        graph, place = self.graph, {n: k for k, n in enumerate(self.given)}
        ahead = [n for a in self.outputs for n in a.ravel().tolist()]
        ahead += [n for row in self.alike for n in row]
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
        outputs = [
            np.array([place[n] for n in a.flat], np.int64).reshape(a.shape) for a in self.outputs
        ]
        return Template(steps, outputs, [tuple([place[n] for n in row]) for row in self.alike])


class Calls:
    """Calls so far, by jaxpr and by the form of their arguments; all with the same `unroll`."""

    def __init__(self) -> None:
        self._found: dict[Hashable, Call | Template | None] = {}
        self._held: dict[int, Any] = {}  # a jaxpr that is gone could leave its id to another one

    def results(
        self,
        graph: Graph,
        jaxpr: Any,
        args: Sequence[Nodes],
        alike: list[tuple[Node, ...]],
        write: Callable[[], list[Nodes]],
    ) -> list[Nodes]:
        """Results of a jaxpr on arrays of nodes, from a template where there is one.

        Args:
            graph: into which it is written.
            jaxpr: of the call.
            args: arrays of nodes.
            alike: rows which may be computed in loops, to which those of the call are added.
            write: walks through the jaxpr.
        """
        if len(jaxpr.eqns) < WORTH:
            return write()
        form, given = _form(graph, args)
        key = id(jaxpr), form
        self._held[id(jaxpr)] = jaxpr
        found = self._found.get(key, self)
        if isinstance(found, Call):
            found = self._found[key] = found.template()
        if isinstance(found, Template):
            outputs, rows = found.into(graph, given)
            alike += rows
            return outputs
        begin, met, outputs = len(alike), len(graph.met), write()
        if found is self:
            made = [n for n in given if graph.op[n] not in SEEN_THROUGH]
            is_free = set(made).isdisjoint(graph.met[met:])
            self._found[key] = Call(graph, given, outputs, alike[begin:]) if is_free else None
        return outputs

    def keep(self, graphs: Sequence[Graph]) -> None:
        """Forget calls that hold other graphs than these."""
        for key, found in list(self._found.items()):
            if isinstance(found, Call) and all(found.graph is not g for g in graphs):
                del self._found[key]


def _form(graph: Graph, args: Sequence[Nodes]) -> tuple[Hashable, list[Node]]:
    """What rules can know of arguments, and the nodes among them that are no known numbers."""
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
