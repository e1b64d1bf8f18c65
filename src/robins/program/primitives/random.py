"""Random numbers: the keys and the bits of JAX's generator, Threefry 2x32.

A key is one scalar of 64 bits: its two words, the first in the upper half. The generator maps a key
and a number of 64 bits to another such number (Salmon et al., SC 2011), by ``threefry`` of
`routines.h`. Splitting a key, folding a number into it and drawing bits are this one function:

    split(key, n)[i]         = threefry(key, i)
    fold_in(key, number)     = threefry(key, number)
    bits(key, 64, shape)[i]  = threefry(key, i)

32 bits are the exclusive or of its two words. JAX does so where ``jax_threefry_partitionable`` is
set, as it is by default; its older numbering is refused.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from robins.program.kinds import Equation, kind_of
from robins.program.nodes import Node
from robins.program.refusal import ProgramError
from robins.program.walk import JaxprWriter, Nodes, rule

HALF = 32  # bits of a word


def joined(walk: JaxprWriter, first: Node, second: Node) -> Node:
    """Two words as one number of 64 bits."""
    graph = walk.graph
    wide = graph.convert(first, "word64")
    high = graph.apply("shift_left", wide, graph.constant(HALF, "word64"))
    return graph.apply("or", high, graph.convert(second, "word64"))


def words(walk: JaxprWriter, both: Node) -> tuple[Node, Node]:
    """The two words of a number of 64 bits."""
    graph = walk.graph
    high = graph.apply("shift_right", both, graph.constant(HALF, "word64"))
    return graph.convert(high, "word"), graph.convert(both, "word")


def numbered(
    walk: JaxprWriter, keys: Nodes, shape: tuple[int, ...], row: Node | None = None
) -> Nodes:
    """Numbers of the generator for each key and the counts from 0, in the order of a shape.

    Where the index of a row of this shape is given, the counts continue those of the rows before.

    Raises:
        ProgramError: JAX is set to its older numbering.
    """
    if not jax.config.values["jax_threefry_partitionable"]:
        raise ProgramError(
            "JAX draws numbers by its older scheme", "", "set jax_threefry_partitionable"
        )
    count = int(np.prod(shape))
    numbers = walk.constants(np.arange(count, dtype=np.uint64))
    if row is not None:
        first = walk.graph.apply("mul", row, walk.graph.constant(count, "whole"))
        numbers = walk.apply("add", numbers, np.array(walk.graph.convert(first, "word64")))
    found = walk.apply("threefry", keys.reshape(-1, 1), numbers.reshape(1, -1))
    return found.reshape((*keys.shape, *shape))


@rule("random_seed")
def _seed(walk: JaxprWriter, equation: Equation, seeds: Nodes) -> Nodes:
    kind_of(equation.outvars[0].aval.dtype)  # refuses other generators
    graph, narrow = walk.graph, equation.invars[0].aval.dtype.itemsize < 8

    def key(seed: Node) -> Node:
        return graph.convert(graph.convert(seed, "word") if narrow else seed, "word64")

    return walk.each(key, seeds)


@rule("random_wrap")
def _wrap(walk: JaxprWriter, equation: Equation, data: Nodes) -> Nodes:
    kind_of(equation.outvars[0].aval.dtype)
    return walk.each(lambda a, b: joined(walk, a, b), data[..., 0], data[..., 1])


@rule("random_unwrap")
def _unwrap(walk: JaxprWriter, equation: Equation, keys: Nodes) -> Nodes:
    found = [words(walk, key) for key in keys.ravel().tolist()]
    return np.array(found, dtype=np.int64).reshape((*keys.shape, 2))


@rule("random_fold_in")
def _fold_in(walk: JaxprWriter, equation: Equation, keys: Nodes, numbers: Nodes) -> Nodes:
    graph = walk.graph
    wide = walk.each(lambda n: graph.convert(graph.convert(n, "word"), "word64"), numbers)
    return walk.apply("threefry", keys, wide)


@rule("random_split")
def _split(walk: JaxprWriter, equation: Equation, keys: Nodes) -> Nodes:
    return numbered(walk, keys, tuple(equation.params["shape"]))


@rule("random_bits")
def _bits(walk: JaxprWriter, equation: Equation, keys: Nodes) -> Nodes:
    return bits_of(walk, keys, tuple(equation.params["shape"]), equation.outvars[0].aval.dtype)


def bits_of(
    walk: JaxprWriter, keys: Nodes, shape: tuple[int, ...], dtype: Any, row: Node | None = None
) -> Nodes:
    """Random bits; for a row those of its entries in the whole array."""
    kind = kind_of(dtype)
    both = numbered(walk, keys, shape, row)
    if kind == "word64":
        return both
    return walk.each(lambda n: walk.graph.apply("xor", *words(walk, n)), both)


@rule("threefry2x32")
def _threefry(walk: JaxprWriter, equation: Equation, *words_of: Nodes) -> list[Nodes]:
    """The generator itself, on two words of a key and two of a number."""

    def both(*four: Node) -> Node:
        key, number = joined(walk, *four[:2]), joined(walk, *four[2:])
        return walk.graph.apply("threefry", key, number)

    found = walk.each(both, *np.broadcast_arrays(*words_of))
    halves = [words(walk, n) for n in found.ravel().tolist()]
    pairs = np.array(halves, dtype=np.int64).reshape((*found.shape, 2))
    return [pairs[..., 0], pairs[..., 1]]
