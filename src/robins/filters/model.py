"""What a filter is told of the world: a motion, and sensors.

Functions in a model are part of its *shape*: exchanging one compiles anew. Everything else (noise
factors, parameters bound with ``jax.tree_util.Partial``) is data: it may change, be batched with
`jax.vmap` or differentiated without a new compilation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold


def as_noise(value: Any, n: int, whose: str) -> Array:
    """Noise factor from standard deviations or a factor.

    Raises:
        ValueError: it is neither (n,) nor (n, k).
    """
    noise = jnp.asarray(value, float)
    if noise.ndim not in (1, 2) or noise.shape[0] != n:
        raise ValueError(
            f"noise of {whose} has shape {noise.shape}: ({n},) standard deviations or an ({n}, k) "
            "factor L of the covariance L L' are wanted"
        )
    return linalg.as_factor(noise)


def _is_static(value: Any) -> bool:
    # `Partial` is callable but carries arrays; JAX looks inside it.
    plain = callable(value) and not isinstance(value, jax.tree_util.Partial)
    return plain or isinstance(value, (str, int, np.integer, type(None)))


def _shape_and_data(cls):
    """Register a dataclass with JAX: callables, names, sizes are static, the rest is data."""
    names = [f.name for f in fields(cls)]

    def flatten(x):
        static = tuple((n, getattr(x, n)) for n in names if _is_static(getattr(x, n)))
        kept = {n for n, _ in static}
        dynamic = tuple(n for n in names if n not in kept)
        return tuple(getattr(x, n) for n in dynamic), (static, dynamic)

    def unflatten(aux, children):
        static, dynamic = aux
        x = object.__new__(cls)
        for name, value in (*static, *zip(dynamic, children, strict=True)):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_node(cls, flatten, unflatten)
    return cls


@_shape_and_data
@dataclass(frozen=True)
class Motion:
    """How the state moves from one step to the next.

    Attributes:
        step: ``(x, u) -> x``; u is the input of this step (increments, a time step, nothing).
        noise: process noise of a step in the tangent space of the new state: (n,) standard
            deviations, (n, k) factor with Q = L L', or ``(x, u) -> `` one of these.
        linear: optional ``(x, u) -> (new x, F, noise)`` where an analytic transition exists;
            `taylor` then uses it in place of automatic differentiation.
    """

    step: Callable[[Any, Any], Any]
    noise: Any
    linear: Callable[[Any, Any], Any] | None = None

    def noise_factor(self, x, u):
        """Process noise factor at x."""
        value = self.noise(x, u) if callable(self.noise) else self.noise
        return as_noise(value, manifold.dim(x), "the motion")


@_shape_and_data
@dataclass(frozen=True)
class Sensor:
    """One measurement: what it would read at a state, and how noisy it is.

    Attributes:
        read: ``(x, aux) -> z``, an (m,) array or a pytree with elements such as `Angle`; aux is
            what the reading needs besides the state (star direction, antenna rate, ...), or None.
        noise: (m,) standard deviations, (m, k) factor with R = L L', or
            ``(x, aux) -> `` one of these.
        dim: tangent dimension m of the measurement.
        name: key of its measurements in a run.
        linear: optional ``(x, aux) -> (z, H)`` with an analytic Jacobian.
    """

    read: Callable[[Any, Any], Any]
    noise: Any
    dim: int
    name: str = "y"
    linear: Callable[[Any, Any], Any] | None = None

    def noise_factor(self, x, aux):
        """Measurement noise factor at x."""
        value = self.noise(x, aux) if callable(self.noise) else self.noise
        return as_noise(value, self.dim, f"sensor '{self.name}'")


@_shape_and_data
@dataclass(frozen=True)
class Model:
    """A motion and its sensors, updated in the order given.

    Raises:
        ValueError: two sensors share a name.
    """

    motion: Motion
    sensors: tuple[Sensor, ...]

    def __post_init__(self):
        names = [s.name for s in self.sensors]
        if len(set(names)) < len(names):
            raise ValueError(f"sensors must have names of their own, got {names}")

    @property
    def dims(self) -> dict[str, int]:
        """Measurement dimension by sensor."""
        return {s.name: s.dim for s in self.sensors}

    def sensor(self, name: str) -> Sensor:
        """The sensor of this name.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for s in self.sensors:
            if s.name == name:
                return s
        raise KeyError(f"no sensor '{name}'; this model has {sorted(self.dims)}")
