"""A filter made again with equal arguments is the filter that was made first.

JAX compiles a run for the very functions it is given, and every call of `kalman`, of a rule or of a
model makes functions anew: in a loop over scenarios each pass would compile what the last one had.
Here functions made by robins are compared by what they are: their code, and what they hold. A
user's own functions are compared as JAX compares them, each equal to itself only, since what they
read from outside may have changed.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import inspect
import types
from collections import OrderedDict
from collections.abc import Hashable, Iterable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import Partial

from robins.filters.model import Model

T = TypeVar("T")

_MOST = 512  # remembered; the least recently used are forgotten
_HOUSE = __name__.partition(".")[0] + "."
_first: OrderedDict[Hashable, Any] = OrderedDict()
_PLAIN = (str, bytes, bool, int, type(None), enum.Enum, type)
_COMPILED: type = type(jax.jit(lambda: None))


class _Traced(Exception):
    """Something holds a stand-in of a transformation, which is worth nothing after it."""


class _Itself:
    """Equal to nothing but the same object, which is kept alive so that its place is not reused."""

    def __init__(self, one: Any):
        self.one = one

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and self.one is other.one

    def __hash__(self) -> int:
        return id(self.one)


def same(made: T) -> T:
    """The first thing of this content.

    Args:
        made: a filter, a rule, or a function; of a ``Partial`` the function, its data stay its own.
            What cannot be hashed is returned as it is.
    """
    if isinstance(made, Partial):
        return Partial(same(made.func), *made.args, **made.keywords)
    try:
        key = _key(made)
    except (_Traced, TypeError):  # of a transformation, or not hashable
        return made
    first = _first.setdefault(key, made)
    _first.move_to_end(key)
    if len(_first) > _MOST:
        _first.popitem(last=False)
    return first


@functools.lru_cache(_MOST)
def _key(made: Hashable) -> Hashable:
    """The content of what hashes by its functions, so that it is taken apart once."""
    return _content(made, {})


def same_model(model: Model) -> Model:
    """The model with the first functions of these contents; its data stay its own."""
    return Model(_settled(model.motion), tuple(map(_settled, model.sensors)))


def content(made: Any) -> Hashable:
    """What other things must share to be the same as this one.

    Args:
        made: of filters, models and functions; a user's function is the same as itself only, and is
            kept alive by what is returned.
    """
    return _content(made, {})


def _settled(part: Any) -> Any:
    named = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    return dataclasses.replace(part, **{k: same(v) for k, v in named.items() if callable(v)})


def _content(x: Any, met: dict[int, tuple[int, Any]]) -> Hashable:
    """What two things must share to be the same.

    Args:
        x: the thing.
        met: number in order, and the object, of what was taken apart before, by `id`; met again,
            or from within itself, its number stands for it.
    """
    if isinstance(x, Tracer):
        raise _Traced
    if isinstance(x, _PLAIN):
        return type(x), x
    if isinstance(x, float):
        return float, x.hex()  # neither is 0.0 the same as -0.0, nor is nan another
    if isinstance(x, (np.ndarray, np.generic, jax.Array)):
        return type(x), *_array(x)
    if id(x) in met:
        return "met", met[id(x)][0]
    met[id(x)] = len(met), x
    parts = _parts(x)
    return _Itself(x) if parts is None else (type(x), *(_content(part, met) for part in parts))


def _array(x: Any) -> tuple[Hashable, ...]:
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    data = np.asarray(jax.random.key_data(x) if is_key else x)
    weak = getattr(x, "weak_type", False)
    return str(x.dtype), x.shape, weak, hashlib.sha256(data.tobytes()).digest()


def _parts(x: Any) -> Iterable[Any] | None:
    """What a thing is made of; None if it is only itself."""
    if isinstance(x, (tuple, list)):
        return x
    if isinstance(x, dict):
        return [part for item in x.items() for part in item]
    if isinstance(x, functools.partial):  # `jax.tree_util.Partial` too
        return x.func, x.args, x.keywords
    if isinstance(x, types.FunctionType) and _is_made(x):
        x = inspect.unwrap(x)  # annotations are checked where tests run, by a wrapper each
        held = [cell.cell_contents for cell in x.__closure__ or ()]
        return x.__code__, x.__defaults__, x.__kwdefaults__, held  # code is shared, so itself
    if isinstance(x, _COMPILED) and _is_made(inspect.unwrap(x)):
        return (inspect.unwrap(x),)
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        return [getattr(x, f.name) for f in dataclasses.fields(x)]
    return None


def _is_made(function: Any) -> bool:
    """Whether a function of robins made this one: only then its code, and what it reads, stay."""
    return function.__module__.startswith(_HOUSE) and "<locals>" in function.__qualname__
