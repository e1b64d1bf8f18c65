"""The filters that are compared, and what each is made of.

The paper's filters have two local ones, for radar with barometer and for stars, fused by its (51);
the locals go on from their own means and covariances (`distributed`). What it does not state is
chosen as the specification does: AEKF adapts R (Sage-Husa), RAUKF has IGG-III weights and an
innovation fading factor. The constrained filters differ in what they take for the constraint, how
firmly they believe it, and where it comes in.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from robins.errors import require_known
from robins.filters import (
    Filter,
    Rule,
    at_master,
    channel,
    distributed,
    federated,
    guarded,
    intersecting,
    kalman,
    taylor,
    unscented,
)
from robins.filters.composite.distributed import Feedback
from robins.filters.rules import (
    gate,
    huber,
    igg3,
    innovation_fading,
    only,
    projection,
    sage_husa,
)
from robins.systems.airship.error_form import feedback
from robins.systems.airship.model import (
    SAR,
    STAR,
    STAR_EARLY,
    WIND,
    WIND_OF_STAR,
)

States = Literal["nine", "errors", "wind", "product"]
Given = Literal["measured", "exact", "constant", "sideslip"]  # of air data and wind
Firm = Literal["exact", "white", "noise"]  # how firmly the constraint is believed

FLOOR = 1e-3  # m/s, of a constraint taken for exact: (51) needs covariances that have an inverse
COMMON = 9  # states that all local filters have

# The metric W = I of the paper, whose D has columns of velocity alone. Those of attitude weigh 10
# m/s a radian: under a plain I they would take nearly all of the correction (244 m).
LEVEL = np.diag([1e12] * 3 + [1.0] * 6)

SENSORS_1, SENSORS_2 = (SAR,), (STAR,)
CONSTRAINED_1, CONSTRAINED_2 = (SAR, WIND), (STAR, WIND_OF_STAR)


class Kind(NamedTuple):
    """A filter of the study."""

    make: Callable[[], Filter]
    sensors: tuple[str, ...]
    states: States = "nine"
    given: Given = "measured"
    firm: Firm = "exact"
    printed: Literal["", "rows", "constraint"] = ""  # taken from the paper as it stands


def ukf(*rules: Rule) -> Filter:
    """The paper's sigma points, with a spread that rounding does not swamp (its alpha is 1e-4)."""
    return kalman(unscented(alpha=1.0, beta=2.0, kappa=0.0), rules)


def robust() -> Filter:
    """A local filter of RAUKF: equivalent weights, then fading by what they leave.

    Judged are radar and stars, not the wind, whose errors have states. The stars show no position,
    which the fading of their filter would blow up without end.
    """
    weights = igg3(1.5, 4.0, 1e-4, patience=None)
    fading = innovation_fading(10, 5.0, reach=1e3)
    return ukf(only((SAR, STAR), weights), only((SAR, STAR), fading))


def _two(
    local: Callable[[], Filter],
    first: tuple[str, ...] = SENSORS_1,
    second: tuple[str, ...] = SENSORS_2,
    feedback: Feedback = "own",
    common: int | None = None,
) -> Filter:
    """Two local filters of one kind."""
    channels = [channel(first, local()), channel(second, local())]
    return distributed(channels, feedback, common=common)


def _constrained(*rules: Rule) -> Filter:
    """The constraint in both local filters."""
    return _two(lambda: ukf(*rules), CONSTRAINED_1, CONSTRAINED_2)


def _gated(constrained: Filter, assumption: tuple[str, ...]) -> Filter:
    """The constraint as long as the filter without it does not speak against it.

    Level velocity and position are judged. The ratio is higher than its default because the filter
    without, fused by (51), is overconfident (NEES of velocity 1.95 a state).
    """
    groups = ((3, 4), (6, 7))
    return guarded(constrained, _two(ukf), assumption, judges=SAR, groups=groups, ratio=3.0)


def _product() -> Filter:
    patient = gate(0.9999, 5, "inflate")
    return kalman(taylor(), [only((SAR,), huber(0.999)), only((WIND,), patient)])


BOTH = (*CONSTRAINED_1, *CONSTRAINED_2)
PLAIN = (*SENSORS_1, *SENSORS_2)
FIRST = (*CONSTRAINED_1, *SENSORS_2)

KINDS: dict[str, Kind] = {
    "ekf": Kind(lambda: _two(lambda: kalman(taylor())), PLAIN),
    "aekf": Kind(lambda: _two(lambda: kalman(taylor(), [sage_husa(0.98)])), PLAIN),
    "ukf": Kind(lambda: _two(ukf), PLAIN),
    "raukf": Kind(lambda: _two(robust), PLAIN),
    "cukf-hard": Kind(_constrained, BOTH),
    "cukf-soft": Kind(lambda: _two(ukf, CONSTRAINED_1), FIRST, firm="white"),
    "cukf-wind-states": Kind(
        lambda: _two(ukf, CONSTRAINED_1, common=COMMON), FIRST, "wind", firm="noise"
    ),
    "cukf-robust": Kind(
        lambda: _two(robust, CONSTRAINED_1, common=COMMON),
        FIRST,
        "wind",
        firm="noise",
    ),
    "cukf-exact": Kind(_constrained, BOTH, given="exact"),
    "cukf-printed": Kind(
        lambda: _two(lambda: kalman(taylor()), CONSTRAINED_1, CONSTRAINED_2),
        BOTH,
        printed="constraint",
    ),
    "cukf-master": Kind(lambda: at_master(_two(ukf), (WIND,)), FIRST, firm="white"),
    "cukf-identity": Kind(lambda: _constrained(projection((WIND, WIND_OF_STAR), LEVEL)), BOTH),
    "cukf-unprojected": Kind(
        lambda: _constrained(projection((WIND, WIND_OF_STAR), project_covariance=False)), BOTH
    ),
    "cukf-wind-known": Kind(_constrained, BOTH, given="constant"),
    "cukf-sideslip": Kind(_constrained, BOTH, given="sideslip"),
    "cukf-hard-gated": Kind(lambda: _gated(_constrained(), (WIND, WIND_OF_STAR)), BOTH),
    "cukf-soft-gated": Kind(lambda: _gated(_two(ukf, CONSTRAINED_1), (WIND,)), FIRST, firm="white"),
    "cukf-wind-known-gated": Kind(
        lambda: _gated(_constrained(), (WIND, WIND_OF_STAR)), BOTH, given="constant"
    ),
    "cukf-sideslip-gated": Kind(
        lambda: _gated(_constrained(), (WIND, WIND_OF_STAR)), BOTH, given="sideslip"
    ),
    "ukf-printed-h": Kind(lambda: _two(lambda: kalman(taylor())), PLAIN, printed="rows"),
    "centralised": Kind(ukf, PLAIN),
    "centralised-errors": Kind(lambda: ukf(feedback()), PLAIN, "errors"),
    "federated": Kind(
        lambda: federated(
            [channel(SENSORS_1, ukf()), channel(SENSORS_2, ukf())],
            linearise=unscented(alpha=1.0, beta=2.0, kappa=0.0),
        ),
        PLAIN,
    ),
    "intersection": Kind(
        lambda: intersecting([channel(SENSORS_1, ukf()), channel(SENSORS_2, ukf())], "det"), PLAIN
    ),
    "distributed-mean": Kind(lambda: _two(ukf, feedback="mean"), PLAIN),
    "distributed-full": Kind(lambda: _two(ukf, feedback="full"), PLAIN),
    "product": Kind(_product, (STAR_EARLY, *FIRST), "product", firm="noise"),
}


@cache
def make_filter(name: str) -> Filter:
    """The filter of a name; the same object each time, so that what was compiled serves again.

    Raises:
        ValueError: there is no filter of this name.
    """
    require_known("filter", name, KINDS)
    return KINDS[name].make()
