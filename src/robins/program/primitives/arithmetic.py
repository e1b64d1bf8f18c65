"""Primitives that compute entry by entry."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robins.program.kinds import Equation, kind_of
from robins.program.nodes import Node
from robins.program.operations import OPERATIONS
from robins.program.refusal import ProgramError
from robins.program.walk import JaxprWriter, Nodes, rule

# Primitives that are one operation of `OPERATIONS`, by their names in JAX.
UNKNOWN_TO_JAX = ("round_even", "round_away", "shift_right", "wrap", "threefry")
SAME = {op: op for op in OPERATIONS if op not in UNKNOWN_TO_JAX}
SAME |= {"add_any": "add", "shift_right_arithmetic": "shift_right"}


@rule(*SAME)
def _same(walk: JaxprWriter, equation: Equation, *arrays: Nodes) -> Nodes:
    return walk.apply(SAME[equation.primitive.name], *arrays)


# Primitives that are a few operations.
COMPOSED: dict[str, Callable[..., Nodes]] = {
    "gt": lambda walk, a, b: walk.apply("lt", b, a),
    "ge": lambda walk, a, b: walk.apply("le", b, a),
    "square": lambda walk, a: walk.apply("mul", a, a),
    "rsqrt": lambda walk, a: walk.apply("div", walk.constants(1.0), walk.apply("sqrt", a)),
    "clamp": lambda walk, low, a, high: walk.apply("min", walk.apply("max", a, low), high),
}


@rule(*COMPOSED)
def _composed(walk: JaxprWriter, equation: Equation, *arrays: Nodes) -> Nodes:
    return COMPOSED[equation.primitive.name](walk, *arrays)


@rule("logistic")
def _logistic(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    one = walk.constants(1.0)
    return walk.apply("div", one, walk.apply("add", one, walk.apply("exp", walk.apply("neg", a))))


@rule("integer_pow")
def _integer_pow(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    """Whole power by squaring, in the order in which JAX multiplies."""
    y = equation.params["y"]
    one = walk.each(lambda n: walk.graph.constant(1, walk.graph.kind[n]), a)
    power, factor, left = None, a, abs(y)
    while left:
        if left & 1:
            power = factor if power is None else walk.apply("mul", power, factor)
        left >>= 1
        if left:
            factor = walk.apply("mul", factor, factor)
    power = one if power is None else power
    return power if y >= 0 else walk.apply("div", one, power)


@rule("round")
def _round(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    to_even = equation.params["rounding_method"].name == "TO_NEAREST_EVEN"
    return walk.apply("round_even" if to_even else "round_away", a)


@rule("select_n")
def _select_n(walk: JaxprWriter, equation: Equation, which: Nodes, *cases: Nodes) -> Nodes:
    graph = walk.graph
    if len(cases) == 2 and equation.invars[0].aval.dtype == np.bool_:
        return walk.select(which, cases[1], cases[0])

    def pick_case(index: Node, *nodes: Node) -> Node:
        return graph.pick(nodes, index)

    return walk.each(pick_case, which, *cases)


@rule("convert_element_type")
def _convert(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    """Convert: reals are truncated and saturate at the ends of the type; whole numbers wrap."""
    graph, given = walk.graph, equation.invars[0].aval.dtype
    dtype = np.dtype(equation.params["new_dtype"])
    kind = kind_of(dtype)
    if given.kind == "f" and dtype.kind in "iu" and dtype.itemsize < 8:
        ends = np.iinfo(dtype)
        low, high = graph.constant(ends.min, "whole"), graph.constant(ends.max, "whole")
        a = walk.each(lambda n: graph.convert(n, "whole"), a)
        a = walk.each(lambda n: graph.apply("min", graph.apply("max", n, low), high), a)
    found = walk.each(lambda n: graph.convert(n, kind), a)
    fits = given.kind in "fb" or (given.kind == "i" and given.itemsize <= dtype.itemsize)
    return found if fits else walk.wrapped(found, dtype)


@rule("shift_right_logical")
def _shift_right(walk: JaxprWriter, equation: Equation, a: Nodes, by: Nodes) -> Nodes:
    """Shift in zeros from the left; a signed number is shifted as an unsigned word."""
    graph, dtype = walk.graph, equation.invars[0].aval.dtype
    if dtype.kind == "u":
        return walk.apply("shift_right", a, by)
    word = "word64" if dtype.itemsize == 8 else "word"
    moved = walk.apply(
        "shift_right", *(walk.each(lambda n: graph.convert(n, word), x) for x in (a, by))
    )
    return walk.wrapped(walk.each(lambda n: graph.convert(n, "whole"), moved), dtype)


@rule("bitcast_convert_type")
def _bits(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    kind = kind_of(equation.params["new_dtype"])
    given = equation.invars[0].aval.dtype
    if given.itemsize != np.dtype(equation.params["new_dtype"]).itemsize:
        raise ProgramError("bits are read as numbers of another width", "", "keep the width")
    return walk.each(lambda n: walk.graph.bits(n, kind), a)


@rule("stop_gradient", "copy", "copy_p", "reduce_precision", "device_put", "optimization_barrier")
@rule("name")
def _unchanged(walk: JaxprWriter, equation: Equation, *arrays: Nodes) -> list[Nodes]:
    if equation.primitive.name == "reduce_precision" and equation.params["mantissa_bits"] < 52:
        raise ProgramError("numbers are rounded to fewer bits", "", "leave them in float64")
    return list(arrays)


@rule(
    "digamma", "igamma", "igammac", "random_gamma_grad", "bessel_i0e", "regularized_incomplete_beta"
)
def _special(walk: JaxprWriter, equation: Equation, *arrays: Nodes) -> Nodes:
    """Evaluate special functions, too long to write out, of known numbers only."""
    import jax

    values = [walk.known(a) for a in arrays]
    if any(v is None for v in values):
        raise ProgramError(
            f"'{equation.primitive.name}' of numbers that are not known has no place in a program",
            "",
            "compute it beforehand, or run this filter by JAX",
        )
    found = equation.primitive.bind(*map(jax.numpy.asarray, values), **equation.params)
    return walk.constants(np.asarray(found))
