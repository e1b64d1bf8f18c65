"""A rule: one published adaptation of the Kalman filter, as pure hooks.

Rules know nothing of how the model was linearised, and keep what they remember in the filter's
state, so that a run stays one scan, a batch one `vmap`, and streaming use the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from jaxtyping import ArrayLike

from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.values import kind, value

Memory = Any  # a pytree of arrays; its shapes may not change from step to step
Again = Callable[["Rule"], Memory]  # the same run with another rule, to its end


class Rule:
    """One adaptation; every hook in compiled code is pure, and by default the identity.

    Attributes:
        init: ``(belief, dims) -> memory``; dims maps each sensor's name to its dimension, in the
            order in which the model updates them.
        process: ``(memory, transition) -> (memory, transition)``, after the model was linearised
            and before the covariance is formed: adapt ``noise``, remember ``spread``.
        before: ``(memory, prior, observation) -> (memory, prior, observation)``: fade the prior,
            refuse components (``accepted``), scale ``noise``, say so (`Observation.noted`). A rule
            that hands back *another* prior has the measurement linearised about it again, keeping
            noise, refusals and notes; one that does not touch the prior must hand back the same
            object.
        after: ``(memory, posterior, info, observation) -> (memory, posterior, info)``: inflate,
            project, learn from the innovation; may add to ``info.notes``. The observation is the
            one the update used.
        name: prefix of its notes.
        settle: ``(memory, belief) -> (memory, belief, code)``, once a step, when all its
            measurements are in and the state is about to be predicted: inflate what the whole step
            left. A code other than ``DONE`` says that the step cannot be taken: the belief then
            stays, the memory of this hook is kept.

    Rules are values (`robins.filters.values`): a class with `value` before it, whose numbers are
    fields and whose hooks are methods.
    """

    name = "rule"

    def __new__(cls, *args: Any, **kw: Any) -> Any:
        """``Rule(before=f)`` is a rule of functions."""
        return object.__new__(Hooks if cls is Rule else cls)

    def init(self, belief: Belief, dims: Mapping[str, int], /) -> Memory:
        return ()

    def process(self, memory: Memory, transition: Transition, /) -> tuple[Memory, Transition]:
        return memory, transition

    def before(
        self, memory: Memory, prior: Belief, o: Observation, /
    ) -> tuple[Memory, Belief, Observation]:
        return memory, prior, o

    def after(
        self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation, /
    ) -> tuple[Memory, Belief, StepInfo]:
        return memory, posterior, info

    def settle(self, memory: Memory, belief: Belief, /) -> tuple[Memory, Belief, Any]:
        return memory, belief, int(Code.DONE)

    @property
    def settles(self) -> bool:
        """True if it does anything once a step."""
        return type(self).settle is not Rule.settle

    @property
    def reports(self) -> bool:
        """True if there can be something to report."""
        return type(self).report is not Rule.report

    def report(
        self, start: Memory, final: Memory, again: Again | None, time: ArrayLike | None
    ) -> None:
        """Raise what it has to report of a run, which compiled code cannot.

        Args:
            start: memory that the run began with.
            final: the one that it ended with.
            again: runs with another rule in the place of this one to another `final`; None where
                samples came one by one.
            time: (T,) seconds of the steps.
        """


_ANY: Any = None  # the hooks of `Rule` look at nothing of theirs
_SETTLE = partial(Rule.settle, _ANY)


@value
class Hooks(Rule):
    """A rule of functions of a user, each equal to itself only."""

    init: Any = kind(default=partial(Rule.init, _ANY))
    process: Any = kind(default=partial(Rule.process, _ANY))
    before: Any = kind(default=partial(Rule.before, _ANY))
    after: Any = kind(default=partial(Rule.after, _ANY))
    name: str = kind(default="rule")
    settle: Any = kind(default=_SETTLE)

    @property
    def settles(self) -> bool:
        return self.settle is not _SETTLE
