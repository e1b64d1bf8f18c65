"""Primitives that move data: they move nodes, and leave no code."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robins.program.kinds import Equation
from robins.program.walk import JaxprWriter, Nodes, rule

# Primitives that are one function of NumPy, of their parameters and arrays.
OF_NUMPY: dict[str, Callable[..., Nodes | list[Nodes]]] = {
    "reshape": lambda p, a: a.reshape(p["new_sizes"]),
    "transpose": lambda p, a: a.transpose(p["permutation"]),
    "squeeze": lambda p, a: a.squeeze(tuple(p["dimensions"])),
    "expand_dims": lambda p, a: np.expand_dims(a, tuple(p["dimensions"])),
    "concatenate": lambda p, *arrays: np.concatenate(arrays, axis=p["dimension"]),
    "stack": lambda p, *arrays: np.stack(arrays, axis=p["axis"]),
    "tile": lambda p, a: np.tile(a, p["reps"]),
    "split": lambda p, a: np.split(a, np.cumsum(p["sizes"])[:-1], axis=p["axis"]),
    "unstack": lambda p, a: list(map(np.asarray, np.moveaxis(a, p["axis"], 0))),
    "rev": lambda p, a: np.flip(a, tuple(p["dimensions"])),
}


@rule(*OF_NUMPY)
def _moved(walk: JaxprWriter, equation: Equation, *arrays: Nodes) -> Nodes | list[Nodes]:
    return OF_NUMPY[equation.primitive.name](equation.params, *arrays)


@rule("broadcast_in_dim")
def _broadcast(walk: JaxprWriter, equation: Equation, a: Nodes, *dynamic: Nodes) -> Nodes:
    shape = tuple(equation.params["shape"])
    axes = equation.params["broadcast_dimensions"]
    wide = [1] * len(shape)
    for size, axis in zip(a.shape, axes, strict=True):
        wide[axis] = size
    return np.broadcast_to(a.reshape(wide), shape)


@rule("slice")
def _slice(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    p = equation.params
    strides = p["strides"] or (1,) * a.ndim
    return a[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]


@rule("iota")
def _iota(walk: JaxprWriter, equation: Equation, *dynamic: Nodes) -> Nodes:
    p = equation.params
    along = [1] * len(p["shape"])
    along[p["dimension"]] = -1
    numbers = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
    return np.broadcast_to(walk.constants(numbers).reshape(along), p["shape"])


@rule("pad")
def _pad(walk: JaxprWriter, equation: Equation, a: Nodes, filling: Nodes) -> Nodes:
    config = equation.params["padding_config"]
    sizes = [
        max(0, low + high + n + max(0, n - 1) * inner)
        for n, (low, high, inner) in zip(a.shape, config, strict=True)
    ]
    out = np.full(sizes, filling.item())
    places, sources = [], []
    for n, size, (low, _, inner) in zip(a.shape, sizes, config, strict=True):
        at = low + np.arange(n) * (inner + 1)
        inside = (at >= 0) & (at < size)
        places.append(at[inside])
        sources.append(np.flatnonzero(inside))
    if a.size:
        out[np.ix_(*places)] = a[np.ix_(*sources)]
    return out
