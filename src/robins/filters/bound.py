"""The covariance bound: how well given sensors can do at best, without any data.

The recursion of the Kalman filter's covariance with the model linearised about the *true* states.
For Gaussian noise of the stated size it is the posterior Cramer-Rao bound along that trajectory
(Tichavsky, Muravchik & Nehorai 1998, eq. 34; Van Trees & Bell 2007, part I): no estimator that is
told the same model has smaller mean square errors. For a linear model the Kalman filter reaches it.

What was measured never enters, only which components were there. Where process noise depends on the
state it is that at the true state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold
from robins.filters.belief import Belief
from robins.filters.kalman import predicted_factor, updated
from robins.filters.linearise import taylor
from robins.filters.model import Model
from robins.filters.observation import Observation, as_measurement
from robins.manifold import State


class Bound(NamedTuple):
    """Lower-triangular factors of the bound, leading axis E steps."""

    predicted: Array  # (E, n, n) before the measurements of a step
    factor: Array  # (E, n, n) after them

    @property
    def covariance(self) -> Array:
        """(..., n, n) after the measurements."""
        return self.factor @ jnp.swapaxes(self.factor, -1, -2)

    @property
    def sigma(self) -> Array:
        """(..., n) after the measurements, of each tangent component."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=-1))


class Along(NamedTuple):
    """A trajectory as a scan takes it: everything a step needs, leading axis E."""

    before: State  # true state that the step begins with
    truth: State  # true state at its measurements
    u: Any
    y: dict[str, Any]
    aux: dict[str, Any]


def along(start: Belief, truth: State, y: Mapping[str, Any], u: Any, aux: Any) -> Along:
    """Line up a trajectory with its inputs.

    Raises:
        ValueError: lengths differ.
    """
    truth, mean, u, aux = (
        jax.tree_util.tree_map(jnp.asarray, x) for x in (truth, start.mean, u, dict(aux or {}))
    )
    before = jax.tree_util.tree_map(
        lambda first, rest: jnp.concatenate([first[None].astype(float), rest[:-1]]), mean, truth
    )
    seen = {name: as_measurement(name, values) for name, values in y.items()}
    row = Along(before, truth, u, seen, aux)
    lengths = {jnp.shape(leaf)[0] for leaf in jax.tree_util.tree_leaves(row)}
    if len(lengths) > 1:
        raise ValueError(
            f"truth, inputs and measurements must have one length, got {sorted(lengths)}"
        )
    return row


def used_sensors(model: Model, without: Sequence[str] = ()) -> np.ndarray:
    """(S,) which sensors of a model are used when some are left out.

    Raises:
        KeyError: the model has no such sensor; the message lists those there are.
    """
    left_out = {model.sensor(name).name for name in without}
    return np.array([s.name not in left_out for s in model.sensors], dtype=bool)


def sights(
    model: Model, row: Along, use: Array | None
) -> Iterator[Callable[[Belief], Observation]]:
    """How each sensor that has measurements is seen, in the model's order.

    Yields:
        A function from a belief to the sensor's `Observation`.
    """
    way = taylor()
    for i, sensor in enumerate(model.sensors):
        if sensor.name not in row.y:
            continue

        def look(belief: Belief, i=i, sensor=sensor) -> Observation:
            seen = way.observation(belief, sensor, row.y[sensor.name], row.aux.get(sensor.name))
            return seen if use is None else seen._replace(accepted=seen.accepted & use[i])

        yield look


def _told(prior: Belief, known: tuple[int, ...]) -> Array:
    """Factor of a belief once some components of the error are known exactly."""
    if not known:
        return prior.factor
    rows = np.array(known)
    here = jnp.ones(len(rows), bool)
    exact = linalg.zeros(len(rows), 0)
    seen = Observation(
        sensor="known",
        prior=prior,
        residual=jnp.zeros(len(rows)),
        present=here,
        accepted=here,
        spread=prior.factor[rows],
        excess=exact,
        noise=exact,
        size=prior.sigma[rows],
    )
    return updated(prior, seen, "sqrt")[0].factor


def covariance_bound(
    model: Model,
    start: Belief,
    truth: State,
    y: Mapping[str, Any],
    u: Any = None,
    aux: Mapping[str, Any] | None = None,
    use: Any = None,
    known: Sequence[int] = (),
) -> Bound:
    """Covariance that no filter can beat, along a true trajectory; one scan, ready for `jax.vmap`.

    The transition of step k is linearised at the true state before it and with its input, for the
    first step at the mean of the start; the sensors at ``truth[k]``.

    Args:
        model: the motion and the sensors.
        start: belief before the first step; its factor is the prior.
        truth: true states at the measurements, leading axis E.
        y: by sensor name, leading axis E. Only what is NaN matters.
        u: inputs of the motion, leading axis E.
        aux: what sensors need besides the state, by sensor name, leading axis E.
        use: (S,) bool, which sensors of the model to use, in its order, as `used_sensors` makes it;
            it is data, so a batch of subsets is one `jax.vmap`. All by default.
        known: numbers of the tangent components that somebody else tells exactly, before every
            prediction and every measurement.

    Raises:
        ValueError: lengths differ, or a component that is known does not exist.
    """
    n = manifold.dim(start.mean)
    known = tuple(int(i) for i in known)
    if any(not 0 <= i < n for i in known):
        raise ValueError(f"known components {list(known)}: the state has 0 to {n - 1}")
    way = taylor()
    use = None if use is None else jnp.asarray(use, bool)

    def step(S: Array, row: Along):
        moved = way.transition(Belief(row.before, S), model.motion, row.u)
        S = _told(Belief(row.truth, predicted_factor(moved, "sqrt")), known)
        predicted = S
        for look in sights(model, row, use):
            prior = Belief(row.truth, S)
            S = updated(prior, look(prior), "sqrt")[0].factor
        return S, Bound(predicted, S)

    first = _told(start, known)
    return jax.lax.scan(step, first, along(start, truth, y, u, aux))[1]
