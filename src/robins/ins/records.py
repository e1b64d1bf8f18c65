"""Records that are checked when written by hand and are pytrees of anything inside JAX."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar

import jax

T = TypeVar("T", bound=type)


def checked_pytree(cls: T) -> T:
    """Register a frozen dataclass as a pytree whose rebuilding skips its ``__post_init__``.

    JAX rebuilds a record with tracers, batches, axis numbers and stand-ins for leaves. Checks and
    conversions are meant for what a person writes, so they run in the constructor and in
    ``dataclasses.replace`` alone. A field that is None is structure, not a leaf.
    """
    names = tuple(f.name for f in dataclasses.fields(cls))

    def flatten(record: Any) -> tuple[tuple[Any, ...], None]:
        keys = (jax.tree_util.GetAttrKey(name) for name in names)
        return tuple((key, getattr(record, key.name)) for key in keys), None

    def unflatten(_: None, values: Iterable[Any]) -> Any:
        record = object.__new__(cls)
        for name, value in zip(names, values, strict=True):
            object.__setattr__(record, name, value)
        return record

    jax.tree_util.register_pytree_with_keys(cls, flatten, unflatten)
    return cls
