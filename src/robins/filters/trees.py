"""Small functions on pytrees for compiled code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from robins.filters.model import Data

T = TypeVar("T")


def finite(tree: Data) -> Array:
    """() bool: all floating-point numbers are finite; true where there are none."""
    leaves = [jnp.asarray(x) for x in jax.tree_util.tree_leaves(tree)]
    found = [jnp.all(jnp.isfinite(x)) for x in leaves if jnp.issubdtype(x.dtype, jnp.inexact)]
    return jnp.all(jnp.stack(found)) if found else jnp.ones((), bool)


def equal(a: Data, b: Data) -> Array:
    """() bool: two pytrees hold the same numbers."""
    pairs = zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True)
    return jnp.all(jnp.stack([jnp.all(x == y) for x, y in pairs]))


def row_of(tree: T, i: ArrayLike) -> T:
    """Row i of each array; several rows if i is an array."""
    return jax.tree_util.tree_map(lambda a: a[i], tree)


def stack(trees: Sequence[T]) -> T:
    """Stack trees along a new leading axis, as JAX arrays."""
    return jax.tree_util.tree_map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *trees)


def repeated(tree: T, count: int) -> T:
    """Tree of `count` copies along a new leading axis."""
    return jax.tree_util.tree_map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), tree)


def select(condition: ArrayLike, new: T, old: T) -> T:
    """``new`` where the condition holds, else ``old``, leaf by leaf."""
    return jax.tree_util.tree_map(lambda a, b: jnp.where(condition, a, b), new, old)
