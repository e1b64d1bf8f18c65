"""The same filter, one sample at a time, for benches and live programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from robins.filters.audit import audit
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.kalman import Filter, FilterState, Prediction
from robins.filters.model import Model
from robins.filters.observation import as_measurement
from robins.filters.run import Step, everything, filter_step
from robins.filters.sameness import same, same_model


@partial(jax.jit, static_argnames=("filter_",))
def _predict(filter_, motion, state, u):
    return filter_.predict(state, motion, u)


@partial(jax.jit, static_argnames=("filter_",))
def _update(filter_, sensor, state, y, aux):
    return filter_.update(state, sensor, y, aux)


@partial(jax.jit, static_argnames=("filter_", "keep"))
def _step(filter_, model, state, u, y, aux, keep):
    state, step = filter_step(filter_, model, state, u, y, aux)
    return state, keep(step), step.prediction.code, {k: i.code for k, i in step.info.items()}


def _settled(state: FilterState) -> FilterState:
    """With types of their own: a weak one would have all compiled again after the first step."""
    if not any(getattr(x, "weak_type", False) for x in jax.tree_util.tree_leaves(state)):
        return state
    return jax.tree_util.tree_map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), state)


class OnlineFilter:
    """A filter with a current state; `predict` and `update` are those of a run, compiled.

    Gives the numbers of `robins.filters.run` to rounding.

    Attributes:
        filter: what it steps, and
        model: with what.
        state: the filter's state; assign to restore a saved one.
        counts: outcomes so far, by `Code` name: of updates, and of predictions not taken.
    """

    def __init__(self, filter_: Filter, model: Model, start: Belief | FilterState):
        """Begin at a belief, or go on from a state.

        Args:
            filter_: from `kalman` and its kin.
            model: the motion and the sensors.
            start: initial belief or saved state.
        """
        self.filter, self.model = same(filter_), same_model(model)
        state = filter_.init(start, model.dims) if isinstance(start, Belief) else start
        self.state = _settled(state)
        self.counts: Counter[str] = Counter()

    @property
    def belief(self) -> Belief:
        """What is believed now."""
        return self.state.belief

    def predict(self, u: Any = None) -> Prediction:
        """Move on by one step with input u."""
        self.state, prediction = _predict(self.filter, self.model.motion, self.state, u)
        code = Code(int(prediction.code))
        if code is not Code.DONE:
            self.counts[code.name] += 1
        audit(self.state, self.state, None, None)
        return prediction

    def step(
        self,
        y: Mapping[str, Any],
        u: Any = None,
        aux: Mapping[str, Any] | None = None,
        keep: Callable[[Step], Any] = everything,
    ) -> Any:
        """A whole step in one compiled call: predict, then update with each sensor in y.

        Args:
            y: measurements by sensor name, NaN where missing, of the same shapes at every call;
                they are not checked as those of `update` are.
            u: input of the motion.
            aux: what sensors need besides the state, by sensor name.
            keep: what to give back of the `Step`, as in `run`.
        """
        found = _step(self.filter, self.model, self.state, u, dict(y), aux or {}, keep)
        self.state, kept, *codes = found
        moved, used = jax.device_get(codes)
        if moved != Code.DONE:
            self.counts[Code(int(moved)).name] += 1
        self.counts.update(Code(int(code)).name for code in used.values())
        audit(self.state, self.state, None, None)
        return kept

    def update(self, y: Any, sensor: str | None = None, aux: Any = None) -> StepInfo:
        """Use a measurement; NaN is missing, per component.

        Args:
            y: the measurement.
            sensor: its sensor's name; may be left out where the model has one sensor.
            aux: what the sensor needs besides the state.

        Raises:
            KeyError: the model has no sensor of this name.
            TypeError: the measurement is not of real numbers.
            ValueError: no name was given and the model has several sensors, or the measurement is
                not of the shape that the sensor reads.
        """
        if sensor is None:
            if len(self.model.sensors) != 1:
                raise ValueError(f"name one of the sensors {sorted(self.model.dims)}")
            sensor = self.model.sensors[0].name
        chosen = self.model.sensor(sensor)
        numbers = as_measurement(sensor, y)
        self.state, info = _update(self.filter, chosen, self.state, numbers, aux)
        self.counts[Code(int(info.code)).name] += 1
        audit(self.state, self.state, None, None)
        return info
