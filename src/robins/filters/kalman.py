"""The Kalman filter: predict and update atoms, and the filter that applies rules around them.

The atoms do not depend on time, sensor names or rules. Both come in two forms with the same inputs
and outputs: *square root*, one QR of a block matrix, no covariance ever formed (Kaminski, Bryson &
Schmidt 1971); and *Joseph*, covariances summed and factored again, faster and accurate up to
condition numbers of about 1e12.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins import linalg, manifold
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.checks import one_of
from robins.filters.linearise import Linearisation, Transition, taylor
from robins.filters.model import Data, Motion, Sensor
from robins.filters.observation import Observation, contradicted, left_out, whiten
from robins.filters.rule import Memory, Rule
from robins.filters.trees import finite, select
from robins.filters.values import kind, value

Form = Literal["sqrt", "joseph"]
# Fields of an observation that rules change; the others are recomputed from the prior.
_OF_RULES = ("noise", "unweighed", "accepted", "notes")


class FilterState(NamedTuple):
    """Everything that a filter carries from step to step."""

    belief: Belief
    memory: Any  # a tuple with one entry per rule; other filters define their own
    points: Any = ()  # sigma points kept from a prediction for its update
    current: Any = np.True_  # () bool: the last prediction was taken, so the belief is current


class Prediction(NamedTuple):
    """Record of a predict step for a smoother and a log."""

    transition: Transition | None  # None where there is no single one, as in a mixture
    belief: Belief  # predicted
    code: Array  # a `Code`
    origin: Belief | None = None  # belief before the step, after `settle` hooks, if there are any


WRONG = "imm.wrong"  # note of a bank: (names,) probability that each of `Filter.suspects` is wrong

Advanced = tuple[FilterState, Prediction]  # result of `predict`
Updated = tuple[FilterState, StepInfo]  # result of `update`
Follow = Callable[[Sequence[Belief], Belief], FilterState]
Again = Callable[["Filter"], FilterState]  # the same run with another filter, to its end


class Filter:
    """Base class of filters, stepped by a run, a campaign, a bench or your own loop.

    A filter of your own is a `robins.filters.values.value` with the methods below. Users call
    `predict` and `update`, which call `_predict` and `_update`.
    """

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        """Initial state; dims maps sensor names to dimensions (`Model.dims`)."""
        raise NotImplementedError(f"{type(self).__name__} must have `init`")

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        raise NotImplementedError(f"{type(self).__name__} must have `_predict`")

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        raise NotImplementedError(f"{type(self).__name__} must have `_update`")

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        """Continue from another belief, keeping the memories of rules, such as a learnt noise.

        Used on filters inside a federated filter or a mixture.
        """
        raise NotImplementedError(f"{type(self).__name__} must have `reset`")

    def members(self, state: FilterState) -> tuple[tuple[Belief, ...], Follow]:
        """Beliefs of the local filters of a joined filter, and a function that replaces them.

        The only access of a filter to the parts of another one.

        Returns:
            The beliefs, none by default, and ``follow(beliefs, belief) -> state``: the state with
            the local filters reset to beliefs, and the whole to their fusion.
        """
        return (), lambda beliefs, belief: state

    @property
    def suspects(self) -> tuple[str, ...]:
        """Names of the instruments, or "motion", that the filter tests for faults; by default none.

        Its updates note the fault probability of each as ``imm.wrong``, in this order.
        """
        return ()

    def suspicions(self, state: FilterState) -> Array:
        """(names,) fault probability of each of the `suspects`."""
        return jnp.zeros(0)

    @property
    def reports(self) -> bool:
        """True if `report` can raise; a stream checks this once."""
        return type(self).report is not Filter.report

    def report(
        self, start: FilterState, final: FilterState, again: Again | None, time: ArrayLike | None
    ) -> None:
        """Raise the errors that rules found in a run; compiled code cannot raise them itself.

        Args:
            start: state at the start of the run.
            final: state at its end.
            again: ``filter -> final state`` of the same run with another filter; None in a stream.
            time: (T,) times of the steps [s].

        Raises:
            Exception: error of a rule.
        """

    @jax.jit
    def predict(self, state: FilterState, motion: Motion, u: Data = None) -> Advanced:
        """Predict over one step; the state remembers whether the prediction was taken."""
        state, prediction = self._predict(state, motion, u)
        # strongly typed: with a weak type a stream would compile again after the first step
        current = (prediction.code == int(Code.DONE)).astype(bool)
        return state._replace(current=current), prediction

    @jax.jit
    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data = None) -> Updated:
        """Update with a measurement, which is ignored after a prediction that was not taken.

        The belief is then older than the measurement, and fusing it would omit the motion and its
        noise. Updates resume after the next prediction that is taken, or a `reset`.
        """
        new, info = self._update(state, sensor, y, aux)
        ok = state.current | (info.code == int(Code.MISSING))
        new = select(state.current, new, state)
        return new, invalidated_unless(ok, info, jnp.asarray(int(Code.NOT_PREDICTED)))


class Composite(Filter):
    """Filter made of filters; `report` asks each of them separately.

    Attributes:
        held: names of the fields that are filters.
        filters: the filters it is made of.
        with_filters: ``filters -> Filter``, the same composite of other filters.
        parts: ``state -> states`` of these filters.
    """

    held: ClassVar[tuple[str, ...]]

    @property
    def filters(self) -> tuple[Filter, ...]:
        return tuple(getattr(self, name) for name in self.held)

    def with_filters(self, filters: tuple[Filter, ...]) -> Filter:
        new = dict(zip(self.held, filters, strict=True))
        return dataclasses.replace(self, **new)  # type: ignore[type-var]

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        raise NotImplementedError(f"{type(self).__name__} must have `parts`")

    @property
    def reports(self) -> bool:
        return any(one.reports for one in self.filters)

    def report(
        self, start: FilterState, final: FilterState, again: Again | None, time: ArrayLike | None
    ) -> None:
        each = zip(self.filters, self.parts(start), self.parts(final), strict=True)
        for i, (one, first, last) in enumerate(each):

            def rerun(other: Filter, i: int = i) -> FilterState:
                assert again is not None
                filters = (*self.filters[:i], other, *self.filters[i + 1 :])
                return self.parts(again(self.with_filters(filters)))[i]

            one.report(first, last, None if again is None else rerun, time)


@value
class FilterWrapper(Composite):
    """Wrapper of a filter, `inner`; it has the state of `inner` unless it defines its own."""

    inner: Filter

    held = ("inner",)

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return (state,)

    @property
    def suspects(self) -> tuple[str, ...]:
        return self.inner.suspects

    def suspicions(self, state: FilterState) -> Array:
        return self.inner.suspicions(self.parts(state)[0])

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        return self.inner.init(belief, dims)

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        return self.inner.reset(state, belief)


def predicted_factor(t: Transition, form: Form) -> Array:
    """Factor of ``F P F' + Omega + Q``."""
    if form == "sqrt":
        S = linalg.tria(t.spread, t.excess, t.noise)
        return S if t.deficit is None else linalg.downdate(S, t.deficit)
    wide = jnp.concatenate([t.spread, t.excess, t.noise], axis=1)
    P = wide @ wide.T
    if t.deficit is not None:
        P = P - t.deficit[:, None] @ t.deficit[None, :]
    return linalg.cholesky(P)


def _outcome(o: Observation) -> Array:
    some = jnp.where(jnp.any(o.accepted), int(Code.PARTLY_MISSING), int(Code.REFUSED))
    some = jnp.where(jnp.any(o.present), some, int(Code.MISSING))
    return jnp.where(jnp.all(o.accepted), int(Code.DONE), some)


def _safe_factor(sound: Array, S_y: Array) -> Array:
    """Factor S_y, or the identity where it is invalid: dividing by NaN would make all gradients
    NaN.
    """
    return jnp.where(sound, S_y, jnp.eye(S_y.shape[0]))


def updated(prior: Belief, o: Observation, form: Form) -> tuple[Belief, StepInfo]:
    """Kalman update for a linearised observation.

    With H S known as the spread, gain and covariance follow from S_y, the innovation's factor:
    K = (S spread') (S_y S_y')^-1 and P = (S - K spread)(..)' + K (Omega + R) K'. The mean moves by
    the cross-covariance with the whitened innovation, S spread' S_y'^-1, times that innovation,
    which avoids cancellation among large entries of the gain.
    """
    spread, excess, noise, deficit, used = left_out(o)
    S = prior.factor
    if form == "sqrt":
        S_y, cross, S_post = linalg.block_factor(spread, (excess, noise), S, deficit)
        sound = finite(S_y * S_y)  # where a square overflows, the other blocks are meaningless
        S_y, cross = _safe_factor(sound, S_y), jnp.where(sound, cross, 0.0)
        S_post = jnp.tril(jnp.where(sound, S_post, jnp.nan))  # constant zeros above, for C code
        # After an exact measurement no variance is left in its direction. Rounding is set to zero,
        # since later updates would take it for variance.
        exact = jnp.any(used & ~jnp.any(noise != 0.0, axis=1) & ~jnp.any(excess != 0.0, axis=1))
        lost = linalg.lost_in_rounding(S_post, prior.sigma)
        S_post = jnp.where(exact & lost, 0.0, S_post)
    else:
        wide = jnp.concatenate([spread, excess, noise], axis=1)
        P_y = wide @ wide.T
        if deficit is not None:
            P_y = P_y - deficit[:, None] @ deficit[None, :]
        S_y = linalg.cholesky(P_y)
        sound = finite(S_y)
        S_y = _safe_factor(sound, S_y)
        cross = linalg.solve_lower(S_y, spread @ S.T).T
        K = linalg.solve_lower_transposed(S_y, cross.T).T
        # [S - K spread, -K excess, -K noise] is a factor of (I - K H) P (I - K H)' + K R K'.
        A = jnp.pad(S, ((0, 0), (0, wide.shape[1] - S.shape[1]))) - K @ wide
        P = A @ A.T
        if deficit is not None:
            taken = K @ deficit[:, None]
            P = P - taken @ taken.T
        S_post = jnp.where(sound, linalg.cholesky(P), jnp.nan)

    seen = whiten(S_y, used, o.residual)
    wrong = jnp.any(contradicted(o, seen))
    mean = manifold.retract(prior.mean, cross @ seen.white)
    gain = linalg.solve_lower_transposed(S_y, cross.T).T
    likely = -0.5 * (seen.nis + seen.dof.astype(float) * math.log(2.0 * math.pi))
    # Without used components the belief is unchanged, bit for bit.
    posterior = select(jnp.any(used), Belief(mean, S_post), prior)
    info = StepInfo(
        innovation=jnp.where(o.present, o.residual, jnp.nan),
        expected=o.expected,
        factor=S_y,
        gain=jnp.where(used[None, :], gain, 0.0),
        used=used,
        nis=seen.nis,
        dof=seen.dof,
        log_likelihood=likely - linalg.log_diagonal(S_y, used),
        code=_outcome(o),
        notes=dict(o.notes),
    )
    return posterior, info.contradicted_where(wrong)


def _failure(inputs: Data, factor: Array) -> Array:
    """Code of a failed step: INDEFINITE if finite inputs gave a factor that is not finite."""
    indefinite = finite(inputs) & ~finite(factor)
    return jnp.where(indefinite, int(Code.INDEFINITE), int(Code.NOT_FINITE))


def invalidated_unless(ok: Array, info: StepInfo, why: Array) -> StepInfo:
    """Information of an update; unless `ok`, with nothing used, likelihood zero and code `why`."""
    return info._replace(
        used=info.used & ok,
        nis=jnp.where(ok, info.nis, 0.0),
        dof=jnp.where(ok, info.dof, 0),
        log_likelihood=jnp.where(ok, info.log_likelihood, -jnp.inf),
        code=jnp.where(ok, info.code, why),
    )


def _named(given: Any) -> str:
    """Text of a wrong argument in an error: a function by its name."""
    return getattr(given, "__name__", None) or repr(given)


def _as_linearisation(given: Any) -> Linearisation:
    if given is None:
        return taylor()
    if not isinstance(given, Linearisation):
        raise TypeError(
            f"linearise must be made by taylor(), unscented() or cubature(), got {_named(given)}"
            + (f": call it, {_named(given)}()" if callable(given) else "")
        )
    return given


def _as_rules(given: Any) -> tuple[Rule, ...]:
    if isinstance(given, Rule) or not isinstance(given, Sequence):
        given_name = f"the rule {given.name}" if isinstance(given, Rule) else _named(given)
        raise TypeError(
            f"rules must be a sequence of rules, as in rules=[gate()], got {given_name}"
        )
    for i, one in enumerate(given):
        if not isinstance(one, Rule):
            raise TypeError(
                f"rules[{i}] must be a rule, as gate() makes one, got {_named(one)}"
                + (f": call it, {_named(one)}()" if callable(one) else "")
            )
    return tuple(given)


@value
class Kalman(Filter):
    """Filter made by `kalman`."""

    way: Linearisation
    rules: tuple[Rule, ...]
    form: Form = kind()

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        memory = tuple(rule.init(belief, dims) for rule in self.rules)
        return FilterState(belief, memory, self.way.drawn(belief))

    @property
    def settles(self) -> bool:
        """True if a rule has the hook `settle`."""
        return any(rule.settles for rule in self.rules)

    def settled(self, state: FilterState) -> tuple[FilterState, Array]:
        """State after the `settle` hooks, when all measurements of a step are in, and a code."""
        belief, memory, code = state.belief, list(state.memory), jnp.asarray(int(Code.DONE))
        for i, rule in enumerate(self.rules):
            memory[i], belief, found = rule.settle(memory[i], belief)
            code = jnp.where(code == int(Code.DONE), found, code)
        return state._replace(belief=belief, memory=tuple(memory)), code

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        begun, settled = self.settled(state) if self.settles else (state, None)
        transition = self.way.transition(begun.belief, motion, u)
        memory = []
        for rule, one in zip(self.rules, begun.memory, strict=True):
            one, transition = rule.process(one, transition)
            memory.append(one)
        belief = Belief(transition.mean, predicted_factor(transition, self.form))
        points = () if transition.points is None else transition.points
        new = FilterState(belief, tuple(memory), points)
        ok = finite(new) & finite(belief.factor * belief.factor)
        why = _failure(transition, belief.factor)
        if settled is not None:
            why = jnp.where(settled == int(Code.DONE), why, settled)
            ok = ok & (settled == int(Code.DONE))
            state = state._replace(memory=select(finite(begun.memory), begun.memory, state.memory))
        code = jnp.where(ok, int(Code.DONE), why)
        new = select(ok, new, state)
        origin = begun.belief if self.settles else None
        return new, Prediction(transition._replace(points=None), new.belief, code, origin)

    def seen(
        self, state: FilterState, sensor: Sensor, y: Data, aux: Data
    ) -> tuple[list[Memory], Belief, Observation]:
        """Memories, prior and observation after the `before` hooks of the rules."""
        prior, memory = state.belief, list(state.memory)
        seen = self.way.first_observation(state.points, prior, sensor, y, aux)
        for i, rule in enumerate(self.rules):
            memory[i], faded, seen = rule.before(memory[i], prior, seen)
            if faded is not prior:  # the rule made another prior; decided while tracing
                prior = faded
                again = self.way.observation(prior, sensor, y, aux)
                seen = again._replace(**{name: getattr(seen, name) for name in _OF_RULES})
        return memory, prior, seen._replace(accepted=seen.accepted & seen.present)

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        memory, prior, seen = self.seen(state, sensor, y, aux)
        posterior, info = updated(prior, seen, self.form)
        # An infinite NIS is an overflow, unless it marks a contradiction.
        ok = finite(info.nis) | (info.code == int(Code.CONTRADICTED))
        for i, rule in enumerate(self.rules):
            memory[i], posterior, info = rule.after(memory[i], posterior, info, seen)
        new = FilterState(posterior, tuple(memory), self.way.drawn(posterior))
        ok = finite(new) & ok
        squares = (block * block for block in left_out(seen)[:3])
        inputs = (prior, jnp.where(info.used, seen.residual, 0.0), *squares)
        why = _failure(inputs, posterior.factor)
        return select(ok, new, state), invalidated_unless(ok, info, why)

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        return FilterState(belief, state.memory, self.way.drawn(belief))

    @property
    def reports(self) -> bool:
        return any(rule.reports for rule in self.rules)

    def report(
        self, start: FilterState, final: FilterState, again: Again | None, time: ArrayLike | None
    ) -> None:
        for i, rule in enumerate(self.rules):

            def anew(rule: Rule, i: int = i) -> Memory:
                assert again is not None
                rules = (*self.rules[:i], rule, *self.rules[i + 1 :])
                return again(dataclasses.replace(self, rules=rules)).memory[i]

            rule.report(start.memory[i], final.memory[i], None if again is None else anew, time)


def kalman(
    linearise: Linearisation | None = None, rules: Sequence[Rule] = (), form: Form = "sqrt"
) -> Filter:
    """Kalman filter: a linearisation, a chain of rules, a form.

    A step that would leave a state, covariance or memory that is not finite is not taken, nor is
    one whose innovation is too large to be squared: the belief and the rules' memories stay, the
    step's code reports it, and its log-likelihood is -inf, so that an optimiser avoids it.

    Args:
        linearise: `taylor` (default), `unscented` or `cubature`.
        rules: applied in the order given at each of their hooks.
        form: "sqrt" (default, keeps full accuracy) or "joseph" (about 2.5 times faster at n = 15).

    Raises:
        TypeError: linearise is not a `Linearisation`, or rules is not a sequence of rules.
        ValueError: the form is neither "sqrt" nor "joseph".
    """
    one_of("form", form, Form)
    return Kalman(_as_linearisation(linearise), _as_rules(rules), form)
