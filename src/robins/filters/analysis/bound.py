"""Covariance bound: the best accuracy that given sensors allow, without any data.

It is the covariance recursion of the Kalman filter with the model, its noise included, linearised
about the *true* states. For Gaussian noise this is the posterior Cramer-Rao bound along that
trajectory (Tichavsky, Muravchik & Nehorai 1998, eq. 34; Van Trees & Bell 2007, part I): no
estimator with the same model has smaller mean square errors. For a linear model the Kalman filter
attains it.

It depends on which components of measurements are present, not on their values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.kalman import updated
from robins.filters.linearise import taylor
from robins.filters.model import Data, Model
from robins.filters.observation import Observation, as_measurement
from robins.filters.values import on_device
from robins.manifold import State

Use = ArrayLike | Sequence[bool]  # (S,) bool, sensors of a model that are used


class Bound(NamedTuple):
    """Lower-triangular factors of the bound, leading axis E steps."""

    predicted: Array  # (E, n, n) before the measurements of a step
    factor: Array  # (E, n, n) after them

    covariance = Belief.covariance  # like sigma, after the measurements
    sigma = Belief.sigma


class LinearisedSensor(NamedTuple):
    """Sensor linearised along a trajectory of E steps."""

    H: Array  # (E, m, n)
    noise: Array  # (E, m, k) factor, R = noise noise'
    present: Array  # (E, m) bool, the component was measured
    size: Array  # (E, m) magnitude of the terms of the reading

    def seen_with(self, factor: Array, use: Array) -> Observation:
        """Observation in one step (no axis E) for a prior error with this covariance factor."""
        n = factor.shape[0]
        belief = Belief(jnp.zeros(n), factor)
        m = self.H.shape[0]
        return Observation(
            sensor="",
            prior=belief,
            residual=jnp.zeros(m),
            present=self.present,
            accepted=self.present & use,
            spread=self.H @ factor,
            excess=jnp.zeros((m, 0)),
            noise=self.noise,
            size=self.size + jnp.abs(self.H) @ belief.sigma,
        )

    def updated_factor(self, factor: Array, use: Array) -> Array:
        """Covariance factor of the error after the update of one step."""
        o = self.seen_with(factor, use)
        return updated(o.prior, o, "sqrt")[0].factor


class Linearised(NamedTuple):
    """Model linearised along a trajectory of E steps."""

    F: Array  # (E, n, n) transition into each step
    noise: Array  # (E, n, q) factor, Q = noise noise'
    sights: tuple[LinearisedSensor | None, ...]  # by sensor of the model; None without measurements


def linearised(
    model: Model,
    start: Belief,
    truth: State,
    y: Mapping[str, Data],
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
) -> Linearised:
    """Linearise a model about a true trajectory.

    The transition of step k is linearised at the true state before it (in the first step at the
    mean of ``start``), the sensors at ``truth[k]``. Arguments are those of `run`, with leading axis
    E, and truth, the true states at the measurements. Of y, by sensor name, only NaN matters.

    Raises:
        ValueError: lengths differ.
    """
    truth, mean, u, aux = on_device((truth, start.mean, u, dict(aux or {})))
    before = delayed_by_one(mean, truth)
    measured = {name: as_measurement(name, values) for name, values in y.items()}
    rows = (before, truth, u, measured, aux)
    lengths = {jnp.shape(leaf)[0] for leaf in jax.tree_util.tree_leaves(rows)}
    require(
        len(lengths) <= 1, "truth, inputs and measurements must have one length", sorted(lengths)
    )
    way, unit = taylor(), jnp.eye(manifold.dim(start.mean))

    def at(row: tuple[State, State, Data, dict[str, State], dict[str, Data]]) -> Linearised:
        before, now, u, y, aux = row
        moved = way.transition(Belief(before, unit), model.motion, u)
        sights = []
        for sensor in model.sensors:
            if sensor.name not in y:
                sights.append(None)
                continue
            o = way.observation(Belief(now, unit), sensor, y[sensor.name], aux.get(sensor.name))
            size = o.size - jnp.sum(jnp.abs(o.spread), axis=1)  # without the unit sigmas
            sights.append(LinearisedSensor(o.spread, o.noise, o.present, size))
        return Linearised(moved.spread, moved.noise, tuple(sights))

    return jax.lax.map(at, rows)


def delayed_by_one(first: State, states: State) -> State:
    """States before each step: ``first``, then all but the last of ``states`` (leading axis)."""
    return jax.tree_util.tree_map(
        lambda a, b: jnp.concatenate([jnp.asarray(a, float)[None], b[:-1]]), first, states
    )


def used_sensors(model: Model, without: Sequence[str] = ()) -> np.ndarray:
    """(S,) mask of the sensors of a model, False for those named in ``without``.

    Raises:
        KeyError: the model has no such sensor; the message lists its sensors.
    """
    left_out = {model.sensor(name).name for name in without}
    return np.array([s.name not in left_out for s in model.sensors], dtype=bool)


def covariance_bound(
    model: Model,
    start: Belief,
    truth: State,
    y: Mapping[str, Data],
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
    use: Use | None = None,
    known: Sequence[int] = (),
) -> Bound:
    """Covariance bound along a true trajectory; may be batched by `jax.vmap`.

    Arguments and errors are those of `linearised`, the factor of ``start`` being the prior, and of
    `bound_along`.
    """
    return bound_along(linearised(model, start, truth, y, u, aux), start.factor, use, known)


def bound_along(
    line: Linearised, factor: Array, use: Use | None = None, known: Sequence[int] = ()
) -> Bound:
    """Covariance bound of a linearised model, by one scan.

    Args:
        line: from `linearised`.
        factor: (n, n) factor of the prior covariance.
        use: (S,) bool, sensors of the model to use, as `used_sensors` returns it; all by default.
            It is data, so a batch of subsets is one `jax.vmap`.
        known: indices of the tangent components that are known exactly, before every prediction and
            every measurement.

    Raises:
        ValueError: a known component does not exist.
    """
    n = factor.shape[0]
    known = tuple(int(i) for i in known)
    if any(not 0 <= i < n for i in known):
        raise ValueError(f"known components {list(known)}: the state has 0 to {n - 1}")
    use = jnp.ones(len(line.sights), bool) if use is None else jnp.asarray(use, bool)

    def step(S: Array, row: Linearised):
        predicted = _conditioned(linalg.tria(row.F @ S, row.noise), known)
        S = predicted
        for i, sight in enumerate(row.sights):
            if sight is not None:
                S = sight.updated_factor(S, use[i])
        return S, Bound(predicted, S)

    return jax.lax.scan(step, _conditioned(factor, known), line)[1]


def _conditioned(factor: Array, known: tuple[int, ...]) -> Array:
    """Factor of the covariance conditioned on exactly known components of the error."""
    if not known:
        return factor
    rows = jnp.eye(factor.shape[0])[np.array(known)]
    m = len(known)
    exact = LinearisedSensor(rows, jnp.zeros((m, 0)), jnp.ones(m, bool), jnp.zeros(m))
    return exact.updated_factor(factor, jnp.ones((), bool))
