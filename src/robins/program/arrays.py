"""Equations on arrays of all runs: NumPy moves large arrays, programs compute numbers.

Between the loops of a function lie a few numbers of each run, which are a program of one round
(`ArrayProgram`), and long histories that are cut, joined and gathered (`moving_step`) or computed
entry by entry. Programs are interpreted: nothing is compiled. What has no place in a program stays
with JAX (`by_jax`).

Arrays are those of NumPy, with a leading axis of runs where they depend on the run; a key of random
numbers is a whole number (`robins.program.kinds.numbers_of`).
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

from robins.program.kept import cached_rounds
from robins.program.kinds import array_of, kind_of, numbers_of
from robins.program.lanes import CompiledRounds, Given
from robins.program.liveness import (
    Equation,
    StageMemory,
    Variable,
    bytes_of,
    bytes_of_jaxpr,
    jaxpr_of,
    last_uses,
    variables,
)
from robins.program.loops import ENTRYWISE, number_of
from robins.program.nodes import Graph
from robins.program.primitives.indexing import filling, gathered, scattered
from robins.program.refusal import BuildError, ProgramError
from robins.program.walk import RULES, JaxprWriter, Leaf, Program

Values = dict[Variable, np.ndarray]

LARGE = 200  # entries of an array beyond which it is moved as a whole
FOLDED = 2_000  # indices or flags that become part of a program
MOST = 200_000  # about the most nodes of one equation that are written out
DRAW = 150  # nodes of a random number
UNROLL = 3_000  # operations up to which a loop is written out
MOVES = {
    *("broadcast_in_dim", "reshape", "transpose", "squeeze", "expand_dims", "slice", "pad", "rev"),
    *("concatenate", "stack", "tile", "split", "unstack", "iota"),
}
INDEXED = {"gather": gathered, "scatter": scattered}
# XLA must not run two batches of these at once (`docs/performance.md`).
FACTORISED = ("qr[", "lu[", "eigh[", "svd[", "cholesky[", "triangular_solve[")
_one_at_a_time = threading.Lock()
# Variables taken, variables made, and their computation from number of runs and values.
Compute = Callable[[int, Values], Sequence[np.ndarray]]
Step = tuple[list[Variable], list[Variable], Compute]


def size_of(v: Variable) -> int:
    """Number of entries of a variable or literal."""
    return int(np.prod(v.aval.shape))


def taken_by(equations: Sequence[Equation]) -> list[Variable]:
    """The variables that equations take from others, each once."""
    made = {v for e in equations for v in e.outvars}
    every = (v for e in equations for v in variables(e.invars))
    return list(dict.fromkeys(v for v in every if v not in made))


def made_by(equations: Sequence[Equation], wanted: Callable[[Variable], bool]) -> list[Variable]:
    """Outputs of the equations that are used elsewhere."""
    return [v for e in equations for v in e.outvars if wanted(v)]


class ArrayProgram:
    """Equations as a program of one round, for all runs; or for all entries of arrays.

    Attributes:
        takes, makes: variables.
        refused: the reason if they are not a program.
    """

    def __init__(
        self,
        equations: Sequence[Equation],
        makes: list[Variable],
        batched: Collection[Variable],
        entries: tuple[int, ...] = (),
    ):
        """Store the equations; the first call writes the program.

        Args:
            equations: in an order of computation.
            makes: variables that are wanted.
            batched: variables that depend on the run.
            entries: the shape of all large arrays; where given, the program is of one entry.
        """
        self.takes, self.makes, self._entries = taken_by(equations), makes, entries
        self.refused: ProgramError | BuildError | None = None
        self._equations, self._batched = equations, [v in batched for v in self.takes]
        self._compute: Compute | None = None
        self._lock = threading.Lock()

    def __call__(self, runs: int, values: Values) -> Sequence[np.ndarray]:
        """Compute the equations, for one run where they depend on none."""
        with self._lock:  # one of the first threads writes the program
            if self._compute is None:
                self._compute = self._made(values)
        return self._compute(runs, values)

    def _made(self, values: Values) -> Compute:
        known = {v: values[v] for v, b in zip(self.takes, self._batched, strict=True) if not b}
        known = {v: a for v, a in known.items() if a.dtype.kind in "bi" and a.size <= FOLDED}
        self._free = [k for k, v in enumerate(self.takes) if v not in known]
        known = {} if self._entries else known
        try:
            if not self._entries and max(map(nodes_of, self._equations)) > MOST:
                return by_jax(self._equations, self.makes, self._batched)
            jaxpr = jaxpr_of(self._equations, self.takes, self.makes)
            parts = [jaxpr, self._entries, [known.get(v) for v in self.takes]]
            program, engine, _ = cached_rounds(parts, lambda: self._program(known))
            self._rounds = CompiledRounds(program, 1, 0, len(program.inputs), engine=engine)
        except (ProgramError, BuildError) as error:
            self.refused = error
            return by_jax(self._equations, self.makes, self._batched)
        return self._of_entries if self._entries else self._of_runs

    def _program(self, known: Values) -> Program:
        """Write the program; known: indices and flags, which are the same in all calls."""
        walk = JaxprWriter(Graph(), UNROLL)
        shape = (lambda v: ()) if self._entries else (lambda v: v.aval.shape)
        nodes = [
            walk.constants(known[v]) if v in known else walk.taken(shape(v), v.aval.dtype)
            for v in self.takes
        ]
        jaxpr = jaxpr_of(self._equations, self.takes, self.makes)
        outputs = walk.open(jaxpr, (), nodes)
        results = [Leaf(shape(v), v.aval.dtype, kind_of(v.aval.dtype), "") for v in self.makes]
        return Program(*(walk.graph, walk.inputs, outputs, results, (None, None)))

    def _of_runs(self, runs: int, values: Values) -> Sequence[np.ndarray]:
        given = [(values[self.takes[k]], self._batched[k]) for k in self._free]
        if not any(self._batched):
            return [np.asarray(a[0, 0]) for a in self._rounds(1, given)]
        return [a[:, 0] for a in self._rounds(runs, given)]

    def _of_entries(self, runs: int, values: Values) -> Sequence[np.ndarray]:
        """Compute all entries of all runs, or once where no array depends on the run."""
        lead = (runs,) if any(self._batched) else ()
        shape = *lead, *self._entries
        given: list[Given] = []
        for v, batched in zip(self.takes, self._batched, strict=True):
            array = values[v]
            if v.aval.shape:
                array = np.broadcast_to(array, shape).reshape(-1)
            elif batched:  # a number of each run, for all its entries
                array = np.repeat(array, int(np.prod(self._entries)))
            given.append((array, batched or bool(v.aval.shape)))
        return [a.reshape(shape) for a in self._rounds(int(np.prod(shape)), given)]


def by_jax(
    equations: Sequence[Equation], makes: list[Variable], batched: Sequence[bool]
) -> Compute:
    """Computation by JAX for all runs at once; batched: flags by variable taken."""
    takes = taken_by(equations)
    jaxpr = jaxpr_of(equations, takes, makes)
    function = jex.jaxpr_as_fun(jex.ClosedJaxpr(jaxpr, []))
    axes = tuple(0 if b else None for b in batched)
    compiled = jax.jit(jax.vmap(function, axes) if any(batched) else function)
    alone = any(name in str(jaxpr) for name in FACTORISED)

    def compute(runs: int, values: Values) -> Sequence[np.ndarray]:
        given = [array_of(values[v], v.aval.dtype) for v in takes]
        with _one_at_a_time if alone else contextlib.nullcontext():
            return list(map(numbers_of, compiled(*given)))

    return compute


def moving_step(e: Equation, batched: Collection[Variable]) -> Compute:
    """Computation of an equation that moves or counts entries at places common to all runs."""
    name = e.primitive.name
    index = e.invars[1] if name in INDEXED else None
    data = [v for v in e.invars if v is not index]
    found: list[np.ndarray] = []  # by result: index of each entry in the joined data
    of_runs = [v in batched for v in variables(e.invars)]

    def flat(v: Variable, runs: int, values: Values) -> np.ndarray:
        depends = not isinstance(v, jex.Literal) and v in batched
        return _value(v, values).reshape(runs if depends else 1, -1)

    def compute(runs: int, values: Values) -> Sequence[np.ndarray]:
        if not found:
            known = [] if index is None else [_value(index, values)]
            found[:] = _places(e, known, data)  # equal, if two threads come first
        parts = [flat(v, runs, values) for v in data]
        if name == "gather":
            parts.append(np.full((1, 1), filling(e)))
        if name == "iota":
            parts.append(np.arange(found[0].max(initial=0) + 1, dtype=e.params["dtype"])[None])
        wide = max(map(len, parts))
        if len(parts) > 1:
            parts = [
                np.concatenate([np.broadcast_to(a, (wide, a.shape[1])) for a in parts], axis=1)
            ]
        made = [_at(parts[0], places) for places in found]
        return made if any(of_runs) else [np.asarray(a[0]) for a in made]

    return compute


def _places(e: Equation, known: list[np.ndarray], data: list[Variable]) -> list[np.ndarray]:
    name, p = e.primitive.name, e.params
    if name == "iota":
        along = [-1 if k == p["dimension"] else 1 for k in range(len(p["shape"]))]
        return [np.broadcast_to(np.arange(p["shape"][p["dimension"]]).reshape(along), p["shape"])]
    places, begin = [], 0
    for v in data:
        places.append(np.arange(begin, begin + size_of(v)).reshape(v.aval.shape))
        begin += size_of(v)
    if name in INDEXED:
        return [INDEXED[name](e, *known, *places)]
    made = RULES[name](JaxprWriter(Graph()), e, *places)
    return list(made) if isinstance(made, (list, tuple)) else [made]


class ArraySteps:
    """Equations outside of loops, in an order of computation.

    Attributes:
        equations: all.
        takes, makes: variables.
    """

    def __init__(self, equations: Sequence[Equation] = ()) -> None:
        self.equations = list(equations)
        self.takes: list[Variable] = []
        self.makes: list[Variable] = []
        self._steps: list[Step] = []
        self._dropped: list[list[Variable]] = []
        self._most = 0

    @property
    def touched(self) -> StageMemory:
        """Variables in and out, and the bytes needed in between."""
        outside = sum(map(bytes_of, {*self.takes, *self.makes}))
        return StageMemory(self.takes, self.makes, max(self._most - outside, 0))

    @property
    def refused(self) -> list[ProgramError | BuildError]:
        """Reasons why parts stay with JAX; known after the first call."""
        every = (step for _, _, step in self._steps if isinstance(step, ArrayProgram))
        return [step.refused for step in every if step.refused is not None]

    def connect(self, batched: Collection[Variable], wanted: Callable[[Variable], bool]) -> None:
        """Find the variables in and out, and cut the equations into steps."""
        self.takes, self.makes = taken_by(self.equations), made_by(self.equations, wanted)
        self._most = bytes_of_jaxpr(jaxpr_of(self.equations, self.takes, self.makes))
        self._steps = steps_of(self.equations, self.makes, batched)
        touched = [StageMemory(takes, makes) for takes, makes, _ in self._steps]
        self._dropped = last_uses(touched, {*self.takes, *self.makes})

    def __call__(self, runs: int, values: Values) -> Values:
        """Compute the variables in `makes` from the values so far."""
        here = {v: values[v] for v in self.takes}
        for (_, makes, step), dropped in zip(self._steps, self._dropped, strict=True):
            here.update(zip(makes, step(runs, here), strict=True))
            for v in dropped:
                here.pop(v, None)
        return {v: here[v] for v in self.makes}


def steps_of(
    equations: Sequence[Equation], makes: list[Variable], batched: Collection[Variable]
) -> list[Step]:
    """Steps of equations: at each level the small ones together, then the large ones."""
    level: dict[Variable, tuple[int, bool]] = {}  # of a result, and whether it is made last there
    small: dict[int, list[Equation]] = {}
    large: dict[int, list[Equation]] = {}
    for e in equations:
        whole = is_large(e, batched)
        of = [level[v] for v in variables(e.invars) if v in level]
        here = max((k + (last and not whole) for k, last in of), default=0)
        (large if whole else small).setdefault(here, []).append(e)
        level.update((v, (here, whole)) for v in e.outvars)
    groups = [
        group
        for k in sorted({*small, *large})
        for group in ([small[k]] if k in small else []) + grouped(large.get(k, []))
    ]
    needed = {*makes, *(v for group in groups for v in taken_by(group))}
    return [_step(group, made_by(group, needed.__contains__), batched) for group in groups]


def grouped(equations: Sequence[Equation]) -> list[list[Equation]]:
    """Group large equations: consecutive entrywise ones of one shape are a group."""
    groups: list[list[Equation]] = []
    kinds: list[tuple[int, ...] | None] = []
    for e in equations:
        kind = e.outvars[0].aval.shape if e.primitive.name in ENTRYWISE else None
        if kind is not None and kinds and kinds[-1] == kind:
            groups[-1].append(e)
        else:
            groups.append([e])
            kinds.append(kind)
    return groups


def moves_entries(e: Equation, batched: Collection[Variable]) -> bool:
    """True for an equation that moves entries, to places that all runs share."""
    name = e.primitive.name
    if name in INDEXED:
        return not set(variables([e.invars[1]])) & set(batched)
    return name in MOVES


def is_large(e: Equation, batched: Collection[Variable]) -> bool:
    """True for an equation that is a step of its own: on large arrays, or unfit for a program."""
    name = e.primitive.name
    if moves_entries(e, batched) or name in ENTRYWISE:
        return max(map(size_of, [*e.invars, *e.outvars])) > LARGE
    return name not in RULES or nodes_of(e) > MOST


def nodes_of(e: Equation) -> int:
    """Estimate the number of nodes of an equation that is written out."""
    name, p, most = e.primitive.name, e.params, max(map(size_of, [*e.invars, *e.outvars]))
    made = size_of(e.outvars[0])
    every = (x for value in p.values() for x in _each(value))
    if jaxprs := [x for x in every if isinstance(x, jex.ClosedJaxpr)]:
        inside = sum(nodes_of(inner) for one in jaxprs for inner in one.jaxpr.eqns)
        rounds = p.get("length", p.get("count", 1))
        return most + inside * (rounds if inside * rounds <= UNROLL else 1)
    match name:
        case "random_bits":
            return DRAW * made
        case "gather" | "dynamic_slice":  # a choice among all that it may be
            return made * max(e.invars[0].aval.shape, default=1)
        case "dot_general":
            ((left, _), _) = p["dimension_numbers"]
            return 2 * made * int(np.prod([e.invars[0].aval.shape[k] for k in left]))
    if name.startswith("scatter") or name == "dynamic_update_slice":
        return most * size_of(e.invars[-1])
    return most


def _each(value: Any) -> Sequence[Any]:
    return value if isinstance(value, (list, tuple)) else [value]


def _step(equations: list[Equation], makes: list[Variable], batched: Collection[Variable]) -> Step:
    e = equations[0]
    large = is_large(e, batched)
    if large and moves_entries(e, batched):
        return variables(e.invars), list(e.outvars), moving_step(e, batched)
    entries = e.outvars[0].aval.shape if large and e.primitive.name in ENTRYWISE else ()
    one = ArrayProgram(equations, makes, batched, entries)
    return one.takes, one.makes, one


def _value(v: Variable, values: Values) -> np.ndarray:
    return number_of(v) if isinstance(v, jex.Literal) else np.asarray(values[v])


def _at(entries: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Entries (runs, n) at places; a view where the places are contiguous."""
    flat = places.ravel()
    if flat.size and flat[0] >= 0 and np.array_equal(flat, np.arange(flat[0], flat[0] + flat.size)):
        found = entries[:, flat[0] : flat[0] + flat.size]
    else:
        found = entries[:, flat]
    return found.reshape(len(entries), *places.shape)
