"""Measurements that only the master uses: what the locals of a joined filter have fused, corrected.

A hard constraint makes the covariance of a local filter singular, so that it cannot be fused
(51 of the airship paper wants its inverse), and one that several locals use is counted several
times. Applied to what was fused, it is counted once and may be exact. Whether it lasts is for the
joined filter to say, by what it makes of the fused belief when it predicts:

    distributed, intersecting   own: locals go on from their own, the constraint is output only
                                mean: its mean goes back; full: its mean and covariance
    federated                   fusion-reset, zero-reset: shared out like all that was fused
                                no-reset, rescale: output only
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from robins.errors import require
from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import sensor_names
from robins.filters.kalman import Filter, FilterState, Prediction, in_step, kalman
from robins.filters.model import Motion, Sensor


class Mastered(NamedTuple):
    """What a joined filter with sensors at its master carries besides the belief given out."""

    joined: FilterState  # its belief is the one given out
    master: FilterState


def at_master(filter: Filter, sensors: str | Sequence[str], master: Filter | None = None) -> Filter:
    """A joined filter, some of whose sensors update what was fused and no local filter.

    They must come last in the model: a local measurement after them is fused anew from the locals,
    which know nothing of them.

    Args:
        filter: `distributed`, `intersecting` or `federated`, of the other sensors.
        sensors: those that update what was fused.
        master: how they do: its way to linearise and what its rules do before and after an update
            (it never predicts). `kalman()` by default.

    Raises:
        ValueError: no sensor is named; at `init`, the model has no such sensor or has another one
            after it, or the filter is not a joined one.
    """
    names = sensor_names("at_master", sensors)
    centre = kalman() if master is None else master

    def init(belief: Belief, dims: Mapping[str, int]) -> FilterState:
        if unknown := [name for name in names if name not in dims]:
            raise ValueError(f"at_master: no sensor {unknown[0]!r}; this model has {sorted(dims)}")
        last = list(dims)[-len(names) :]
        if late := [name for name in last if name not in names]:
            raise ValueError(
                f"at_master: sensor {late[0]!r} comes after one of the master's: put {list(names)} "
                "last in the model"
            )
        joined = filter.init(belief, {k: m for k, m in dims.items() if k not in names})
        require(
            filter.members(joined)[0],
            "at_master wants a filter of channels: one without locals uses the sensor itself",
        )
        own = centre.init(belief, {k: m for k, m in dims.items() if k in names})
        return FilterState(joined.belief, Mastered(joined, own))

    def predict(
        state: FilterState, motion: Motion, u: Any = None
    ) -> tuple[FilterState, Prediction]:
        mastered: Mastered = state.memory
        joined, prediction = filter.predict(mastered.joined, motion, u)
        return FilterState(joined.belief, mastered._replace(joined=joined)), prediction

    def update(
        state: FilterState, sensor: Sensor, y: Any, aux: Any = None
    ) -> tuple[FilterState, StepInfo]:
        mastered: Mastered = state.memory
        if sensor.name not in names:
            joined, info = filter.update(mastered.joined, sensor, y, aux)
            return FilterState(joined.belief, mastered._replace(joined=joined)), info
        own, info = centre.update(centre.reset(mastered.master, state.belief), sensor, y, aux)
        joined = mastered.joined._replace(belief=own.belief)
        return FilterState(own.belief, Mastered(joined, own)), info

    def reset(state: FilterState, belief: Belief) -> FilterState:
        mastered: Mastered = state.memory
        joined = filter.reset(mastered.joined, belief)
        return FilterState(joined.belief, Mastered(joined, centre.reset(mastered.master, belief)))

    def members(state: FilterState):
        mastered: Mastered = state.memory
        beliefs, follow = filter.members(mastered.joined)

        def followed(beliefs: Sequence[Belief], belief: Belief) -> FilterState:
            return FilterState(belief, mastered._replace(joined=follow(beliefs, belief)))

        return beliefs, followed

    return in_step(Filter(init, predict, update, reset, members))
