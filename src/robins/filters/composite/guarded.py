r"""Guarded filters: an assumption is weighted by its error, which is estimated online.

A wrong assumption (an exact constraint, air data whose errors are modelled as white) makes the
covariance of a filter too small, so its own residuals do not show the fault. A *reference* filter
without the assumption shows it: if the assumption is right, the estimate x_c that uses it is
efficient, and the covariance of its difference from the reference's x_u is the reduction of the
covariance (Hausman 1978),

    E (x_c - x_u)(x_c - x_u)' = P_u - P_c = G

If the assumption adds an error of covariance B, this becomes G + B, and the best estimate is a
weighted mean (the covariance of the error of x_u and x_c - x_u is -G): with B = beta G

    x = x_u + w (x_c - x_u),   P = P_u - w (2 - w (1 + beta)) G,   w = 1 / (1 + beta)

which is never worse than the reference; a weight above 2 / (1 + beta) would be. P holds for any w,
and is computed with a beta that is larger by the error that the test cannot detect. beta is
estimated from the same differences,

    T_i = (x_c - x_u)_i^2 / P_u,ii        v_i = 1 - P_c,ii / P_u,ii  (not below 0)

whose means are E T_i = (1 + beta) v_i, in sums with exponential forgetting. Differences of
consecutive steps are strongly correlated, so samples are weighted by new information: a measurement
of a *judge*, a sensor that both filters use, renews the share w_i = 1 - P+_u,ii/P-_u,ii of the
reference's knowledge of state i. The sums are counted in such renewals, *looks*. Without
measurements of a judge nothing is renewed, and the weight stays.

A filter that has diverged does not recover by itself when its assumption is right again. So it is
reset to the reference's belief, with beta kept, when it is worse than the reference, B > G. The
evidence for that is summed as in Page's test (1954) for the quickest detection of a change,

    g_i := max(0, g_i + w_i (T_i - ratio v_i - slack)),   g_i > limit
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from robins.filters.rules._variances import ratio
from robins.filters.trees import select
from robins.filters.values import Numbers, kind, number, value

Groups = Sequence[Sequence[int]]

# Negligible harm: a tenth of the reference's variance, 5 % of its standard deviation.
SLACK = 0.1

# A beta up to 1/2 can be chance, in sums over some ten looks. Neglecting it costs at most a sixth
# of G in variance, at beta = 1/2.
_CHANCE = 0.5

# Limit of T: six standard deviations, squared, are conclusive, and more would not be forgotten.
_SURE = 36.0


class GuardMemory(NamedTuple):
    """Memory of a guarded filter."""

    filter: FilterState
    reference: FilterState
    evidence: Array  # (groups,) g
    excess: Array  # (groups,) sum of T - v, mean over the components
    gained: Array  # (groups,) sum of v, mean over the components
    looks: Array  # (groups,) sum of renewals, mean over the components
    trips: Array  # () number of resets of the filter to its reference

    @property
    def beta(self) -> Array:
        """() beta of the worst group, not below 0."""
        beta = self.excess / (self.gained + SLACK * jnp.maximum(self.looks, 1.0))
        return jnp.maximum(jnp.max(beta), 0.0)

    @property
    def weight(self) -> Array:
        """() weight w of the filter."""
        return 1.0 / (1.0 + jnp.maximum(self.beta - _CHANCE, 0.0))


@value
class Guarded(Composite):
    """Filter made by `guarded`.

    The `StepInfo` of an update is that of the filter with the greater weight; if this is the
    reference, a sensor of the assumption is reported as refused. Notes: those of the filter, those
    of the reference as ``reference.`` and their name, ``guarded.weight``, ``guarded.evidence`` (the
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

    held = ("filter", "reference")

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return state.memory[:2]

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        if unknown := [name for name in (*self.assumed, *self.judging) if name not in dims]:
            raise ValueError(f"guarded: no sensor {unknown[0]!r}; this model has {sorted(dims)}")
        count = len(_members(self.groups, belief.factor.shape[0]))
        without = {name: m for name, m in dims.items() if name not in self.assumed}
        states = self.filter.init(belief, dims), self.reference.init(belief, without)
        none, excess = jnp.zeros(count), jnp.full(count, 0.0 if self.trusted else _SURE * SLACK)
        return _given_out(GuardMemory(*states, none, excess, none, none, jnp.zeros((), int)))

    def reset_to_reference(self, watch: GuardMemory) -> FilterState:
        """State of the filter, reset to the belief of the reference.

        If both are joined filters with the same number of locals, each local is reset to its
        counterpart: one belief in all locals would be counted more than once.
        """
        mine, follow = self.filter.members(watch.filter)
        others, _ = self.reference.members(watch.reference)
        if mine and len(mine) == len(others):
            return follow(others, watch.reference.belief)
        return self.filter.reset(watch.filter, watch.reference.belief)

    def judged(self, watch: GuardMemory, failed: Array, renewed: Array | float) -> GuardMemory:
        """Memory after a step, with the filter reset to its reference if the evidence requires."""
        square, gained = _difference(watch.filter.belief, watch.reference.belief)
        renewed = jnp.broadcast_to(jnp.asarray(renewed), square.shape)
        M = _members(self.groups, len(square))
        fresh = M @ (renewed * (square - self.ratio * gained - SLACK))
        evidence = jnp.maximum(watch.evidence + fresh, 0.0)
        sure = failed | ((M @ (square > self.leap**2).astype(float)) > 0.0)
        wrong = jnp.any(sure | (evidence > self.limit))
        mean = M / np.sum(M, axis=1, keepdims=True)
        return self.learnt(watch, mean, renewed, square, gained, sure)._replace(
            filter=select(wrong, self.reset_to_reference(watch), watch.filter),
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
        """Sums after a step, by group, each a mean over its components."""
        looks = mean @ renewed
        # All groups forget at the same rate, else one that no judge observes would never forget.
        kept = jnp.exp(-jnp.max(looks) / self.patience)
        gain = kept * watch.gained + mean @ (renewed * gained)
        looks = kept * watch.looks + looks
        excess = jnp.minimum(square, _SURE) * (2.0 / self.ratio) - gained
        excess = kept * watch.excess + mean @ (renewed * excess)
        most = _SURE * (gain + SLACK * jnp.maximum(looks, 1.0))
        return watch._replace(excess=jnp.where(sure, most, excess), gained=gain, looks=looks)

    def renewed(self, sensor: Sensor, before: Belief, after: Belief, dof: Array) -> Array | float:
        """Share of the reference's information that a measurement of a judge has renewed."""
        if sensor.name not in self.judging:
            return 0.0
        was, now = before.sigma, after.sigma
        share = jnp.clip(1.0 - ratio(now**2, was**2), 0.0, 1.0)
        return jnp.where((dof > 0) & (was > 0.0), share, 0.0)

    def _predict(self, state: FilterState, motion: Motion, u: Data) -> Advanced:
        watch: GuardMemory = state.memory
        mine, first = self.filter.predict(watch.filter, motion, u)
        other, second = self.reference.predict(watch.reference, motion, u)
        # Without its reference the filter cannot be tested: they take a step together.
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
            renewed, other = 0.0, _unused_update(info)
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
    """Combine a filter that uses an assumption with one that does not, weighted by its error.

    The belief lies between those of ``filter`` and of ``reference``, which never uses the sensors
    of the assumption, by the weight w of the worst group (module docstring); without evidence
    against the assumption it is that of ``filter``. The estimated error is forgotten to 1/e in
    ``patience`` looks. The filter is reset to the reference's belief when the evidence of a group
    of states exceeds the limit, when a component differs by more than ``leap`` standard deviations
    of the reference, or when it cannot take a step that the reference can; in the last two cases
    its weight falls at once.

    The test detects harm to the estimate, and relies on the reference's covariance: if that is
    overconfident (NEES per state above one), multiply ``ratio`` by that NEES.

    Args:
        filter: filter that uses the assumption.
        reference: filter of the same state that does not. Each may be a filter of filters.
        assumption: sensors that the reference does not use.
        judges: sensors that both use and that are beyond doubt.
        groups: tangent components tested together, by their sum, such as ``[(3, 4), (6, 7)]``,
            which is faster than testing each component, the default. Others are not tested.
        ratio: mean of T over v (module docstring) above which the filter is reset; half of it is
            the mean expected under a right assumption. At 2 the filter is as bad as the reference.
        limit: limit of the evidence; a small one detects quickly, a large one is rarely wrong.
        patience: time constant of forgetting the estimated error [looks].
        leap: difference that chance does not exceed, in standard deviations of the reference;
            `inf` for none.
        trusted: True if the assumption is taken as right at the start.

    Raises:
        ValueError: a sensor is on both sides, no judge or no assumption is named, a group is empty
            or a parameter is out of its range; at `init`, the model has no sensor of such a name,
            or the state has no such component.
    """
    assumed, judging = _sensors_of_sides(assumption, judges)
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


def _sensors_of_sides(
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


def _difference(mine: Belief, other: Belief) -> tuple[Array, Array]:
    """T and v of each tangent component."""
    variance = other.sigma**2
    square = ratio(manifold.local(other.mean, mine.mean) ** 2, variance)
    gained = jnp.maximum(1.0 - ratio(mine.sigma**2, variance), 0.0)
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


def _unused_update(info: StepInfo) -> StepInfo:
    """Information of a measurement that did not change the reported belief."""
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
