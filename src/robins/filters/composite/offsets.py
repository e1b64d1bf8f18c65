"""Hypotheses of temporary sensor offsets: an additional state that modes switch on and off.

    y = h(x) [+] sigma * b + v,      v ~ N(0, R),  sigma the standard deviations of R

b is a state in addition to x, in units of the noise of its sensor, so that the same numbers serve
every sensor. Modes of a bank (`robins.filters.composite.imm`) assume that

    no sensor is off        b does not act
    an offset begins        b acts, b ~ N(0, BEGINS^2 I): a new offset
    it lasts                b acts, and changes by N(0, WANDERS^2 I) in a step

and change by

    none is off  -- BEGIN -->  begins  -- at once -->  lasts  -- END -->  none is off

"Begins" and "lasts" are separate because an unlikely mode is mixed with likely ones in every step:
a single mode would repeatedly restart with an unknown offset, at a cost in likelihood each time.

A weight (`robins.filters.rules.huber`) reduces the effect of one outlier, without memory. If
readings stay off, because a sensor is disturbed for a while or because the model between two
sensors is wrong, the offset is estimated, and the information of the readings on changes of x is
kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins import linalg, manifold
from robins.filters.belief import Belief
from robins.filters.composite.bank import EVERY, transitions
from robins.filters.kalman import Advanced, Filter, FilterState, FilterWrapper, Prediction, Updated
from robins.filters.model import Data, Motion, Sensor
from robins.filters.values import Numbers, kind, value

BEGINS = 10.0  # sigma of a new offset, in standard deviations of the sensor noise
WANDERS = 0.03  # sigma of its change per step, in the same unit
BEGIN, END = 1e-3, 1e-2  # probabilities per step that an offset begins, and that it ends


class Augmented(NamedTuple):
    """State, and the offset of each sensor."""

    state: Any
    offset: tuple[Array, ...]  # (m,) of each sensor, in standard deviations of its noise


class OffsetHypothesis(NamedTuple):
    """Offset hypothesis, or with a leading axis those of a bank."""

    off: Any  # (sensors,) 1 if the readings have an offset, else 0
    lasts: Any  # (sensors,) 1 if the offset continues that of the step before, else 0


# ------------------------------------------------------------------------------------- the bank


def offset_hypotheses(plain: int, sensors: int) -> OffsetHypothesis:
    """Hypotheses of a bank: first plain ones without offsets, then two for each sensor."""
    none, each = np.zeros((plain, sensors)), np.repeat(np.eye(sensors), 2, axis=0)
    second = np.tile([0.0, 1.0], sensors)[:, None]
    return OffsetHypothesis(np.vstack([none, each]), np.vstack([none, second * each]))


def offset_transitions(change: np.ndarray, sensors: int) -> np.ndarray:
    """Transition probabilities per step of the hypotheses of `offset_hypotheses`.

    Args:
        change: (plain, plain) probabilities between modes without offsets, the first that without
            faults.
        sensors: number of sensors that may have an offset, one at a time.

    Returns:
        (plain + 2 sensors, plain + 2 sensors) probabilities.
    """
    plain, count = len(change), len(change) + 2 * sensors
    begins = plain + 2 * np.arange(sensors)
    at = np.arange(count)
    plain_rows = slice(plain)
    edges = [(plain_rows, plain_rows, change), (slice(plain, None), 0, END), (EVERY, begins, BEGIN)]
    return transitions(count, edges, np.where(np.isin(at, begins), at + 1, at))


# ----------------------------------------------------------------------------- the model of a mode


def _components(x: Augmented, each: Array) -> Array:
    """One number per sensor, repeated for every component of its offset."""
    return jnp.concatenate([jnp.broadcast_to(each[i], b.shape) for i, b in enumerate(x.offset)])


def _kept(x: Augmented, of: OffsetHypothesis) -> tuple[Array, ...]:
    return tuple(of.lasts[i] * b for i, b in enumerate(x.offset))


def _drawn(x: Augmented, of: OffsetHypothesis) -> Array:
    return jnp.diag(_components(x, jnp.where(of.lasts > 0.0, WANDERS, BEGINS)))


Scaled = Partial  # function of a factor of the process noise to that of a mode


def _step(motion: Motion, of: OffsetHypothesis, x: Augmented, u: Data) -> Augmented:
    return Augmented(motion.moved(x.state, u), _kept(x, of))


def _noise(motion: Motion, of: OffsetHypothesis, scaled: Scaled, x: Augmented, u: Data) -> Array:
    return linalg.block_diagonal(scaled(motion.noise_factor(x.state, u)), _drawn(x, of))


def _step_linear(motion: Motion, of: OffsetHypothesis, scaled: Scaled, x: Augmented, u: Data):
    assert motion.linear is not None
    state, F, noise = motion.linear(x.state, u)
    F = linalg.block_diagonal(F, jnp.diag(_components(x, of.lasts)))
    noise = linalg.block_diagonal(scaled(linalg.as_factor(noise)), _drawn(x, of))
    return Augmented(state, _kept(x, of)), F, noise


def _read(sensor: Sensor, x: Augmented, aux: Data):
    return sensor.reading(x.state, aux)


def _read_noise(sensor: Sensor, x: Augmented, aux: Data):
    return sensor.noise_factor(x.state, aux)


@value
class OffsetReading:
    """Measurement function of a sensor with an offset from the state."""

    sensor: Sensor
    off: Numbers  # () 1 if the offset acts, else 0
    at: int = kind()  # index of the offset

    def __call__(self, x: Augmented, aux: Data):
        noise = self.sensor.noise_factor(x.state, aux)
        sigma = jnp.sqrt(jnp.sum(noise**2, axis=1))
        by = jnp.asarray(self.off) * sigma * x.offset[self.at]
        return manifold.retract(self.sensor.reading(x.state, aux), by)


def _augmented_sensor(sensor: Sensor, names: Sequence[str], of: OffsetHypothesis) -> Sensor:
    """Sensor of the augmented state; a `linear` of the given sensor is not used."""
    read: Any = Partial(_read, sensor)
    if sensor.name in names:
        at = names.index(sensor.name)
        read = OffsetReading(sensor, of.off[at], at)
    return Sensor(read, Partial(_read_noise, sensor), sensor.dim, sensor.name)


@value
class UnderHypothesis(FilterWrapper):
    """Filter made by `under_hypothesis`."""

    of: OffsetHypothesis
    scaled: Scaled
    names: tuple[str, ...] = kind()

    @jax.jit
    def predict(self, state: FilterState, motion: Motion, u: Data = None) -> Advanced:
        linear = None
        if motion.linear is not None:
            linear = Partial(_step_linear, motion, self.of, self.scaled)
        noise = Partial(_noise, motion, self.of, self.scaled)
        return self.inner.predict(state, Motion(Partial(_step, motion, self.of), noise, linear), u)

    @jax.jit
    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data = None) -> Updated:
        return self.inner.update(state, _augmented_sensor(sensor, self.names, self.of), y, aux)


def under_hypothesis(
    filter_: Filter, names: Sequence[str], of: OffsetHypothesis, scaled: Scaled
) -> Filter:
    """Filter of the `Augmented` state under a hypothesis, for motion and sensors of the state.

    Args:
        filter_: filter for any state, such as `kalman` returns.
        names: names of the sensors that may have an offset, in the order of the offsets.
        of: the hypothesis; its numbers may be traced.
        scaled: function of a factor of the process noise to that of the mode; data of a program.
    """
    return UnderHypothesis(filter_, of, scaled, tuple(names))


def _augmented(belief: Belief, offset: tuple[Array, ...], factor: Array) -> Belief:
    return Belief(Augmented(belief.mean, offset), linalg.block_diagonal(belief.factor, factor))


def _marginal_belief(wide: FilterState) -> FilterState:
    mean, n = wide.belief.mean.state, manifold.dim(wide.belief.mean.state)
    # the first rows of a lower triangle are the factor of the first components
    return FilterState(Belief(mean, wide.belief.factor[:n, :n]), wide, (), wide.current)


@value
class Marginal(FilterWrapper):
    """Filter made by `marginal`."""

    names: tuple[str, ...] = kind()

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return (state.memory,)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        if unknown := set(self.names) - set(dims):
            raise ValueError(
                f"off names {sorted(unknown)}: name sensors of the model, which has {list(dims)}"
            )
        offset = tuple(jnp.zeros(dims[name]) for name in self.names)
        factor = BEGINS * jnp.eye(sum(dims[name] for name in self.names))
        return _marginal_belief(self.inner.init(_augmented(belief, offset, factor), dims))

    @jax.jit
    def predict(self, state: FilterState, motion: Motion, u: Data = None) -> Advanced:
        wide, prediction = self.inner.predict(state.memory, motion, u)
        new = _marginal_belief(wide)
        return new, Prediction(None, new.belief, prediction.code)

    @jax.jit
    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data = None) -> Updated:
        wide, info = self.inner.update(state.memory, sensor, y, aux)
        new = _marginal_belief(wide)
        return new, info._replace(gain=info.gain[: len(new.belief.factor)])

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        wide = state.memory.belief
        factor = linalg.tria(wide.factor[len(belief.factor) :])
        return _marginal_belief(
            self.inner.reset(state.memory, _augmented(belief, wide.mean.offset, factor))
        )


def marginal(filter_: Filter, names: Sequence[str]) -> Filter:
    """Filter of the plain state from one of the `Augmented` state; `reset` keeps the offsets.

    Args:
        filter_: filter of the augmented state.
        names: names of the sensors that may have an offset.

    Raises:
        ValueError: when a run starts: the model has no sensor of one of these names.
    """
    return Marginal(filter_, tuple(names))
