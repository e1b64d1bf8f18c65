"""Filter of a nine-axis unit: adaptive noise, gates and hypotheses."""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from robins import linalg
from robins.filters import Belief, Filter, kalman, rules
from robins.filters.composite.alternative import alternative
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.trees import select
from robins.filters.values import Numbers, number, value
from robins.systems.marg import model
from robins.systems.marg.parameters import MargReplay

# adaptation of the travel noise: forgetting factor, least and largest variance ratio
_MEMORY, _TRAVEL_VARIANCE = 0.98, (0.3, 10.0)
# the same of the field: from that of a room to that read by an uncalibrated unit
_FIELD_MEMORY, _FIELD_VARIANCE = 0.95, (1.0, 16.0)
_TAILS = 4.0  # degrees of freedom of Student's t
_NATS = 40.0  # evidence for a bare chip; travel errors are correlated, so it counts several times
BARE = "gyro_gain"  # suspect: the gyros are those of an uncalibrated chip


def field_forgotten(prior: Belief, field_t: Numbers | float) -> Belief:
    """Belief with the field and its declination forgotten, and all other states unchanged.

    The heading is kept: the gyros know it better than a field that has changed. As the declination
    decays, the heading follows the new field within minutes.
    """
    forgotten = jnp.zeros(prior.factor.shape[0]).at[model.DECLINATION].set(math.pi)
    forgotten = forgotten.at[model.FIELD].set(field_t)
    S = jnp.where(forgotten[:, None] > 0.0, 0.0, prior.factor)
    mean = prior.mean._replace(declination=jnp.zeros_like(prior.mean.declination))
    return Belief(mean, linalg.tria(S, jnp.diag(forgotten)))


@value
class Undisturbed(Rule):
    """Rule of `undisturbed`: a gate that forgets the field when it recovers."""

    gate: Rule
    field_t: Numbers  # () T

    name = "undisturbed"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        """Memory of the gate."""
        return self.gate.init(belief, dims)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        """Gate a measurement; on recovery, replace the prior by `field_forgotten`."""
        memory, reopened, o = self.gate.before(memory, prior, o)
        new = o.notes["gate.recovered"]
        return memory, select(new, field_forgotten(prior, self.field_t), Belief(*reopened)), o


def undisturbed(probability: float, patience: int, field_t: float) -> Rule:
    """Refuse a magnetic field other than the known one, until it has persisted.

    A chi-square gate on azimuth, strength and vertical component together. ``patience`` consecutive
    refusals that agree with each other while the unit moves mean a new place, or that the first
    field was disturbed: the known field is then forgotten and learned again (`field_forgotten`). A
    disturbance fixed to the unit turns with it, so such refusals do not agree.

    Args:
        probability: share of undisturbed measurements that pass.
        patience: consecutive refusals.
        field_t: T, sigma of strength and vertical component after forgetting.
    """
    gate = rules.gate(probability, patience, "reinitialise")
    spread = number("field_t must be a number", field_t)
    return rules.only(model.MAGNETOMETER, Undisturbed(gate, spread))


def marg_filter(
    gate: float | None = 0.95, patience: int = 20, field_t: float = 1e-4, sites: bool = True
) -> Filter:
    """Filter of `marg.model_of`, for one prior.

    The noise of travel and of the field is estimated: no constant suits both a hand and a flight,
    or both a calibrated and an uncalibrated unit.

    Args:
        gate: share of undisturbed magnetometer readings that pass; None accepts every reading, and
            also suits a model without a magnetometer.
        patience: consecutive refused readings before a persisting field is adopted.
        field_t: T, sigma of strength and vertical component of a new field.
        sites: the model has the sensor "revisit".
    """
    tails = rules.student_t(_TAILS, patience=None)
    chain = [
        rules.only(model.TRAVEL, rules.sage_husa(_MEMORY, "R", *_TRAVEL_VARIANCE)),
        rules.only(model.TRAVEL, tails),
        # a pseudo-measurement may be wrong for long: waiting does not make it right
        rules.only(model.REST, rules.gate(0.9999, 100, "accept")),
    ]
    if gate is not None:
        learned = rules.sage_husa(_FIELD_MEMORY, "R", *_FIELD_VARIANCE)
        chain += [
            rules.only(model.MAGNETOMETER, learned),
            undisturbed(gate, patience, field_t),
            rules.only(model.MAGNETOMETER, tails),
        ]
    if sites:
        chain.append(rules.only(model.REVISIT, tails))
    return kalman(rules=chain)


def one_prior(parameters: MargReplay) -> Filter:
    """Filter with its rules, for gyros whose gain errors have the sigma `parameters.gyro.gain`."""
    m, sees = parameters.magnetometer, parameters.use_magnetometer
    return marg_filter(
        gate=m.gate if sees == "undisturbed" else None,
        patience=max(1, round(m.patience / parameters.travel.every)),
        field_t=m.most,
        sites=sees != "never",
    )


def filter_of(parameters: MargReplay) -> Filter:
    """Filter of a log; widens the prior of the gyro gains once an uncalibrated chip is likelier.

    Its own velocity and place must be within the stated travel, or wide gains only explain some of
    the travel of a vehicle. A wrong tilt shows in their horizontal components.
    """
    gyro, travel, spread = parameters.gyro, parameters.travel, np.zeros(model.DIM)
    spread[model.GAINS] = gyro.bare_gain
    sizes = [size for s in (travel.velocity, travel.place) for size in (s, s, np.inf)]
    return alternative(one_prior(parameters), spread, {model.TRAVEL: sizes}, _NATS, BARE)
