"""Values: frozen dataclasses whose numbers JAX may exchange, batch and differentiate.

A field holds *data* (numbers, or values and tuples of them) unless it is a *kind*: declared so by
`kind`, or a name or a plain function. Values of equal kinds share what is compiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterable
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform

import jax
import numpy as np
from jax.core import Tracer
from jax.tree_util import GetAttrKey, Partial, register_pytree_with_keys

from robins.errors import require
from robins.filters.checks import finite_numbers

T = TypeVar("T")
Data = Any  # a pytree of arrays, such as a measurement or an input
Fields = tuple[tuple[str, ...], tuple[tuple[str, Hashable], ...]]  # names of data; kinds
if TYPE_CHECKING:  # stubs lack operators between a scalar of NumPy and an array of JAX
    Numbers = jax.Array | Any
else:
    Numbers = jax.Array | np.ndarray | np.generic  # a leaf; tracers of JAX are arrays too


def kind(**how: Any) -> Any:
    """Dataclass field of a static value: changing it compiles again."""
    return dataclasses.field(metadata={"kind": True}, **how)


def is_kind(x: Data) -> bool:
    """True if x is a name or a plain function, not a `Partial` or a callable pytree."""
    return isinstance(x, str) or (callable(x) and jax.tree_util.all_leaves([x]))


@dataclass_transform(
    frozen_default=True, eq_default=False, field_specifiers=(kind, dataclasses.field)
)
def value(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass that JAX takes as an argument.

    Its instances are equal by identity. A transformation builds them without ``__init__`` and
    ``__post_init__``, since it replaces numbers by tracers, batches and ``None``.
    """
    cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    kinds = {f.name for f in fields if f.metadata.get("kind")}
    names = [f.name for f in fields]

    def flatten(x: T):
        fixed = tuple((n, getattr(x, n)) for n in names if n in kinds or is_kind(getattr(x, n)))
        held = {n for n, _ in fixed}
        data = tuple(n for n in names if n not in held)
        return [getattr(x, n) for n in data], (data, fixed)

    def flatten_with_keys(x: T):
        children, aux = flatten(x)
        return [(GetAttrKey(n), v) for n, v in zip(aux[0], children, strict=True)], aux

    def unflatten(aux: Fields, children: Iterable[Data]) -> T:
        data, fixed = aux
        x = object.__new__(cls)
        for n, v in (*fixed, *zip(data, children, strict=True)):
            object.__setattr__(x, n, v)
        return x

    register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def is_known(x: Data) -> bool:
    """True if x holds no tracer of a JAX transformation."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree_util.tree_leaves(x))


def is_share(x: Numbers) -> Numbers:
    """Test for numbers in (0, 1]."""
    return (x > 0.0) & (x <= 1.0)


def is_probability(x: Numbers) -> Numbers:
    """Test for numbers in (0, 1)."""
    return (x > 0.0) & (x < 1.0)


def is_factor(x: Numbers) -> Numbers:
    """Test for numbers in [1, inf)."""
    return (x >= 1.0) & (x < np.inf)


def number(
    what: str, given: Data, holds: Callable[[Numbers], Numbers | bool] | None = None
) -> Numbers:
    """Number as a leaf: float64, without the weak type of a Python number; tracers pass.

    Raises:
        TypeError: ``what, got ...``: it is not of real numbers.
        ValueError: ``what, got ...``: the test is not true of all of them.
    """
    if not is_known(given):
        return given
    if np.asarray(given).dtype.kind not in "biuf":
        raise TypeError(f"{what}, got {given!r}")
    require(holds is None or bool(np.all(holds(np.asarray(given, float)))), what, given)
    # whole numbers as leaves would break jax.grad
    return given.astype(float) if isinstance(given, jax.Array) else np.asarray(given, float)


def finite_leaf(what: str, given: Data) -> Numbers:
    """Finite numbers as a leaf, checked where they are known (`finite_numbers`)."""
    return finite_numbers(what, given) if is_known(given) else jax.numpy.asarray(given)


def as_data(function: Callable[..., T]) -> Callable[..., T]:
    """Function as data: a plain one becomes a `Partial` that binds nothing."""
    return Partial(function) if is_kind(function) else function


def on_device(tree: T) -> T:
    """Copy with JAX arrays in place of NumPy ones, which each call would transfer again."""
    return jax.tree_util.tree_map(jax.numpy.asarray, tree)


def content(*trees: Data) -> Hashable:
    """Key that values with equal kinds and numbers share, for programs that fold numbers.

    Functions are compared by identity.
    """

    def raw(x: Data) -> np.ndarray:
        is_key = jax.numpy.issubdtype(getattr(x, "dtype", float), jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    leaves, structure = jax.tree_util.tree_flatten(trees)
    return structure, tuple(
        # the bytes of an array of objects are addresses
        (x,) if a.dtype.hasobject else (a.dtype.str, a.shape, a.tobytes())
        for x, a in zip(leaves, map(raw, leaves), strict=True)
    )


def split_numbers(tree: T) -> tuple[np.ndarray, Callable[[Numbers], T], Hashable]:
    """Split a tree into numbers that are arguments of a program, and the rest that is its key.

    Arguments are the float64 numbers except zeros, ones, minus ones and those that are not finite,
    which save operations as constants.

    Returns:
        (n,) the numbers; a function that rebuilds the tree with other numbers; and the key.
    """
    leaves, structure = jax.tree_util.tree_flatten(tree)
    fixed, given, places = [], [np.zeros(0)], []
    for leaf in leaves:
        free = np.zeros(np.shape(leaf), bool)
        if getattr(leaf, "dtype", None) == np.float64:
            known = np.asarray(leaf)
            free = np.isfinite(known) & ~np.isin(known, (-1.0, 0.0, 1.0))
            given.append(known[free])
            leaf = np.where(free, 0.5, known)
        fixed.append(leaf)
        places.append(free)

    def joined(numbers: Numbers) -> T:
        found, at = [], 0
        for free, known in zip(places, fixed, strict=True):
            where = np.where(free, at + np.cumsum(free).reshape(free.shape) - 1, 0)
            at += int(np.sum(free))
            found.append(jax.numpy.where(free, numbers[where], known) if np.any(free) else known)
        return structure.unflatten(found)

    masks = tuple((free.shape, free.tobytes()) for free in places)
    return np.concatenate(given), joined, (content(structure.unflatten(fixed)), masks)


def without_weak_types(state: T) -> T:
    """State without weak types, which would compile everything again after the first step."""
    if not any(getattr(x, "weak_type", False) for x in jax.tree_util.tree_leaves(state)):
        return state
    return jax.tree_util.tree_map(lambda x: jax.numpy.asarray(x, jax.numpy.asarray(x).dtype), state)
