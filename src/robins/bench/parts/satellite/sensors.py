"""The sensors: a gyro on the rate table, a star sensor before its star simulator."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from robins.bench.parts.satellite.kit import Kit, driven
from robins.bench.parts.station import Inputs, Part
from robins.systems.satellite import nodes

_expected = jax.jit(nodes.expected)


def gyro(kit: Kit) -> Part:
    """The gyro triad: it reports the turn since its last sample, in whole counts."""
    reads = driven(kit, nodes.gyro)
    first = (jnp.asarray(kit.vehicle.craft.q_ib), kit.vehicle.residue)

    def act(state: tuple[Any, Any], k: int, inputs: Inputs):
        before, residue = state
        if (mounted := inputs["mounted"]) is None:  # what it turned comes with the next sample
            return state, []
        theta, residue = reads(k, before, mounted["q_ib"], residue)
        return (mounted["q_ib"], residue), [("gyro", {"theta_b": np.asarray(theta)})]

    example = {"mounted": {"q_ib": np.asarray(kit.vehicle.craft.q_ib)}}
    return Part("gyro", {"mounted": 0}, lambda: first, act, example)


def star(kit: Kit) -> Part:
    """The star sensor; a camera is told where to look for its stars."""
    lens, sees = kit.given.lens, driven(kit, nodes.star)
    takes = {"motion": 0} if lens is None else {"motion": 0, "gyro": 0, "estimate": 1}
    at_first = np.asarray(kit.vehicle.star_q_ib)

    def begin() -> tuple[Any, Any, Any]:
        return at_first, np.asarray(kit.form.attitude(kit.belief.mean)), np.zeros(3)

    def act(state: tuple[Any, Any, Any], k: int, inputs: Inputs):
        seen, q, bias = state
        if lens is not None and (estimate := inputs["estimate"]) is not None:
            q, bias = estimate["q_ib"], estimate["gyro_bias"]
        turned = inputs.get("gyro")
        theta = np.zeros(3) if turned is None else turned["theta_b"]
        motion = inputs["motion"]
        if motion is None or not kit.due[min(k, len(kit.due) - 1)]:
            return (seen, q, bias), []
        at = motion["q_ib"]
        looks = at if lens is None else _expected(kit.given, q, bias, theta)
        frame = sees(k, at, looks, seen)
        factor = np.zeros(9) if frame.factor is None else np.ravel(np.asarray(frame.factor))
        stars = 0 if frame.stars is None else int(frame.stars)
        says = {"q_ib": np.asarray(frame.q_ib), "factor": factor, "stars": stars}
        return (np.asarray(frame.seen_q_ib), q, bias), [("star", says)]

    seen, q, bias = begin()
    example = {
        "motion": {"q_ib": seen},
        "gyro": {"theta_b": np.zeros(3)},
        "estimate": {"q_ib": q, "gyro_bias": bias},
    }
    return Part("star", takes, begin, act, example)
