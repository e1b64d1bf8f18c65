"""Filters by name, their assumptions, and the case that each makes of a world."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from robins.errors import require_known
from robins.filters import kalman, rules
from robins.filters.rule import Rule
from robins.filters.values import Numbers
from robins.systems.gnss.model import (
    RANGES,
    GnssModelKind,
    GnssState,
    LocalFrame,
    MotionStep,
    gnss_model,
    start_belief,
)
from robins.systems.gnss.parameters import GnssAssumptions, RobustWeights
from robins.systems.gnss.weights import by_component, huber_weight, student_weight, switch_weight
from robins.systems.study import Case, Contender, Recipe

KINDS = {
    "ls": GnssModelKind(memory=False),
    "ekf": GnssModelKind(),
    "huber": GnssModelKind(),
    "student-t": GnssModelKind(),
    "switchable": GnssModelKind(),
    "delays": GnssModelKind(delays=True),
}
"""Model of the pseudoranges of each filter; "delays" is the default of a replay."""

SMOOTHERS = {f"{name}+rts": name for name, kind in KINDS.items() if kind.memory}
"""Smoothers of recorded logs: name -> name of the filter whose run it smooths."""

NAMES = (*KINDS, *SMOOTHERS)


class GnssWorld(NamedTuple):
    """Inputs of a filter for a drive; leading axis E, except for the fix."""

    fix: Any  # (4 + K,) `first_fix` at the first epoch
    u: MotionStep
    y: Any  # measurements by sensor
    sky: Any  # `Sky`
    truth: GnssState | None = None


def robust_rules(name: str, weights: RobustWeights) -> tuple[Rule, ...]:
    """Robust weighting rules of a filter; none for "ls", "ekf" and other names."""
    chosen = {
        "huber": huber_weight(weights.huber),
        "student-t": student_weight(weights.dof),
        "switchable": switch_weight(weights.switch),
        "delays": student_weight(weights.dof),
    }
    if name not in chosen:
        return ()
    return (rules.only(RANGES, by_component(chosen[name], name.replace("-", "_"))),)


def _case(
    kind: GnssModelKind,
    believed: GnssAssumptions,
    numbers: tuple[LocalFrame, Numbers],
    world: GnssWorld,
) -> Case:
    place, member = numbers
    systems = np.shape(member)[1]
    first = MotionStep(*(a[0] for a in world.u))
    start = start_belief(believed, kind, world.fix, place, systems, first)
    truth = world.truth
    if truth is not None and not kind.delays:
        truth = truth._replace(delay=truth.delay[:, :0])
    return Case(start, world.u, world.y, {RANGES: world.sky}, truth)


def contender(
    believed: GnssAssumptions, place: LocalFrame, member: np.ndarray, name: str
) -> Contender:
    """A filter with its model.

    Args:
        believed: assumptions on clock, wheels, delays and weights.
        place: origin of the state.
        member: (N, K) as in `gnss_model`.
        name: of the filter.

    Raises:
        ValueError: there is no filter of this name, or it is a smoother.
    """
    if name in SMOOTHERS:
        raise ValueError(f"{name}: campaigns compare causal filters; `robins replay` smooths a log")
    require_known("filter", name, KINDS, "this system, where all but ls may end in +rts")
    kind = KINDS[name]
    n = 8 + member.shape[1] + len(member) * kind.delays
    return Contender(
        kalman(rules=robust_rules(name, believed.weights)),
        gnss_model(believed, kind, place, member),
        Recipe(_case, (kind, believed), (place, np.asarray(member, float))),
        reported=np.eye(3, n),
    )
