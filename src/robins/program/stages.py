"""A function of one run, applied to many: its loops as programs, and arrays between them.

The jaxpr of the function is cut into *stages*: what goes along one axis is a loop
(`robins.program.loops`), what lies between loops are arrays (`robins.program.arrays`). What depends
on no run is computed once. What has no place in a program stays with JAX, which is reported.

Compilers call this loop distribution (or fission) with typed fusion (Kennedy & McKinley 1993): an
equation joins the loop of its axis at the lowest *level* at which all it needs is there, so loops
are as few and as long as dependences allow. A row needs its own row of an earlier equation, which
the same loop has just made; a whole array must be finished, which begins the next level.

An example: a random walk less its last value. The sum needs rows of the product, so both are one
loop. The difference needs the last value, so it is a second loop one level later:

    level 0   loop    b[k] = 2 a[k];  c[k] = c[k-1] + b[k]
    level 1   arrays  d = c[299]
              loop    e[k] = c[k] - d

>>> def centred(a):
...     c = jax.numpy.cumsum(2.0 * a)
...     return c - c[-1]
>>> shape = jax.ShapeDtypeStruct((300,), "float64")
>>> staged = StagedFunction(centred, shape, engine=interpreted_rounds)
>>> [[e.primitive.name for e in loop.equations] for loop in staged.loops]
[['mul', 'scan'], ['sub']]

The product is never an array: a run holds a, c, d and e.

>>> staged.bytes_of_run == 8 * (300 + 300 + 1 + 300)
True
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.extend import core as jex
from jaxtyping import PyTree

from robins.program.arrays import (
    LARGE,
    UNROLL,
    ArraySteps,
    Values,
    by_jax,
    jaxpr_of,
    made_by,
    size_of,
    taken_by,
)
from robins.program.interpreter import interpreted_rounds
from robins.program.kept import cached_rounds
from robins.program.kinds import array_of, is_key, numbers_of
from robins.program.lanes import CompiledRounds, Given, RoundsEngine, compiled_rounds, zero_in_all
from robins.program.liveness import (
    Equation,
    StageMemory,
    Variable,
    last_uses,
    most_bytes,
    variables,
)
from robins.program.loops import (
    SHORTEST,
    Along,
    LoopBody,
    axis_of,
    makes_rows,
    number_of,
    operations,
    uses,
)
from robins.program.names import Tree
from robins.program.primitives.control import called
from robins.program.refusal import BuildError, ProgramError
from robins.program.trace import with_preserved_zeros

WORTH = 5_000  # operations of a loop that is worth a compiler; others are interpreted
FEWEST = 8  # number of equations from which on any loop is worth one
FOLDED = 2_000  # numbers of a known array that becomes part of a program
CUMULATED = {
    "cumsum": (lax.add, lambda dtype: 0),
    "cumprod": (lax.mul, lambda dtype: 1),
    "cummax": (lax.max, lambda dtype: _extreme(dtype, -1)),
    "cummin": (lax.min, lambda dtype: _extreme(dtype, 1)),
}


def as_jaxpr(function: Callable[..., PyTree], *shapes: PyTree) -> tuple[jex.ClosedJaxpr, Tree]:
    """A function of these shapes as one jaxpr, and the structure of its results.

    All calls are written out, and sums along the first axis are scans; variables occur once.
    """
    closed, results = jax.make_jaxpr(function, return_shape=True)(*shapes)
    equations: list[Equation] = []
    known: dict[Variable, Any] = {}

    def write(closed: jex.ClosedJaxpr, args: Sequence[Variable]) -> list[Variable]:
        jaxpr = closed.jaxpr
        now: dict[Variable, Variable] = dict(zip(jaxpr.invars, args, strict=True))
        for v, value in zip(jaxpr.constvars, closed.consts, strict=True):
            now[v] = jex.Var(v.aval)
            known[now[v]] = value

        def read(v: Variable) -> Variable:
            return v if isinstance(v, jex.Literal) else now[v]

        for e in jaxpr.eqns:
            given = list(map(read, e.invars))
            inner = called(e) or cumulative_scan(e) or unrolled_scan(e)
            if inner is not None:
                found = write(inner, given)
            else:
                found = [jex.Var(v.aval) for v in e.outvars]
                equations.append(e.replace(invars=given, outvars=found))
            now.update(zip(e.outvars, found, strict=True))
        return list(map(read, jaxpr.outvars))

    takes = [jex.Var(v.aval) for v in closed.jaxpr.invars]
    makes = write(closed, takes)
    jaxpr = jaxpr_of(equations, takes, makes, list(known))
    return jex.ClosedJaxpr(jaxpr, list(known.values())), jax.tree_util.tree_structure(results)


def cumulative_scan(e: Equation) -> jex.ClosedJaxpr | None:
    """A sum, product or extreme along the first axis as the closed jaxpr of a scan."""
    name, p = e.primitive.name, e.params
    if name not in CUMULATED or p["axis"] != 0:
        return None
    join, neutral = CUMULATED[name]

    def scanned(a: jax.Array) -> jax.Array:
        def step(total: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
            total = join(total, row)
            return total, total

        begin = jax.numpy.full(a.shape[1:], neutral(a.dtype), a.dtype)
        return lax.scan(step, begin, a, reverse=p["reverse"])[1]

    aval = e.invars[0].aval
    return jax.make_jaxpr(scanned)(jax.ShapeDtypeStruct(aval.shape, aval.dtype))


def unrolled_scan(e: Equation) -> jex.ClosedJaxpr | None:
    """A short scan over large arrays as a closed jaxpr without it: its rounds one after another."""
    p = e.params
    if e.primitive.name != "scan" or p["length"] >= SHORTEST:
        return None
    if all(size_of(v) <= LARGE for v in [*e.invars, *e.outvars]):
        return None
    body, fixed, carried = jex.jaxpr_as_fun(p["jaxpr"]), p["num_consts"], p["num_carry"]

    def rounds(*given: jax.Array) -> tuple[jax.Array, ...]:
        now, rows = given[fixed : fixed + carried], given[fixed + carried :]
        made: list[Any] = [None] * p["length"]
        for k in sorted(range(p["length"]), reverse=p["reverse"]):
            row = [lax.index_in_dim(a, k, keepdims=False) for a in rows]
            found = body(*given[:fixed], *now, *row)
            now, made[k] = found[:carried], found[carried:]
        return (*now, *map(jax.numpy.stack, zip(*made, strict=True)))

    shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in e.invars]
    return jax.make_jaxpr(rounds)(*shapes)


def _extreme(dtype: np.dtype, sign: int) -> float | int:
    """The least or greatest number of a type."""
    if np.issubdtype(dtype, np.floating):
        return sign * np.inf
    return np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min


class AxisLoop:
    """Equations along one axis: rounds of a program, or JAX if they have no place in one.

    Attributes:
        equations: in an order of computation.
        is_worth: whether it is worth the time of a compiler.
        refused: the reason if they are not a program.
        nodes: number of nodes of its program, if it is interpreted.
    """

    def __init__(self, axis: Along, engine: RoundsEngine, is_worth: bool):
        self.axis, self.is_worth = axis, is_worth
        self._engine = engine if is_worth else interpreted_rounds
        self.equations: list[Equation] = []
        self.refused: ProgramError | BuildError | None = None
        self.rounds: CompiledRounds | None = None
        self.nodes = 0
        self._lock = threading.Lock()

    def connect(
        self,
        batched: set[Variable],
        wanted: Callable[[Variable], bool],
        named: Collection[Variable],
        unroll: int | None,
    ) -> None:
        """Find inputs and outputs; named: variables of which the first run is enough."""
        self._batched, self._wanted, self._unroll = batched, wanted, unroll
        self.body = body = LoopBody(self.equations, self.axis, wanted)
        made = [*body.after, *body.made]
        self._named = {k for k, v in enumerate(made, 1) if v in named}
        self.touched = StageMemory([*body.begin, *body.stays, *body.rows], made)

    def __call__(self, runs: int, values: Values) -> Values:
        """Compute the variables that it makes from the values so far."""
        body = self.body

        def given(v: Variable) -> Given:
            if isinstance(v, jex.Literal):
                return number_of(v), False
            return values[v], v in self._batched

        known = {
            v: np.asarray(values[v])
            for v in body.stays
            if v not in self._batched and size_of(v) <= FOLDED and not is_key(v.aval.dtype)
        }
        begin = [(np.zeros((), np.int64), False), *map(given, body.begin)]
        with self._lock:  # one of the first threads compiles
            self._compile(known, begin)
            rounds = self.rounds
        if rounds is None:
            return dict(zip(self._makes, self._by_jax(runs, values), strict=True))
        free = [v for v in body.stays if v not in known]
        found = rounds(runs, [*begin, *map(given, free), *map(given, body.rows)], self._named)
        return dict(zip([*body.after, *body.made], found[1:], strict=True))

    def hand_over(self) -> None:
        """Replace the interpreter by compiled rounds, after the first call; the bits stay the same.

        Raises:
            BuildError: there is no compiler, or it refuses the program.
        """
        if self.rounds is not None:
            if not self.rounds.program.outputs:  # from the cache
                self.rounds.program = self._write()
            self.rounds.hand_over(compiled_rounds)

    def _compile(self, known: Values, begin: Sequence[Given]) -> None:
        if self.refused or (self.rounds is not None and self.rounds.holds_for(begin)):
            return
        body, zeros = self.body, {k: zero_in_all(g) for k, g in enumerate(begin) if k}
        self._write = lambda: with_preserved_zeros(
            lambda some, calls: [body.program(known, some, self._unroll, calls)], zeros
        )[0]
        try:
            if self._engine is interpreted_rounds:
                parts = [body.jaxpr, self.axis, self._unroll, body.known(known), zeros]
                program, engine, self.nodes = cached_rounds(parts, self._write)
            else:
                program, engine = self._write(), self._engine
            stays = len(body.stays) - len(known)
            axis = self.axis
            self.rounds = CompiledRounds(program, axis[0], len(begin), stays, axis[1], engine)
        except (ProgramError, BuildError) as error:
            self.refused = error
            takes, makes = taken_by(self.equations), made_by(self.equations, self._wanted)
            self._makes = makes
            self._by_jax = by_jax(self.equations, makes, [v in self._batched for v in takes])


def split_stages(
    equations: Sequence[Equation], takes: Sequence[Variable], engine: RoundsEngine
) -> tuple[
    ArraySteps, dict[int, ArraySteps], dict[tuple[int, Along], AxisLoop], dict[Variable, int]
]:
    """Cut equations into stages.

    Args:
        equations: in an order of computation.
        takes: variables that depend on the run.
        engine: of loops that are worth a compiler.

    Returns:
        Arrays that depend on no run; arrays, and loops by axis, of each level; and the levels of
        all variables that depend on the run. What a loop makes is there for arrays, and for loops
        along other axes, one level later.
    """
    axes = {id(e): axis for e in equations if (axis := axis_of(e)) is not None}
    worth: Counter[Along] = Counter()
    for e in equations:
        if (axis := axes.get(id(e))) is not None:
            worth[axis] += operations(e) + WORTH // FEWEST
    level: dict[Variable, int] = dict.fromkeys(takes, 0)
    source: dict[Variable, Along] = {}  # of what a loop makes, row by row
    after: set[Variable] = set()  # what a loop leaves
    known = ArraySteps()
    batches: dict[int, ArraySteps] = {}
    loops: dict[tuple[int, Along], AxisLoop] = {}
    for e in equations:
        axis = axes.get(id(e))
        if axis is None:
            whole, rows = [v for v in e.invars if not isinstance(v, jex.Literal)], []
        else:
            whole, rows = uses(e, axis[0])
        of = [level[v] + (v in source or v in after) for v in whole if v in level]
        for v in rows:
            if v in level:
                same = v in source and source[v] == axis
                of.append(level[v] + (not same and (v in source or v in after)))
        if not of:
            known.equations.append(e)
            continue
        here = max(of)
        level.update((v, here) for v in e.outvars)
        if axis is None:
            batches.setdefault(here, ArraySteps()).equations.append(e)
            continue
        if (here, axis) not in loops:
            loops[here, axis] = AxisLoop(axis, engine, worth[axis] >= WORTH)
        loops[here, axis].equations.append(e)
        made = makes_rows(e)
        source.update((v, axis) for v in made)
        after.update(v for v in e.outvars if v not in source)
    return known, batches, loops, level


class StagedFunction:
    """A function of one run as a function of a batch of them.

    Results of a run have the same bits in any batch; parts that stay with JAX agree to rounding.

    Attributes:
        bytes_of_run: approximate peak memory of the values of a run, its arguments included.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        *shapes: PyTree,
        unroll: int | None = UNROLL,
        named: bool = False,
        engine: RoundsEngine = compiled_rounds,
    ):
        """Cut a function into stages; they are compiled when it is called.

        Args:
            function: pure, of the arguments of one run.
            shapes: of these, pytrees of `jax.ShapeDtypeStruct`.
            unroll: as in `robins.program.trace`.
            named: the function returns a pair, and the second is kept of the first run only: its
                leading axis is one.
            engine: of the rounds of loops: `compiled_rounds`, or `interpreted_rounds`.
        """
        closed, self._tree = as_jaxpr(function, *shapes)
        flat = closed.jaxpr
        self._takes: list[Variable] = list(flat.invars)
        self._makes: list[Variable] = list(flat.outvars)
        of_all = self._tree.children()[0] if named else self._tree
        self._of_all: int = of_all.num_leaves
        known, batches, loops, level = split_stages(flat.eqns, self._takes, engine)
        batched = self._batched = set(level)
        parts = [known, *batches.values(), *loops.values()]
        between = {v for p in parts for v in taken_by(p.equations)}
        wanted = {*variables(self._makes), *between}.__contains__
        self._named = set(variables(self._makes)) - set(variables(self._makes[: self._of_all]))
        for one in (known, *batches.values()):
            one.connect(batched, wanted)
        for one in loops.values():
            one.connect(batched, wanted, self._named - between, unroll)
        self._stages: list[ArraySteps | AxisLoop] = []
        for k in range(max(level.values(), default=0) + 1):
            self._stages += [batches[k]] if k in batches else []
            self._stages += [one for (at, _), one in loops.items() if at == k]
        given = dict(zip(flat.constvars, map(numbers_of, closed.consts), strict=True))
        self._known = given | known(1, given)
        self._known_refused = known.refused
        touched = [self._of_runs(one.touched, between) for one in self._stages]
        kept = set(variables(self._makes)) - self._named
        self._dropped = last_uses(touched, kept | set(self._takes))
        self.bytes_of_run = most_bytes(touched, self._takes, kept)

    def _of_runs(self, one: StageMemory, between: set[Variable]) -> StageMemory:
        """Stage with its per-run variables: none that is known or kept of one run alone."""
        here = self._batched - (self._named - between)
        takes, makes = ([v for v in variables(some) if v in here] for some in one[:2])
        return StageMemory(takes, makes, one.within)

    @property
    def loops(self) -> list[AxisLoop]:
        """The loops, in an order of computation."""
        return [one for one in self._stages if isinstance(one, AxisLoop)]

    @property
    def refused(self) -> list[ProgramError | BuildError]:
        """Errors that explain which parts could not be compiled; complete after the first call."""
        arrays = (one for one in self._stages if isinstance(one, ArraySteps))
        loops = [loop.refused for loop in self.loops if loop.refused]
        return [*self._known_refused, *(why for one in arrays for why in one.refused), *loops]

    def __call__(self, *args: PyTree) -> PyTree:
        """The function on arguments with a leading axis of runs, as arrays of NumPy or JAX."""
        leaves = jax.tree_util.tree_leaves(args)
        runs = leaves[0].shape[0]
        values = dict(self._known)
        values.update(zip(self._takes, map(numbers_of, leaves), strict=True))
        for stage, dropped in zip(self._stages, self._dropped, strict=True):
            values.update(stage(runs, values))
            for v in dropped:
                value = values.pop(v, None)  # a loop left to JAX makes fewer
                if value is not None and v in self._named:
                    values[v] = first_of(value)
                del value

        def found(v: Variable, count: int) -> np.ndarray | jax.Array:
            if isinstance(v, jex.Literal) or v not in self._batched:
                alone = number_of(v) if isinstance(v, jex.Literal) else values[v]
                value = np.broadcast_to(alone, (count, *alone.shape))
            else:
                value = values[v] if count > 1 else first_of(values[v])
            dtype: Any = getattr(v.aval, "dtype")  # noqa: B009 pyright knows no such attribute
            return array_of(value, dtype) if is_key(dtype) else value

        many, few = self._makes[: self._of_all], self._makes[self._of_all :]
        leaves = [*(found(v, runs) for v in many), *(found(v, 1) for v in few)]
        return jax.tree_util.tree_unflatten(self._tree, leaves)


def first_of(value: np.ndarray) -> np.ndarray:
    """First run of an array of runs, copied so that the others can be freed."""
    return value if value.shape[0] == 1 else value[:1].copy()
