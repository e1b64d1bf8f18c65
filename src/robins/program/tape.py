"""A program as a tape: the instructions of the interpreter (`interpreter.cc`).

An instruction is one operation, its result a register, and up to three arguments. Nodes become
instructions in the order of computation, scope by scope; registers are allocated by linear scan
(Poletto & Sarkar 1999) and reused after the last read. A product that only one sum reads is part of
that instruction; both are rounded.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robins.program.native import address
from robins.program.nodes import GraphLoop, Node
from robins.program.operations import KINDS
from robins.program.refusal import ProgramError
from robins.program.walk import Program, counts, flat

DEEPEST = 16  # nested loops: the interpreter has so many counters of rounds
CHANGES = ("keep", "move")  # instructions that change what is there

# A value that an instruction makes or reads: a node; or by name an argument, a constant, or what a
# loop carries from round to round.
Value = int | tuple
Place = tuple[Value, int]  # the value that holds another, and the offset from its first register


@dataclass(slots=True)
class Instruction:
    """An operation before its registers are known.

    Attributes:
        code: its name; empty if registers are only reserved.
        result: the place of a value.
        args: places of values.
        listed: places of values in a list, behind `numbers`.
        numbers: immediate operands.
        count: number of results, in consecutive registers.
    """

    code: str
    result: Place | None = None
    args: tuple[Place, ...] = ()
    listed: tuple[Place, ...] = ()
    numbers: tuple[int, ...] = ()
    count: int = 1

    @property
    def widens(self) -> bool:
        """True if it reads words: they are half as wide as what is made of them."""
        return self.code.startswith("word_") or self.code.endswith("_of_word")

    @property
    def read(self) -> list[Value]:
        """Values that it reads."""
        read = [value for value, _ in self.args + self.listed]
        if self.result is not None and self.code in CHANGES:
            read.append(self.result[0])
        return read


class Writer:
    """Instructions of one program, and the loops in which they lie.

    Attributes:
        written: instructions.
        given: places of the values that are the results.
        around: of each loop, by its scope, that around it.
        spans: of each loop, by its scope, the first of its instructions and the one behind it.
    """

    def __init__(self, program: Program):
        self.program, self.graph = program, program.graph
        self.written: list[Instruction] = []
        self.around: dict[int, int] = {0: -1}
        self.spans: dict[int, tuple[int, int]] = {}
        self.scope_of: dict[Value, int] = {}  # the loop in which a value is written
        self._places: dict[Value, Place] = {}
        live = program.live
        self.results = flat(program.outputs)
        self.inner: dict[int, list[Node]] = defaultdict(list)
        self.uses: Counter[Node] = Counter(self.results)
        for node in live:
            self.uses.update(self.graph.args[node])
            if self.graph.op[node] == "loop":
                self.uses.update(self.graph.value[node].changes)
            self.inner[self.graph.scope[node]].append(node)
        self.kept = self.graph.kept(live)
        self.uses.update(self.kept.values())
        self.joined = dict(self._products(live))
        self.done: set[Node] = set()
        self._scope(0, set(live))
        # A result that is not a real is given as a whole number.
        self.given = [self.place(self._as_whole(n)) for n in self.results]

    def _products(self, live: list[Node]) -> list[tuple[Node, Node]]:
        """Sums, each with the product that becomes part of it."""
        graph, taken, found = self.graph, set(), []
        for node in live:
            if graph.op[node] not in ("add", "sub") or graph.kind[node] != "real":
                continue
            for arg in graph.args[node][::-1]:
                alone = self.uses[arg] == 1 and graph.scope[arg] == graph.scope[node]
                if alone and graph.op[arg] == "mul" and arg not in taken:
                    taken.add(arg)
                    found.append((node, arg))
                    break
        return found

    # ------------------------------------------------------------------------------ instructions

    def _write(
        self,
        code: str,
        result: Value | None,
        *args: Value,
        listed: tuple[Value, ...] = (),
        numbers: tuple[int, ...] = (),
        count: int = 1,
    ) -> None:
        place = self.place
        made = None if result is None else place(result)
        read, more = (tuple([place(v) for v in some]) for some in (args, listed))
        self.written.append(Instruction(code, made, read, more, numbers, count))

    def _scope(self, scope: int, only: set[Node]) -> None:
        products = set(self.joined.values())
        for node in self.inner[scope]:
            if node in only and node not in self.done and node not in products:
                self.done.add(node)
                self._node(node)

    def _node(self, node: Node) -> None:
        graph, op = self.graph, self.graph.op[node]
        self.scope_of[node] = graph.scope[node]
        args = graph.args[node]
        match op:
            case "constant" | "leaf" | "after" | "item" | "array":
                return
            case "input":
                if graph.kind[node] not in ("real", "whole"):
                    self._from_whole(node)
            case "loop":
                self._loop(node)
            case "block":
                routine, sizes, count = graph.value[node]
                numbers = (*sizes, 0, 0, 0)[:3]
                self._write(routine, node, listed=args, numbers=(*numbers, len(args)), count=count)
            case "pick" if graph.is_round(args[1]):
                scope, _ = graph.value[args[1]]
                self._write("take", node, listed=graph.args[args[0]], numbers=(scope,))
            case "pick":
                self._write(graph.routine(node), node, args[1], listed=graph.args[args[0]])
            case _ if node in self.joined:
                self._sum(node, self.joined[node])
            case _:
                self._write(graph.routine(node), node, *args)

    def _sum(self, node: Node, product: Node) -> None:
        """A sum or difference with a product in it."""
        first, second = self.graph.args[node]
        other = second if first == product else first
        if self.graph.op[node] == "add":
            code = "multiply_add"
        else:
            code = "multiply_subtract" if second == product else "multiply_less"
        self._write(code, node, *self.graph.args[product], other)

    def _from_whole(self, node: Node) -> None:
        """Convert an argument that is passed as a whole number."""
        kind, raw = self.graph.kind[node], ("raw", self.graph.value[node])
        if kind == "flag":
            self._write("whole_ne", node, raw, ("constant", "whole", 0))
        else:
            self._write(f"{kind}_of_whole", node, raw)

    def _as_whole(self, node: Node) -> Value:
        kind = self.graph.kind[node]
        if kind in ("real", "whole"):
            return node
        made = ("whole", node)
        self.scope_of[made] = 0
        self._write(f"whole_of_{kind}", made, node)
        return made

    # -------------------------------------------------------------------------------------- loops

    def _loop(self, node: Node) -> None:
        """Write a loop: leaves are set before it and changed at the end of each round."""
        graph, loop = self.graph, self.graph.value[node]
        s, around = loop.scope, self.graph.scope[node]
        self.around[s] = around
        if self.depth(s) >= DEEPEST:
            raise ProgramError(f"more than {DEEPEST} loops in each other", "", "use --machine c")
        for k, n in enumerate(loop.begin):
            self.scope_of[s, k] = around
            self._write("move", (s, k), n)
        kept = {k: n for k, n in enumerate(loop.kept) if (s, k) in self.kept}
        for k in kept:
            self.scope_of["kept", s, k] = around
            self._write("", ("kept", s, k), count=loop.count or 0)
        self._write("begin", None, numbers=(s,))
        begin = len(self.written)
        self.scope_of["round", s] = s
        if any(graph.op[n] == "leaf" and graph.value[n] == (s, -1) for n in self.inner[s]):
            self._write("round", ("round", s), numbers=(s,))
        if loop.condition is not None:
            self._scope(s, set(graph.live([loop.condition])))
            self._write("leave_unless", None, loop.condition, numbers=(s,))
        self._scope(s, set(self.inner[s]))
        for k, n in kept.items():
            self._write("keep", ("kept", s, k), n, numbers=(s,))
        self._next(loop)
        most = 2**31 - 1 if loop.count is None else loop.count
        self._write("again", None, numbers=(s, most, begin))
        self.spans[s] = begin, len(self.written)

    def _next(self, loop: GraphLoop) -> None:
        """Write the leaves of the next round, none before its last read."""
        s, graph = loop.scope, self.graph
        changed = [k for k, n in enumerate(loop.next) if n != loop.leaves[k]]
        new: dict[int, Value] = dict(enumerate(loop.next))
        for k in changed:
            is_leaf = graph.op[n := loop.next[k]] == "leaf" and graph.value[n][0] == s
            self.scope_of["next", s, k] = s
            if loop.condition is not None:
                code = f"{graph.kind[loop.leaves[k]]}_select"
                self._write(code, ("next", s, k), loop.condition, n, (s, k))
            elif is_leaf:
                self._write("move", ("next", s, k), n)
            else:
                continue
            new[k] = ("next", s, k)
        for k in changed:
            self._write("move", (s, k), new[k])

    # ---------------------------------------------------------------------------------- registers

    def place(self, value: Value) -> Place:
        """Place of a value."""
        if (found := self._places.get(value)) is None:
            found = self._places[value] = self._place(value)
        return found

    def _place(self, value: Value) -> Place:
        if isinstance(value, tuple):
            return value, 0
        graph = self.graph
        match graph.op[value]:
            case "constant" if isinstance(bits := graph.literal[value], bytes):
                # Not as a number: -0 would be 0.
                return ("constant", "bits", int.from_bytes(bits, "little", signed=True)), 0
            case "constant":
                return ("constant", graph.kind[value], graph.value[value]), 0
            case "leaf":
                s, k = graph.value[value]
                return (("round", s) if k < 0 else (s, k)), 0
            case "item":
                return graph.args[value][0], graph.value[value]
            case "after":
                loop = graph.value[graph.args[value][0]]
                k, row = graph.value[value]
                return ((loop.scope, k), 0) if row is None else (("kept", loop.scope, k), row)
            case "input" if graph.kind[value] == "real":
                return ("x", graph.value[value]), 0
            case "input" if graph.kind[value] == "whole":
                return ("raw", graph.value[value]), 0
        return value, 0

    def last_uses(self) -> dict[Value, int]:
        """Last instruction that reads each value; the end of a loop for values from outside it."""
        last: dict[Value, int] = {}
        scope = self._scopes()
        for at, one in enumerate(self.written):
            for value in one.read:
                until, s, own = at, scope[at], self.scope_of.get(value, 0)
                while s != own:
                    until = max(until, self.spans[s][1] - 1)
                    s = self.around[s]
                last[value] = max(last.get(value, 0), until)
        for value, _ in self.given:
            last[value] = len(self.written)
        return last

    def depth(self, scope: int) -> int:
        """Number of loops around one, which is the index of its counter of rounds."""
        found = 0
        while (scope := self.around[scope]) > 0:
            found += 1
        return found

    def _scopes(self) -> list[int]:
        """Innermost loop of each instruction."""
        found = [0] * len(self.written)
        for s, (begin, end) in sorted(self.spans.items()):  # a later scope lies further in
            found[begin:end] = [s] * (end - begin)
        return found


class Tape:
    """A program as a tape.

    Attributes:
        arrays: instructions, lists, constants with their registers, registers of the results.
        sizes: counts of instructions, constants, registers, scratch, and of what goes in and out.
        address: of the pointers and sizes, as `interpreter.cc` reads them.
    """

    def __init__(self, program: Program, codes: Mapping[str, int], flag: int):
        """Write the instructions and allocate their registers.

        Args:
            program: of scalars.
            codes: numbers of the instructions, by name.
            flag: a flag that is set: 1, or -1 where flags are masks.
        """
        self._codes, self._flag = codes, flag
        self._writer = writer = Writer(program)
        (nx, nk), (ny, nm) = counts(program.inputs), counts(program.results)
        self._nx = nx
        self._constants: dict[int, int] = {}
        wanted = [v for one in writer.written for v in one.read]
        for value in dict.fromkeys([*wanted, *(v for v, _ in writer.given)]):
            if isinstance(value, tuple) and value[0] == "constant":
                bits = self._bits(*value[1:])
                self._constants.setdefault(bits, nx + nk + len(self._constants))
        self._count = nx + nk + len(self._constants)  # registers
        self._of: dict[Value, int] = {}
        self._lasting: dict[Value, int] = {}  # registers that are never freed
        self._free: dict[int, list[int]] = defaultdict(list)  # by number of consecutive registers
        self._ends: dict[int, list[tuple[Value, int]]] = defaultdict(list)
        self._rows: list[tuple[int, ...]] = []
        self._lists: list[int] = []
        self._scratch = 0
        self._assemble()
        results = list(map(self._register, writer.given))
        real = [writer.graph.kind[n] == "real" for n in writer.results]
        ordered = [r for r, k in zip(results, real, strict=True) if k]
        ordered += [r for r, k in zip(results, real, strict=True) if not k]
        pairs = [(at, bits) for bits, at in self._constants.items()]
        arrays = (
            np.array(self._rows, np.int32).reshape(-1, 5),
            np.array(self._lists, np.int32),
            np.array(pairs, np.int64).reshape(-1, 2),
            np.array(ordered, np.int32),
        )
        sizes = len(self._rows), len(pairs), self._count, self._scratch, nx, nk, ny, nm
        self._hold(arrays, np.array(sizes, np.int64))
        del self._writer, self._rows, self._lists, self._of, self._lasting, self._free, self._ends

    @classmethod
    def of(cls, arrays: Sequence[np.ndarray], sizes: np.ndarray) -> Tape:
        """Tape from the arrays and sizes of an existing one."""
        made = object.__new__(cls)
        made._hold(arrays, sizes)
        return made

    def _hold(self, arrays: Sequence[np.ndarray], sizes: np.ndarray) -> None:
        self.arrays, self.sizes = arrays, sizes
        self._fields = np.array([*(a.ctypes.data for a in arrays), *sizes], np.int64)
        self.address = address(self._fields)

    def _bits(self, kind: str, value: np.generic | int) -> int:
        """The 64 bits of a number in a register; a word fills both halves."""
        number = np.zeros(1, np.int64)
        if kind == "bits":
            number[0] = value
        elif kind == "flag":
            number[0] = self._flag * bool(value)
        else:
            number.view(KINDS[kind])[:] = value
        return int(number[0])

    def _register(self, place: Place) -> int:
        value, behind = place
        if (first := self._of.get(value)) is None:
            first = self._lasting.get(value)
            if first is None:
                first = self._lasting[value] = self._argument(value)
        return first + behind

    def _argument(self, value: Value) -> int:
        """Register of an argument of the program, or of a constant."""
        match value:
            case ("x", int(k)):
                return k
            case ("raw", int(k)):
                return self._nx + k
            case ("constant", kind, number):
                return self._constants[self._bits(kind, number)]
        raise KeyError(value)

    def _assemble(self) -> None:
        """Write all instructions, and the targets of jumps in the end."""
        writer = self._writer
        last, at_row = writer.last_uses(), [0] * (len(writer.written) + 1)
        jumps: list[tuple[int, int, int]] = []  # row, operand in it, target instruction
        for at, one in enumerate(writer.written):
            at_row[at] = len(self._rows)
            args = list(map(self._register, one.args))
            listed = list(map(self._register, one.listed))
            if not one.widens:
                self._free_after(at)
            result = 0
            if one.result is not None:
                value, behind = one.result
                if value not in self._of:
                    self._take(value, one.count, max(last.get(value, 0), at + 1))
                result = self._of[value] + behind
            self._free_after(at)
            if one.code == "again":
                jumps.append((len(self._rows), 3, one.numbers[2]))
            elif one.code == "leave_unless":
                jumps.append((len(self._rows), 2, writer.spans[one.numbers[0]][1]))
            if one.code and one.code not in self._codes:
                raise ProgramError(f"the interpreter has no operation '{one.code}'")
            if one.code:
                row = self._row(one, result, args, listed)
                self._rows.append((self._codes[one.code], *(*row, 0, 0, 0)[:4]))
        at_row[-1] = len(self._rows)
        for row, k, to in jumps:
            numbers = self._rows[row]
            self._rows[row] = (*numbers[:k], at_row[to], *numbers[k + 1 :])

    def _take(self, value: Value, count: int, until: int) -> None:
        """Allocate registers to a value up to an instruction."""
        if self._free[count]:
            self._of[value] = self._free[count].pop()
        else:
            self._of[value] = self._count
            self._count += count
        self._ends[until].append((value, count))

    def _free_after(self, at: int) -> None:
        """Free the registers that an instruction is the last to need."""
        for value, count in self._ends.pop(at, ()):
            self._free[count].append(self._of.pop(value))

    def _row(
        self, one: Instruction, result: int, args: Sequence[int], listed: Sequence[int]
    ) -> tuple[int, ...]:
        """Operands of an instruction, which follow its code."""
        match one.code:
            case "begin":
                return (self._writer.depth(one.numbers[0]),)
            case "round":
                return result, self._writer.depth(one.numbers[0])
            case "keep":
                return result, args[0], self._writer.depth(one.numbers[0])
            case "again":
                return self._writer.depth(one.numbers[0]), one.numbers[1]
        if not one.listed:
            return (*args,) if one.result is None else (result, *args)
        begin = len(self._lists)
        if one.code == "take":
            self._lists += listed
            return result, begin, self._writer.depth(one.numbers[0])
        self._lists += [*one.numbers, *listed]
        if not one.numbers:
            return result, begin, args[0]
        self._scratch = max(self._scratch, len(listed) + one.count)
        return result, begin, one.count
