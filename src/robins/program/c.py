"""A program as C99: one function, locals only, no allocation, no library but libm.

The text names every scalar once, in the order of computation; a scalar that is used once is
written where it is used. Selects, comparisons and functions are calls of `scalars.h` and
`routines.h`, which stand at the head of the text, so that the same text can be compiled for lanes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from importlib.resources import files

import numpy as np

from robins.program.layout import IN_PLACE, Array, MemoryLayout, operands
from robins.program.nodes import GraphLoop, Node
from robins.program.operations import OPERATIONS
from robins.program.precision import DOUBLE, Precision
from robins.program.walk import Program, flat
from robins.program.wrap import wrapped

PREFIX = {"real": "r", "flag": "f", "whole": "i", "word": "u", "word64": "v"}
POOL = {"real": "x", "flag": "k", "whole": "k", "word": "k", "word64": "k"}
WIDEST = 60  # most characters of a scalar that is inlined


def header(name: str = "scalars.h", precision: Precision = DOUBLE) -> str:
    """C text that a program builds on, for single numbers or, in doubles, for lanes."""
    parts = "finite.h", name, precision.sine, "routines.h"
    return precision.text("\n".join(map(part, parts)))


def part(name: str) -> str:
    """A file of C of this room; `finite.h` refuses a compiler that assumes there is no NaN."""
    return (files("robins.program") / name).read_text("utf-8")


def function(
    program: Program, name: str = "robins_step", linkage: str = "", precision: Precision = DOUBLE
) -> str:
    """The function of a program: ``void name(const real *x, const whole *k, real *y, whole *m)``.

    x and y hold the reals of arguments and results, k and m all else, in the order of the leaves.
    The results may overlap the arguments: they are written last.
    """
    return wrapped("\n".join(_Writer(program, precision).function(name, linkage))) + "\n"


def to_c(program: Program, name: str = "robins_step") -> str:
    """Self-contained C file: the text of `header`, and the function of the program."""
    return header() + "\n" + function(program, name)


class _Writer:
    """Writes one program, scope by scope."""

    def __init__(self, program: Program, precision: Precision):
        self.program, self.graph, self.precision = program, program.graph, precision
        self.lines: list[str] = []
        self.names: dict[Node, str] = {}  # C text of each node
        self.inlined: set[Node] = set()
        self.strides: dict[Node, tuple[Array, int, int]] = {}  # arrays that lie in another one
        live = program.live
        self.results = flat(program.outputs)
        roots = [*self.results]
        users: dict[Node, list[Node]] = defaultdict(list)
        for node in live:
            for arg in self.graph.args[node]:
                users[arg].append(node)
            if self.graph.op[node] == "loop":
                roots += self.graph.value[node].changes
        roots += self.graph.kept(live).values()
        self.user = {n: u[0] for n, u in users.items() if len(u) == 1}
        self.roots = set(roots)
        self.inner: dict[int, list[Node]] = defaultdict(list)
        for node in live:
            self.inner[self.graph.scope[node]].append(node)
        self.layout = MemoryLayout(self.graph, live, self.roots)
        picks = [self.graph.args[n] for n in live if self.graph.op[n] == "pick"]
        # arrays that are picked from by any number
        self.addressed = {array for array, index in picks if not self.graph.is_round(index)}

    def function(self, name: str, linkage: str) -> list[str]:
        """The lines of the function."""
        head = f"{linkage}void {name}(const real *x, const whole *k, real *y, whole *m)"
        for node in live_inputs(self.program):
            if node in self.roots:
                self._declare(node, self._read_input(node), 1)
        self._scope(0, 1)
        reals, others = 0, 0
        for node in self.results:
            kind, read = self.graph.kind[node], self._read(node)
            if kind == "real":
                self.lines.append(f"    y[{reals}] = {read};")
                reals += 1
            else:
                whole = read if kind == "whole" else f"whole_of_{kind}({read})"
                self.lines.append(f"    m[{others}] = {whole};")
                others += 1
        pools = {POOL[self.graph.kind[n]] for n in live_inputs(self.program)}
        used = {"x": "x" in pools, "k": "k" in pools, "y": reals > 0, "m": others > 0}
        unused = [f"    (void){name};" for name, some in used.items() if not some]
        return [head, "{", *unused, *self.lines, "}"]

    def _scope(self, scope: int, depth: int, only: set[Node] | None = None) -> None:
        """Write the nodes of a scope, or only some of them."""
        for node in self.inner[scope]:
            if node not in self.names and (only is None or node in only):
                self._node(node, depth)

    def _node(self, node: Node, depth: int) -> None:
        graph, op = self.graph, self.graph.op[node]
        match op:
            case "constant" | "leaf" | "after" | "item":
                return
            case "input":
                self.names[node] = self._read_input(node)
            case "array":
                self._array(node, depth)
            case "pick" if graph.args[node][0] in self.strides:
                self.names[node] = self._expression(node)
            case "block":
                self._block(node, depth)
            case "loop":
                self._loop(graph.value[node], node, depth)
            case _:
                text = self._expression(node)
                if self._may_be_inlined(node, text):
                    self.inlined.add(node)
                    self.names[node] = text
                else:
                    self._declare(node, text, depth)

    def _may_be_inlined(self, node: Node, text: str) -> bool:
        graph, user = self.graph, self.user.get(node)
        return (
            user is not None
            and node not in self.roots
            and len(text) <= WIDEST
            and graph.scope[user] == graph.scope[node]
            and graph.op[user] not in ("array", "block", "loop", "pick")
        )

    def _declare(self, node: Node, text: str, depth: int) -> None:
        kind = self.graph.kind[node]
        name = self.names[node] = f"{PREFIX[kind]}{node}"
        self.lines.append(f"{'    ' * depth}const {kind} {name} = {text};")

    # ---------------------------------------------------------------------------- expressions

    def _read_input(self, node: Node) -> str:
        return self._input_at(self.graph.kind[node], str(self.graph.value[node]))

    def _input_at(self, kind: str, at: str) -> str:
        read = f"{POOL[kind]}[{at}]"
        if kind == "flag":
            return f"whole_ne({read}, WHOLE(0))"
        return read if kind in ("real", "whole") else f"{kind}_of_whole({read})"

    def _read(self, node: Node, bare: bool = False) -> str:
        """C text of a node; bare: next to an operator, where a number needs no macro."""
        graph = self.graph
        match graph.op[node]:
            case "constant":
                return literal(graph.value[node], graph.kind[node], bare, self.precision)
            case "leaf":
                scope, k = graph.value[node]
                return f"WHOLE(n{scope})" if k < 0 else f"l{scope}_{k}"
            case "item":
                return f"b{graph.args[node][0]}[{graph.value[node]}]"
            case "after":
                loop: GraphLoop = graph.value[graph.args[node][0]]
                k, row = graph.value[node]
                if row is None:
                    return f"l{loop.scope}_{k}"
                array, at = self.layout.source(node)
                assert array is not None
                return f"{array[1]}[{at}]"
        text = self.names[node]
        infix = bare and node in self.inlined and self._infix(node)
        return f"({text})" if infix else text

    def _expression(self, node: Node) -> str:
        """The operation of a node on its arguments."""
        graph, op, args = self.graph, self.graph.op[node], self.graph.args[node]
        if sign := self._infix(node):
            parts = [self._read(a, bare=True) for a in args]
            return f"{sign}{parts[0]}" if len(parts) == 1 else f" {sign} ".join(parts)
        if op == "pick":
            array, index = args
            if graph.is_round(index):
                number = f"n{graph.value[index][0]}"
                if array in self.strides:
                    return self._at(self.strides[array], graph.kind[node], number)
                return f"a{array}[{number}]"
            return f"{graph.routine(node)}(a{array}, {self._read(index)})"
        return f"{graph.routine(node)}({', '.join(map(self._read, args))})"

    def _infix(self, node: Node) -> str:
        """The operator of a node, if it is one in C for numbers of its kind."""
        op = self.graph.op[node]
        if op == "div":
            return "/" if self.graph.kind[node] == "real" else ""
        return OPERATIONS[op].infix if op in OPERATIONS else ""

    # -------------------------------------------------------------------- arrays, blocks, loops

    def _array(self, node: Node, depth: int) -> None:
        args = self.graph.args[node]
        if node not in self.addressed and (found := self.layout.stride(args)):
            self.strides[node] = found
            return
        entries = [self._read(a) for a in self.graph.args[node]]
        self._listed(f"const {self.graph.kind[node]} a{node}[{len(entries)}]", entries, depth)
        self.names[node] = f"a{node}"

    def _listed(self, head: str, entries: list[str], depth: int) -> None:
        """Declare an array with its entries, several to a line."""
        pad = "    " * depth
        self.lines.append(f"{pad}{head} = {{")
        line = ""
        for entry in entries:
            if line and len(line) + len(entry) > 80:
                self.lines.append(f"{pad}    {line.rstrip()}")
                line = ""
            line += f"{entry}, "
        self.lines += [f"{pad}    {line.rstrip(' ,')}", f"{pad}}};"]

    def _block(self, node: Node, depth: int) -> None:
        """Call a routine; copied operands are in braces, so that their memory is reused."""
        routine, sizes, count = self.graph.value[node]
        pad, kind = "    " * depth, "real" if routine in IN_PLACE else "const real"
        self.lines += [f"{pad}real b{node}[{count}];", f"{pad}{{"]
        given = []
        for index, nodes in enumerate(operands(self.graph, node)):
            if found := self.layout.operand(node, index):
                array, first = found
                given.append(self._address(array, first))
            else:
                given.append(f"in{node}_{index}")
                entries = [self._read(a) for a in nodes]
                self._listed(f"{kind} {given[-1]}[{len(entries)}]", entries, depth + 1)
        arguments = ", ".join([*map(str, sizes), *given, f"b{node}"])
        self.lines += [f"{pad}    {routine}({arguments});", f"{pad}}}"]
        self.names[node] = f"b{node}"

    def _loop(self, loop: GraphLoop, node: Node, depth: int) -> None:
        graph, pad, s = self.graph, "    " * depth, loop.scope
        self.names[node] = ""
        for k, n in enumerate(loop.begin):
            self.lines.append(f"{pad}{graph.kind[n]} l{s}_{k} = {self._read(n)};")
        rows = self.layout.rows[s]
        for name, entries in rows:
            kind, size = graph.kind[loop.kept[entries[0]]], len(entries) * (loop.count or 0)
            self.lines.append(f"{pad}{kind} {name}[{size}];")
        inner = f"{pad}    "
        if loop.count is not None:
            self.lines.append(f"{pad}for (int n{s} = 0; n{s} < {loop.count}; ++n{s}) {{")
            self._scope(s, depth + 1)
        else:
            assert loop.condition is not None
            self.lines.append(f"{pad}for (;;) {{")
            self._scope(s, depth + 1, set(graph.live([loop.condition])))
            going = self._read(loop.condition)
            self.lines.append(f"{inner}if (!ANY({going})) {{ break; }}")
            self._scope(s, depth + 1)
        for name, entries in rows:
            for column, k in enumerate(entries):
                at = place_of(column, [(f"n{s}", len(entries))])
                self.lines.append(f"{inner}{name}[{at}] = {self._read(loop.kept[k])};")
        changed = [k for k, n in enumerate(loop.next) if n != loop.leaves[k]]
        new = {k: self._read(loop.next[k]) for k in changed}
        for k in changed:  # a leaf that becomes another is read before that one is written
            n = loop.next[k]
            if graph.op[n] == "leaf" and graph.value[n][0] == s and graph.value[n][1] >= 0:
                new[k] = f"t{s}_{k}"
                self.lines.append(f"{inner}const {graph.kind[n]} t{s}_{k} = {self._read(n)};")
        for k in changed:
            kind = graph.kind[loop.leaves[k]]
            text = new[k]
            if loop.condition is not None:
                text = f"{kind}_select({self._read(loop.condition)}, {text}, l{s}_{k})"
            self.lines.append(f"{inner}l{s}_{k} = {text};")
        self.lines.append(f"{pad}}}")

    def _at(self, found: tuple[Array, int, int], kind: str, index: str) -> str:
        """C text that reads an entry of an array."""
        (what, name, rounds), first, step = found
        steps = [(f"n{scope}", by) for scope, by in rounds] + [(index, step)]
        at = place_of(first, steps)
        return self._input_at(kind, at) if what == "input" else f"{what}{name}[{at}]"

    def _address(self, array: Array, first: int) -> str:
        """C text of a pointer to a real in an array."""
        what, name, rounds = array
        at = place_of(first, [(f"n{scope}", by) for scope, by in rounds])
        return ("x" if what == "input" else f"{what}{name}") + (f" + {at}" if at != "0" else "")


def place_of(first: int, steps: Sequence[tuple[str, int]]) -> str:
    """C text of an index into an array: the first index and strides."""
    parts = [index if by == 1 else f"{by} * {index}" for index, by in steps if by]
    return " + ".join([str(first)] * (first != 0 or not parts) + parts).replace("+ -", "- ")


def live_inputs(program: Program) -> list[Node]:
    """The arguments that a program reads."""
    return [n for n in program.live if program.graph.op[n] == "input"]


def literal(
    value: float | int | np.generic, kind: str, bare: bool = False, precision: Precision = DOUBLE
) -> str:
    """A number in C; bare next to an operator, else in the macro of its kind."""
    if kind == "real":
        text = precision.number(value)
        if not bare or text.lstrip("-") in ("INFINITY", "NAN"):  # which C has as floats
            return f"REAL({text})"
        return f"({text})" if text.startswith("-") else text
    number = int(value)  # type: ignore[call-overload]
    if kind == "whole" and number == -(2**63):
        return "WHOLE(INT64_MIN)"
    suffix = {"word": "u", "word64": "u"}.get(kind, "")
    return f"{kind.upper()}({number}{suffix})"
