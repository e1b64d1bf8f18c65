"""Interacting multiple model: several filters of one state, and the probability of each.

Blom & Bar-Shalom, *The interacting multiple model algorithm for systems with Markovian switching
coefficients*, IEEE Trans. Automatic Control 33 (1988). With p_ij the probability of a change from
mode i to mode j in a step and mu_i that of mode i, each step

    predicts    c_j = sum_i p_ij mu_i
    mixes       filter j starts from the moments of the mixture of all, weights p_ij mu_i / c_j
    updates     mu_j = c_j L_j / sum_k c_k L_k, L_j the likelihood of the measurement in filter j

and returns the moments of the mixture under mu. Probabilities are kept as logarithms, and moments
are computed on the state's manifold and on factors, so that nothing is subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.composite.mixture import innovation, log_normalised, matched
from robins.filters.kalman import WRONG, Again, Filter, FilterState, Prediction
from robins.filters.model import Data, Given, Motion, Sensor
from robins.filters.trees import equal, row_of, select, stack
from robins.filters.values import Numbers, is_known, kind, on_device, value
from robins.linalg.rows import each_row

T = TypeVar("T")
One = tuple[Data, Data, dict[str, Array]]  # state, result and notes of one mode
Of = Callable[..., One]
Every = tuple[Data, Data, Sequence[dict[str, Array]]]


@value
class Mode:
    """Filter of a mode, with a motion and sensors of its own if any."""

    filter_: Filter
    motion: Motion | None = None
    sensors: tuple[Sensor, ...] = ()

    def predict(self, state: FilterState, motion: Motion, u: Data) -> One:
        """State and code of a prediction, by the motion of this mode if it has one; no notes."""
        own = motion if self.motion is None else self.motion
        state, prediction = self.filter_.predict(state, own, u)
        return state, prediction.code, {}

    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> One:
        """State, information and notes of an update, by the mode's own sensor if it has one."""
        own = next((s for s in self.sensors if s.name == sensor.name), sensor)
        state, info = self.filter_.update(state, own, y, aux)
        return state, info._replace(notes={}), info.notes


@value
class SeparateModes:
    """Modes of any kind, each a part of the program; their states are a tuple."""

    modes: tuple[Mode, ...]

    @property
    def size(self) -> int:
        """Number of modes."""
        return len(self.modes)

    def mode(self, i: int) -> Mode:
        """Mode i."""
        return self.modes[i]

    def every(self, of: Of, states: Data, *rows: Data) -> Every:
        """Apply a function to all modes; return states, results with a leading axis, and notes.

        Args:
            of: ``(mode, state, *row) -> (state, found, notes)``.
            states: of the modes.
            rows: pytrees with a leading axis of modes.
        """
        done = [
            of(mode, state, *row_of(rows, i))
            for i, (mode, state) in enumerate(zip(self.modes, states, strict=True))
        ]
        after, found, notes = zip(*done, strict=True)
        return after, stack(found), notes

    def beliefs(self, states: Data) -> Belief:
        """Beliefs with a leading axis of modes."""
        return stack([s.belief for s in states])

    def state(self, states: Data, i: int) -> FilterState:
        """State of one mode."""
        return states[i]

    def exchanged(self, i: int, filter_: Filter) -> SeparateModes:
        """Copy with another filter in mode i."""
        own = replace(self.modes[i], filter_=filter_)
        return SeparateModes((*self.modes[:i], own, *self.modes[i + 1 :]))


@value
class ModeFamily:
    """Modes that differ in numbers only.

    Filters of different kinds are each a part of the program. Those of a family are one part,
    batched: seven modes compile in the time of one.

    Attributes:
        make: function from one row of the numbers to a filter, or to the result of `mode`. It may
            compute with the numbers but not branch on them, since they are traced. A function
            created at each call compiles again: give a `Partial` of a module-level function.
        numbers: pytree of arrays, one row per mode.
    """

    make: Callable[[Data], Filter | Mode]
    numbers: Data

    @property
    def size(self) -> int:
        """Number of rows."""
        lengths = {jnp.shape(x)[:1] for x in jax.tree_util.tree_leaves(self.numbers)}
        if len(lengths) != 1 or lengths == {()}:
            raise ValueError(
                "the numbers of a family must be arrays with one row a mode; "
                f"their shapes begin with {sorted(lengths)}"
            )
        return next(iter(lengths))[0]

    def of(self, row: Data) -> Mode:
        """Mode of one row of numbers."""
        return _as_mode(self.make(row))

    def mode(self, i: int) -> Mode:
        """Mode of row i."""
        return self.of(row_of(jax.tree_util.tree_map(np.asarray, self.numbers), i))

    def every(self, of: Of, states: Data, *rows: Data) -> Every:
        """Apply a function to all modes, as `SeparateModes.every`, tracing it only once.

        States have a leading axis of modes.
        """
        after, found, notes = each_row(
            lambda row, *part: of(self.of(row), *part), on_device(self.numbers), states, *rows
        )
        return after, found, [row_of(notes, i) for i in range(self.size)]

    def beliefs(self, states: Data) -> Belief:
        """Beliefs with a leading axis of modes."""
        return states.belief

    def state(self, states: Data, i: int) -> FilterState:
        """State of one mode."""
        return row_of(states, i)

    def exchanged(self, i: int, filter_: Filter) -> ModeFamily:
        """Copy with another filter in mode i, which may differ in numbers only."""
        modes = jax.vmap(self.of)(on_device(self.numbers))
        put = jax.tree_util.tree_map(lambda x, new: x.at[i].set(new), modes.filter_, filter_)
        return ModeFamily(_as_mode, replace(modes, filter_=put))


def _as_mode(one: Filter | Mode) -> Mode:
    return one if isinstance(one, Mode) else Mode(one)


_ONE = 1e-9  # tolerance of a sum of probabilities


class Interaction(NamedTuple):
    """Memory of an `imm` filter."""

    states: Data  # of the modes: a tuple, or those of a family with a leading axis
    log_probability: Array  # (modes,)


def mode(filter_: Filter, motion: Motion | None = None, sensors: Sequence[Sensor] = ()) -> Mode:
    """One mode of `imm`.

    Args:
        filter_: the filter, such as `kalman` returns.
        motion: motion of this mode, of the same state; None: that of the run.
        sensors: sensors of this mode, each in place of the run's sensor of its name.
    """
    return Mode(filter_, motion, tuple(sensors))


@value
class Imm(Filter):
    """Filter made by `imm`."""

    modes: SeparateModes | ModeFamily
    log_change: Numbers  # (modes, modes)
    log_first: Numbers  # (modes,)
    likeliest: bool = kind()
    wrong: tuple[tuple[str, tuple[int, ...]], ...] = kind()  # each name, with its modes

    @property
    def suspects(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.wrong)

    def suspicions(self, state: FilterState) -> Array:
        return self._by_name(jnp.exp(state.memory.log_probability))

    def _by_name(self, probability: Array) -> Array:
        each = [jnp.sum(probability[np.asarray(modes)]) for _, modes in self.wrong]
        return jnp.stack(each) if each else jnp.zeros(0)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        own = set()

        def begin(mode: Mode, _: Data) -> One:
            own.update(s.name for s in mode.sensors)
            return mode.filter_.init(belief, dims), None, {}

        states, *_ = self.modes.every(begin, (None,) * self.modes.size)
        if unknown := own - set(dims):
            raise ValueError(f"modes of imm bring {sorted(unknown)}; the model has {list(dims)}")
        return FilterState(belief, Interaction(states, jnp.asarray(self.log_first)))

    def mixed(self, states: Data, log_now: Array) -> tuple[Data, Array]:
        """States of the filters after mixing, and the predicted log-probabilities."""
        joint = log_now[:, None] + jnp.asarray(self.log_change)
        log_weight, log_next = jax.vmap(log_normalised, in_axes=1)(joint)
        weight = jnp.exp(log_weight)  # (to, from)
        beliefs = self.modes.beliefs(states)
        begun = each_row(partial(matched, beliefs), weight, beliefs.mean)
        # A mode of zero predicted probability, or without contribution from others, is not mixed
        # and keeps its state bit for bit.
        alone = ~jnp.isfinite(log_next) | (jnp.diagonal(weight) == 1.0)

        def restart(mode: Mode, state: FilterState, belief: Belief, alone: Array) -> One:
            return select(alone, state, mode.filter_.reset(state, belief)), None, {}

        return self.modes.every(restart, states, begun, alone)[0], log_next

    def _predict(self, state: FilterState, motion: Motion, u: Data):
        states, log_now = state.memory
        begun, log_next = (states, log_now) if self.modes.size == 1 else self.mixed(states, log_now)
        after, code, _ = self.modes.every(lambda m, s: m.predict(s, motion, u), begun)
        taken = code == int(Code.DONE)
        log_next = _without_failed(taken, log_next)
        failed = code[jnp.argmax(log_now)]
        belief = _mixture(self.modes.beliefs(after), log_next)
        outcome = jnp.where(jnp.any(taken), int(Code.DONE), failed)
        return FilterState(belief, Interaction(after, log_next)), Prediction(None, belief, outcome)

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data):
        states, log_prior = state.memory
        after, seen, each = self.modes.every(lambda m, s: m.update(s, sensor, y, aux), states)
        log_prior, log_post, used = _judged(seen, log_prior)
        notes = {f"imm.{i}.{k}": v for i, own in enumerate(each) for k, v in own.items()}
        notes["imm.probability"] = probability = jnp.exp(log_post)
        if self.wrong:
            notes[WRONG] = self._by_name(probability)
        info = self.mixture_info(seen, log_prior, log_post, used)._replace(notes=notes)
        # If no mode has changed its belief, that of the mixture stays the same bit for bit.
        was, now = self.modes.beliefs(states), self.modes.beliefs(after)
        same = jnp.all(each_row(equal, now, was))
        belief = select(same, state.belief, _mixture(now, log_post))
        return FilterState(belief, Interaction(after, log_post)), info

    def mixture_info(
        self, seen: StepInfo, log_prior: Array, log_post: Array, used: Array
    ) -> StepInfo:
        """Information of the mixture, or with `likeliest` mostly that of the likeliest mode."""
        info = row_of(seen, 0) if self.modes.size == 1 else _seen(seen, log_prior, log_post, used)
        if not self.likeliest:
            return info
        one = row_of(seen, jnp.argmax(log_post))
        return one._replace(gain=info.gain, log_likelihood=info.log_likelihood)

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        def moved(mode: Mode, one: FilterState) -> One:
            return mode.filter_.reset(one, belief), None, {}

        states, *_ = self.modes.every(moved, state.memory.states)
        return FilterState(belief, state.memory._replace(states=states))

    @property
    def reports(self) -> bool:
        return any(self.modes.mode(i).filter_.reports for i in range(self.modes.size))

    def report(
        self, start: FilterState, final: FilterState, again: Again | None, time: ArrayLike | None
    ):
        for i in range(self.modes.size):
            first = self.modes.state(start.memory.states, i)
            last = self.modes.state(final.memory.states, i)
            anew = None if again is None else partial(self.rerun_mode, again, i)
            self.modes.mode(i).filter_.report(first, last, anew, time)

    def rerun_mode(self, again: Again, i: int, filter_: Filter) -> FilterState:
        """Final state of mode i in a run with another filter in its place."""
        final = again(replace(self, modes=self.modes.exchanged(i, filter_)))
        return self.modes.state(final.memory.states, i)


def imm(
    modes: Sequence[Filter | Mode] | ModeFamily,
    transition: Given,
    start: Given | None = None,
    likeliest: bool = False,
    wrong: Mapping[str, Sequence[int]] | None = None,
) -> Filter:
    """Interacting multiple model filter over any filters of the same state.

    Modes may differ in rules, in linearisation, and by `mode` in motion and sensors. Each keeps the
    memory of its rules; only beliefs are mixed. Without measurements, the probabilities follow the
    Markov chain alone.

    The `StepInfo` is that of the mixture: innovation and factor are its moments before the update,
    the gain is the mean of the modes' gains, and ``imm.probability`` (modes,) is noted. Notes by
    rules of mode i have ``imm.i.`` before their name. With a mode of small probability and large
    covariance the mixture is far from Gaussian, and its NIS meaningless: then set ``likeliest``.

    Likelihoods are comparable only if all modes use the same components. If a rule of one mode
    refuses a component that another uses, the measurement leaves the probabilities unchanged. A
    mode whose step fails has probability zero until the next mixing; the code is a failure only if
    all fail.

    Args:
        modes: filters, or results of `mode`; a `ModeFamily` if they differ in numbers only.
        transition: (modes, modes), row i the probabilities of a change from i in one step.
        start: (modes,) probabilities before the first prediction; equal by default.
        likeliest: take innovation, factor, NIS and the mask of used components from the mode that
            is likeliest after the update. Beliefs and likelihoods are the same either way.
        wrong: indices of the modes in which an instrument, or "motion", is faulty, by its name; a
            mode may be under several names. The probability of each name is noted as ``imm.wrong``
            (names,), and `Filter.suspects` has the names.

    Raises:
        ValueError: there is no mode; probabilities are negative, of a wrong shape or do not sum to
            one; `wrong` has an index without a mode. When a run starts: a mode has a sensor that
            the model does not have.
    """
    all_ = modes if isinstance(modes, ModeFamily) else SeparateModes(tuple(map(_as_mode, modes)))
    count = all_.size
    require(count, "imm needs at least one mode")
    even = np.full(count, 1.0 / count)
    log_first = _log_probabilities("start", even if start is None else start, (count,))
    log_change = _log_probabilities("transition", transition, (count, count))
    of = tuple((name, tuple(sorted(set(modes)))) for name, modes in (wrong or {}).items())
    for name, numbers in of:
        there = bool(numbers) and numbers[0] >= 0 and numbers[-1] < count
        require(there, f"modes of '{name}' in wrong must be among 0 to {count - 1}", list(numbers))
    return Imm(all_, log_change, log_first, likeliest, of)


def _log_probabilities(name: str, given: Given, shape: tuple[int, ...]) -> Numbers:
    known = is_known(given)
    chance = np.asarray(given, float) if known else jnp.asarray(given)
    require(
        chance.shape == shape, f"{name} of imm has shape {chance.shape}, its modes need {shape}"
    )
    total = chance.sum(axis=-1)
    if not known:
        some = chance > 0.0  # twice: the slope of the logarithm of zero is infinite
        return jnp.where(some, jnp.log(jnp.where(some, chance / total[..., None], 1.0)), -jnp.inf)
    if not (np.all(chance >= 0.0) and np.all(np.abs(total - 1.0) <= _ONE)):
        raise ValueError(
            f"{name} of imm must hold probabilities, rows that sum to one: got {chance.tolist()}"
        )
    with np.errstate(divide="ignore"):
        return np.log(chance / total[..., None])


def _judged(seen: StepInfo, log_prior: Array) -> tuple[Array, Array, Array]:
    """Log-probabilities before and after, and the mask of used components, by successful modes.

    The first result is -inf for modes whose step failed.
    """
    sound = ~jnp.isneginf(seen.log_likelihood)
    used = jnp.any(seen.used & sound[:, None], axis=0)
    alike = jnp.all((seen.used == used[None]) | ~sound[:, None])
    gained = jnp.where(sound & ~alike, 0.0, seen.log_likelihood)
    log_post, _ = log_normalised(log_prior + gained)
    log_post = jnp.where(jnp.any(sound), log_post, log_prior)
    return jnp.where(sound, log_prior, -jnp.inf), log_post, used


def _without_failed(taken: Array, log_probability: Array) -> Array:
    """Log-probabilities with zero probability for modes whose step failed, unless all did."""
    kept = jnp.where(taken | ~jnp.any(taken), log_probability, -jnp.inf)
    return log_normalised(kept)[0]


def _mixture(beliefs: Belief, log_probability: Array) -> Belief:
    """Moments of the mixture; if one mode is certain, its own belief bit for bit."""
    likely = jnp.argmax(log_probability)
    best = row_of(beliefs, likely)
    if len(log_probability) == 1:
        return best
    weight = jnp.exp(log_probability)
    return select(weight[likely] == 1.0, best, matched(beliefs, weight, best.mean))


def _seen(seen: StepInfo, log_prior: Array, log_post: Array, used: Array) -> StepInfo:
    """Information of the mixture of predicted measurements."""
    _, log_likelihood = log_normalised(log_prior + seen.log_likelihood)
    lost = jnp.isneginf(log_likelihood)
    used = used & ~lost
    expected = innovation(seen, jnp.exp(log_normalised(log_prior)[0]), used)
    code = seen.code[jnp.argmax(log_post)]
    gain = jnp.einsum("r,rnm->nm", jnp.exp(log_post), seen.gain)
    return expected.info(used, gain, code, code == int(Code.CONTRADICTED), log_likelihood)
