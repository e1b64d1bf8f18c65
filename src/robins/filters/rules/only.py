"""Restrict a rule to some sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import sensor_names
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule


def only(sensors: str | Sequence[str], rule: Rule) -> Rule:
    """A rule that acts on measurements of the named sensors only.

    Its `before` and `after` are called for these alone, and it begins with their dimensions alone.
    Its hooks of a step (`process`, `settle`) are called as usual. Other sensors carry no notes of
    it.

    Args:
        sensors: a name, or several; those that a filter does not have are left out, so that one
            rule can serve several local filters.
        rule: any other.

    Raises:
        ValueError: no sensor is named; by `init`, the filter has none of them.
    """
    names = sensor_names(f"only, for the rule '{rule.name}'", sensors)

    def init(belief: Belief, dims: Mapping[str, int]) -> Memory:
        seen = {name: m for name, m in dims.items() if name in names}
        if not seen:
            raise ValueError(
                f"only: the rule '{rule.name}' is for {list(names)}, this filter has {list(dims)}"
            )
        return rule.init(belief, seen)

    def before(memory: Memory, prior: Belief, o: Observation):
        return rule.before(memory, prior, o) if o.sensor in names else (memory, prior, o)

    def after(memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        known = o.sensor in names
        return rule.after(memory, posterior, info, o) if known else (memory, posterior, info)

    return rule._replace(init=init, before=before, after=after)
