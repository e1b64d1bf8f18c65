"""Strong tracking: fading of the prior when innovations are larger than the filter expects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.filters.belief import Belief, Number, StepInfo
from robins.filters.checks import one_of
from robins.filters.linearise import Transition, of_width
from robins.filters.observation import Observation
from robins.filters.rule import Rule
from robins.filters.rules import _fading
from robins.filters.values import Numbers, is_factor, is_share, kind, number, value

Form = Literal["outside", "lumped", "multiple", "projected"]
Power = Literal["classic", "ewma"]


class _StrongTrackingMemory(NamedTuple):
    power: dict[str, Array]  # (m,) averaged squares of each sensor's whitened residuals
    begun: dict[str, Array]  # (m,) bool: the average has a first value
    moved: Array  # (n, 2n + 1) factor of F P F' + Omega
    noise: Array  # (n, n) factor of Q
    fresh: Array  # () bool: no measurement has been used since the prediction


@value
class StrongTracking(Rule):
    """Rule of `strong_tracking`: lambda = max(1, tr N / tr M) times the covariance of its form."""

    keep: Numbers  # () share of V that is kept
    beta: Numbers  # () weakening factor of R
    sigmas: Numbers | None  # () threshold of V, in standard deviations; None: no test
    limit: Numbers  # () greatest lambda
    weights: Numbers | None  # (n,) a_j, the greatest 1
    form: Form = kind()
    power: Power = kind()

    name = "strong_tracking"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> _StrongTrackingMemory:
        n = belief.factor.shape[0]
        _fading.check_size("strong_tracking", self.weights, belief)
        return _StrongTrackingMemory(
            power={name: jnp.ones(m) for name, m in dims.items()},
            begun={name: jnp.full(m, self.power != "classic") for name, m in dims.items()},
            moved=jnp.zeros((n, 2 * n + 1)),
            noise=jnp.zeros((n, n)),
            fresh=jnp.array(False),
        )

    def process(self, memory: _StrongTrackingMemory, transition: Transition):
        if self.form != "outside":
            return memory, transition
        moved = jnp.concatenate([transition.spread, transition.excess], axis=1)
        moved = of_width(moved, memory.moved.shape[1])
        noise = of_width(transition.noise, len(transition.noise))
        return memory._replace(moved=moved, noise=noise, fresh=jnp.array(True)), transition

    def before(self, memory: _StrongTrackingMemory, prior: Belief, o: Observation):
        white = _fading.whitened(o)
        V, begun = memory.power[o.sensor], memory.begun[o.sensor]
        first = white.counts & ~begun
        V = jnp.where(first, white.residual**2, _fading.averaged(V, white, self.keep))
        total = _fading.total(V, white)
        N = total - self.beta * white.dof
        if self.sigmas is not None:
            N = jnp.where(_fading.significant(total, white, self.keep, self.sigmas), N, 0.0)
        if self.form == "outside":
            S, factor = _faded_outside(memory, prior.factor, white, N, self.limit)
        else:
            S, factor = _fading.faded(prior.factor, white, N, self.form, self.weights, self.limit)
        memory = memory._replace(
            power={**memory.power, o.sensor: V},
            begun={**memory.begun, o.sensor: begun | white.counts},
        )
        return memory, Belief(prior.mean, S), o.noted(self.name, lambda_=factor)

    def after(
        self, memory: _StrongTrackingMemory, posterior: Belief, info: StepInfo, o: Observation
    ):
        return memory._replace(fresh=memory.fresh & ~jnp.any(info.used)), posterior, info


def strong_tracking(
    rho: Number = 0.95,
    beta: Number = 1.0,
    form: Form = "outside",
    power: Power = "classic",
    threshold: Number | None = None,
    limit: Number = 1e3,
    weights: _fading.Weights = None,
) -> Rule:
    r"""Fade the prior so that the innovation is as large as expected (Zhou & Frank 1996).

    With r, H whitened by R^-1/2, so that the traces add numbers without unit,

        V = r r' at first, then (rho V + r r') / (1 + rho)
        lambda = max(1, tr N / tr M)

        form       N                    tr M                   prior becomes
        outside    V - H Q H' - beta R  tr H F P F' H'         lambda F P F' + Q
        lumped     V - beta R           tr H P H'              lambda P
        multiple   V - beta R           sum_j a_j (P H' H)_jj  Lam^1/2 P Lam^1/2
        projected  V - beta R           tr H P H'              P + (lambda-1) P H' (H P H')^+ H P

    with Lam_j = max(1, a_j lambda). The outside form is that of the paper; lumped fades Q too;
    projected widens only the measured components, so that nothing else grows without bound. Sigma
    points are drawn from the faded prior, which for linear h equals scaling Pxz and Pzz - R. After
    the first sensor used in a step the outside form is the same as lumped.

    The classic V has keep = rho / (1 + rho) <= 1/2: it averages about two samples, and lambda
    follows the noise. ``power="ewma"`` has keep = rho, starts at R, and fades only if
    tr V > (1 + threshold sqrt(2 (1 - keep) / ((1 + keep) m))) tr(H P H' + R).

    Notes: ``strong_tracking.lambda``, for multiple the greatest. Components missing, refused or
    without noise do not count. The Kalman filter is ``limit=1`` or ``threshold=inf``.

    Args:
        rho: forgetting factor of V, in (0, 1].
        beta: weakening factor of R, at least 1.
        form: covariance that is faded, as in the table.
        power: "classic" or "ewma" average of V.
        threshold: standard deviations of the test; None is 3 for "ewma", no test for "classic".
        limit: upper bound of lambda, at least 1.
        weights: (n,) a_j >= 0 of the states for "multiple"; None: equal, which is lumped.

    Raises:
        ValueError: an argument is out of its range; at `init`, weights is not one number per state.
    """
    kept = number("strong_tracking rho must lie in (0, 1]", rho, is_share)
    one_of("strong_tracking form", form, Form)
    one_of("strong_tracking power", power, Power)
    sigmas = 3.0 if threshold is None and power == "ewma" else threshold
    negative = "strong_tracking threshold must not be negative"
    return StrongTracking(
        keep=kept / (1.0 + kept) if power == "classic" else kept,
        beta=number("strong_tracking beta must be at least 1 and finite", beta, is_factor),
        sigmas=None if sigmas is None else number(negative, sigmas, lambda t: t >= 0.0),
        limit=number("strong_tracking limit must be at least 1 and finite", limit, is_factor),
        weights=_fading.checked_weights("strong_tracking", weights, form),
        form=form,
        power=power,
    )


def _faded_outside(
    memory: _StrongTrackingMemory,
    S: Array,
    white: _fading.WhitenedInnovation,
    N: Array,
    limit: Numbers,
) -> tuple[Array, Array]:
    """Factor of P + (lambda - 1) F P F' = lambda F P F' + Q, or lambda P unless fresh; lambda."""
    n = len(S)
    whole = jnp.concatenate([S, jnp.zeros((n, memory.moved.shape[1] - n))], axis=1)
    moved = jnp.where(memory.fresh, memory.moved, whole)
    noise = jnp.where(memory.fresh, memory.noise, 0.0)
    H = _fading.seen_by(white.spread, S)
    M = jnp.sum((H @ moved) ** 2) + white.left_over
    factor = _fading.fading_factor(N - jnp.sum((H @ noise) ** 2), M, limit)
    more = factor > 1.0
    gain = jnp.sqrt(jnp.where(more, factor - 1.0, 1.0))
    return jax.lax.cond(more, lambda: linalg.tria(S, gain * moved), lambda: S), factor
