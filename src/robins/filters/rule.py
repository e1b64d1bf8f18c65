"""A rule: one published adaptation of the Kalman filter, as pure hooks.

Rules are independent of the linearisation, and keep their memory in the filter's state, so that a
run stays one scan, a batch one `vmap`, and streaming uses the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from jaxtyping import Array, ArrayLike

from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.values import kind, value

Memory = Any  # a pytree of arrays; its shapes may not change from step to step
Again = Callable[["Rule"], Memory]  # memory at the end of the same run with another rule


class Rule:
    """Base class of rules; every hook in compiled code is pure, and by default the identity.

    Attributes:
        init: ``(belief, dims) -> memory``; dims maps each sensor's name to its dimension, in the
            order in which the model updates them.
        process: ``(memory, transition) -> (memory, transition)``, after the model was linearised
            and before the covariance is formed: adapt ``noise``, remember ``spread``.
        before: ``(memory, prior, observation) -> (memory, prior, observation)``: fade the prior,
            refuse components (``accepted``), scale ``noise``, note it (`Observation.noted`). For
            *another* prior the measurement is linearised again, keeping noise, refusals and notes;
            a rule that does not change the prior must return the same object.
        after: ``(memory, posterior, info, observation) -> (memory, posterior, info)``: inflate,
            project, learn from the innovation; may add to ``info.notes``. The observation is the
            one the update used.
        name: prefix of its notes.
        settle: ``(memory, belief) -> (memory, belief, code)``, once a step, after all its
            measurements and before the prediction: inflate. With a code other than ``DONE`` the
            step is not taken: the belief stays, the memory of this hook is kept.

    Rules are values (`robins.filters.values`): a class with `value` before it, whose numbers are
    fields and whose hooks are methods.
    """

    name = "rule"

    def __new__(cls, *args: Any, **kw: Any) -> Any:
        """Make ``Rule(before=f)`` a rule of functions (`Hooks`)."""
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

    def settle(self, memory: Memory, belief: Belief, /) -> tuple[Memory, Belief, Array | int]:
        return memory, belief, int(Code.DONE)

    @property
    def settles(self) -> bool:
        """True if the rule has the hook `settle`."""
        return type(self).settle is not Rule.settle

    @property
    def reports(self) -> bool:
        """True if the rule has the hook `report`."""
        return type(self).report is not Rule.report

    def report(
        self, start: Memory, final: Memory, again: Again | None, time: ArrayLike | None
    ) -> None:
        """Raise the errors found in a run; compiled code cannot raise them itself.

        Args:
            start: memory at the start of the run.
            final: memory at its end.
            again: ``rule -> final memory`` of the same run with another rule in place of this one;
                None in a stream.
            time: (T,) times of the steps [s].
        """


_ANY: Any = None  # the hooks of `Rule` do not use self
_SETTLE = partial(Rule.settle, _ANY)


@value
class Hooks(Rule):
    """Rule made of a user's functions, which are compared by identity."""

    init: Callable[..., Memory] = kind(default=partial(Rule.init, _ANY))
    process: Callable[..., tuple[Memory, Transition]] = kind(default=partial(Rule.process, _ANY))
    before: Callable[..., tuple[Memory, Belief, Observation]] = kind(
        default=partial(Rule.before, _ANY)
    )
    after: Callable[..., tuple[Memory, Belief, StepInfo]] = kind(default=partial(Rule.after, _ANY))
    name: str = kind(default="rule")
    settle: Callable[..., tuple[Memory, Belief, Array | int]] = kind(default=_SETTLE)

    @property
    def settles(self) -> bool:
        return self.settle is not _SETTLE
