"""Interacting multiple model: several filters of one state, and how likely each is the right one.

Blom & Bar-Shalom, *The interacting multiple model algorithm for systems with Markovian switching
coefficients*, IEEE Trans. Automatic Control 33 (1988). With p_ij the probability of a change from
mode i to mode j in a step and mu_i that of mode i, each step

    predicts    c_j = sum_i p_ij mu_i
    mixes       filter j begins with the moments of the mixture of all, weights p_ij mu_i / c_j
    updates     mu_j = c_j L_j / sum_k c_k L_k, L_j the likelihood that filter j gives what is seen

and answers with the moments of the mixture under mu. Probabilities are kept as logarithms, and
moments are taken on the state's manifold and on factors, so that nothing is subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.composite.mixture import innovation, log_normalised, matched
from robins.filters.kalman import Filter, FilterState, Prediction
from robins.filters.model import Motion, Sensor
from robins.filters.trees import equal, select
from robins.filters.values import Numbers, kind, value


@value
class Mode:
    """A filter and what of the model is its own."""

    filter_: Filter
    motion: Motion | None = None
    sensors: tuple[Sensor, ...] = ()

    def predict(self, state: FilterState, motion: Motion, u: Any):
        """State, code and no notes of a prediction, by the motion of this mode if it has one."""
        own = motion if self.motion is None else self.motion
        state, prediction = self.filter_.predict(state, own, u)
        return state, prediction.code, {}

    def update(self, state: FilterState, sensor: Sensor, y: Any, aux: Any):
        """State, information and notes of an update, by its own sensor of that name if any."""
        own = next((s for s in self.sensors if s.name == sensor.name), sensor)
        state, info = self.filter_.update(state, own, y, aux)
        return state, info._replace(notes={}), info.notes


@value
class Family:
    """Modes that differ in numbers only.

    Filters of different kinds are each a part of the program. Those of a family are one part,
    batched: seven modes compile in the time of one.

    Attributes:
        make: makes a filter, or what `mode` makes of one, of one row of the numbers. What depends
            on a number is computed with it, not decided by it: the numbers are stand-ins then.
        numbers: pytree of arrays, one row a mode.
    """

    make: Callable[[Any], Filter | Mode] = kind()
    numbers: Any

    def of(self, row: Any) -> Mode:
        """The mode of one row."""
        return _as_mode(self.make(row))


class Bank(NamedTuple):
    """The modes as one: states are kept as the layout likes, beliefs have a leading axis of modes.

    Attributes:
        size: number of modes.
        every: ``(of, states, *rows) -> (states, found, notes)``, what ``of(mode, state, *row)``
            makes of every mode: states, what was found with a leading axis of modes, as ``rows``
            have, and a dict of notes for each.
        beliefs: ``states -> Belief``.
    """

    size: int
    every: Callable[..., tuple[Any, Any, Sequence[dict[str, Array]]]]
    beliefs: Callable[[Any], Belief]


def bank(modes: Sequence[Filter | Mode] | Family) -> Bank:
    """The modes as one."""
    if isinstance(modes, Family):
        return _batched(modes)
    return _each(tuple(map(_as_mode, modes)))


def _as_mode(one: Filter | Mode) -> Mode:
    return one if isinstance(one, Mode) else Mode(one)


def _each(modes: tuple[Mode, ...]) -> Bank:
    """A tuple of states; each mode is traced by itself."""

    def every(of, states, *rows):
        done = []
        for j, (mode, state) in enumerate(zip(modes, states, strict=True)):
            row = jax.tree_util.tree_map(lambda a, j=j: a[j], rows)
            done.append(of(mode, state, *row))
        after, found, notes = zip(*done, strict=True)
        return after, _stack(found), notes

    return Bank(len(modes), every, lambda states: _stack([s.belief for s in states]))


def _batched(family: Family) -> Bank:
    """States with a leading axis of modes; one mode is traced, for all."""
    numbers = jax.tree_util.tree_map(jnp.asarray, family.numbers)
    lengths = {jnp.shape(x)[:1] for x in jax.tree_util.tree_leaves(numbers)}
    if len(lengths) != 1 or lengths == {()}:
        raise ValueError(
            "the numbers of a family must be arrays with one row a mode; "
            f"their shapes begin with {sorted(lengths)}"
        )
    ((count,),) = lengths

    def every(of, *parts):
        one = jax.vmap(lambda row, *part: of(family.of(row), *part))
        after, found, notes = one(numbers, *parts)
        return after, found, [{k: v[i] for k, v in notes.items()} for i in range(count)]

    return Bank(count, every, lambda states: states.belief)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree_util.tree_map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *trees)


Rows = ArrayLike | Sequence[Any]  # numbers, or rows of them

_ONE = 1e-9  # how far a sum of probabilities may be off


class Interaction(NamedTuple):
    """Memory of a mixture of filters."""

    states: Any  # of the modes: a tuple, or those of a family with a leading axis
    log_probability: Array  # (modes,)


def mode(filter_: Filter, motion: Motion | None = None, sensors: Sequence[Sensor] = ()) -> Mode:
    """One mode of `imm`.

    Args:
        filter_: from `kalman` and its kin.
        motion: of this mode, of the same state; else the run's.
        sensors: of this mode, each in the place of the run's sensor of its name.
    """
    return Mode(filter_, motion, tuple(sensors))


@value
class Imm(Filter):
    """The filter of `imm`."""

    modes: tuple[Mode, ...] | Family
    log_change: Numbers  # (modes, modes)
    log_first: Numbers  # (modes,)
    likeliest: bool = kind()

    @property
    def bank(self) -> Bank:
        return bank(self.modes)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        own = set()

        def begin(mode: Mode, _):
            own.update(s.name for s in mode.sensors)
            return mode.filter_.init(belief, dims), None, {}

        states, *_ = self.bank.every(begin, (None,) * self.bank.size)
        if unknown := own - set(dims):
            raise ValueError(f"modes of imm bring {sorted(unknown)}; the model has {list(dims)}")
        return FilterState(belief, Interaction(states, jnp.asarray(self.log_first)))

    def mixed(self, states: Any, log_now: Array) -> tuple[Any, Array]:
        """Where each filter begins, and the predicted log-probabilities."""
        joint = log_now[:, None] + jnp.asarray(self.log_change)
        log_weight, log_next = jax.vmap(log_normalised, in_axes=1)(joint)
        weight = jnp.exp(log_weight)  # (to, from)
        beliefs = self.bank.beliefs(states)
        begun = jax.vmap(matched, in_axes=(None, 0, 0))(beliefs, weight, beliefs.mean)
        # A mode that receives nothing goes on alone, as does one that mixes with none, bit for bit.
        alone = ~jnp.isfinite(log_next) | (jnp.diagonal(weight) == 1.0)

        def restart(mode: Mode, state: FilterState, belief: Belief, alone: Array):
            return select(alone, state, mode.filter_.reset(state, belief)), None, {}

        return self.bank.every(restart, states, begun, alone)[0], log_next

    def _predict(self, state: FilterState, motion: Motion, u: Any):
        states, log_now = state.memory
        begun, log_next = (states, log_now) if self.bank.size == 1 else self.mixed(states, log_now)
        after, code, _ = self.bank.every(lambda m, s: m.predict(s, motion, u), begun)
        taken = code == int(Code.DONE)
        log_next = _among(taken, log_next)
        failed = code[jnp.argmax(log_now)]
        belief = _mixture(self.bank.beliefs(after), log_next)
        outcome = jnp.where(jnp.any(taken), int(Code.DONE), failed)
        return FilterState(belief, Interaction(after, log_next)), Prediction(None, belief, outcome)

    def _update(self, state: FilterState, sensor: Sensor, y: Any, aux: Any):
        states, log_prior = state.memory
        after, seen, each = self.bank.every(lambda m, s: m.update(s, sensor, y, aux), states)
        sound = ~jnp.isneginf(seen.log_likelihood)
        of_all = jnp.any(seen.used & sound[:, None], axis=0)
        alike = jnp.all((seen.used == of_all[None]) | ~sound[:, None])
        gained = jnp.where(sound & ~alike, 0.0, seen.log_likelihood)
        log_post, _ = log_normalised(log_prior + gained)
        log_post = jnp.where(jnp.any(sound), log_post, log_prior)
        if self.bank.size == 1:
            info = jax.tree_util.tree_map(lambda a: a[0], seen)
        else:
            info = _seen(seen, jnp.where(sound, log_prior, -jnp.inf), log_post, of_all)
        if self.likeliest:
            one = jax.tree_util.tree_map(lambda a: a[jnp.argmax(log_post)], seen)
            info = one._replace(gain=info.gain, log_likelihood=info.log_likelihood)
        notes = {f"imm.{i}.{k}": v for i, own in enumerate(each) for k, v in own.items()}
        notes["imm.probability"] = jnp.exp(log_post)
        # Where no mode has moved the mixture stands bit for bit.
        was, now = self.bank.beliefs(states), self.bank.beliefs(after)
        belief = select(equal(now, was), state.belief, _mixture(now, log_post))
        return FilterState(belief, Interaction(after, log_post)), info._replace(notes=notes)

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        inner = state.memory
        states, *_ = self.bank.every(
            lambda m, s: (m.filter_.reset(s, belief), None, {}), inner.states
        )
        return FilterState(belief, inner._replace(states=states))

    @property
    def reports(self) -> bool:
        modes = self.modes
        if isinstance(modes, Family):  # all of one kind
            first = jax.tree_util.tree_map(lambda x: np.asarray(x)[0], modes.numbers)
            modes = (modes.of(first),)
        return any(mode.filter_.reports for mode in modes)

    def report(self, start: FilterState, final: FilterState, again: Any, time: Any) -> None:
        for i in range(self.bank.size):
            if isinstance(self.modes, Family):
                mode = self.modes.of(
                    jax.tree_util.tree_map(lambda x: np.asarray(x)[i], self.modes.numbers)
                )
                first, last = (
                    jax.tree_util.tree_map(lambda x: x[i], s.memory.states) for s in (start, final)
                )
                mode.filter_.report(first, last, None, time)
                continue

            def other(filter_: Filter, i: int = i) -> FilterState:
                own = replace(self.modes[i], filter_=filter_)
                return again(
                    replace(self, modes=(*self.modes[:i], own, *self.modes[i + 1 :]))
                ).memory.states[i]

            first, last = start.memory.states[i], final.memory.states[i]
            self.modes[i].filter_.report(first, last, None if again is None else other, time)


def imm(
    modes: Sequence[Filter | Mode] | Family,
    transition: Rows,
    start: Rows | None = None,
    likeliest: bool = False,
) -> Filter:
    """Interacting multiple model filter over any filters of the same state.

    Modes may differ in rules, in linearisation, and by `mode` in motion and sensors. Each keeps the
    memory of its rules; only beliefs are mixed. With nothing measured, probabilities only mix.

    The `StepInfo` is that of the mixture: innovation and factor are its moments before the update,
    the gain is the mean of the modes' gains, and ``imm.probability`` (modes,) is noted. What rules
    of mode i note is found under ``imm.i.`` and its name. A mode that is rare and wide makes these
    moments those of no Gaussian, and the NIS says nothing: then ask for the ``likeliest``.

    Likelihoods only compare where all modes use the same components. Where a rule of one mode
    refuses what another uses, the measurement leaves the probabilities as they are. A mode whose
    step fails is out until the next mixing; the code is a failure only where all fail.

    Args:
        modes: filters, or what `mode` makes of one; a `Family` where they differ in numbers only.
        transition: (modes, modes), row i the probabilities to change from i in one step.
        start: (modes,) probabilities before the first prediction; all equal where not given.
        likeliest: innovation, factor, NIS and what was used are those of the mode that is likeliest
            after the update. Beliefs and likelihoods are the same either way.

    Raises:
        ValueError: no modes, or probabilities that are negative, of a wrong shape or do not sum to
            one. When a run begins: a mode brings a sensor that the model does not have.
    """
    modes = modes if isinstance(modes, Family) else tuple(map(_as_mode, modes))
    count = bank(modes).size
    require(count, "imm needs at least one mode")
    even = np.full(count, 1.0 / count)
    first = _probabilities("start", even if start is None else start, (count,))
    with np.errstate(divide="ignore"):
        log_change = np.log(_probabilities("transition", transition, (count, count)))
        return Imm(modes, log_change, np.log(first), likeliest)


def _probabilities(name: str, given: Rows, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(given, dtype=float)
    require(value.shape == shape, f"{name} of imm has shape {value.shape}, its modes need {shape}")
    total = value.sum(axis=-1)
    if not (np.all(value >= 0.0) and np.all(np.abs(total - 1.0) <= _ONE)):
        raise ValueError(
            f"{name} of imm must hold probabilities, rows that sum to one: got {value.tolist()}"
        )
    return value / total[..., None]


def _among(taken: Array, log_probability: Array) -> Array:
    """The same without modes whose step failed, unless all did."""
    kept = jnp.where(taken | ~jnp.any(taken), log_probability, -jnp.inf)
    return log_normalised(kept)[0]


def _mixture(beliefs: Belief, log_probability: Array) -> Belief:
    """Moments of all modes; those of one that is certain are its own, bit for bit."""
    likely = jnp.argmax(log_probability)
    best = jax.tree_util.tree_map(lambda a: a[likely], beliefs)
    if len(log_probability) == 1:
        return best
    weight = jnp.exp(log_probability)
    return select(weight[likely] == 1.0, best, matched(beliefs, weight, best.mean))


def _seen(seen: StepInfo, log_prior: Array, log_post: Array, used: Array) -> StepInfo:
    """One `StepInfo` for the mixture of predicted measurements."""
    _, log_likelihood = log_normalised(log_prior + seen.log_likelihood)
    lost = jnp.isneginf(log_likelihood)
    used = used & ~lost
    expected = innovation(seen, jnp.exp(log_normalised(log_prior)[0]), used)
    code = seen.code[jnp.argmax(log_post)]
    return StepInfo(
        innovation=expected.mean,
        expected=expected.expected,
        factor=expected.factor,
        gain=jnp.einsum("r,rnm->nm", jnp.exp(log_post), seen.gain),
        used=used,
        nis=jnp.where(code == int(Code.CONTRADICTED), jnp.inf, expected.nis),
        dof=expected.dof,
        log_likelihood=log_likelihood,
        code=code,
        notes={},
    )
