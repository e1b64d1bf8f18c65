"""Restriction of a rule to some sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from jaxtyping import ArrayLike

from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import sensor_names
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Again, Memory, Rule
from robins.filters.values import kind, value


@value
class Only(Rule):
    """Rule of `only`."""

    inner: Rule
    names: tuple[str, ...] = kind()

    @property
    def name(self) -> str:
        return self.inner.name

    @property
    def reports(self) -> bool:
        return self.inner.reports

    @property
    def settles(self) -> bool:
        return self.inner.settles

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        own = {name: m for name, m in dims.items() if name in self.names}
        if not own:
            raise ValueError(
                f"only: the rule '{self.name}' is for {list(self.names)}, "
                f"this filter has {list(dims)}"
            )
        return self.inner.init(belief, own)

    def process(self, memory: Memory, transition: Transition):
        return self.inner.process(memory, transition)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        own = o.sensor in self.names
        return self.inner.before(memory, prior, o) if own else (memory, prior, o)

    def after(self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        own = o.sensor in self.names
        return self.inner.after(memory, posterior, info, o) if own else (memory, posterior, info)

    def settle(self, memory: Memory, belief: Belief):
        return self.inner.settle(memory, belief)

    def report(
        self, start: Memory, final: Memory, again: Again | None, time: ArrayLike | None
    ) -> None:
        repeat = None if again is None else lambda inner: again(replace(self, inner=inner))
        self.inner.report(start, final, repeat, time)


def only(sensors: str | Sequence[str], rule: Rule) -> Rule:
    """Rule that acts on measurements of the named sensors only.

    `before` and `after` are called for these sensors alone, and `init` gets only their dimensions;
    `process` and `settle` are called as usual.

    Args:
        sensors: a name, or several; those that a filter does not have are ignored, so that one rule
            can serve several local filters.
        rule: any other rule.

    Raises:
        ValueError: no sensor is named; at `init`, the filter has none of them.
    """
    return Only(rule, sensor_names(f"only, for the rule '{rule.name}'", sensors))
