"""The filter of a nine-axis unit: learnt noise, gates and hypotheses."""

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

# of what is learned of travel: forgetting, and least and most of its variances
_MEMORY, _TRAVEL_VARIANCE = 0.98, (0.3, 10.0)
# the same of the field: within that of a room, or as an uncalibrated unit reads it
_FIELD_MEMORY, _FIELD_VARIANCE = 0.95, (1.0, 16.0)
_TAILS = 4.0  # degrees of freedom of Student's t
_NATS = 40.0  # for a bare chip; errors of travel last for some looks, so they count several times
BARE = "gyro_gain"  # what is found wrong where the gyros are those of a bare chip


def field_forgotten(prior: Belief, field_t: Numbers | float) -> Belief:
    """Belief that knows nothing of the field any more, and all else as before.

    The heading too: the gyros know it better than a field that has changed. That the declination of
    a place is small on the long run then leads the heading to the new field in some minutes.
    """
    forgotten = jnp.zeros(prior.factor.shape[0]).at[model.DECLINATION].set(math.pi)
    forgotten = forgotten.at[model.FIELD].set(field_t)
    S = jnp.where(forgotten[:, None] > 0.0, 0.0, prior.factor)
    mean = prior.mean._replace(declination=jnp.zeros_like(prior.mean.declination))
    return Belief(mean, linalg.tria(S, jnp.diag(forgotten)))


@value
class Undisturbed(Rule):
    """The rule of `undisturbed`: a gate that forgets the field where it recovers."""

    gate: Rule
    field_t: Numbers  # () T

    name = "undisturbed"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        """Memory of the gate."""
        return self.gate.init(belief, dims)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        """Judge a measurement as the gate does, but for the prior where it recovers."""
        memory, reopened, o = self.gate.before(memory, prior, o)
        new = o.notes["gate.recovered"]
        return memory, select(new, field_forgotten(prior, self.field_t), Belief(*reopened)), o


def undisturbed(probability: float, patience: int, field_t: float) -> Rule:
    """Refuse a magnetic field that is not the one known, until it has proved to be the field.

    A chi-square gate on azimuth, strength and vertical component together. Refusals that agree with
    each other while the unit moves, ``patience`` in a row, are the field of a new place, or the
    first was disturbed: what was known of the field is then forgotten and learned from it
    (`field_forgotten`). What sits on the unit turns with it and does not agree.

    Args:
        probability: share of right measurements that pass.
        patience: refusals in a row.
        field_t: T, spread of strength and vertical component after forgetting.
    """
    gate = rules.gate(probability, patience, "reinitialise")
    spread = number("field_t must be a number", field_t)
    return rules.only(model.MAGNETOMETER, Undisturbed(gate, spread))


def marg_filter(
    gate: float | None = 0.95, patience: int = 20, field_t: float = 1e-4, sites: bool = True
) -> Filter:
    """The filter of `marg.model_of`, for one prior.

    How far the unit travels, and how much the field of its places scatters, is learned: no constant
    is right for a hand and a flight, or for a unit that was calibrated and one that was not.

    Args:
        gate: share of right magnetometer readings that pass; None believes every reading, and is
            for a model without a magnetometer too.
        patience: readings refused in a row before a field that stays is taken up.
        field_t: T, spread of strength and vertical component of a new field.
        sites: the model reads sites.
    """
    tails = rules.student_t(_TAILS, patience=None)
    chain = [
        rules.only(model.TRAVEL, rules.sage_husa(_MEMORY, "R", *_TRAVEL_VARIANCE)),
        rules.only(model.TRAVEL, tails),
        # assumptions, which may be wrong for long: time does not make them right
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
    """The filter, with its rules, for gyros of the gain `parameters.gyro.gain`."""
    m, sees = parameters.magnetometer, parameters.use_magnetometer
    return marg_filter(
        gate=m.gate if sees == "undisturbed" else None,
        patience=max(1, round(m.patience / parameters.travel.every)),
        field_t=m.most,
        sites=sees != "never",
    )


def filter_of(parameters: MargReplay) -> Filter:
    """The filter of a log, which takes gyros for those of a bare chip once that is likelier."""
    gyro, spread = parameters.gyro, np.zeros(model.DIM)
    spread[model.GAINS] = gyro.bare_gain
    return alternative(one_prior(parameters), spread, [model.TRAVEL], _NATS, BARE)
