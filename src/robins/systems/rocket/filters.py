"""The filters that are compared, by study, and what each is made of.

The paper's filter is "federated-vector-stukf": two local unscented filters, for gyro and
magnetometer, each with strong tracking in its simplified (lumped) form; shares by the observability
of each state; information shared as A^-1/2 P A^-1/2 ("half"), with a reset at every step. It is no
upper bound (`robins.filters.federated`), hence the warning that is silenced here: the study is
about it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from robins.errors import require_known
from robins.filters import Filter, Rule, channel, federated, kalman, taylor, unscented
from robins.filters.composite.fusion import Sharing
from robins.filters.rules import discriminator, gate, huber, only, strong_tracking
from robins.systems.rocket.angles import GYRO, MAGNETIC
from robins.systems.rocket.field import FIELD, SNAPSHOT
from robins.systems.rocket.parameters import ANGLE_FILTERS, FIELD_FILTERS

PROBABILITY = 0.999  # of the chi-square tests
PATIENCE = 30  # samples: 3 s, longer than a burst, shorter than a loss of track to be borne

Shares = tuple[tuple[float, ...], ...]  # of the two local filters, one for each state

ANGLES_SEEN, RATES_SEEN = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)


class Sight(NamedTuple):
    """What a filter of "magnetic-attitude" must know of its sensors."""

    shares: Shares = ((0.5,) * 6,) * 2  # of gyro and magnetometer, for those that share by state
    gyro_reads: Literal["rate", "attitude"] = "rate"


def ukf(*rules: Rule) -> Filter:
    """Unscented filter with the sigma points of the study."""
    return kalman(unscented(alpha=0.5, beta=2.0, kappa=0.0), rules)


def simplified(beta: float = 1.0) -> Rule:
    """Strong tracking as the paper prints it."""
    return strong_tracking(0.95, beta, "lumped", "classic", limit=1e3)


def telling(sensor: str, sight: Sight) -> Rule:
    """Outliers told from model errors; faded are the states that the sensor reads."""
    rates = sensor == GYRO and sight.gyro_reads == "rate"
    seen = RATES_SEEN if rates else ANGLES_SEEN
    rule = discriminator(PATIENCE, PROBABILITY, 0.98, "multiple", weights=seen)
    return only((sensor,), rule)


def telling_projected(robust: Literal["huber", "gate"]) -> Rule:
    """The same for one vector, that sees none of the states whole."""
    return discriminator(PATIENCE, PROBABILITY, 0.98, "projected", robust)


def patient() -> Rule:
    """A gate that gives in when it has refused for too long, and says so."""
    return gate(PROBABILITY, PATIENCE, "inflate")


def _two(
    sharing: Sharing, shares: str | Shares, rules: Callable[[str], Sequence[Rule]] = lambda name: ()
) -> Filter:
    """A local filter for the gyro, one for the magnetometer; reset at every step."""
    channels = [channel((name,), ukf(*rules(name))) for name in (GYRO, MAGNETIC)]
    given = shares if isinstance(shares, str) else np.asarray(shares)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "sharing='half'", UserWarning)
        return federated(
            channels,
            "fusion-reset",
            sharing,
            given,
            linearise=unscented(alpha=0.5, beta=2.0, kappa=0.0),
        )


class Kind(NamedTuple):
    """A filter of the study "magnetic-attitude"."""

    make: Callable[[Sight], Filter]
    sensors: tuple[str, ...] = (GYRO, MAGNETIC)
    motion: str = "body"  # or "reckoned" by the gyro, or "unmoved"


def _one(*rules: Rule) -> Callable[[Sight], Filter]:
    return lambda sight: ukf(*rules)


KINDS: dict[str, Kind] = {
    "gyro": Kind(lambda sight: kalman(taylor()), (), "reckoned"),
    "magnetic-raw": Kind(lambda sight: kalman(taylor()), (MAGNETIC,), "unmoved"),
    "magnetometer": Kind(_one(), (MAGNETIC,)),
    "gyro-ukf": Kind(_one(), (GYRO,)),
    "ukf": Kind(_one()),
    "federated-scalar-ukf": Kind(lambda sight: _two("scalar", "equal")),
    "federated-vector-ukf": Kind(lambda sight: _two("half", sight.shares)),
    "federated-root": Kind(lambda sight: _two("root", sight.shares)),
    "stukf": Kind(_one(simplified())),
    "federated-scalar-stukf": Kind(
        lambda sight: _two("scalar", "equal", lambda name: [simplified()])
    ),
    "federated-vector-stukf": Kind(
        lambda sight: _two("half", sight.shares, lambda name: [simplified()])
    ),
    "federated-vector-multiple": Kind(
        lambda sight: _two(
            "half",
            sight.shares,
            lambda name: [strong_tracking(0.95, 1.0, "multiple", "classic", limit=1e3)],
        )
    ),
    "federated-vector-weakened": Kind(
        lambda sight: _two("half", sight.shares, lambda name: [simplified(beta=4.0)])
    ),
    "huber": Kind(_one(huber(PROBABILITY))),
    "gate": Kind(_one(patient())),
    "discriminator": Kind(lambda sight: ukf(telling(GYRO, sight), telling(MAGNETIC, sight))),
    "federated-root-discriminator": Kind(
        lambda sight: _two("root", sight.shares, lambda name: [telling(name, sight)])
    ),
}


class FieldKind(NamedTuple):
    """A filter of the study "field-vector"."""

    make: Callable[[], Filter]
    sees: str = FIELD  # or SNAPSHOT, the field taken at its word; or ""
    scaled: bool = False  # scale factors of the gyro are states


FIELD_KINDS: dict[str, FieldKind] = {
    "gyro": FieldKind(lambda: kalman(taylor()), ""),
    "magnetometer": FieldKind(lambda: kalman(taylor()), SNAPSHOT),
    "usque": FieldKind(ukf),
    "huber": FieldKind(lambda: ukf(huber(PROBABILITY))),
    "gate": FieldKind(lambda: ukf(patient())),
    "discriminator": FieldKind(lambda: ukf(telling_projected("huber"))),
    "discriminator-gate": FieldKind(lambda: ukf(telling_projected("gate"))),
    "strong-tracking": FieldKind(lambda: ukf(simplified())),
    "strong-tracking-projected": FieldKind(
        lambda: ukf(strong_tracking(0.95, 1.0, "projected", "classic", limit=1e3))
    ),
    "gate-scale-factor": FieldKind(lambda: ukf(patient()), scaled=True),
    "usque-scale-factor": FieldKind(ukf, scaled=True),
}

BY_STATE = tuple(name for name in KINDS if name.startswith(("federated-vector", "federated-root")))
"""Filters that share information by the observability of each state."""

assert set(KINDS) == set(ANGLE_FILTERS)
assert set(FIELD_KINDS) == set(FIELD_FILTERS)


@cache
def make_filter(name: str, sight: Sight) -> Filter:
    """A filter of "magnetic-attitude"; the same object each time, so that it compiles once.

    Raises:
        ValueError: there is no filter of this name.
    """
    require_known("filter", name, KINDS)
    return KINDS[name].make(sight)


@cache
def make_field_filter(name: str) -> Filter:
    """A filter of "field-vector"; the same object each time, so that it compiles once.

    Raises:
        ValueError: there is no filter of this name.
    """
    require_known("filter", name, FIELD_KINDS)
    return FIELD_KINDS[name].make()
