"""H-infinity filter: a Kalman update, an inflation, a prediction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins import manifold
from robins.errors import RobinsError, require
from robins.filters import trees
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.checks import one_of
from robins.filters.kalman import Filter
from robins.filters.linearise import Transition
from robins.filters.model import Data, Given
from robins.filters.observation import Observation
from robins.filters.rule import Again, Rule
from robins.filters.rules import _inflation
from robins.filters.rules._inflation import GivenWeight, Weight, inflated, local_bound
from robins.filters.values import Numbers, is_known, is_probability, kind, number, value
from robins.manifold import State

Policy = Literal["raise", "raise_gamma", "compensate"]
Estimate = Literal["a-posteriori", "a-priori", "predictor"]

NAME = "h_infinity"
F = TypeVar("F", bound=Filter)


class Infeasible(RobinsError, ValueError):
    """No H-infinity filter exists for the given gamma.

    Attributes:
        step: row of the measurements, from 0, after which no filter exists; in a stream, the number
            of predictions before it minus one.
        time_s: time of that step [s], or None if times are not known.
        gamma: the given bound.
        local_bound: sqrt(lambda_max(L P L')) there, which gamma must exceed.
        gamma_min: least gamma for the whole run, or None if it cannot be run again.
    """

    def __init__(
        self,
        step: int,
        time_s: float | None,
        gamma: float,
        local_bound: float,
        gamma_min: float | None,
    ):
        self.step, self.time_s, self.gamma = step, time_s, gamma
        self.local_bound, self.gamma_min = local_bound, gamma_min
        when = "" if time_s is None else f" (t = {time_s:g} s)"
        overall = "" if gamma_min is None else f"; the whole run needs gamma = {gamma_min:.6g}"
        super().__init__(
            f"no H-infinity filter with gamma = {gamma:.6g} exists at step {step}{when}: the local "
            f"bound sqrt(lambda_max(L P L')) is {local_bound:.6g} there{overall}",
            fix="give a larger gamma, or policy='raise_gamma' or 'compensate'; gamma has the units "
            "of L x over those of whitened noise, so look at the units of weight, R and P0 too",
        )


class HInfinityMemory(NamedTuple):
    """Memory of `h_infinity`."""

    steps: Array  # () number of predictions
    fresh: Array  # () bool, no update since the prediction
    measured: Array  # () bool, a component was used since the prediction
    predicted: State  # predicted mean; () if the estimate does not need it
    weighted: Array  # (q, n) L S of the existence test of the last step
    events: Array  # () number of steps in which the policy acted or the filter did not exist
    first: Array  # () the first of these steps; -1: none
    weighted_first: Array  # (q, n) L S in that step


def least_gamma(exists: Callable[[float], bool], lower: float, rtol: float = 1e-4) -> float:
    """Least feasible gamma above a lower bound, within rtol from above, by doubling and bisection.

    Raises:
        ValueError: no gamma up to 2^100 times the lower bound is feasible.
    """
    low, high = lower, 2.0 * lower
    while not exists(high):
        low, high = high, 2.0 * high
        if high > 2.0**100 * lower:
            raise ValueError(f"no gamma up to {high:.3g} exists: the Kalman filter must fail too")
    while high > low * (1.0 + rtol):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if exists(middle) else (middle, high)
    return high


@value
class HInfinity(Rule):
    """Rule of `h_infinity`: P becomes (P^-1 - gamma^-2 L'L)^-1 before a prediction."""

    inverse: Numbers  # () 1 / gamma: 0 is the Kalman filter, and has a finite derivative
    weight: Weight  # (q, n) L, or a function of the mean
    margin: Numbers  # ()
    policy: Policy = kind()
    estimate: Estimate = kind()
    count_missing: bool = kind()

    name = NAME

    def weighted(self, belief: Belief) -> Array:
        """(q, n) L S."""
        return _inflation.weighted_factor(self.weight, belief, NAME)

    def in_force(self, bound: Array) -> Numbers:
        """1 / gamma of this step under the policy."""
        if self.policy != "raise_gamma":
            return self.inverse
        some = jnp.where(bound > 0.0, bound, 1.0)
        raised = jnp.minimum(self.inverse, (1.0 - self.margin) ** 0.5 / some)
        return jnp.where(bound > 0.0, raised, self.inverse)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> HInfinityMemory:
        weighted = self.weighted(belief)
        return HInfinityMemory(
            steps=jnp.zeros((), int),
            fresh=jnp.array(True),
            measured=jnp.array(False),
            predicted=() if self.estimate == "a-posteriori" else belief.mean,
            weighted=weighted,
            events=jnp.zeros((), int),
            first=jnp.array(-1),
            weighted_first=jnp.zeros_like(weighted),
        )

    def process(self, memory: HInfinityMemory, transition: Transition):
        if self.estimate != "a-posteriori":
            memory = memory._replace(predicted=transition.mean)
        return memory, transition

    def before(self, memory: HInfinityMemory, prior: Belief, o: Observation):
        if self.estimate == "a-priori":  # existence depends on the predicted P
            weighted = jnp.where(memory.fresh, self.weighted(prior), memory.weighted)
            memory = memory._replace(weighted=weighted)
        return memory._replace(fresh=jnp.array(False)), prior, o

    def after(self, memory: HInfinityMemory, posterior: Belief, info: StepInfo, o: Observation):
        if self.estimate != "a-priori":
            memory = memory._replace(weighted=self.weighted(posterior))
        memory = memory._replace(measured=memory.measured | jnp.any(info.used))
        # A note, not part of the memory: a run that does not keep it does not compute it.
        bound = local_bound(memory.weighted)
        inverse = self.in_force(bound)
        left = 1.0 - (bound * inverse) ** 2
        notes = {"bound": bound, "gamma": 1.0 / inverse, "margin": left}
        counts = memory.measured | self.count_missing
        if self.policy == "raise_gamma":
            notes["raised"] = counts & (inverse < self.inverse)
        if self.policy == "compensate":
            notes["compensated"] = counts & (left < self.margin)
        return memory, posterior, info.noted(NAME, **notes)

    def settle(self, memory: HInfinityMemory, belief: Belief):
        counts = memory.measured | (self.count_missing & (memory.steps > 0))
        weighted = judged = self.weighted(belief)
        if self.estimate == "a-priori":
            judged = jnp.where(memory.fresh, weighted, memory.weighted)
        inverse, factor, weighted, acted = self.eased(belief, weighted, judged)
        wide, exists = inflated(factor, inverse * weighted)
        if self.estimate == "a-priori":
            exists = exists & inflated(factor, inverse * judged)[1]
        active = counts & exists & (self.inverse > 0.0)
        new = trees.select(active, self.moved(memory, belief, inverse, wide), belief)
        missed = counts & ~exists
        acted = missed | (counts & acted)
        begins = acted & (memory.events == 0)
        memory = memory._replace(
            steps=memory.steps + 1,
            fresh=jnp.array(True),
            measured=memory.measured & missed,
            events=memory.events + acted.astype(int),
            first=jnp.where(begins, memory.steps - 1, memory.first),
            weighted_first=jnp.where(begins, judged, memory.weighted_first),
        )
        return memory, new, jnp.where(missed, int(Code.INFEASIBLE), int(Code.DONE))

    def eased(self, belief: Belief, weighted: Array, judged: Array):
        """1 / gamma, factor and L S under the policy, and () bool: the policy acted."""
        if self.policy == "raise_gamma":
            inverse = self.in_force(local_bound(judged))
            return inverse, belief.factor, weighted, inverse < self.inverse
        if self.policy == "compensate":
            A = self.inverse * weighted
            factor, acted = _inflation.deflated(belief.factor, A, 1.0 - self.margin)
            weighted = self.weighted(belief._replace(factor=factor))
            return self.inverse, factor, weighted, acted
        return self.inverse, belief.factor, weighted, jnp.array(False)

    def moved(
        self, memory: HInfinityMemory, belief: Belief, inverse: Numbers, wide: Array
    ) -> Belief:
        """Belief with the inflated factor, and the mean of the chosen estimate."""
        if self.estimate == "a-posteriori":
            return Belief(belief.mean, wide)
        # P~ L'L d / gamma^2 changes the correction from P H'R^-1 r to P~ H'R^-1 r.
        d = manifold.local(memory.predicted, belief.mean)
        L = inverse * _inflation.rows_of(self.weight, belief.mean, NAME)
        return Belief(manifold.retract(belief.mean, wide @ ((L @ wide).T @ (L @ d))), wide)

    def first_infeasible(
        self, final: HInfinityMemory, before: int = 0, test_last: bool = True
    ) -> tuple[int, Numbers] | None:
        """First step without a filter, and L S there; None if the filter existed throughout.

        ``before`` is the number of events before this run, with perhaps another gamma. If
        ``test_last``, the last step is tested too, from which nothing has been predicted.
        """
        missed = int(final.events) - before
        # Arrays are NumPy arrays in a stream in C and from the interpreter.
        first, weighted = jnp.asarray(final.weighted_first), jnp.asarray(final.weighted)
        if missed > 0 and before == 0:
            return int(final.first), first
        if missed > 0:  # `first` is of an earlier run; after a missed step all are missed
            return int(final.steps) - 1 - missed, weighted
        if not test_last or not final.measured:
            return None
        exists = inflated(jnp.eye(weighted.shape[1]), self.inverse * weighted)[1]
        return None if exists else (int(final.steps) - 1, weighted)

    @property
    def reports(self) -> bool:
        return self.policy == "raise"

    def report(
        self,
        start: HInfinityMemory,
        final: HInfinityMemory,
        again: Again | None,
        time: ArrayLike | None,
    ) -> None:
        """Raise under policy "raise" if the filter did not exist at some step.

        In a stream a step is tested at the next prediction, since more sensors may come until then.

        Raises:
            Infeasible: the filter did not exist.
        """
        if not self.reports:
            return
        before = int(start.events)
        broken = self.first_infeasible(final, before, test_last=again is not None)
        if broken is None:
            return
        step, weighted = broken
        gamma, least = 1.0 / float(self.inverse), None
        if again is not None:
            step -= int(start.steps)

            def exists(one: float) -> bool:
                other = replace(self, inverse=1.0 / np.asarray(one))
                return other.first_infeasible(again(other), before) is None

            least = least_gamma(exists, gamma)
        times = () if time is None else np.asarray(time)
        time_s = float(times[step]) if 0 <= step < len(times) else None
        bound = float(local_bound(jnp.asarray(weighted)))  # a NumPy array in a stream in C
        raise Infeasible(step, time_s, gamma, bound, least)


def h_infinity(
    gamma: Given,
    weight: GivenWeight,
    policy: Policy = "raise",
    estimate: Estimate = "a-posteriori",
    margin: float = 0.05,
    count_missing: bool = False,
) -> HInfinity:
    """Central H-infinity filter (Hassibi, Sayed & Kailath 1999, ch. 4).

    The energy of the estimation error L (x - x_hat), summed over a run, stays below gamma^2 times

        |x0 - x0_hat|^2_{P0^-1} + sum |w_k|^2_{Q^-1} + sum |v_k|^2_{R^-1}

    for all disturbances. After the Kalman updates of a step, and before the next prediction,

        it exists if   lambda_max(L P L') < gamma^2
        P becomes      (P^-1 - gamma^-2 L'L)^-1 = P + P L' (gamma^2 I - L P L')^-1 L P

    in square-root form S N^-T with N N' = I - (L S / gamma)' (L S / gamma): it exists if this has a
    Cholesky factor. A run reports the beliefs before the inflation. P is then no covariance of the
    error: NEES, NIS and chi-square gates do not apply unchanged.

    Notes, after each sensor (those of the last one are for the step): ``h_infinity.bound``,
    sqrt(lambda_max(L P L')); ``.gamma``, the value used under the policy; ``.margin``,
    1 - bound^2 / gamma^2; ``.raised`` or ``.compensated`` under these policies. Derivatives treat a
    raised gamma as constant.

    Args:
        gamma: bound, in units of L x per unit of whitened noise; inf is the Kalman filter, bit for
            bit. `with_gamma` exchanges it.
        weight: L, which maps the state to the error that is bounded: (q, n) matrix, (n,) diagonal,
            or ``mean -> `` one of these. Its units fix those of gamma.
        policy: action if the filter does not exist. "raise": stop predicting, with code
            ``INFEASIBLE``; `run` then raises `Infeasible`. "raise_gamma": use in that step the
            least gamma that leaves ``margin``. "compensate": shrink P in the violating directions
            until ``margin`` is left; the smaller P has no justification in the data.
        estimate: estimate whose error is bounded. "a-posteriori": after the measurement.
            "a-priori": before it, with gain P~ H' R^-1 for the inflated P~; exists where
            lambda_max(L P L') < gamma^2 for the *predicted* P. "predictor": the same gain with the
            test after the measurement (Simon 2006, eq. 11.89 and 11.90), which is weaker and does
            not guarantee the bound.
        margin: value of 1 - bound^2 / gamma^2 that the policies leave, between 0 and 1.
        count_missing: inflate also in steps in which nothing was measured, or all was refused.

    Raises:
        TypeError: gamma or the weight is not of real numbers.
        ValueError: an argument is out of its range, or policy and estimate do not go together.
    """
    inverse = 1.0 / _as_gamma(gamma)
    one_of("h_infinity policy", policy, Policy)
    one_of("h_infinity estimate", estimate, Estimate)
    left = number("margin must lie between 0 and 1", margin, is_probability)
    if estimate == "a-priori" and policy == "compensate":
        raise ValueError(
            "policy='compensate' changes P after the measurement, estimate='a-priori' needs it "
            "before: use 'raise_gamma'"
        )
    L = _inflation.as_weight(weight, NAME)
    return HInfinity(inverse, L, left, policy, estimate, count_missing)


def _as_gamma(gamma: Given) -> Numbers:
    if not is_known(gamma):
        return jnp.asarray(gamma, float)
    value = np.asarray(gamma)
    if value.dtype.kind not in "iuf" or value.ndim:
        raise TypeError(f"gamma must be one real number, got {gamma!r}")
    require(value > 1e-300, f"gamma must be positive, or inf for the Kalman filter; got {gamma}")
    return value.astype(float)


def with_gamma(filter_: F, gamma: Given) -> F:
    """Filter with another gamma in each of its `h_infinity` rules, also in filters it is made of.

    Gamma may be traced, so that a batch of gammas is one `jax.vmap`, without a new compilation. The
    new filter can continue from a state of the old one.

    Raises:
        TypeError: gamma is not one real number.
        ValueError: gamma is not positive, or the filter has no `h_infinity` rule.
    """
    inverse = 1.0 / _as_gamma(gamma)

    def is_rule(part: Data) -> bool:
        return isinstance(part, HInfinity)

    parts, structure = jax.tree_util.tree_flatten(filter_, is_leaf=is_rule)
    none = "this filter has no h_infinity rule whose gamma could be exchanged"
    require(any(map(is_rule, parts)), none)
    put = [replace(one, inverse=inverse) if is_rule(one) else one for one in parts]
    return jax.tree_util.tree_unflatten(structure, put)
