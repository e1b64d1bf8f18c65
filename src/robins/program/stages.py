"""A function of one run, for many: its long loops in lanes, all else as batches of JAX.

The jaxpr of the function is cut into *stages*. A scan is one, so is a call that draws a large array
of random numbers; what lies between them is one. What depends on no run is computed once. What has
no place in a program stays with JAX, which is said; so does what is too short to be worth it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

from robins.program import rows
from robins.program.lanes import Given, Rounds, of_scan
from robins.program.primitives.control import called, size_of
from robins.program.refusal import ProgramError

ROUNDS = 30  # of a scan that is worth a program
WORTH = 5_000  # scalar operations of all its rounds
DRAWN = 1_000  # random numbers of a call that is worth one
DRAW = 150  # operations of a scan that cost JAX as much as a normal number
FOLDED = 2_000  # numbers of a known array that becomes part of a program
UNROLL = 3_000


def is_scan(equation: Any) -> bool:
    """Whether an equation is a scan with enough to do."""
    p = equation.params
    return (
        equation.primitive.name == "scan"
        and p["length"] >= ROUNDS
        and operations(equation) >= WORTH
    )


def operations(equation: Any) -> int:
    """About how many scalar operations a scan is, or a call that draws random numbers."""
    if equation.primitive.name != "scan":
        return DRAW * rows.draws(equation)
    return equation.params["length"] * size_of(equation.params["jaxpr"].jaxpr)


def worthwhile(equation: Any) -> bool:
    """Whether an equation is worth a program."""
    return is_scan(equation) or rows.draws(equation) >= DRAWN


def has_worth(jaxpr: Any) -> bool:
    """Whether something worth a program is in a jaxpr or in what it calls."""
    calls = (c.jaxpr for c in map(called, jaxpr.eqns) if c is not None)
    return any(map(worthwhile, jaxpr.eqns)) or any(map(has_worth, calls))


class Flat:
    """A jaxpr with the calls written out that hold something worth a program.

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
            inner = called(e)
            if inner is not None and not worthwhile(e) and has_worth(inner.jaxpr):
                found = self._write(inner, given)
            else:
                found = [jex.Var(v.aval) for v in e.outvars]
                self.equations.append(e.replace(invars=given, outvars=found))
            now.update(zip(e.outvars, found, strict=True))
        return list(map(read, jaxpr.outvars))


class Batch:
    """Equations that JAX computes for all runs at once.

    Attributes:
        takes, makes: variables.
    """

    def __init__(self) -> None:
        self.equations: list[Any] = []
        self.takes: list[Any] = []
        self.makes: list[Any] = []
        self._compiled: Callable[..., Any] | None = None

    def compile(self, batched: set[Any]) -> None:
        """Let JAX compile it."""
        jaxpr = jex.Jaxpr([], self.takes, self.makes, self.equations)
        function = jex.jaxpr_as_fun(jex.ClosedJaxpr(jaxpr, []))
        axes = tuple(0 if v in batched else None for v in self.takes)
        self._compiled = jax.jit(jax.vmap(function, axes) if 0 in axes else function)

    def __call__(self, values: dict[Any, Any]) -> dict[Any, Any]:
        """What it makes of what is there."""
        assert self._compiled is not None
        found = self._compiled(*(values[v] for v in self.takes)) if self.makes else []
        return dict(zip(self.makes, found, strict=True))


class Long:
    """An equation worth a program: rounds in lanes, or JAX if it has no place there.

    Attributes:
        equation: of the jaxpr.
        rounds: where it is compiled.
        refused: why it is not.
    """

    def __init__(self, equation: Any, unroll: int | None):
        self.equation, self.unroll = equation, unroll
        self.rounds: Rounds | None = None
        self.refused: ProgramError | None = None
        self._by_jax = Batch()
        self._lock = threading.Lock()

    def __call__(self, runs: int, values: dict[Any, Any], batched: set[Any]) -> dict[Any, Any]:
        """What it makes of what is there."""
        e = self.equation

        def given(v: Any) -> Given:
            if isinstance(v, jex.Literal):
                return Given(np.asarray(v.val, v.aval.dtype), False)
            return Given(values[v], v in batched)

        args = list(map(given, e.invars))
        if e.primitive.name == "scan":
            fixed, carried = e.params["num_consts"], e.params["num_carry"]
            consts, begin = args[:fixed], args[fixed : fixed + carried]
            known = {
                k: np.asarray(g.array)
                for k, g in enumerate(consts)
                if not g.batched and g.array.size <= FOLDED
            }
            with self._lock:
                self._compile(lambda: of_scan(e, known, begin, self.unroll), begin)
            free = [g for k, g in enumerate(consts) if k not in known]
            args = [*begin, *free, *args[fixed + carried :]]
            dropped = 0
        else:
            with self._lock:
                self._compile(lambda: rows.of_call(e), [])
            args = [Given(np.zeros((), np.int64), False), *(args[k] for k in rows.order_of(e))]
            dropped = 1  # the number of the round
        if self.rounds is None:
            return self._whole(values, batched)
        found = self.rounds(runs, args)
        return dict(zip(e.outvars, found[dropped:], strict=True))

    def _compile(self, make: Callable[[], Rounds], begin: Sequence[Given]) -> None:
        if self.refused or (self.rounds is not None and self.rounds.holds_for(begin)):
            return
        try:
            self.rounds = make()
        except ProgramError as error:
            self.refused = error

    def _whole(self, values: dict[Any, Any], batched: set[Any]) -> dict[Any, Any]:
        if not self._by_jax.equations:
            free = dict.fromkeys(v for v in self.equation.invars if not isinstance(v, jex.Literal))
            self._by_jax.equations = [self.equation]
            self._by_jax.takes, self._by_jax.makes = list(free), list(self.equation.outvars)
            self._by_jax.compile(batched)
        return self._by_jax(values)


class Staged:
    """A function of one run as a function of a batch of them.

    The numbers of a run do not depend on the runs beside it, nor on how many there are.

    Attributes:
        long: its equations that are worth a program.
    """

    def __init__(self, function: Callable[..., Any], *shapes: Any, unroll: int | None = UNROLL):
        """Cut a function into stages; they are compiled when it is called.

        Args:
            function: pure, of the arguments of one run.
            shapes: of these, pytrees of `jax.ShapeDtypeStruct`.
            unroll: as in `robins.program.trace`.
        """
        self._flat = flat = Flat(function, *shapes)
        level: dict[Any, int] = dict.fromkeys(flat.takes, 0)
        self._levels: list[tuple[Batch, list[Long]]] = []
        known = Batch()
        for e in flat.equations:
            of = [level[v] for v in e.invars if not isinstance(v, jex.Literal) and v in level]
            if not of:
                known.equations.append(e)
                continue
            here = max(of)
            while len(self._levels) <= here:
                self._levels.append((Batch(), []))
            if worthwhile(e):
                self._levels[here][1].append(Long(e, unroll))
                here += 1
            else:
                self._levels[here][0].equations.append(e)
            level.update((v, here) for v in e.outvars)
        self._batched = set(level)
        self._connect([known, *(batch for batch, _ in self._levels)])
        self._known = flat.known | known(flat.known)

    @property
    def long(self) -> list[Long]:
        """The equations that are worth a program."""
        return [one for _, some in self._levels for one in some]

    @property
    def operations(self) -> int:
        """About how many scalar operations they are, for a run."""
        return sum(operations(one.equation) for one in self.long)

    def _connect(self, batches: Sequence[Batch]) -> None:
        """Let each batch give what others use, and JAX compile it."""
        of = {id(e): b for b in batches for e in b.equations}
        made = {v: of.get(id(e)) for e in self._flat.equations for v in e.outvars}
        takes: dict[int, dict[Any, None]] = {id(b): {} for b in batches}
        makes: dict[int, dict[Any, None]] = {id(b): {} for b in batches}
        users = [(of.get(id(e)), e.invars) for e in self._flat.equations]
        for here, atoms in (*users, (None, self._flat.makes)):
            for v in atoms:
                there = None if isinstance(v, jex.Literal) else made.get(v)
                if isinstance(v, jex.Literal) or (here is not None and there is here):
                    continue
                if here is not None:
                    takes[id(here)][v] = None
                if there is not None:
                    makes[id(there)][v] = None
        for b in batches:
            b.takes, b.makes = list(takes[id(b)]), list(makes[id(b)])
            b.compile(self._batched)

    def __call__(self, *args: Any) -> Any:
        """The function on arguments with a leading axis of runs, as arrays of NumPy or JAX."""
        leaves = jax.tree_util.tree_leaves(args)
        runs = leaves[0].shape[0]
        values = dict(self._known)
        values.update(zip(self._flat.takes, leaves, strict=True))
        for batch, some in self._levels:
            values.update(batch(values))
            for one in some:
                values.update(one(runs, values, self._batched))

        def of_all(v: Any) -> Any:
            if not isinstance(v, jex.Literal) and v in self._batched:
                return values[v]
            alone = np.asarray(v.val if isinstance(v, jex.Literal) else values[v])
            return np.broadcast_to(alone, (runs, *alone.shape))

        return jax.tree_util.tree_unflatten(self._flat.tree, map(of_all, self._flat.makes))
