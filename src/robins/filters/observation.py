"""A measurement relative to a belief: residual, spread and NIS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold
from robins.filters.belief import Belief, Number, with_notes
from robins.filters.model import Data, Given
from robins.filters.values import Numbers
from robins.manifold import State

# Exactly known quantities accumulate rounding over many steps. This share of the summands is far
# above that rounding, and far below the noise of any sensor.
CONTRADICTS = 1e-9


class Observation(NamedTuple):
    """A measurement linearised about a belief. Not a JAX type: `sensor` is a string."""

    sensor: str
    prior: Belief
    residual: Array  # (m,) y minus its prediction; 0 where missing
    present: Array  # (m,) bool, the component was measured
    accepted: Array  # (m,) bool, the component is used; rules may refuse one that is present
    spread: Array  # (m, n) H S
    excess: Array  # (m, k) factor of the linearisation error Omega; k = 0 for Taylor
    noise: Array  # (m, q) measurement noise factor
    size: Array  # (m,) size of the summands of the spread: 1e-14 of it is rounding
    deficit: Array | None = None  # (m,) vector whose square is subtracted, for indefinite weights
    notes: Mapping[str, Number] = {}  # of rules, before the update
    unweighed: Array | None = None  # (m, q) noise before robust rules; None: none has raised it

    @property
    def expected(self) -> Array:
        """(m,) standard deviation of the innovation, before a robust rule raises the noise."""
        noise = self.noise if self.unweighed is None else self.unweighed
        square = sum(jnp.sum(root**2, axis=-1) for root in (self.spread, self.excess, noise))
        taken = 0.0 if self.deficit is None else self.deficit**2
        return jnp.sqrt(jnp.maximum(square - taken, 0.0))

    def raised(self, noise: Array, accepted: Array) -> Observation:
        """Copy with noise factor and accepted components of a robust rule."""
        before = self.noise if self.unweighed is None else self.unweighed
        return self._replace(noise=noise, accepted=accepted, unweighed=before)

    def noted(self, rule: str, **notes: Number) -> Observation:
        """Copy with notes of a rule, which the update copies to its `StepInfo` (`with_notes`)."""
        return self._replace(notes=with_notes(self.notes, rule, notes))


class Normalised(NamedTuple):
    """Innovation whitened by its predicted covariance."""

    factor: Array  # (m, m) lower factor of the innovation covariance; identity rows where not used
    used: Array  # (m,) bool, accepted and independent of the components above
    white: Array  # (m,) white, of unit variance if the filter is consistent; 0 where not used
    nis: Array  # () sum of squares of white, chi-square of dof
    dof: Array  # () number of components used


def as_measurement(sensor: str, data: Data) -> Data:
    """Measurements as 64-bit floats of JAX, from arrays of any real kind or lists of numbers."""
    # a copy of NumPy's, since JAX computes later and the given array may change
    return jax.tree_util.tree_map(
        lambda x: x if isinstance(x, jax.Array) else jnp.array(x), as_real(sensor, data)
    )


def as_real(sensor: str, data: Data) -> Data:
    """Measurements as 64-bit floats, JAX arrays or else NumPy; NumPy float64 is not copied.

    Raises:
        TypeError: they are not real numbers.
    """

    def is_list(leaf: Data) -> bool:
        return isinstance(leaf, list)

    def is_real(leaf: Data) -> bool:
        return type(leaf) in (np.ndarray, np.float64) and leaf.dtype == float

    def as_numbers(leaf: Given) -> Numbers:
        array = leaf if isinstance(leaf, jax.Array) else np.asarray(leaf)
        if not jnp.issubdtype(array.dtype, np.floating) and array.dtype.kind not in "iu":
            raise TypeError(
                f"measurements of '{sensor}' hold {array.dtype}: "
                "real numbers are wanted, NaN where one is missing"
            )
        return array.astype(float)

    if all(map(is_real, jax.tree_util.tree_leaves(data, is_leaf=is_list))):
        return data
    return jax.tree_util.tree_map(as_numbers, data, is_leaf=is_list)


def innovation(z: State, y: Data) -> tuple[Array, Array]:
    """Tangent vector from a predicted to an actual measurement, and mask of present components.

    A component is missing where the measurement itself is NaN or infinite; a prediction that is
    not finite is a fault of the model and stays visible. Missing numbers are replaced before any
    arithmetic, so that gradients stay finite.
    """
    pairs = zip(manifold.leaves(z), manifold.leaves(y), strict=True)
    present = jnp.concatenate([_present(a, b) for a, b in pairs])
    filled = jax.tree_util.tree_map(lambda a, b: jnp.where(jnp.isfinite(b), b, a), z, y)
    return jnp.where(present, manifold.local(z, filled), 0.0), present


def _present(predicted: State, measured: State) -> Array:
    if not manifold.is_element(predicted):
        return jnp.isfinite(jnp.reshape(measured, -1))
    # An element has fewer tangent components than numbers: test the tangent vector.
    is_finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(measured)]))
    return jnp.isfinite(jnp.reshape(predicted.local(measured), -1)) | is_finite


def left_out(o: Observation) -> tuple[Array, Array, Array, Array | None, Array]:
    """Spread, excess, noise and deficit without the rows not used, and the mask of used rows.

    A row is not used if it was not accepted, or if it has no noise and either depends on components
    above it or measures an exactly known quantity: its spread is then rounding, correlated with
    everything. It becomes unit noise, uncorrelated with the rest, which keeps shapes.
    """
    kept = [jnp.where(o.accepted[:, None], b, 0.0) for b in (o.spread, o.excess, o.noise)]
    exact = o.accepted & ~jnp.any(kept[2] != 0.0, axis=1)
    size = jnp.where(exact, o.size, 0.0)
    used = jax.lax.cond(
        linalg.plainly_independent(o.noise),
        lambda: o.accepted,  # all have noise, the usual case
        lambda: linalg.independent_rows(jnp.concatenate(kept, axis=1), size),
    )
    spread, excess, noise = (jnp.where(used[:, None], b, 0.0) for b in kept)
    unit = jnp.diag(jnp.where(used, 0.0, 1.0))
    deficit = None if o.deficit is None else jnp.where(used, o.deficit, 0.0)
    return spread, excess, jnp.concatenate([noise, unit], axis=1), deficit, used


def whiten(factor: Array, used: Array, residual: Array) -> Normalised:
    """Whiten a residual by the factor of its covariance."""
    rest = jnp.where(used, residual, 0.0)
    white = linalg.solve_lower(factor, rest[:, None])[:, 0]
    return Normalised(factor, used, white, jnp.sum(white**2), jnp.sum(used))


def contradicted(o: Observation, seen: Normalised) -> Array:
    """(m,) bool: components that contradict exactly known values.

    These follow from the belief and the used components (R = 0 and P = 0, or one exact sensor
    twice), so the residual of such a component is determined by the other residuals.
    """
    idle = o.accepted & ~seen.used

    def compare() -> Array:
        wide = jnp.concatenate([o.spread, o.excess, o.noise], axis=1)
        used = jnp.where(seen.used[:, None], wide, 0.0)
        if o.deficit is None:
            # By an orthogonal transform: products of rows, divided by a small pivot, are rounding.
            m = len(used)
            top = jnp.concatenate([used, jnp.diag(jnp.where(seen.used, 0.0, 1.0))], axis=1)
            share = linalg.tria(jnp.concatenate([top, jnp.pad(wide, ((0, 0), (0, m)))]))[m:, :m]
        else:
            among = used @ wide.T - jnp.outer(jnp.where(seen.used, o.deficit, 0.0), o.deficit)
            share = linalg.solve_lower(seen.factor, among).T
        off = jnp.abs(o.residual - share @ seen.white)
        return idle & (off > CONTRADICTS * (o.size + jnp.abs(share) @ jnp.abs(seen.white)))

    return jax.lax.cond(jnp.any(idle), compare, lambda: jnp.zeros_like(idle))


def normalised(o: Observation) -> Normalised:
    """Innovation normalised as in the update, for rules that test a measurement."""
    spread, excess, noise, deficit, used = left_out(o)
    factor = linalg.tria(spread, excess, noise)
    if deficit is not None:
        factor = linalg.downdate(factor, deficit)
    return whiten(factor, used, o.residual)
