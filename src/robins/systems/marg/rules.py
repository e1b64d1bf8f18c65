"""The rules of the filter: which measurements are believed, and how a new field is taken up."""

from __future__ import annotations

import math
from functools import lru_cache

import jax.numpy as jnp

from robins import linalg
from robins.filters import Belief, Filter, kalman, rules
from robins.filters.observation import Observation
from robins.filters.rule import Rule
from robins.filters.trees import select
from robins.systems.marg.model import DECLINATION, FIELD, HEADING, MAGNETOMETER, REST_RATE, TRAVEL


def doubted(prior: Belief, declination: float, field_t: float) -> Belief:
    """Belief that has forgotten heading, declination and field, and keeps all else."""
    forgotten = jnp.zeros(prior.factor.shape[0])
    forgotten = forgotten.at[HEADING].set(math.pi).at[DECLINATION].set(declination)
    forgotten = forgotten.at[FIELD].set(field_t)
    S = jnp.where(forgotten[:, None] > 0.0, 0.0, prior.factor)
    mean = prior.mean._replace(declination=jnp.zeros_like(prior.mean.declination))
    return Belief(mean, linalg.tria(S, jnp.diag(forgotten)))


def undisturbed(probability: float, patience: int, declination: float, field_t: float) -> Rule:
    """Refuse a magnetic field that is not the one known, until it has proved to be the field.

    A chi-square gate on azimuth, strength and vertical component together. Refusals that agree with
    each other while the unit moves, ``patience`` in a row, are the field of a new place, or the
    first was disturbed: heading, declination and field are then forgotten and taken from it. What
    sits on the unit turns with it and does not agree.

    Args:
        probability: share of right measurements that pass.
        patience: refusals in a row.
        declination: rad, spread of the declination after forgetting.
        field_t: T, spread of strength and vertical component after forgetting.
    """
    inner = rules.gate(probability, patience, "reinitialise")

    def before(memory, prior: Belief, o: Observation):
        memory, reopened, o = inner.before(memory, prior, o)
        new = memory[o.sensor].recovered
        return memory, select(new, doubted(prior, declination, field_t), Belief(*reopened)), o

    return rules.only(MAGNETOMETER, inner._replace(before=before, name="undisturbed"))


@lru_cache(maxsize=16)
def marg_filter(
    gate: float | None = 0.99,
    patience: int = 20,
    weight: float = 0.9999,
    declination: float = 0.1,
    field_t: float = 1e-4,
) -> Filter:
    """The filter of `marg_model`; the same object for the same arguments, so compiled once.

    Args:
        gate: share of right magnetometer readings that pass; None believes every reading, and is
            for a model without a magnetometer too.
        patience: readings refused in a row before a field that stays is taken up.
        weight: share of travel that keeps its weight (`rules.huber`).
        declination: rad, spread of the declination in a new field.
        field_t: T, spread of strength and vertical component of a new field.
    """
    chain = [
        rules.only(TRAVEL, rules.huber(weight)),
        rules.only(REST_RATE, rules.gate(0.9999, 100, "inflate")),
    ]
    if gate is not None:
        chain.append(undisturbed(gate, patience, declination, field_t))
    return kalman(rules=chain)
