"""A rule: one published adaptation of the Kalman filter, as pure hooks.

Rules know nothing of how the model was linearised, and keep what they remember in the filter's
state, so that a run stays one scan, a batch one `vmap`, and streaming use the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.linearise import Transition
from robins.filters.observation import Observation

Memory = Any  # a pytree of arrays; its shapes may not change from step to step


def _no_memory(belief: Belief, dims: Mapping[str, int]) -> Memory:
    return ()


def _keep_transition(memory: Memory, transition: Transition) -> tuple[Memory, Transition]:
    return memory, transition


def _keep_prior(
    memory: Memory, prior: Belief, observation: Observation
) -> tuple[Memory, Belief, Observation]:
    return memory, prior, observation


def _keep_posterior(
    memory: Memory, posterior: Belief, info: StepInfo, observation: Observation
) -> tuple[Memory, Belief, StepInfo]:
    return memory, posterior, info


def keep_belief(memory: Memory, belief: Belief) -> tuple[Memory, Belief, int]:
    """The default of `Rule.settle`."""
    return memory, belief, int(Code.DONE)


class Rule(NamedTuple):
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

    A memory that has something to report of a run has a method `audit`: see `robins.filters.audit`.
    """

    init: Callable[[Belief, Mapping[str, int]], Memory] = _no_memory
    process: Callable[[Memory, Transition], tuple[Memory, Transition]] = _keep_transition
    before: Callable[[Memory, Belief, Observation], tuple[Memory, Belief, Observation]] = (
        _keep_prior
    )
    after: Callable[[Memory, Belief, StepInfo, Observation], tuple[Memory, Belief, StepInfo]] = (
        _keep_posterior
    )
    name: str = "rule"
    settle: Callable[[Memory, Belief], tuple[Memory, Belief, Any]] = keep_belief
