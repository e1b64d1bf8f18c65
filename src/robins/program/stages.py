"""A function of one run, for many: its scans in lanes, all else as batches of JAX.

The jaxpr of the function is cut into *stages*: a scan is one, and what lies between scans is one.
What depends on no run is computed once. A scan whose body has no place in a program stays with JAX,
and so do short ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

from robins.program.lanes import Given, LaneScan
from robins.program.primitives.control import size_of
from robins.program.refusal import ProgramError

ROUNDS = 30  # of a scan that is worth a program
WORTH = 5_000  # scalar operations of all its rounds
FOLDED = 2_000  # numbers of a known array that becomes part of the program
UNROLL = 3_000

INLINED = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"}


@dataclass
class Batch:
    """Equations between scans."""

    equations: list[Any] = field(default_factory=list)
    compiled: Any = None
    takes: list[Any] = field(default_factory=list)
    makes: list[Any] = field(default_factory=list)


@dataclass
class Scan:
    """A scan, which lanes may do."""

    equation: Any
    compiled: LaneScan | None = None


def worthwhile(equation: Any) -> bool:
    """Whether an equation is a scan with enough to do."""
    p = equation.params
    return (
        equation.primitive.name == "scan"
        and p["length"] >= ROUNDS
        and p["length"] * size_of(p["jaxpr"].jaxpr) >= WORTH
    )


def called(equation: Any) -> Any:
    """The jaxpr that an equation calls, if it is a call."""
    if equation.primitive.name not in INLINED:
        return None
    p = equation.params
    return next((p[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in p), None)


def has_scan(jaxpr: Any) -> bool:
    """Whether a scan that is worthwhile is in a jaxpr or in what it calls."""
    calls = (getattr(c, "jaxpr", c) for c in map(called, jaxpr.eqns) if c is not None)
    return any(map(worthwhile, jaxpr.eqns)) or any(map(has_scan, calls))


class Flat:
    """A jaxpr with the calls that hold scans written out.

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
        self.makes = self._write(closed.jaxpr, closed.consts, self.takes)

    def _write(self, jaxpr: Any, consts: Any, args: Any) -> list[Any]:
        now: dict[Any, Any] = dict(zip(jaxpr.invars, args, strict=True))
        for v, value in zip(jaxpr.constvars, consts, strict=True):
            now[v] = jex.Var(v.aval)
            self.known[now[v]] = value

        def read(v: Any) -> Any:
            return v if isinstance(v, jex.Literal) else now[v]

        for e in jaxpr.eqns:
            given = list(map(read, e.invars))
            whole = called(e)
            if whole is not None and has_scan(getattr(whole, "jaxpr", whole)):
                inner = getattr(whole, "jaxpr", whole)
                found = self._write(inner, getattr(whole, "consts", ()), given)
            else:
                found = [jex.Var(v.aval) for v in e.outvars]
                self.equations.append(e.replace(invars=given, outvars=found))
            now.update(zip(e.outvars, found, strict=True))
        return list(map(read, jaxpr.outvars))


class Staged:
    """A function of one run as a function of a batch of them.

    Attributes:
        lanes: scans in lanes so far, and
        left: why others are not.
    """

    def __init__(self, function: Callable[..., Any], *shapes: Any, unroll: int | None = UNROLL):
        """Cut a function into stages.

        Args:
            function: pure, of the arguments of one run.
            shapes: of one run, a pytree of `jax.ShapeDtypeStruct`.
            unroll: as in `robins.program.trace`.
        """
        self.unroll = unroll
        self._flat = flat = Flat(function, *shapes)
        self.lanes: list[LaneScan] = []
        self.left: list[str] = []
        level: dict[Any, int] = dict.fromkeys(flat.takes, 0)
        self._levels: dict[int, tuple[Batch, list[Scan]]] = {}
        known = Batch()
        for e in flat.equations:
            of = [level[v] for v in e.invars if not isinstance(v, jex.Literal) and v in level]
            if not of and not e.effects:
                known.equations.append(e)
                continue
            here = max(of)
            batch, scans = self._levels.setdefault(here, (Batch(), []))
            if worthwhile(e):
                scans.append(Scan(e))
                here += 1
            else:
                batch.equations.append(e)
            level.update((v, here) for v in e.outvars)
        self._batched = set(level)
        self._last_use(known)
        self._known = dict(flat.known)
        self._known.update(self._run(known, self._known))

    # ------------------------------------------------------------------------------- stages

    def _last_use(self, known: Batch) -> None:
        """Let JAX compile the batches, each to give what others use."""
        batches = [known, *(batch for batch, _ in self._levels.values())]
        of = {id(e): k for k, b in enumerate(batches) for e in b.equations}
        made = {v: of.get(id(e)) for e in self._flat.equations for v in e.outvars}
        takes: list[dict[Any, None]] = [{} for _ in batches]
        gives: list[dict[Any, None]] = [{} for _ in batches]
        users = [(of.get(id(e)), e.invars) for e in self._flat.equations]
        for here, atoms in (*users, (None, self._flat.makes)):
            for v in atoms:
                if isinstance(v, jex.Literal) or (there := made.get(v, -1)) == here is not None:
                    continue
                if here is not None:
                    takes[here][v] = None
                if there is not None and there >= 0:
                    gives[there][v] = None
        for batch, used, given in zip(batches, takes, gives, strict=True):
            batch.takes, batch.makes = list(used), list(given)
            jaxpr = jex.Jaxpr([], batch.takes, batch.makes, batch.equations)
            function = jex.jaxpr_as_fun(jex.ClosedJaxpr(jaxpr, []))
            axes = tuple(0 if v in self._batched else None for v in batch.takes)
            batch.compiled = jax.jit(jax.vmap(function, axes) if 0 in axes else function)

    def _run(self, batch: Batch, values: dict[Any, Any]) -> dict[Any, Any]:
        found = batch.compiled(*(values[v] for v in batch.takes)) if batch.makes else []
        return dict(zip(batch.makes, found, strict=True))

    def __call__(self, *args: Any) -> Any:
        """The function on arguments with a leading axis of runs; NumPy or JAX arrays."""
        leaves = jax.tree_util.tree_leaves(args)
        runs = leaves[0].shape[0]
        values = dict(self._known)
        values.update(zip(self._flat.takes, leaves, strict=True))
        for level in sorted(self._levels):
            batch, scans = self._levels[level]
            values.update(self._run(batch, values))
            for scan in scans:
                values.update(self._scanned(scan, runs, values))

        def wide(v: Any) -> Any:
            if v in self._batched if not isinstance(v, jex.Literal) else False:
                return values[v]
            alone = v.val if isinstance(v, jex.Literal) else values[v]
            return np.broadcast_to(alone, (runs, *np.shape(alone)))

        return jax.tree_util.tree_unflatten(self._flat.tree, map(wide, self._flat.makes))

    def _scanned(self, scan: Scan, runs: int, values: dict[Any, Any]) -> dict[Any, Any]:
        e, p = scan.equation, scan.equation.params

        def given(v: Any) -> Given:
            if isinstance(v, jex.Literal):
                return Given(np.asarray(v.val, v.aval.dtype), False)
            return Given(np.asarray(values[v]), v in self._batched)

        all_ = list(map(given, e.invars))
        fixed, carried = p["num_consts"], p["num_carry"]
        begin, taken = all_[fixed : fixed + carried], all_[fixed + carried :]
        if scan.compiled is None or not scan.compiled.holds_for(begin):
            known = {
                k: g.array
                for k, g in enumerate(all_[:fixed])
                if not g.batched and g.array.size <= FOLDED
            }
            scan.compiled = LaneScan(e, known, begin, self.unroll)
            self.lanes.append(scan.compiled)
        stays = [all_[k] for k in scan.compiled.fixed]
        after, rows = scan.compiled(runs, begin, stays, taken)
        return dict(zip(e.outvars, [*after, *rows], strict=True))
