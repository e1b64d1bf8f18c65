"""Last uses of values, and so the memory that a function takes.

A stage is described by the variables of a jaxpr that it takes and makes. The equations of a jaxpr
are stages too, so what JAX computes is counted by the same function. Compilers call this liveness
analysis; stages have no branches, so one pass finds the last use of each variable.

An example: of ``sum(sin(a) * a)`` the sine is last used by the product, and the product by the
sum. The most is held while the product is made: three arrays of 300 numbers.

>>> import jax
>>> a = jax.ShapeDtypeStruct((300,), "float64")
>>> jaxpr = jax.make_jaxpr(lambda a: (jax.numpy.sin(a) * a).sum())(a).jaxpr
>>> stages = [StageMemory(e.invars, e.outvars) for e in jaxpr.eqns]
>>> [len(dropped) for dropped in last_uses(stages, {*jaxpr.invars, *jaxpr.outvars})]
[0, 1, 1]
>>> most_bytes(stages, jaxpr.invars, jaxpr.outvars) == 8 * 3 * 300
True
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jax.extend import core as jex

from robins.program.kinds import Equation, Variable, is_key
from robins.program.primitives.control import called

KEY_BYTES = 8


class StageMemory(NamedTuple):
    """Inputs and outputs of a stage, and the bytes that it needs for itself in addition."""

    takes: Sequence[Variable]
    makes: Sequence[Variable]
    within: int = 0


def last_uses(stages: Sequence[StageMemory], kept: Collection[Variable]) -> list[list[Variable]]:
    """Variables that nothing needs once a stage is done, by stage.

    Args:
        stages: in an order of computation.
        kept: variables needed in the end.
    """
    last: dict[Variable, int] = {}
    for k, one in enumerate(stages):
        last.update(dict.fromkeys(variables([*one.takes, *one.makes]), k))
    found: list[list[Variable]] = [[] for _ in stages]
    for v, k in last.items():
        if v not in kept:
            found[k].append(v)
    return found


def most_bytes(
    stages: Sequence[StageMemory], given: Iterable[Variable], kept: Collection[Variable]
) -> int:
    """Peak memory [bytes] of all values, each dropped after its last use.

    Args:
        stages: in an order of computation.
        given: variables that exist before and stay.
        kept: variables needed in the end.
    """
    stay = set(variables(given))
    most = here = sum(map(bytes_of, stay))
    for one, dropped in zip(stages, last_uses(stages, {*variables(kept), *stay}), strict=True):
        made = sum(map(bytes_of, variables(one.makes)))
        most = max(most, here + made + one.within)
        here += made - sum(map(bytes_of, dropped))
    return most


def bytes_of_jaxpr(jaxpr: jex.Jaxpr) -> int:
    """Peak memory [bytes] of the values of a jaxpr, computed one equation after the other.

    An upper estimate: XLA fuses equations, whose intermediate values are then never in memory.
    """

    def touched(e: Equation) -> StageMemory:
        inner = called(e)
        if inner is None:
            return StageMemory(e.invars, e.outvars)
        there = {*variables(e.invars), *e.outvars}
        within = bytes_of_jaxpr(inner.jaxpr) - sum(map(bytes_of, there))
        return StageMemory(e.invars, e.outvars, max(within, 0))

    given = [*jaxpr.invars, *jaxpr.constvars]
    return most_bytes([touched(e) for e in jaxpr.eqns], given, jaxpr.outvars)


def bytes_of(v: Variable) -> int:
    """The bytes of a variable of a jaxpr, or of the shape of an array."""
    aval = getattr(v, "aval", v)
    size = KEY_BYTES if is_key(aval.dtype) else np.dtype(aval.dtype).itemsize
    return int(np.prod(aval.shape)) * size


def variables(some: Iterable[Variable]) -> list[Variable]:
    """Variables that are not literals."""
    return [v for v in some if not isinstance(v, jex.Literal)]


def jaxpr_of(
    equations: Sequence[Equation],
    takes: Sequence[Variable],
    makes: Sequence[Variable],
    known: Sequence[Variable] = (),
) -> jex.Jaxpr:
    """Equations as a jaxpr; known: variables of its constants."""
    about = jex.DebugInfo("jit", "stage", None, None)
    return jex.Jaxpr(list(known), list(takes), list(makes), list(equations), debug_info=about)
