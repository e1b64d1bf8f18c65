"""How well a filter predicts its measurements: the log density of each, before it is used.

The density is that of the belief alone, whatever rules then refuse or weigh, so that it can be
compared between filters of any kind, and no filter looks better for refusing more.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import linalg
from robins.filters.belief import StepInfo
from robins.filters.kalman import Filter, FilterState
from robins.filters.linearise import taylor
from robins.filters.model import Sensor
from robins.filters.observation import Normalised, normalised
from robins.filters.run import Step

OUTLIERS = 0.02  # share of measurements whose errors are `WIDER` times as large
WIDER = 10.0
_RULE = "predicted"


class Predicted(NamedTuple):
    """Of a step, or of several with leading axes."""

    log_density: Float[Array, "..."]  # of all its measurements
    components: Array  # how many


def log_density(seen: Normalised) -> Float[Array, ""]:
    """Log density of an innovation z of dimension m with covariance S.

    A normal density, contaminated by a share e of outliers of k times the size (Tukey 1960):

        p(z) = (1 - e) N(z; 0, S) + e N(z; 0, k^2 S)

    A plain normal density would let one outlier outweigh all else; leaving outliers out would pay
    for every measurement that is called one.
    """
    m = seen.dof.astype(float)
    normal = math.log1p(-OUTLIERS) - 0.5 * seen.nis
    wide = math.log(OUTLIERS) - m * math.log(WIDER) - 0.5 * seen.nis / WIDER**2
    spread = linalg.log_diagonal(seen.factor, seen.used) + 0.5 * m * math.log(2.0 * math.pi)
    return jnp.logaddexp(normal, wide) - spread


def scored(filter_: Filter) -> Filter:
    """The same filter, whose updates note how well the measurement was predicted.

    Measurements are linearised about the mean of the belief (first-order Taylor). What is found is
    read by `predicted`; after a prediction that was not taken it is -inf.
    """
    way = taylor()

    def update(
        state: FilterState, sensor: Sensor, y: Any, aux: Any = None
    ) -> tuple[FilterState, StepInfo]:
        seen = normalised(way.observation(state.belief, sensor, y, aux))
        there = seen.dof > 0
        density = jnp.where(there, jnp.where(state.current, log_density(seen), -jnp.inf), 0.0)
        new, info = filter_.update(state, sensor, y, aux)
        return new, info.noted(_RULE, log_density=density, components=seen.dof)

    return filter_._replace(update=update)


def predicted(step: Step) -> Predicted:
    """What `scored` noted of a step, for ``run(..., keep=predicted)``."""
    notes = [info.notes for info in step.info.values()]
    density = sum((n[f"{_RULE}.log_density"] for n in notes), jnp.zeros(()))
    return Predicted(density, sum((n[f"{_RULE}.components"] for n in notes), jnp.zeros((), int)))
