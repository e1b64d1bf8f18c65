"""Fusion of the equations of a jaxpr along one axis into the rounds of one loop.

A scan goes along its axis; so does an operation on arrays whose first axis is as long, if it treats
all rows alike and independently; and so do random numbers, as the generator takes the index of an
entry. Equations along the same axis become one loop, in which a row that only the next equation
needs is never written to memory. Values that a round leaves for the next are carried.

Compilers call this loop fusion, and the array that shrinks to one row array contraction; a scan is
the loop of a recurrence. An example: ``sin a`` and the sums of ``a``, added. Three equations go
along the axis of 300, and the loop reads one array and writes one:

    for k:   b = sin a[k];   c = c + a[k];   g[k] = b + c

>>> import jax
>>> def added(a):
...     return jax.numpy.sin(a) + jax.lax.scan(lambda c, x: (c + x, c + x), 0.0, a)[1]
>>> jaxpr = jax.make_jaxpr(added)(jax.ShapeDtypeStruct((300,), "float64")).jaxpr
>>> [(e.primitive.name, axis_of(e)) for e in jaxpr.eqns]
[('sin', (300, False)), ('scan', (300, False)), ('add', (300, False))]
>>> body = LoopBody(jaxpr.eqns, (300, False), lambda v: v in jaxpr.outvars)
>>> len(body.rows), len(body.after), len(body.made)  # taken row by row, carried, made row by row
(1, 1, 1)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax.extend import core as jex

from robins.program.calls import Calls
from robins.program.kinds import kind_of
from robins.program.liveness import Equation, Variable, jaxpr_of, variables
from robins.program.nodes import Graph
from robins.program.primitives.control import size_of
from robins.program.primitives.random import bits_of, numbered
from robins.program.walk import JaxprWriter, Leaf, Nodes, Program

ROUNDS = 200  # least length of a loop over rows; that of a scan is SHORTEST
SHORTEST = 30
WIDEST = 64  # most entries of a row
DRAW = 150  # operations of a scan that cost JAX as much as one random number

ENTRYWISE = {
    *("add", "sub", "mul", "div", "rem", "neg", "max", "min", "abs", "sign", "sqrt", "cbrt"),
    *("and", "or", "xor", "not", "shift_right_logical", "shift_left", "eq", "ne", "lt", "le"),
    *("gt", "ge", "select_n", "clamp", "is_finite", "floor", "ceil", "round", "integer_pow"),
    *("square", "rsqrt", "pow", "exp", "exp2", "expm1", "log", "log1p", "sin", "cos", "tan"),
    *("asin", "acos", "atan", "atan2", "tanh", "erf_inv", "convert_element_type", "copy"),
    *("bitcast_convert_type", "random_fold_in", "random_wrap", "random_unwrap", "stop_gradient"),
}
# Parameters that name the axes a primitive acts on; it goes along axis 0 if that is none of them.
AXES = {
    **dict.fromkeys(("squeeze", "expand_dims", "rev"), "dimensions"),
    **dict.fromkeys(("reduce_sum", "reduce_max", "reduce_min", "reduce_and", "reduce_or"), "axes"),
    **dict.fromkeys(("reduce_prod", "argmax", "argmin"), "axes"),
    **dict.fromkeys(("split", "stack", "cumsum"), "axis"),
    **dict.fromkeys(("concatenate", "sort"), "dimension"),
}
SIZES = {"broadcast_in_dim": "shape", "reshape": "new_sizes", "slice": "limit_indices"}
RANDOM = {"random_bits", "random_split"}
Named = dict[Variable, Nodes]


Along = tuple[int, bool]  # length of an axis, and whether equations go along it backwards


def axis_of(e: Equation) -> Along | None:
    """Axis along which an equation can be part of a loop; None if there is none."""
    name, p = e.primitive.name, e.params
    if name == "scan":
        return (p["length"], p["reverse"]) if p["length"] >= SHORTEST else None
    shapes = [v.aval.shape for v in e.outvars]
    if not all(shapes) or len({s[0] for s in shapes}) > 1 or e.effects:
        return None
    length = shapes[0][0]
    if length < ROUNDS or any(np.prod(s[1:]) > WIDEST for s in shapes):
        return None
    return (length, False) if _by_rows(e, name, p, length) else None


def _by_rows(e: Equation, name: str, p: Mapping[str, Any], length: int) -> bool:
    """True if an equation does the same to each row of its arrays."""
    given = [v.aval.shape for v in e.invars]
    rank = len(e.outvars[0].aval.shape)
    if name in RANDOM and not any(s and s[0] == length for s in given):
        return not given[0] and p["shape"][0] == length
    if name == "iota":
        return p["dimension"] == 0
    if name == "broadcast_in_dim":
        dims, shape = p["broadcast_dimensions"], given[0]
        return 0 not in dims or (dims[0] == 0 and shape[0] == length)
    rows = [bool(s) and s[0] == length for s in given]
    if name in ENTRYWISE or name == "random_bits":
        same = (
            r or not s or (len(s) == rank and s[0] == 1) for r, s in zip(rows, given, strict=True)
        )
        return any(rows) and all(same)
    if not rows or not all(rows):
        return False
    if name in AXES:
        axes = p[AXES[name]]
        return 0 not in (axes if isinstance(axes, (tuple, list)) else (axes,))
    match name:
        case "transpose":
            return p["permutation"][0] == 0
        case "reshape":
            return p["new_sizes"][0] == length and p["dimensions"] is None
        case "slice":
            strides = p["strides"] or (1,)
            return (
                p["start_indices"][0] == 0
                and p["limit_indices"][0] == length == length * strides[0]
            )
        case "dot_general":
            (_, _), (left, right) = p["dimension_numbers"]
            return bool(left) and left[0] == 0 == right[0]
        case "triangular_solve" | "cholesky" | "qr":
            return min(map(len, given)) >= 3
    return False


def operations(e: Equation) -> int:
    """Approximate cost of an equation to JAX, in scalar operations of a scan."""
    name = e.primitive.name
    if name == "scan":
        return e.params["length"] * size_of(e.params["jaxpr"].jaxpr)
    entries = int(np.prod(e.outvars[0].aval.shape))
    return DRAW * entries if name == "random_bits" else 0


def uses(e: Equation, length: int) -> tuple[list[Variable], list[Variable]]:
    """Variables that an equation needs whole before the loop, and those it needs row by row."""
    if e.primitive.name == "scan":
        before = e.params["num_consts"] + e.params["num_carry"]
        whole, rows = e.invars[:before], e.invars[before:]
    else:
        rows = [v for v in e.invars if v.aval.shape and v.aval.shape[0] == length]
        if e.primitive.name == "broadcast_in_dim" and 0 not in e.params["broadcast_dimensions"]:
            rows = []
        whole = [v for v in e.invars if v not in rows] if rows else e.invars
    return variables(whole), variables(rows)


def makes_rows(e: Equation) -> list[Variable]:
    """The variables that an equation makes row by row; a scan also leaves what it carried."""
    return e.outvars[e.params["num_carry"] :] if e.primitive.name == "scan" else e.outvars


class LoopBody:
    """The body of a loop over some equations, ready to be made a program.

    Attributes:
        begin: initial carries of the scans, variables or literals; in the carry of the loop they
            follow the number of the round.
        stays: variables needed whole, the same in all rounds.
        rows: variables of which each round takes a row.
        after: variables of the final carries of the scans.
        made: variables of which each round gives a row.
    """

    def __init__(
        self, equations: Sequence[Equation], axis: Along, wanted: Callable[[Variable], bool]
    ):
        """Find inputs and outputs.

        Args:
            equations: in an order of computation.
            axis: along which all go.
            wanted: whether anything outside needs a variable.
        """
        self.equations, self.axis = equations, axis
        inside = {v for e in equations for v in makes_rows(e)}
        stays: dict[Variable, None] = {}
        rows: dict[Variable, None] = {}
        self.begin: list[Variable] = []
        self.after: list[Variable] = []
        for e in equations:
            whole, by_row = uses(e, axis[0])
            if e.primitive.name == "scan":
                fixed, carried = e.params["num_consts"], e.params["num_carry"]
                whole = [v for v in e.invars[:fixed] if not isinstance(v, jex.Literal)]
                self.begin += e.invars[fixed : fixed + carried]
                self.after += e.outvars[:carried]
            stays.update(dict.fromkeys(whole))
            rows.update(dict.fromkeys(v for v in by_row if v not in inside))
        self.stays, self.rows = list(stays), list(rows)
        self.made = [v for e in equations for v in makes_rows(e) if wanted(v)]

    @property
    def jaxpr(self) -> jex.Jaxpr:
        """The equations, on all rows."""
        takes = [*variables(self.begin), *self.stays, *self.rows]
        return jaxpr_of(self.equations, list(dict.fromkeys(takes)), [*self.after, *self.made])

    def known(self, known: Mapping[Variable, np.ndarray]) -> list[np.ndarray | None]:
        """Known numbers of the variables that stay, in their order; None of the others."""
        return [known.get(v) for v in self.stays]

    def program(
        self,
        known: dict[Variable, np.ndarray],
        zeros: dict[int, np.ndarray],
        unroll: int | None,
        calls: Calls | None = None,
    ) -> Program:
        """One round as a program: (number, carry, staying, rows) -> (next number, carry, rows).

        Args:
            known: numbers of some variables that stay, which become part of the program.
            zeros: by index of an argument, mask of its carried entries that are zero.
            unroll: as in `robins.program.trace`.
            calls: of earlier attempts.

        Raises:
            ProgramError: an equation has no place in a program.
        """
        graph = Graph()
        walk = JaxprWriter(graph, unroll, calls)

        def taken(shape: tuple[int, ...], dtype: Any) -> Nodes:
            return walk.taken(shape, dtype, zero=zeros.get(len(walk.inputs)))

        index = taken((), np.dtype(np.int64))
        begin = [taken(v.aval.shape, v.aval.dtype) for v in self.begin]
        whole = {v: walk.constants(value) for v, value in known.items()}
        whole |= {v: taken(v.aval.shape, v.aval.dtype) for v in self.stays if v not in known}
        rows = {v: taken(v.aval.shape[1:], v.aval.dtype) for v in self.rows}
        after: list[Nodes] = []
        for e in self.equations:
            if e.primitive.name == "scan":
                count = e.params["num_carry"]
                now = begin[len(after) : len(after) + count]
                found = self._scanned(walk, e, now, whole, rows)
                after += found[:count]
                rows.update(zip(makes_rows(e), found[count:], strict=True))
            else:
                rows.update(zip(e.outvars, self._row(walk, e, whole, rows, index), strict=True))
        next_ = graph.apply("add", index.item(), graph.constant(1, "whole"))
        outputs = [np.array(next_), *after, *(rows[v] for v in self.made)]
        results = [Leaf((), np.dtype(np.int64), "whole", "results[0]")]
        for v in self.after:
            results.append(Leaf(v.aval.shape, v.aval.dtype, kind_of(v.aval.dtype), "carried"))
        for v in self.made:
            results.append(Leaf(v.aval.shape[1:], v.aval.dtype, kind_of(v.aval.dtype), "row"))
        return Program(graph, walk.inputs, outputs, results, (None, None), dict(zeros))

    def _scanned(
        self,
        walk: JaxprWriter,
        e: Equation,
        now: list[Nodes],
        whole: dict[Variable, Nodes],
        rows: dict[Variable, Nodes],
    ) -> list[Nodes]:
        fixed, carried = e.params["num_consts"], e.params["num_carry"]

        def read(v: Variable, of: Named) -> Nodes:
            if isinstance(v, jex.Literal):
                return walk.constants(number_of(v))
            return of[v]

        consts = [read(v, whole) for v in e.invars[:fixed]]
        taken = [read(v, rows) for v in e.invars[fixed + carried :]]
        return walk.closed(e.params["jaxpr"], *consts, *now, *taken)

    def _row(
        self,
        walk: JaxprWriter,
        e: Equation,
        whole: dict[Variable, Nodes],
        rows: dict[Variable, Nodes],
        index: Nodes,
    ) -> list[Nodes]:
        """Results of an equation on arrays of one row."""
        name, p, length = e.primitive.name, dict(e.params), self.axis[0]
        by_row = uses(e, length)[1]
        if name == "iota":
            kind = kind_of(e.outvars[0].aval.dtype)
            at = walk.graph.convert(index.item(), kind)
            return [np.full(e.outvars[0].aval.shape[1:], at)]
        if name in RANDOM and not by_row:
            (key,) = e.invars
            keys = whole[key]
            shape, at = tuple(p["shape"][1:]), index.item()
            if name == "random_split":
                return [numbered(walk, keys, shape, at)]
            return [bits_of(walk, keys, shape, e.outvars[0].aval.dtype, at)]
        if (sizes := SIZES.get(name)) is not None:
            p[sizes] = (1, *p[sizes][1:])

        def one(v: Variable, row: bool) -> Variable:
            if not row:
                return v
            return jex.Var(v.aval.update(shape=(1, *v.aval.shape[1:])))

        flags = [not isinstance(v, jex.Literal) and v in by_row for v in e.invars]
        same = e.replace(
            params=p,
            invars=[one(v, f) for v, f in zip(e.invars, flags, strict=True)],
            outvars=[one(v, True) for v in e.outvars],
        )

        def read(v: Variable, row: bool) -> Nodes:
            if isinstance(v, jex.Literal):
                return walk.constants(number_of(v))
            return rows[v][None] if row else whole[v]

        found = walk.equation(same, *(read(v, f) for v, f in zip(e.invars, flags, strict=True)))
        return [np.asarray(np.asarray(a)[0]) for a in found]


def number_of(literal: Variable) -> np.ndarray:
    """The number of a literal, in its type."""
    return np.asarray(literal.val, literal.aval.dtype)
