"""Model of a filter: a motion, and sensors.

Functions in a model are part of its *shape*: exchanging one recompiles. Everything else (noise
factors, parameters bound with ``jax.tree_util.Partial``) is data: it may change, be batched with
`jax.vmap` or differentiated without a new compilation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import InitVar
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from robins import linalg, manifold
from robins.errors import require
from robins.filters.values import Data, kind, value
from robins.manifold import State

T = TypeVar("T")
Given = ArrayLike | Sequence[Any]  # numbers from a user, or lists of them
_LARGEST = float(np.sqrt(np.finfo(float).max))  # largest standard deviation: its square is finite


def as_noise(value: Data, n: int, whose: str) -> Array:
    """Noise factor with n rows, from (n,) standard deviations or an (n, k) factor."""
    noise = jnp.asarray(value, float)
    if noise.ndim not in (1, 2) or noise.shape[0] != n:
        raise ValueError(
            f"noise of {whose} has shape {noise.shape}: ({n},) standard deviations or a ({n}, k) "
            "factor L of the covariance L L' are wanted"
        )
    return linalg.as_factor(noise)


def _settle_noise(own: Motion | Sensor, covariance: ArrayLike | None, whose: str) -> None:
    if (own.noise is None) == (covariance is None):
        raise TypeError(
            f"{whose} needs noise=, standard deviations or a factor L of the covariance L L', or "
            "noise_covariance= in its place"
        )
    if covariance is not None:
        object.__setattr__(own, "noise", linalg.factor(covariance, f"noise covariance of {whose}"))
    leaves = [] if callable(own.noise) else jax.tree_util.tree_leaves(own.noise)
    # as NumPy, since comparisons of JAX arrays are traced inside a trace
    leaves = [np.asarray(x) for x in leaves if not isinstance(x, Tracer)]
    if any(x.dtype.kind not in "biuf" for x in leaves):
        raise TypeError(f"noise of {whose} is not of real numbers")
    if any(x.ndim == 1 and np.any(x < 0.0) for x in leaves):
        raise ValueError(f"noise of {whose} holds a negative number, and is standard deviations")
    if any(np.any(np.abs(x) > _LARGEST) for x in leaves):
        raise ValueError(
            f"noise of {whose} holds a number above {_LARGEST:.3g}, whose square is none: give a "
            "smaller standard deviation, or NaN in the place of readings that tell nothing"
        )


def _kinds(x: State) -> str:
    """Types and shapes of the numbers of a state, for messages."""
    return str(jax.tree_util.tree_map(lambda a: f"{jnp.result_type(a)}{jnp.shape(a)}", x))


def _in_float64(whose: str, found: T) -> T:
    """Result of a user's function; refuse any dtype but float64."""
    for leaf in jax.tree_util.tree_leaves(found):
        if (width := str(jnp.result_type(leaf))) != "float64":
            raise TypeError(
                f"{whose} returns {width}, and filters compute in float64: name no other dtype in "
                "it, or end it with .astype(float)"
            )
    return found


@value
class Motion:
    """Motion of the state over one step.

    Attributes:
        step: ``(x, u) -> x``; u is the input of this step (increments, a time step, nothing).
        noise: process noise of a step in the tangent space of the new state: (n,) standard
            deviations, (n, k) factor with Q = L L', or ``(x, u) -> `` one of these.
        linear: optional ``(x, u) -> (new x, F, noise)`` where an analytic transition exists;
            `taylor` then uses it in place of automatic differentiation.
        noise_covariance: (n, n) Q, in place of `noise` (not inside `jit`).

    Raises:
        TypeError: both of noise and its covariance are given, or neither.
        ValueError: the covariance is not positive semidefinite.
    """

    step: Callable[[State, Data], State]
    noise: Any = None
    linear: Callable[[State, Data], tuple[State, Array, Array]] | None = None
    noise_covariance: InitVar[ArrayLike | None] = None

    def __post_init__(self, noise_covariance: ArrayLike | None) -> None:
        """Check noise or covariance."""
        _settle_noise(self, noise_covariance, "the motion")

    def moved(self, x: State, u: Data) -> State:
        """State after a step; refuse any dtype but float64, and types or shapes other than x's."""
        new = _in_float64("step of the motion", self.step(x, u))
        if (found := _kinds(new)) != (wanted := _kinds(x)):
            parts = isinstance(new, list | tuple) and not any(
                map(jnp.shape, jax.tree_util.tree_leaves(new))
            )
            fix = ": return jnp.array([...])" if parts and isinstance(x, jax.Array) else ""
            raise ValueError(f"step of the motion returns {found} of a state {wanted}{fix}")
        return new

    def noise_factor(self, x: State, u: Data) -> Array:
        """Process noise factor at x."""
        value = self.noise(x, u) if callable(self.noise) else self.noise
        return as_noise(value, manifold.dim(x), "the motion")


@value
class Sensor:
    """Measurement function of one sensor, and its noise.

    Attributes:
        read: ``(x, aux) -> z``, an (m,) array or a pytree with elements such as `Angle`; aux is
            data besides the state (star direction, antenna rate, ...), or None.
        noise: (m,) standard deviations, (m, k) factor with R = L L', or
            ``(x, aux) -> `` one of these.
        dim: tangent dimension m of the measurement; by default the length of the noise.
        name: key of its measurements in a run.
        linear: optional ``(x, aux) -> (z, H)`` with an analytic Jacobian.
        noise_covariance: (m, m) R, in place of `noise` (not inside `jit`).

    Raises:
        TypeError: both of noise and its covariance are given, or neither; dim is not known.
        ValueError: the covariance is not positive semidefinite.
    """

    read: Callable[[State, Data], Data]
    noise: Any = None
    dim: int = kind(default=-1)
    name: str = kind(default="y")
    linear: Callable[[State, Data], tuple[Data, Array]] | None = None
    noise_covariance: InitVar[ArrayLike | None] = None

    def __post_init__(self, noise_covariance: ArrayLike | None) -> None:
        """Check the noise, and derive dim from it."""
        _settle_noise(self, noise_covariance, f"sensor '{self.name}'")
        if self.dim < 0:
            shape = () if callable(self.noise) else jnp.shape(self.noise)
            if not shape:
                raise TypeError(
                    f"sensor '{self.name}' needs dim=, how many numbers it reads, or noise with an "
                    "axis of that length"
                )
            object.__setattr__(self, "dim", shape[0])

    def reading(self, x: State, aux: Data) -> Data:
        """Predicted measurement at x; refuse any dtype but float64."""
        return _in_float64(f"read of sensor '{self.name}'", self.read(x, aux))

    def noise_factor(self, x: State, aux: Data) -> Array:
        """Measurement noise factor at x."""
        value = self.noise(x, aux) if callable(self.noise) else self.noise
        return as_noise(value, self.dim, f"sensor '{self.name}'")


@value
class Model:
    """A motion and its sensors, of different names, updated in the order given."""

    motion: Motion
    sensors: tuple[Sensor, ...]

    def __post_init__(self):
        if isinstance(self.sensors, Sensor):
            one = self.sensors.name
            raise TypeError(
                f"sensors must be a tuple of sensors, as in ({one},), got the Sensor '{one}'"
            )
        names = [s.name for s in self.sensors]
        require(len(set(names)) >= len(names), "sensors must have names of their own", names)

    @property
    def dims(self) -> dict[str, int]:
        """Measurement dimension by sensor."""
        return {s.name: s.dim for s in self.sensors}

    def sensor(self, name: str) -> Sensor:
        """Sensor with this name.

        Raises:
            KeyError: there is none; the message lists all names.
        """
        named = {s.name: s for s in self.sensors}
        if name in named:
            return named[name]
        raise KeyError(f"no sensor '{name}'; this model has {sorted(named)}")
