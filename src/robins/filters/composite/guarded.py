r"""Guarded filters: an assumption is weighed by the error that is learnt of it.

A wrong assumption (an exact constraint, air data whose errors are modelled as white) makes the
covariance of a filter too small, so its own residuals do not show the fault. A *reference* that
does without the assumption shows it: where the assumption is right, the estimate x_c that uses it
is efficient, and differs from the reference's x_u by exactly what was gained (Hausman 1978),

    E (x_c - x_u)(x_c - x_u)' = P_u - P_c = G

Where it brings in an error of variance B of its own, this is G + B, and the best estimate from both
weighs them (cov(x_u error, x_c - x_u) = -G): with B = beta G

    x = x_u + w (x_c - x_u),   P = P_u - w (2 - w (1 + beta)) G,   w = 1 / (1 + beta)

which is never worse than the reference; a weight that is wrong is, where it is above 2 w. P holds
for any w, and is stated with a beta larger by what the test does not see. beta is learnt from the
same differences,

    T_i = (x_c - x_u)_i^2 / P_u,ii        v_i = 1 - P_c,ii / P_u,ii  (not below 0)

whose means are E T_i = (1 + beta) v_i, in sums that forget. The sum of w_i makes samples
comparable: differences of consecutive steps are nearly the same number. A measurement of a
*judge*, a sensor that both filters use, renews the share w_i = 1 - P+_u,ii/P-_u,ii of what the
reference knows; the sums count in such renewals, *looks*. Where no judge measures nothing is
renewed, and the weight stands.

A filter that has gone astray does not come back by itself when its assumption is right again. So
it goes on from the reference's belief, with what was learnt, where it is worse than that: B > G, in
evidence that is summed up as Page (1954) has it for the quickest detection of a change,

    g_i := max(0, g_i + w_i (T_i - ratio v_i - slack)),   g_i > limit
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, Code, Number, StepInfo, is_failure
from robins.filters.checks import sensor_names
from robins.filters.kalman import Advanced, Composite, Filter, FilterState, Prediction, Updated
from robins.filters.model import Data, Motion, Sensor
from robins.filters.trees import select
from robins.filters.values import Numbers, kind, number, value

Groups = Sequence[Sequence[int]]

# Harm that is not worth a word: a tenth of the reference's variance, 5 % of its deviation.
SLACK = 0.1

# beta up to a half is chance, in sums over some ten looks. To neglect it costs little: at most a
# sixth of what is gained, at beta = 1/2.
_CHANCE = 0.5

# Six deviations of the reference, squared, are conclusive; more would not be forgotten.
_SURE = 36.0


class GuardMemory(NamedTuple):
    """Memory of a guarded filter."""

    filter: FilterState
    reference: FilterState
    evidence: Array  # (groups,) g
    excess: Array  # (groups,) sum of T - v, of a component
    gained: Array  # (groups,) sum of v
    looks: Array  # (groups,) sum of renewals
    trips: Array  # () how often the filter was sent back to its reference

    @property
    def beta(self) -> Array:
        """() of the worst group, not below 0."""
        beta = self.excess / (self.gained + SLACK * jnp.maximum(self.looks, 1.0))
        return jnp.maximum(jnp.max(beta), 0.0)

    @property
    def weight(self) -> Array:
        """() w."""
        return 1.0 / (1.0 + jnp.maximum(self.beta - _CHANCE, 0.0))


@value
class Guarded(Composite):
    """The filter of `guarded`.

    The report of an update is that of the filter with the greater weight; a sensor of the
    assumption that has the smaller one is refused. Notes: those of the filter, those of the
    reference as ``reference.`` and their name, ``guarded.weight``, ``guarded.evidence`` (the
    greatest, as a share of the limit) and ``guarded.trips``.
    """

    filter: Filter
    reference: Filter
    ratio: Numbers
    limit: Numbers
    patience: Numbers
    leap: Numbers
    assumed: tuple[str, ...] = kind()
    judging: tuple[str, ...] = kind()
    groups: tuple[tuple[int, ...], ...] | None = kind()
    trusted: bool = kind()

    @property
    def filters(self) -> tuple[Filter, ...]:
        return self.filter, self.reference

    def with_filters(self, filters: tuple[Filter, ...]) -> Filter:
        return replace(self, filter=filters[0], reference=filters[1])

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return state.memory.filter, state.memory.reference

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        if unknown := [name for name in (*self.assumed, *self.judging) if name not in dims]:
            raise ValueError(f"guarded: no sensor {unknown[0]!r}; this model has {sorted(dims)}")
        count = len(_members(self.groups, belief.factor.shape[0]))
        without = {name: m for name, m in dims.items() if name not in self.assumed}
        states = self.filter.init(belief, dims), self.reference.init(belief, without)
        none, excess = jnp.zeros(count), jnp.full(count, 0.0 if self.trusted else _SURE * SLACK)
        return _given_out(GuardMemory(*states, none, excess, none, none, jnp.zeros((), int)))

    def taken_over(self, watch: GuardMemory) -> FilterState:
        """The filter gone on from what the reference believes.

        Where both are filters of as many locals, local by local: a joined filter that is reset to
        one belief would have it in every local, and so count it more than once.
        """
        mine, follow = self.filter.members(watch.filter)
        others, _ = self.reference.members(watch.reference)
        if mine and len(mine) == len(others):
            return follow(others, watch.reference.belief)
        return self.filter.reset(watch.filter, watch.reference.belief)

    def judged(self, watch: GuardMemory, failed: Array, renewed: Array | float) -> GuardMemory:
        """Watch after a step, in which the filter may go on from its reference."""
        square, gained = _difference(watch.filter.belief, watch.reference.belief)
        renewed = jnp.broadcast_to(jnp.asarray(renewed), square.shape)
        M = _members(self.groups, len(square))
        fresh = M @ (renewed * (square - self.ratio * gained - SLACK))
        evidence = jnp.maximum(watch.evidence + fresh, 0.0)
        sure = failed | ((M @ (square > self.leap**2).astype(float)) > 0.0)
        wrong = jnp.any(sure | (evidence > self.limit))
        mean = M / np.sum(M, axis=1, keepdims=True)
        return self.learnt(watch, mean, renewed, square, gained, sure)._replace(
            filter=select(wrong, self.taken_over(watch), watch.filter),
            evidence=jnp.where(wrong, 0.0, evidence),
            trips=watch.trips + wrong.astype(int),
        )

    def learnt(
        self,
        watch: GuardMemory,
        mean: np.ndarray,
        renewed: Array,
        square: Array,
        gained: Array,
        sure: Array,
    ) -> GuardMemory:
        """The sums after a step, each by group: a mean over its components."""
        looks = mean @ renewed
        # One clock for all, or a group that no judge sees would never forget.
        kept = jnp.exp(-jnp.max(looks) / self.patience)
        gain = kept * watch.gained + mean @ (renewed * gained)
        looks = kept * watch.looks + looks
        excess = jnp.minimum(square, _SURE) * (2.0 / self.ratio) - gained
        excess = kept * watch.excess + mean @ (renewed * excess)
        most = _SURE * (gain + SLACK * jnp.maximum(looks, 1.0))
        return watch._replace(excess=jnp.where(sure, most, excess), gained=gain, looks=looks)

    def renewed(self, sensor: Sensor, before: Belief, after: Belief, dof: Array) -> Array | float:
        """Share of what the reference knows that a measurement of a judge renewed."""
        if sensor.name not in self.judging:
            return 0.0
        was, now = before.sigma, after.sigma
        share = jnp.clip(1.0 - _quotient(now**2, was**2), 0.0, 1.0)
        return jnp.where((dof > 0) & (was > 0.0), share, 0.0)

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        watch: GuardMemory = state.memory
        mine, first = self.filter.predict(watch.filter, motion, u)
        other, second = self.reference.predict(watch.reference, motion, u)
        # Without its reference a filter cannot be judged: they take a step together.
        together = second.code == int(Code.DONE)
        moved = watch._replace(filter=select(together, mine, watch.filter), reference=other)
        new = _given_out(self.judged(moved, together & (first.code != int(Code.DONE)), 0.0))
        return new, Prediction(None, new.belief, second.code)

    def _update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data) -> Updated:
        watch: GuardMemory = state.memory
        mine, info = self.filter.update(watch.filter, sensor, y, aux)
        notes, failed = dict(info.notes), is_failure(info.code)
        both = watch._replace(filter=mine)
        if sensor.name in self.assumed:
            renewed, other = 0.0, _not_believed(info)
        else:
            reference, other = self.reference.update(watch.reference, sensor, y, aux)
            both = both._replace(reference=reference)
            before, after = watch.reference.belief, reference.belief
            renewed = self.renewed(sensor, before, after, other.dof)
            failed = failed & ~is_failure(other.code)
            notes |= {f"reference.{name}": value for name, value in other.notes.items()}
        new = self.judged(both, failed, renewed)
        said = select(watch.weight >= 0.5, info._replace(notes={}), other._replace(notes={}))
        notes["guarded.weight"] = new.weight
        notes["guarded.evidence"] = jnp.max(new.evidence) / self.limit
        notes["guarded.trips"] = new.trips
        return _given_out(new), said._replace(notes=notes)

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        watch: GuardMemory = state.memory
        mine = self.filter.reset(watch.filter, belief)
        other = self.reference.reset(watch.reference, belief)
        return _given_out(watch._replace(filter=mine, reference=other))


def guarded(
    filter: Filter,
    reference: Filter,
    assumption: str | Sequence[str],
    judges: str | Sequence[str],
    groups: Groups | None = None,
    ratio: Number = 2.0,
    limit: Number = 8.0,
    patience: Number = 5.0,
    leap: Number = 6.0,
    trusted: bool = True,
) -> Filter:
    """A filter under an assumption, weighed against one without by the error learnt of it.

    The belief lies between those of ``filter`` and of ``reference``, which never sees the sensors
    of the assumption, by the weight w of the worst group (module docstring); without evidence
    against the assumption it is that of ``filter``. What was learnt is forgotten to 1/e in
    ``patience`` looks. The filter goes on from the reference's belief when the evidence of a group
    of states exceeds its limit, when a component is further off than ``leap`` deviations of the
    reference, or when it cannot take a step that the reference can; by the last two its weight
    falls at once.

    The test is of harm to the estimate, and relies on the reference's covariance: where that is
    overconfident (NEES per state above one) a ratio larger by that makes up for it.

    Args:
        filter: believes the assumption.
        reference: does without; of the same state. Each may be a filter of filters.
        assumption: sensors that the reference does not use.
        judges: sensors that both use and that are beyond question.
        groups: tangent components judged together, by their sum, such as ``[(3, 4), (6, 7)]``:
            faster than one by one, the default. Others are not watched.
        ratio: how many times what it should be a squared difference may be on average before the
            filter goes on from its reference, which then is as good as it; half of it is what is
            expected under a right assumption.
        limit: of the evidence. Small: quick; large: rarely wrong.
        patience: looks in which the learnt error is forgotten.
        leap: deviations of the reference that no difference exceeds by chance; `inf` to leave out.
        trusted: whether the assumption is taken to be right at the start.

    Raises:
        ValueError: a sensor is on both sides, no judge or no assumption is named, a group is empty
            or a parameter is not of its range; at `init`, the model has no sensor of such a name,
            or the state no such component.
    """
    assumed, judging = _two_sides(assumption, judges)
    named = groups is None or (len(groups) > 0 and all(len(one) > 0 for one in groups))
    require(named, "guarded groups must each name a component", groups)
    return Guarded(
        filter=filter,
        reference=reference,
        ratio=number("guarded ratio must be at least 1", ratio, lambda x: x >= 1.0),
        limit=_positive("limit", limit),
        patience=_positive("patience", patience),
        leap=_positive("leap", leap),
        assumed=assumed,
        judging=judging,
        groups=None if groups is None else tuple(map(tuple, groups)),
        trusted=trusted,
    )


def _positive(name: str, given: Number) -> Numbers:
    return number(f"guarded {name} must be positive", given, lambda x: x > 0.0)


def _two_sides(
    assumption: str | Sequence[str], judges: str | Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the sensors of the assumption and of the judges; no sensor may be both."""
    assumed = sensor_names("guarded assumption", assumption)
    judging = sensor_names("guarded judges", judges)
    both = sorted(set(assumed) & set(judging))
    require(not both, f"guarded: {both} cannot judge, it belongs to the assumption")
    return assumed, judging


def _given_out(watch: GuardMemory) -> FilterState:
    w, mine, other = watch.weight, watch.filter.belief, watch.reference.belief
    mean = manifold.retract(other.mean, w * manifold.local(other.mean, mine.mean))
    # (1 - f) P_u + f P_c; f is above 0 and at most 1 - SLACK
    f = w * (2.0 - w * (1.0 + watch.beta + SLACK))
    factor = linalg.tria(jnp.sqrt(1.0 - f) * other.factor, jnp.sqrt(f) * mine.factor)
    return FilterState(Belief(select(w < 1.0, mean, mine.mean), factor), watch)


def _quotient(a: Array, b: Array) -> Array:
    """The ratio, or 0 where b is 0: what the reference knows exactly is not in question."""
    some = b > 0.0
    return jnp.where(some, a / jnp.where(some, b, 1.0), 0.0)


def _difference(mine: Belief, other: Belief) -> tuple[Array, Array]:
    """T and v of each tangent component."""
    variance = other.sigma**2
    square = _quotient(manifold.local(other.mean, mine.mean) ** 2, variance)
    gained = jnp.maximum(1.0 - _quotient(mine.sigma**2, variance), 0.0)
    return square, gained


def _members(groups: Groups | None, n: int) -> np.ndarray:
    """(groups, n) ones where a component belongs to a group."""
    if groups is None:
        return np.eye(n)
    M = np.zeros((len(groups), n))
    for row, members in zip(M, groups, strict=True):
        if any(not 0 <= i < n for i in members):
            raise ValueError(f"guarded: group {list(members)} is not of a state of {n} components")
        row[list(members)] = 1.0
    return M


def _not_believed(info: StepInfo) -> StepInfo:
    """Report of a measurement that did not change the belief given out."""
    missing = info.code == int(Code.MISSING)
    return info._replace(
        factor=jnp.eye(len(info.used)),
        gain=jnp.zeros_like(info.gain),
        used=jnp.zeros_like(info.used),
        nis=jnp.zeros_like(info.nis),
        dof=jnp.zeros_like(info.dof),
        log_likelihood=jnp.zeros_like(info.log_likelihood),
        code=jnp.where(missing, info.code, int(Code.REFUSED)),
        notes={},
    )
