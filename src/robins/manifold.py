"""States that are not vectors: `retract` moves a state along a tangent vector, `local` measures it.

A state is any pytree. Its leaves are arrays, which add, and *elements*: objects with ``dim``,
``retract(delta)`` and ``local(other)``, such as `robins.rotation.Rotation` or `Angle`. The tangent
vector of a state stacks those of its leaves in pytree order. An element in a state is one, not
many; many states are one state under `vmap`. An element whose arrays are not in the units of its
tangent vector has ``units``, by array: texts for a reader of exported code. Without elements there
is not an overhead: `retract` is addition and `local` subtraction.

    retract(x, local(x, y)) == y        local(x, retract(x, d)) == d
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401

State = Any  # a pytree of arrays and elements


def wrap(angle_rad):
    """Wrap an angle to [-pi, pi); one already in that range is returned bit for bit."""
    turn = 2.0 * jnp.pi
    folded = angle_rad - turn * jnp.floor((angle_rad + jnp.pi) / turn)
    # The sum can round up to a full turn just below pi; the result is then just below -pi.
    return jnp.where(folded < -jnp.pi, folded + turn, folded)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Angle:
    """A plane angle [rad] whose differences wrap to [-pi, pi)."""

    rad: Any  # (...) array

    dim = 1

    def retract(self, delta: Float[Array, "*b 1"]) -> Angle:
        """Add, wrapped."""
        return Angle(wrap(self.rad + delta[..., 0]))

    def local(self, other: Angle) -> Float[Array, "*b 1"]:
        """Shortest signed angle from self to other [rad]."""
        return wrap(other.rad - self.rad)[..., None]


def is_element(leaf) -> bool:
    """True if a leaf brings its own `retract` and `local`."""
    return hasattr(leaf, "retract") and hasattr(leaf, "local")


def _leaves(x: State):
    return jax.tree_util.tree_flatten(x, is_leaf=is_element)


def leaves(x: State) -> list[Any]:
    """The arrays and elements of a state, in tangent order."""
    return _leaves(x)[0]


def _form(leaf):
    """Class of an element or shape of an array, which must be equal for two leaves."""
    return type(leaf).__name__ if is_element(leaf) else jnp.shape(leaf)


def dim(x: State) -> int:
    """Tangent dimension of a single (not batched) state."""
    return sum(leaf.dim if is_element(leaf) else jnp.size(leaf) for leaf in leaves(x))


def retract(x: State, delta: Float[Array, "n"]) -> State:
    """Move x along the tangent vector delta.

    Raises:
        ValueError: delta does not have one component per tangent dimension of x.
    """
    leaves, tree = _leaves(x)
    if delta.shape != (dim(x),):
        raise ValueError(f"tangent vector has shape {delta.shape}, the state needs ({dim(x)},)")
    out, at = [], 0
    for leaf in leaves:
        if is_element(leaf):
            out.append(leaf.retract(delta[at : at + leaf.dim]))
            at += leaf.dim
        else:
            size = jnp.size(leaf)
            out.append(leaf + delta[at : at + size].reshape(jnp.shape(leaf)))
            at += size
    return jax.tree_util.tree_unflatten(tree, out)


def local(x: State, y: State) -> Float[Array, "n"]:
    """Tangent vector from x to y.

    Raises:
        ValueError: the states differ in structure, in a kind of element or in the shape of a leaf.
    """
    xs, tree = _leaves(x)
    ys, other = _leaves(y)
    if tree != other:
        raise ValueError(f"states of different structure: {tree} and {other}")
    for a, b in zip(xs, ys, strict=True):
        if _form(a) != _form(b):
            raise ValueError(f"states of different leaves: {_form(a)} and {_form(b)}")
    parts = [
        a.local(b).reshape(-1) if is_element(a) else jnp.reshape(jnp.asarray(b) - a, -1)
        for a, b in zip(xs, ys, strict=True)
    ]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)
