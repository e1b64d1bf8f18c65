"""The graph of a program: scalars, each written once, folded where they are known.

A node is a number, an index into the lists of a `Graph`. Its arguments are nodes before it, so the
order of nodes is an order of computation. Two equal nodes are one node. In addition to scalar
operations there are

- *blocks*: a routine on arrays, such as a QR; its arguments are gathered, its results are leaves;
- *loops*: `GraphLoop`; what depends on the leaves of a loop is computed inside it, all else before.

Zeros are structural: a product with a known zero is zero, whatever the other factor is. Filters
test their inputs for finiteness, so that no infinity is lost by this.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robins.program.operations import KINDS, OPERATIONS

Node = int

ALIKE = {"neg", "not", "and", "or", "max", "min"}  # may simplify by the nodes of their arguments
COMMUTING = {op for op, row in OPERATIONS.items() if row.commutes}
_DOUBLE = struct.Struct("<d")


@dataclass
class GraphLoop:
    """A loop: its leaves, the carried values at the start of a round, and their next values.

    Attributes:
        scope: its number.
        begin: values of the leaves in the first round.
        leaves: one for each of `begin`.
        index: the number of the round, from 0.
        count: number of rounds; None: as long as `condition` holds at the beginning of a round.
        condition: a node inside the loop, of its leaves.
        next: values of the leaves in the next round.
        kept: nodes whose values in all rounds are kept; only where `count` is known.
        sizes: numbers of entries of the arrays that `kept` lists one after the other.
    """

    scope: int
    begin: list[Node]
    leaves: list[Node]
    index: Node
    count: int | None
    condition: Node | None = None
    next: list[Node] = field(default_factory=list)
    kept: list[Node] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)

    @property
    def changes(self) -> list[Node]:
        """Nodes to be computed inside for the next round."""
        return [*self.next, *([] if self.condition is None else [self.condition])]

    @property
    def roots(self) -> list[Node]:
        """Nodes that may have to be computed inside."""
        return [*self.changes, *self.kept]


class Graph:
    """Nodes, by their fields: ``op``, ``args``, ``kind``, ``value``, ``scope``.

    Attributes:
        op: an operation of `OPERATIONS`, or ``constant``, ``input``, ``select``, ``convert``,
            ``bits``; ``array`` of nodes, and ``pick`` of an array; ``block`` and ``item``; of loops
            ``leaf``, ``loop`` and ``after``.
        value: of a constant its number; what else an op needs besides its arguments.
        literal: of a constant the bytes of a real, or a text of its kind and number; else None.
        scope: the loop in which a node is computed, 0 outside of all.
        within: of each scope the one around it.
        met: existing nodes that were to be added again, in order.
    """

    def __init__(self) -> None:
        self.op: list[str] = []
        self.args: list[tuple[Node, ...]] = []
        self.kind: list[str] = []
        self.value: list[Any] = []
        self.literal: list[bytes | str | None] = []
        self.scope: list[int] = []
        self.within: list[int] = [0]
        self.met: list[Node] = []
        self._known: dict[Any, Node] = {}

    def __len__(self) -> int:
        return len(self.op)

    def add(
        self,
        op: str,
        args: Sequence[Node],
        kind: str,
        value: Any = None,
        key: Any = None,
        scope: int | None = None,
        order: Sequence[Node] | None = None,
    ) -> Node:
        """Add a node, or return the existing one with the same fields."""
        args = tuple(args)
        same = args if order is None else tuple(order)
        known = (op, same, kind, value if key is None else key)
        if (found := self._known.get(known)) is not None:
            if op != "constant":
                self.met.append(found)
            return found
        node = self._known[known] = len(self.op)
        self.op.append(op)
        self.args.append(args)
        self.kind.append(kind)
        self.value.append(value)
        self.literal.append(key if op == "constant" else None)
        if scope is None:  # later scopes lie further in
            scope = max([self.scope[a] for a in args]) if args and len(self.within) > 1 else 0
        self.scope.append(scope)
        return node

    def ordered(self, op: str, args: tuple[Node, ...], kind: str, value: Any = None) -> Node:
        """Node of an operation, without folding.

        Commuted arguments give the same node, which keeps the order that was written first.
        """
        commutes = op in COMMUTING and args[0] > args[1]
        return self.add(op, args, kind, value, order=args[::-1] if commutes else None)

    # ------------------------------------------------------------------------------- leaves

    def constant(self, value: float | int | np.generic | np.ndarray, kind: str) -> Node:
        """Node of a known number."""
        number = KINDS[kind](value)
        key = _DOUBLE.pack(number) if kind == "real" else f"{kind} {int(number)}"
        return self.add("constant", (), kind, number, key)

    def input(self, index: int, kind: str) -> Node:
        """Node of a scalar argument, counted among the reals or among all else."""
        return self.add("input", (), kind, index)

    def known(self, node: Node) -> np.generic | None:
        """The number of a constant, None of any other node."""
        return None if self.literal[node] is None else self.value[node]

    # --------------------------------------------------------------------------- operations

    def apply(self, op: str, *args: Node) -> Node:
        """An operation of `OPERATIONS` on nodes of one kind."""
        row, known = OPERATIONS[op], [self.literal[a] is not None for a in args]
        gives = row.gives or self.kind[args[0]]
        if all(known):
            with np.errstate(all="ignore"):
                return self.constant(row.fold(*[self.value[a] for a in args]), gives)
        # All other operations on unknown numbers stay, whatever their arguments are.
        may_be_simpler = op in ALIKE or any(known)
        if may_be_simpler and (simple := self._simpler(op, args)) is not None:
            return simple
        return self.ordered(op, args, gives)

    def select(self, condition: Node, new: Node, old: Node) -> Node:
        """``new`` where the condition holds, else ``old``."""
        known = self.known(condition)
        if known is not None:
            return new if known else old
        if new == old:
            return new
        if self.op[condition] == "not":
            return self.select(self.args[condition][0], old, new)
        if self.kind[new] == "flag":
            if (value := self.known(new)) is not None:
                left = condition if value else self.apply("not", condition)
                return self.apply("or" if value else "and", left, old)
            if (value := self.known(old)) is not None:
                left = self.apply("not", condition) if value else condition
                return self.apply("or" if value else "and", left, new)
        return self.add("select", (condition, new, old), self.kind[new])

    def convert(self, node: Node, kind: str) -> Node:
        """The same number in another kind; a flag is 0 or 1, a real is truncated towards zero."""
        given = self.kind[node]
        if given == kind:
            return node
        if (value := self.known(node)) is not None:
            with np.errstate(all="ignore"):
                return self.constant(value.astype(KINDS[kind]), kind)
        if kind == "flag":
            return self.apply("ne", node, self.constant(0, given))
        return self.add("convert", (node,), kind)

    def bits(self, node: Node, kind: str) -> Node:
        """The same bits read as another kind of the same width."""
        if (value := self.known(node)) is not None:
            return self.constant(np.array(value).view(KINDS[kind])[()], kind)
        return self.add("bits", (node,), kind)

    def pick(self, among: Sequence[Node], index: Node) -> Node:
        """One of several nodes, by an index that is in range."""
        if (value := self.known(index)) is not None:
            return among[int(value)]
        if len(set(among)) == 1:
            return among[0]
        if len(among) > 4 or self.is_round(index):
            array = self.add("array", among, self.kind[among[0]])
            return self.add("pick", (array, index), self.kind[among[0]])
        found = among[-1]
        for k in reversed(range(len(among) - 1)):
            here = self.apply("eq", index, self.constant(k, self.kind[index]))
            found = self.select(here, among[k], found)
        return found

    def is_round(self, node: Node) -> bool:
        """True if a node is the number of a round."""
        return self.op[node] == "leaf" and self.value[node][1] < 0

    def routine(self, node: Node) -> str:
        """Name by which C and the interpreter know the operation of a node with arguments."""
        op, own, given = self.op[node], self.kind[node], self.kind[self.args[node][0]]
        match op:
            case "select" | "pick":
                return f"{own}_{op}"
            case "convert":
                return f"{own}_of_{given}"
            case "bits":
                return f"{own}_bits_{given}"
        return f"{given}_{op}"

    def block(
        self, routine: str, sizes: Sequence[int], args: Sequence[Node], count: int
    ) -> list[Node]:
        """Results (reals) of a routine of `routines.h` on an array of reals."""
        block = self.add("block", args, "real", (routine, tuple(sizes), count))
        return [self.add("item", (block,), "real", k) for k in range(count)]

    # -------------------------------------------------------------------------------- loops

    def open(self, begin: Sequence[Node], count: int | None) -> GraphLoop:
        """Open a loop; nodes that depend on its leaves are computed inside it."""
        scope = len(self.within)
        self.within.append(max((self.scope[n] for n in begin), default=0))
        leaves = [
            self.add("leaf", (), self.kind[n], (scope, k), scope=scope) for k, n in enumerate(begin)
        ]
        index = self.add("leaf", (), "whole", (scope, -1), scope=scope)
        return GraphLoop(scope, list(begin), leaves, index, count)

    def close(self, loop: GraphLoop) -> tuple[list[Node], list[list[Node]]]:
        """Close a loop: its leaves after the last round, and each kept node in all rounds."""
        outside = [n for n in self._needed_by(loop) if self.scope[n] < loop.scope]
        args = list(dict.fromkeys([*loop.begin, *outside]))
        node = self.add("loop", args, "", loop, key=loop.scope)
        self.within[loop.scope] = self.scope[node]
        after = [
            self.add("after", (node,), self.kind[n], (k, None)) for k, n in enumerate(loop.begin)
        ]

        def of_round(k: int, n: Node, i: int) -> Node:
            if self.scope[n] < loop.scope:  # the same in all rounds, such as a zero
                return n
            return self.add("after", (node,), self.kind[n], (k, i))

        rounds = range(loop.count or 0)
        kept = [[of_round(k, n, i) for i in rounds] for k, n in enumerate(loop.kept)]
        return after, kept

    def _needed_by(self, loop: GraphLoop) -> list[Node]:
        """All nodes inside a loop that its roots need, and the nodes outside that these use."""
        seen: set[Node] = set()
        ahead = loop.roots
        while ahead:
            node = ahead.pop()
            if node not in seen:
                seen.add(node)
                if self.scope[node] >= loop.scope:
                    ahead += self.args[node]
                    if self.op[node] == "loop":
                        ahead += self.value[node].roots
        return sorted(seen)

    def live(self, roots: Sequence[Node]) -> list[Node]:
        """All nodes that the roots need, in the order of computation."""
        op, args = self.op, self.args
        seen: set[Node] = set()
        ahead = list(roots)
        while ahead:
            node = ahead.pop()
            if node in seen:
                continue
            seen.add(node)
            ahead += args[node]
            if op[node] == "loop":
                ahead += self.value[node].changes
            elif op[node] == "after":
                ahead += self.kept([node]).values()
        return sorted(seen)

    def kept(self, nodes: Sequence[Node]) -> dict[tuple[int, int], Node]:
        """Kept nodes of loops that the given nodes read, by scope and index."""
        read: dict[tuple[int, int], Node] = {}
        for node in nodes:
            if self.op[node] == "after" and self.value[node][1] is not None:
                loop, k = self.value[self.args[node][0]], self.value[node][0]
                read[loop.scope, k] = loop.kept[k]
        return read

    # ------------------------------------------------------------------------------ folding

    def _simpler(self, op: str, args: tuple[Node, ...]) -> Node | None:
        """Simpler node of the same value; None if there is none."""
        match op:
            case "add" | "or" | "xor":
                for one, other in (args, args[::-1]):
                    if self._is(other, 0):
                        return one
                    if op == "or" and self.kind[one] == "flag" and self._is(other, 1):
                        return other
                if op == "or" and args[0] == args[1]:
                    return args[0]
            case "sub":
                if self._is(args[1], 0):
                    return args[0]
            case "mul":
                for one, other in (args, args[::-1]):
                    if self._is(other, 1):
                        return one
                    if self._is(other, 0):
                        return self.constant(0, self.kind[other])
                    if self._is(other, -1) and self.kind[one] == "real":
                        return self.apply("neg", one)
            case "div":
                if self._is(args[1], 1):
                    return args[0]
                if self.kind[args[0]] == "real" and self._is(args[0], 0):
                    return args[0]
            case "and":
                for one, other in (args, args[::-1]):
                    if self._is(other, 0):
                        return other
                    if self.kind[one] == "flag" and self._is(other, 1):
                        return one
                if args[0] == args[1]:
                    return args[0]
            case "not" | "neg" if self.op[args[0]] == op:
                return self.args[args[0]][0]
            case "eq" | "ne" if self.kind[args[0]] == "flag":
                for one, other in (args, args[::-1]):
                    if (value := self.known(other)) is not None:
                        return one if bool(value) == (op == "eq") else self.apply("not", one)
            case "max" | "min" if args[0] == args[1]:
                return args[0]
        return None

    def _is(self, node: Node, number: int) -> bool:
        return self.literal[node] is not None and bool(self.value[node] == number)
