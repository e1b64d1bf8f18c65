"""The filter and its rules: which measurements are believed, and how a new field is taken up."""

from __future__ import annotations

import math

import jax.numpy as jnp

from robins import linalg
from robins.filters import Belief, Filter, kalman, rules
from robins.filters.observation import Observation
from robins.filters.rule import Rule
from robins.filters.trees import select
from robins.systems.marg.model import DECLINATION, FIELD, MAGNETOMETER, REST_RATE, TRAVEL
from robins.systems.marg.parameters import Replay

CAUSAL, SMOOTHED = FILTERS = ("marg", "marg-smoothed")


def field_forgotten(prior: Belief, field_t: float) -> Belief:
    """Belief that knows nothing of the field any more, and all else as before.

    The heading too: the gyros know it better than a field that has changed. That the declination of
    a place is small on the long run then leads the heading to the new field in some minutes.
    """
    forgotten = jnp.zeros(prior.factor.shape[0]).at[DECLINATION].set(math.pi)
    forgotten = forgotten.at[FIELD].set(field_t)
    S = jnp.where(forgotten[:, None] > 0.0, 0.0, prior.factor)
    mean = prior.mean._replace(declination=jnp.zeros_like(prior.mean.declination))
    return Belief(mean, linalg.tria(S, jnp.diag(forgotten)))


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
    inner = rules.gate(probability, patience, "reinitialise")

    def before(memory, prior: Belief, o: Observation):
        memory, reopened, o = inner.before(memory, prior, o)
        new = o.notes["gate.recovered"]
        return memory, select(new, field_forgotten(prior, field_t), Belief(*reopened)), o

    return rules.only(MAGNETOMETER, inner._replace(before=before, name="undisturbed"))


def marg_filter(
    gate: float | None = 0.95,
    patience: int = 20,
    weight: float = 0.9999,
    field_t: float = 1e-4,
) -> Filter:
    """The filter of `marg.model_of`.

    Args:
        gate: share of right magnetometer readings that pass; None believes every reading, and is
            for a model without a magnetometer too.
        patience: readings refused in a row before a field that stays is taken up.
        weight: share of travel that keeps its weight (`rules.huber`).
        field_t: T, spread of strength and vertical component of a new field.
    """
    chain = [
        rules.only(TRAVEL, rules.huber(weight)),
        rules.only(REST_RATE, rules.gate(0.9999, 100)),
    ]
    if gate is not None:
        chain.append(undisturbed(gate, patience, field_t))
    return kalman(rules=chain)


def filter_of(parameters: Replay) -> Filter:
    """The filter, with its rules."""
    m = parameters.magnetometer
    return marg_filter(
        gate=m.gate if parameters.use_magnetometer == "undisturbed" else None,
        patience=max(1, round(m.patience / parameters.travel.every)),
        weight=parameters.travel.weight,
        field_t=m.most,
    )
