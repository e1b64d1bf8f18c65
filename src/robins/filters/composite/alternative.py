"""Filter run from two priors; the wider one takes over once the measurements favour it.

A tight prior is useful for most units of a product. A filter of a unit outside it corrects the
state only slowly, and other states absorb the error meanwhile. Both filters run from the start, so
the estimate from the wider prior has converged when it is needed.

Where the model is wrong in another way, a wider prior explains some of that, and is likelier
without being right. Its own innovations then remain larger than stated, and it does not take over.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg
from robins.errors import require, require_kind
from robins.filters.belief import Belief
from robins.filters.kalman import WRONG, Advanced, Filter, FilterState, Prediction, Updated
from robins.filters.model import Data, Given, Motion, Sensor
from robins.filters.trees import stack
from robins.filters.values import Numbers, kind, value
from robins.linalg.rows import each_row

T = TypeVar("T")
_REMEMBERED, _MOST_SQUARE = 20.0, 10.0  # innovations in a mean square, and its limit
_MOST_RATIO = 1e3  # larger innovations count as this, so that the mean square stays finite


@value
class Alternative(Filter):
    """Filter made by `alternative`.

    Its memory: states with a leading axis of two, from the given prior and from the wider one; ()
    evidence for the second [nat], above its minimum; () bool, the second has taken over for good;
    () mean square of the innovations of the second over their stated sizes, weighted by age.
    """

    inner: Filter
    spread: Numbers  # (n,)
    nats: Numbers  # ()
    sizes: tuple[Numbers, ...]  # (m,) of each judging sensor
    judging: tuple[str, ...] = kind()
    wrong: str = kind()

    @property
    def suspects(self) -> tuple[str, ...]:
        return (self.wrong,)

    def suspicions(self, state: FilterState) -> Array:
        return state.memory[2].astype(float)[None]

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        missing = [name for name in self.judging if name not in dims]
        require(not missing, f"alternative: no such sensor; this model has {sorted(dims)}", missing)
        n = belief.factor.shape[0]
        require(len(self.spread) == n, f"spread of an alternative needs {n} numbers", self.spread)
        for name, sizes in zip(self.judging, self.sizes, strict=True):
            m = dims[name]
            require(len(sizes) == m, f"{name} of an alternative needs {m} numbers", sizes)
        wide = linalg.tria(belief.factor, jnp.diag(jnp.asarray(self.spread)))
        begun = [self.inner.init(b, dims) for b in (belief, belief._replace(factor=wide))]
        return FilterState(belief, (stack(begun), jnp.zeros(()), jnp.zeros((), bool), jnp.ones(())))

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        def predicted(one: FilterState) -> tuple[FilterState, tuple[Belief, Array]]:
            one, prediction = self.inner.predict(one, motion, u)
            return one, (prediction.belief, prediction.code)

        states, evidence, taken, square = state.memory
        states, found = each_row(predicted, states)
        belief, code = _one(found, taken)
        state = FilterState(belief, (states, evidence, taken, square))
        return state, Prediction(None, belief, code)

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        def updated(one: FilterState) -> Updated:
            return self.inner.update(one, sensor, y, aux)

        states, evidence, before, square = state.memory
        states, found = each_row(updated, states)
        taken = before
        if sensor.name in self.judging:
            first, second = found.log_likelihood
            gained = jnp.where(jnp.isfinite(second - first), second - first, 0.0)
            evidence = jnp.maximum(evidence + gained, 0.0)
            sizes = self.sizes[self.judging.index(sensor.name)]
            square = _aged(square, found.innovation[1] / jnp.asarray(sizes))
            likelier = evidence > jnp.asarray(self.nats)
            taken = taken | (likelier & (square < _MOST_SQUARE))
        info = _one(found, before)
        wrong = taken.astype(float)[None]
        notes = {**info.notes, "alternative.evidence": evidence, WRONG: wrong}
        belief = _one(states.belief, taken)
        return FilterState(belief, (states, evidence, taken, square)), info._replace(notes=notes)

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        states, *known = state.memory
        states = each_row(lambda one: self.inner.reset(one, belief), states)
        return FilterState(belief, (states, *known))


def _one(tree: T, second: Array) -> T:
    return jax.tree_util.tree_map(lambda x: jnp.where(second, x[1], x[0]), tree)


def _aged(square: Array, ratio: Array) -> Array:
    """Mean square after a ratio (m,) of innovations to their sizes; 0 does not count, nor NaN."""
    ratio = jnp.where(jnp.isfinite(ratio), jnp.minimum(jnp.abs(ratio), _MOST_RATIO), 0.0)
    count = jnp.sum((ratio != 0.0).astype(float))
    mean = jnp.sum(ratio**2) / jnp.maximum(count, 1.0)
    return jnp.where(count > 0.0, square + (mean - square) / _REMEMBERED, square)


def alternative(
    inner: Filter, spread: Given, judging: Mapping[str, Given], nats: float, wrong: str
) -> Filter:
    """Filter run from the given prior and from a wider one, which takes over once it is likelier.

    Both take every step. The evidence is the log-likelihood ratio of their innovations, summed from
    its minimum (Page's test, Biometrika 41, 1954). The wider one takes over once it exceeds
    ``nats``, while the mean square of the wider one's innovations over their stated sizes is below
    10 (weighted by age: the last 20 or so, from a first 1). Until then the result is bit for bit
    that of the given prior, afterwards that of the wider one. Updates note
    ``alternative.evidence`` and, as ``imm.wrong`` (1,), 1 if the wider one has taken over, else 0.
    To smooth a run, run `inner` from the prior that was in use at its end. After a `reset` both
    continue from the same belief, so no more evidence for the second arises.

    Args:
        inner: filter that both run.
        spread: (n,) standard deviations that the wider prior has in addition to the given one.
        judging: sensors whose innovations are compared, each with (m,) their stated standard
            deviations, infinite for components that may be of any size.
        nats: evidence at which the wider one takes over [nat], above 0.
        wrong: name for a wrong given prior, in `Filter.suspects`.

    Raises:
        ValueError: spread is negative or not finite, nats or a standard deviation is not positive,
            judging is empty.
    """
    spread = np.asarray(spread, float)
    if spread.ndim != 1 or not np.all(np.isfinite(spread) & (spread >= 0.0)):
        raise ValueError("spread of an alternative must be a vector of finite numbers from 0 up")
    require_kind(judging, Mapping, "judging of an alternative")
    require(nats > 0.0, "nats of an alternative must be positive", nats)
    require(len(judging) > 0, "an alternative needs a sensor that judges")
    sizes = tuple(np.asarray(size, float) for size in judging.values())
    for name, size in zip(judging, sizes, strict=True):
        fine = size.ndim == 1 and bool(np.all(size > 0.0))
        require(fine, f"{name} of an alternative must be a vector of positive numbers", size)
    return Alternative(inner, spread, np.asarray(float(nats)), sizes, tuple(judging), wrong)
