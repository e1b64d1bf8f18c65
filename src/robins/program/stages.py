"""A function of one run, for many: its loops as programs, all else as batches of JAX.

The jaxpr of the function is cut into *stages*: what goes along one axis is a loop
(`robins.program.loops`), what lies between loops is a batch. What depends on no run is computed
once. What has no place in a program stays with JAX, which is said.
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

from robins.program.kinds import is_key
from robins.program.lanes import Given, Rounds, Scan, compiled_rounds, zero_in_all
from robins.program.liveness import (
    Touched,
    bytes_of,
    bytes_of_jaxpr,
    last_uses,
    most_bytes,
    variables,
)
from robins.program.loops import (
    Along,
    Body,
    along,
    foldable,
    makes_rows,
    number_of,
    operations,
    uses,
)
from robins.program.primitives.control import called
from robins.program.refusal import BuildError, ProgramError
from robins.program.trace import Program, lasting

Engine = Callable[[Program], tuple[Scan, int]]
WORTH = 5_000  # operations of a loop that is worth a program
FEWEST = 8  # equations without a scan or random numbers that are
FOLDED = 2_000  # numbers of a known array that becomes part of a program
UNROLL = 3_000
# Of these XLA must not run two batches at once (`docs/performance.md`).
FACTORISED = ("qr[", "lu[", "eigh[", "svd[", "cholesky[", "triangular_solve[")
_one_at_a_time = threading.Lock()
CUMULATED = {
    "cumsum": (lax.add, lambda dtype: 0),
    "cumprod": (lax.mul, lambda dtype: 1),
    "cummax": (lax.max, lambda dtype: _extreme(dtype, -1)),
    "cummin": (lax.min, lambda dtype: _extreme(dtype, 1)),
}


class Flat:
    """A jaxpr with all calls written out, and sums along the first axis as scans.

    Attributes:
        equations: of variables of their own.
        known: the numbers of constants, by variable.
        takes: variables of the arguments.
        makes: variables or literals of the results.
        tree: the results' structure.
    """

    def __init__(self, function: Callable[..., Any], *shapes: Any):
        """Trace a function of arguments of these shapes."""
        closed, results = jax.make_jaxpr(function, return_shape=True)(*shapes)
        self.tree = jax.tree_util.tree_structure(results)
        self.equations: list[Any] = []
        self.known: dict[Any, Any] = {}
        self.takes = [jex.Var(v.aval) for v in closed.jaxpr.invars]
        self.makes = self._write(closed, self.takes)

    def _write(self, closed: Any, args: Sequence[Any]) -> list[Any]:
        jaxpr = closed.jaxpr
        now: dict[Any, Any] = dict(zip(jaxpr.invars, args, strict=True))
        for v, value in zip(jaxpr.constvars, closed.consts, strict=True):
            now[v] = jex.Var(v.aval)
            self.known[now[v]] = value

        def read(v: Any) -> Any:
            return v if isinstance(v, jex.Literal) else now[v]

        for e in jaxpr.eqns:
            given = list(map(read, e.invars))
            inner = called(e) or cumulated(e)
            if inner is not None:
                found = self._write(inner, given)
            else:
                found = [jex.Var(v.aval) for v in e.outvars]
                self.equations.append(e.replace(invars=given, outvars=found))
            now.update(zip(e.outvars, found, strict=True))
        return list(map(read, jaxpr.outvars))


def cumulated(e: Any) -> Any:
    """A sum, product or extreme along the first axis as the closed jaxpr of a scan."""
    name, p = e.primitive.name, e.params
    if name not in CUMULATED or p["axis"] != 0:
        return None
    join, neutral = CUMULATED[name]

    def scanned(a: Any) -> Any:
        def step(total: Any, row: Any) -> tuple[Any, Any]:
            total = join(total, row)
            return total, total

        begin = jax.numpy.full(a.shape[1:], neutral(a.dtype), a.dtype)
        return lax.scan(step, begin, a, reverse=p["reverse"])[1]

    aval = e.invars[0].aval
    return jax.make_jaxpr(scanned)(jax.ShapeDtypeStruct(aval.shape, aval.dtype))


def _extreme(dtype: Any, sign: int) -> Any:
    """The least or greatest number of a type."""
    if np.issubdtype(dtype, np.floating):
        return sign * np.inf
    return np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min


class Batch:
    """Equations that JAX computes for all runs at once.

    Attributes:
        takes, makes: variables.
    """

    def __init__(self, equations: Sequence[Any] = ()) -> None:
        self.equations = list(equations)
        self.takes: list[Any] = []
        self.makes: list[Any] = []
        self._compiled: Callable[..., Any] | None = None
        self._alone = False
        self._most = 0

    @property
    def touched(self) -> Touched:
        """What goes in and out, and what it needs in between."""
        outside = sum(map(bytes_of, {*self.takes, *self.makes}))
        return Touched(self.takes, self.makes, max(self._most - outside, 0))

    def compile(self, batched: set[Any], wanted: Callable[[Any], bool]) -> None:
        """Find what goes in and out, and let JAX compile it."""
        self.takes = list(dict.fromkeys(taken(self)))
        self.makes = [v for e in self.equations for v in e.outvars if wanted(v)]
        about = jex.DebugInfo("jit", "stage", None, None)
        jaxpr = jex.Jaxpr([], self.takes, self.makes, self.equations, debug_info=about)
        function = jex.jaxpr_as_fun(jex.ClosedJaxpr(jaxpr, []))
        axes = tuple(0 if v in batched else None for v in self.takes)
        self._most = bytes_of_jaxpr(jaxpr)
        self._alone = any(name in str(jaxpr) for name in FACTORISED)
        self._compiled = jax.jit(jax.vmap(function, axes) if 0 in axes else function)

    def __call__(self, runs: int, values: dict[Any, Any]) -> dict[Any, Any]:
        """What it makes of what is there."""
        assert self._compiled is not None
        given = [values[v] for v in self.takes]
        if self._alone:
            with _one_at_a_time:
                found = jax.block_until_ready(self._compiled(*given)) if self.makes else []
        else:
            found = self._compiled(*given) if self.makes else []
        return dict(zip(self.makes, found, strict=True))


class Loop:
    """Equations along one axis: rounds of a program, or JAX if they have no place in one.

    Attributes:
        equations: in an order of computation.
        refused: why they are no program.
    """

    def __init__(self, axis: Along, engine: Engine):
        self.axis, self._engine = axis, engine
        self.equations: list[Any] = []
        self.refused: ProgramError | BuildError | None = None
        self.rounds: Rounds | None = None
        self._lock = threading.Lock()

    def connect(
        self,
        batched: set[Any],
        wanted: Callable[[Any], bool],
        named: Collection[Any],
        unroll: int | None,
    ) -> None:
        """Find what goes in and out; of some variables that are made the first run is enough."""
        self._batched, self._wanted, self._unroll = batched, wanted, unroll
        self.body = body = Body(self.equations, self.axis, wanted)
        made = [*body.after, *body.made]
        self._named = {k for k, v in enumerate(made, 1) if v in named}
        self.touched = Touched([*body.begin, *body.stays, *body.rows], made)

    def __call__(self, runs: int, values: dict[Any, Any]) -> dict[Any, Any]:
        """What it makes of what is there."""
        body = self.body

        def given(v: Any) -> Given:
            if isinstance(v, jex.Literal):
                return number_of(v), False
            return values[v], v in self._batched

        known = {
            v: np.asarray(values[v])
            for v in body.stays
            if v not in self._batched and foldable(values[v], FOLDED)
        }
        begin = [(np.zeros((), np.int64), False), *map(given, body.begin)]
        with self._lock:  # of the threads that come first, one compiles
            self._compile(known, begin)
            rounds = self.rounds
        if rounds is None:
            return self._by_jax(runs, values)
        free = [v for v in body.stays if v not in known]
        found = rounds(runs, [*begin, *map(given, free), *map(given, body.rows)], self._named)
        return dict(zip([*body.after, *body.made], found[1:], strict=True))

    @property
    def nodes(self) -> int:
        """How many nodes its program has, once it was called."""
        return len(self.rounds.program.live) if self.rounds else 0

    def hand_over(self) -> None:
        """Compile the rounds of a loop that was called; they have the same bits.

        Raises:
            BuildError: there is no compiler, or it refuses the program.
        """
        if self.rounds is not None:
            self.rounds.hand_over(compiled_rounds)

    def _compile(self, known: dict[Any, np.ndarray], begin: Sequence[Given]) -> None:
        if self.refused or (self.rounds is not None and self.rounds.holds_for(begin)):
            return
        body, zeros = self.body, {k: zero_in_all(g) for k, g in enumerate(begin) if k}
        try:
            (program,) = lasting(lambda some: [body.program(known, some, self._unroll)], zeros)
            stays = len(body.stays) - len(known)
            axis = self.axis
            self.rounds = Rounds(
                program, axis.length, len(begin), stays, axis.backwards, self._engine
            )
        except (ProgramError, BuildError) as error:
            self.refused = error
            self._by_jax = Batch(self.equations)
            self._by_jax.compile(self._batched, self._wanted)


class Staged:
    """A function of one run as a function of a batch of them.

    What loops make of a run has the same bits in any batch; what JAX makes has them to rounding.

    Attributes:
        loops: that are worth a program.
        bytes_of_run: about the most that the values of a run take at once, its arguments included.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        *shapes: Any,
        unroll: int | None = UNROLL,
        named: bool = False,
        engine: Engine = compiled_rounds,
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
        self._flat = flat = Flat(function, *shapes)
        self._of_all = flat.tree.children()[0].num_leaves if named else flat.tree.num_leaves
        axes = {id(e): axis for e in flat.equations if (axis := along(e)) is not None}
        worth: Counter[Along] = Counter()
        for e in flat.equations:
            if (axis := axes.get(id(e))) is not None:
                worth[axis] += operations(e) + WORTH // FEWEST
        level: dict[Any, int] = dict.fromkeys(flat.takes, 0)
        source: dict[Any, Along] = {}  # of what a loop makes, row by row
        after: set[Any] = set()  # what a loop leaves
        known = Batch()
        batches: dict[int, Batch] = {}
        loops: dict[tuple[int, Along], Loop] = {}
        for e in flat.equations:
            axis = axes.get(id(e))
            axis = axis if axis is not None and worth[axis] >= WORTH else None
            if axis is None:
                whole, rows = [v for v in e.invars if not isinstance(v, jex.Literal)], []
            else:
                whole, rows = uses(e, axis.length)
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
                batches.setdefault(here, Batch()).equations.append(e)
                continue
            loops.setdefault((here, axis), Loop(axis, engine)).equations.append(e)
            made = makes_rows(e)
            source.update((v, axis) for v in made)
            after.update(v for v in e.outvars if v not in source)
        batched = self._batched = set(level)
        parts = [known, *batches.values(), *loops.values()]
        wanted = self._wanted(parts)
        self._named = set(variables(flat.makes)) - set(variables(flat.makes[: self._of_all]))
        between = {v for p in parts for v in taken(p)}
        for one in (known, *batches.values()):
            one.compile(batched, wanted)
        for one in loops.values():
            one.connect(batched, wanted, self._named - between, unroll)
        self._stages: list[Batch | Loop] = []
        for k in range(max(level.values(), default=0) + 1):
            self._stages += [batches[k]] if k in batches else []
            self._stages += [one for (at, _), one in loops.items() if at == k]
        self._known = flat.known | known(1, flat.known)
        touched = [self._of_runs(one.touched, between) for one in self._stages]
        kept = set(variables(flat.makes)) - self._named
        self._dropped = last_uses(touched, kept | set(flat.takes))
        self.bytes_of_run = most_bytes(touched, flat.takes, kept)

    def _of_runs(self, one: Touched, between: set[Any]) -> Touched:
        """What a stage takes and makes by run: not of what is known or of the first run alone."""
        here = self._batched - (self._named - between)
        takes, makes = ([v for v in variables(some) if v in here] for some in one[:2])
        return Touched(takes, makes, one.within)

    def _wanted(self, parts: Sequence[Batch | Loop]) -> Callable[[Any], bool]:
        """Whether a variable is needed outside of the part that makes it."""
        out = {*variables(self._flat.makes), *(v for p in parts for v in taken(p))}
        return out.__contains__

    @property
    def loops(self) -> list[Loop]:
        """The loops, in an order of computation."""
        return [one for one in self._stages if isinstance(one, Loop)]

    def __call__(self, *args: Any) -> Any:
        """The function on arguments with a leading axis of runs, as arrays of NumPy or JAX."""
        leaves = jax.tree_util.tree_leaves(args)
        runs = leaves[0].shape[0]
        values = dict(self._known)
        values.update(zip(self._flat.takes, leaves, strict=True))
        for stage, dropped in zip(self._stages, self._dropped, strict=True):
            values.update(stage(runs, values))
            for v in dropped:
                value = values.pop(v, None)  # JAX makes less than a loop
                if value is not None and v in self._named:
                    values[v] = first_of(value)
                del value

        def found(v: Any, count: int) -> Any:
            if not isinstance(v, jex.Literal) and v in self._batched:
                return values[v] if count > 1 else first_of(values[v])
            alone = np.asarray(v.val if isinstance(v, jex.Literal) else values[v])
            return np.broadcast_to(alone, (count, *alone.shape))

        many, few = self._flat.makes[: self._of_all], self._flat.makes[self._of_all :]
        leaves = [*(found(v, runs) for v in many), *(found(v, 1) for v in few)]
        return jax.tree_util.tree_unflatten(self._flat.tree, leaves)


def first_of(value: Any) -> Any:
    """The first run of an array of runs, without holding the others."""
    if value.shape[0] == 1:
        return value
    return value[:1] if is_key(value.dtype) else np.array(np.asarray(value)[:1])


def taken(part: Batch | Loop) -> list[Any]:
    """The variables that a part takes from others."""
    made = {v for e in part.equations for v in e.outvars}
    return [v for e in part.equations for v in variables(e.invars) if v not in made]
