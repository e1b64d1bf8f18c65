"""Values: frozen dataclasses whose numbers JAX may exchange, batch and differentiate.

A field holds *data* (numbers, or values and tuples of them) unless it is a *kind*: declared so by
`kind`, or a name or a plain function by its content. Kinds choose what is compiled; two values of
equal kinds share it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform

import jax
import numpy as np
from jax.core import Tracer
from jax.tree_util import GetAttrKey, Partial, register_pytree_with_keys

from robins.errors import require

T = TypeVar("T")
if TYPE_CHECKING:  # which knows no operator of a scalar of NumPy with an array of JAX
    Numbers = jax.Array | Any
else:
    Numbers = jax.Array | np.ndarray | np.generic  # of a leaf; JAX's stand-ins are arrays too


def kind(**how: Any) -> Any:
    """A field that chooses what is compiled."""
    return dataclasses.field(metadata={"kind": True}, **how)


def is_kind(x: object) -> bool:
    """True of a name or a plain function, into which JAX cannot look.

    A `Partial`, or a callable that is a pytree such as a network, is data.
    """
    return isinstance(x, str) or (callable(x) and jax.tree_util.all_leaves([x]))


@dataclass_transform(
    frozen_default=True, eq_default=False, field_specifiers=(kind, dataclasses.field)
)
def value(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass that JAX takes as an argument.

    Its instances are equal by identity. A transformation builds them without calling ``__init__``
    or ``__post_init__``, since it puts stand-ins, batches and ``None`` in the place of numbers.
    """
    cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    kinds = {f.name for f in fields if f.metadata.get("kind")}
    names = [f.name for f in fields]

    def split(x: Any) -> tuple[tuple[str, ...], tuple[tuple[str, Any], ...]]:
        fixed = tuple((n, getattr(x, n)) for n in names if n in kinds or is_kind(getattr(x, n)))
        held = {n for n, _ in fixed}
        return tuple(n for n in names if n not in held), fixed

    def flatten_with_keys(x: Any) -> Any:
        data, fixed = split(x)
        return [(GetAttrKey(n), getattr(x, n)) for n in data], (data, fixed)

    def flatten(x: Any) -> Any:
        data, fixed = split(x)
        return [getattr(x, n) for n in data], (data, fixed)

    def unflatten(aux: Any, children: Any) -> Any:
        data, fixed = aux
        x = object.__new__(cls)
        for n, v in (*fixed, *zip(data, children, strict=True)):
            object.__setattr__(x, n, v)
        return x

    register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def is_known(x: object) -> bool:
    """True if it holds no stand-in of a transformation."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree_util.tree_leaves(x))


def number(what: str, given: Any, holds: Callable[[Any], Any] | None = None) -> Any:
    """A number as a leaf: of float64, and checked where it is known.

    A float of Python is of a weak type: mixed with arrays it would be another program.

    Args:
        what: is wrong where the check fails, for the error.
        given: a number or an array, or a stand-in of a transformation, which passes.
        holds: numbers -> bools, all of which must be true.

    Raises:
        TypeError: it is not of real numbers.
        ValueError: the check fails.
    """
    if not is_known(given):
        return given
    if np.asarray(given).dtype.kind not in "biuf":
        raise TypeError(f"{what}, got {given!r}")
    require(holds is None or bool(np.all(holds(np.asarray(given, float)))), what, given)
    return given if isinstance(given, jax.Array) else np.asarray(given, float)


def as_data(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function as data: a plain one as a `Partial` that binds nothing."""
    return Partial(function) if is_kind(function) else function


def on_device(tree: T) -> T:
    """The same with arrays of JAX for numbers of NumPy, which each call would hand over anew."""
    return jax.tree_util.tree_map(jax.numpy.asarray, tree)


def content(*trees: Any) -> Hashable:
    """Key of values with equal kinds and numbers, for programs that fold them.

    Functions are the same by identity.
    """
    leaves, structure = jax.tree_util.tree_flatten(trees)
    keyed = [jax.random.key_data(x) if _is_key(x) else x for x in leaves]
    arrays = [np.asarray(x) for x in keyed]
    return structure, tuple((a.dtype.str, a.shape, a.tobytes()) for a in arrays)


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)
