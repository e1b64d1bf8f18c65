"""Strong tracking: fade the past when innovations are larger than the filter expects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg
from robins.filters.belief import Belief, Number, StepInfo
from robins.filters.checks import one_of
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule
from robins.filters.rules import _fading
from robins.filters.values import Numbers, kind, number, value

Form = Literal["outside", "lumped", "multiple", "projected"]
Power = Literal["classic", "ewma"]


class _Memory(NamedTuple):
    power: dict[str, Array]  # (m,) averaged squares of each sensor's whitened residuals
    begun: dict[str, Array]  # (m,) bool: the average has a first value
    moved: Array  # (n, 2n + 1) F S and what its linearisation left over
    noise: Array  # (n, n) factor of Q
    fresh: Array  # () bool: nothing has been used since the prediction


@value
class StrongTracking(Rule):
    """The rule of `strong_tracking`: lambda = max(1, tr N / tr M) times what its form fades."""

    keep: Numbers  # () share of V that is kept
    beta: Numbers  # ()
    sigmas: Numbers | None  # () by which V must exceed what is expected; None asks for nothing
    limit: Numbers  # () greatest lambda
    weights: Numbers | None  # (n,) a_j, the greatest 1
    form: Form = kind()
    power: Power = kind()

    name = "strong_tracking"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> _Memory:
        n = belief.factor.shape[0]
        _fading.check_size("strong_tracking", self.weights, belief)
        return _Memory(
            power={name: jnp.ones(m) for name, m in dims.items()},
            begun={name: jnp.full(m, self.power != "classic") for name, m in dims.items()},
            moved=jnp.zeros((n, 2 * n + 1)),
            noise=jnp.zeros((n, n)),
            fresh=jnp.array(False),
        )

    def process(self, memory: _Memory, transition: Transition):
        if self.form != "outside":
            return memory, transition
        noise = transition.noise
        moved = jnp.concatenate([transition.spread, transition.excess], axis=1)
        moved, noise = _fitted(moved, memory.moved.shape[1]), _fitted(noise, len(noise))
        return memory._replace(moved=moved, noise=noise, fresh=jnp.array(True)), transition

    def before(self, memory: _Memory, prior: Belief, o: Observation):
        white = _fading.whitened(o)
        V, begun = memory.power[o.sensor], memory.begun[o.sensor]
        first = white.counts & ~begun
        V = jnp.where(first, white.residual**2, _fading.averaged(V, white, self.keep))
        S, factor = self.faded(memory, prior.factor, white, self.excess(V, white))
        memory = memory._replace(
            power={**memory.power, o.sensor: V},
            begun={**memory.begun, o.sensor: begun | white.counts},
        )
        return memory, Belief(prior.mean, S), o.noted(self.name, lambda_=factor)

    def excess(self, V: Array, white: _fading.White) -> Array:
        """Tr V less beta times that of R; 0 where V is not large enough."""
        total = _fading.total(V, white)
        N = total - self.beta * white.dof
        if self.sigmas is None:
            return N
        return jnp.where(_fading.significant(total, white, self.keep, self.sigmas), N, 0.0)

    def faded(self, memory: _Memory, S: Array, white: _fading.White, N: Array):
        """The factor S as the form fades it, and lambda."""
        if self.form == "outside":
            return _faded_outside(memory, S, white, N, self.limit)
        return _fading.faded(S, white, N, self.form, self.weights, self.limit)

    def after(self, memory: _Memory, posterior: Belief, info: StepInfo, o: Observation):
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

    with Lam_j = max(1, a_j lambda).

    The outside form is that of the paper; lumped fades Q too; multiple knows which states may have
    moved; projected widens only what the sensor sees, so that nothing else grows without bound.
    Sigma points are drawn anew from the faded prior; where h is linear that is the same as scaling
    Pxz and Pzz - R, the "simplified" form of some papers. ``H P H'`` contains what sigma points
    find left over. Where several sensors follow one prediction, the first that is used knows Q
    apart; the later ones see a posterior, which the outside form fades as lumped does.

    The classic V is an average with the weights of keep = rho / (1 + rho) <= 1/2: it remembers two
    samples, and lambda follows noise. ``power="ewma"`` takes keep = rho, starts at R, and fades
    only when tr V > (1 + threshold sqrt(2 (1 - keep) / ((1 + keep) m))) tr(H P H' + R).

    Notes: ``strong_tracking.lambda``, for multiple the greatest. Components that are
    missing, refused, or without noise of their own leave V and lambda alone. The Kalman filter is
    ``limit=1``, ``threshold=inf`` or beta large enough.

    Args:
        rho: forgetting factor of V, in (0, 1].
        beta: weakening, at least 1: so many R are noise.
        form: which covariance is faded.
        power: how V is averaged.
        threshold: standard deviations by which V must exceed what is expected; None is 3 for
            "ewma", and no test for "classic".
        limit: upper bound of lambda, at least 1.
        weights: (n,) a_j >= 0 of the states for "multiple"; None is all alike (then as lumped).

    Raises:
        ValueError: an argument is out of its range; when the filter starts, if the weights are not
            one a state.
    """
    share = "strong_tracking rho must lie in (0, 1]"
    kept = number(share, rho, lambda r: (r > 0.0) & (r <= 1.0))
    below = "strong_tracking beta must be at least 1 and finite"
    weakened = number(below, beta, lambda b: (b >= 1.0) & (b < np.inf))
    one_of("strong_tracking form", form, Form)
    one_of("strong_tracking power", power, Power)
    sigmas = 3.0 if threshold is None and power == "ewma" else threshold
    negative = "strong_tracking threshold must not be negative"
    below = "strong_tracking limit must be at least 1 and finite"
    return StrongTracking(
        keep=kept / (1.0 + kept) if power == "classic" else kept,
        beta=weakened,
        sigmas=None if sigmas is None else number(negative, sigmas, lambda t: t >= 0.0),
        limit=number(below, limit, lambda x: (x >= 1.0) & (x < np.inf)),
        weights=_fading.checked_weights("strong_tracking", weights, form),
        form=form,
        power=power,
    )


def _faded_outside(memory: _Memory, S: Array, white: _fading.White, N: Array, limit: Numbers):
    """P + (lambda - 1) F P F', which is lambda F P F' + Q; P itself instead of F P F' once used."""
    n = len(S)
    whole = jnp.concatenate([S, jnp.zeros((n, memory.moved.shape[1] - n))], axis=1)
    moved = jnp.where(memory.fresh, memory.moved, whole)
    noise = jnp.where(memory.fresh, memory.noise, 0.0)
    H = _fading.seen_by(white.spread, S)
    M = jnp.sum((H @ moved) ** 2) + white.left_over
    factor = _fading.ratio(N - jnp.sum((H @ noise) ** 2), M, limit)
    more = factor > 1.0
    gain = jnp.sqrt(jnp.where(more, factor - 1.0, 1.0))
    return jax.lax.cond(more, lambda: linalg.tria(S, gain * moved), lambda: S), factor


def _fitted(columns: Array, width: int) -> Array:
    """The same covariance from a factor of so many columns, at least one a row."""
    n, k = columns.shape
    if k > width:
        columns, k = linalg.tria(columns), n
    return jnp.concatenate([columns, jnp.zeros((n, width - k))], axis=1)
