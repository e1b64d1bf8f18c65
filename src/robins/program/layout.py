"""Memory layout of a program in C: arrays whose numbers are read in place.

Where the operands already lie in one array, a routine takes a pointer, and a loop an offset and a
stride; else they are copied into an array of their own.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from itertools import accumulate, pairwise

from robins.program.nodes import Graph, GraphLoop, Node

# An array: prefix and rest of its name ("b" and a block; "" and a name), or "input" and a kind;
# then the scopes of loops whose rounds shift the place of a number, each with its stride.
Array = tuple[str, Node | str, tuple[tuple[int, int], ...]]
Entry = tuple[int, int]  # scope of a loop, and index of a node in its `kept`
# Array of the kept nodes of a loop, one row a round: its name, and the indices of the nodes.
Rows = tuple[str, list[int]]

OPERANDS = {
    "product": lambda m, depth, n: (m * depth, n * depth),
    "solve_lower": lambda n, width: (n * n, n * width),
}
IN_PLACE = {"triangle", "householder", "eigh"}  # routines that overwrite their operands


def operands(graph: Graph, block: Node) -> list[tuple[Node, ...]]:
    """Arguments of a block, matrix by matrix."""
    routine, sizes, _ = graph.value[block]
    args = graph.args[block]
    counts = OPERANDS[routine](*sizes) if routine in OPERANDS else (len(args),)
    return [args[a:b] for a, b in pairwise(accumulate([0, *counts]))]


class MemoryLayout:
    """Arrays of the live nodes of a graph.

    Attributes:
        rows: arrays that a loop keeps, by its scope.
    """

    def __init__(self, graph: Graph, live: Sequence[Node], roots: Collection[Node]):
        """Choose arrays; roots are results and what loops keep or change."""
        self._graph = graph
        self._readers = Counter([*roots, *(a for n in live for a in set(graph.args[n]))])
        kept: dict[int, set[int]] = defaultdict(set)
        for scope, k in graph.kept(live):
            kept[scope].add(k)
        whole: dict[tuple[Node, int], Entry] = {}  # operands that are a whole array
        for block in live:
            if graph.op[block] == "block":
                for index, nodes in enumerate(operands(graph, block)):
                    if entries := self._entries(nodes):
                        whole[block, index] = entries[0]
                        kept[entries[0][0]].update(k for _, k in entries)
        self.rows: dict[int, list[Rows]] = {}
        self._column: dict[Entry, tuple[Rows, int]] = {}
        for node in live:
            if graph.op[node] == "loop":
                self._lay_out(graph.value[node], kept[graph.value[node].scope])
        self._whole = {key: self._column[entry][0] for key, entry in whole.items()}

    def _lay_out(self, loop: GraphLoop, kept: set[int]) -> None:
        arrays = self.rows[loop.scope] = []
        for part, (begin, end) in enumerate(pairwise(accumulate([0, *loop.sizes]))):
            if entries := [k for k in range(begin, end) if k in kept]:
                arrays.append((f"k{loop.scope}_{part}", entries))
                for column, k in enumerate(entries):
                    self._column[loop.scope, k] = arrays[-1], column

    def _is_kept(self, node: Node) -> bool:
        return self._graph.op[node] == "after" and self._graph.value[node][1] is not None

    def _entries(self, nodes: Sequence[Node]) -> list[Entry]:
        """Entries of an array of a loop if the nodes are all of it, with constants; else none."""
        graph = self._graph
        first = next((n for n in nodes if self._is_kept(n)), None)
        if first is None:
            return []
        loop, k = graph.value[graph.args[first][0]], graph.value[first][0]
        begin, end = next(p for p in pairwise(accumulate([0, *loop.sizes])) if k < p[1])
        columns = range(begin, end)
        if len(nodes) != len(columns) * loop.count:
            return []
        for i, node in enumerate(nodes):
            row, column = divmod(i, len(columns))
            value = loop.kept[columns[column]]
            if graph.op[value] == "constant":
                same = node == value
            else:
                of_loop = self._is_kept(node) and graph.value[graph.args[node][0]] is loop
                same = of_loop and graph.value[node] == (columns[column], row)
            if not same:
                return []
        return [(loop.scope, k) for k in columns]

    def source(self, node: Node) -> tuple[Array | None, int]:
        """Array that holds a node, and its index there; None where no array does."""
        graph = self._graph
        match graph.op[node]:
            case "input":
                return ("input", graph.kind[node], ()), graph.value[node]
            case "item":
                return ("b", graph.args[node][0], ()), graph.value[node]
            case "after" if self._is_kept(node):
                k, row = graph.value[node]
                (name, entries), column = self._column[graph.value[graph.args[node][0]].scope, k]
                return ("", name, ()), row * len(entries) + column
            case "pick" if graph.is_round(graph.args[node][1]):
                array, index = graph.args[node]
                if found := self.stride(graph.args[array]):
                    (what, name, rounds), first, step = found
                    return (what, name, (*rounds, (graph.value[index][0], step))), first
        return None, 0

    def stride(self, nodes: Sequence[Node]) -> tuple[Array, int, int] | None:
        """Array that holds nodes at a constant stride, first index and stride; or None."""
        array, first = self.source(nodes[0])
        if array is None:
            return None
        step = self.source(nodes[1])[1] - first if len(nodes) > 1 else 1
        if any(self.source(n) != (array, first + k * step) for k, n in enumerate(nodes)):
            return None
        return array, first, step

    def operand(self, block: Node, index: int) -> tuple[Array, int] | None:
        """Array that holds an operand, and its first index; None if it must be copied.

        A routine that works in place never gets a number that something else reads.
        """
        graph, nodes = self._graph, operands(self._graph, block)[index]
        if rows := self._whole.get((block, index)):
            found: tuple[Array, int, int] | None = ("", rows[0], ()), 0, 1
        else:
            found = self.stride(nodes)
        if found is None or found[2] != 1:
            return None
        array, first, _ = found
        if graph.value[block][0] in IN_PLACE:
            # Rows that are picked by a round are needed again when a loop around it repeats.
            is_ours = all(self._readers[n] == 1 for n in nodes if graph.op[n] != "constant")
            if array[0] == "input" or array[2] or not is_ours:
                return None
        return array, first
