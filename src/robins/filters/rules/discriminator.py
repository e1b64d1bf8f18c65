"""Distinguish outliers from model errors by their duration: reweigh the former, fade the latter.

An average V of squared innovations indicates a model error if it exceeds a factor times its
expectation. Chance alone exceeds that factor in a whole run with about the probability
``false_alarm``: it is the quantile of such an average (`chance_levels` in
`robins.filters.rules._fading`) at false_alarm / looks for each of the run's ``looks`` (Bonferroni).
Since consecutive averages are correlated, false alarms are three to four times rarer than stated
with rho = 0.98; with rho = 0.9 they are 1.3 times as many. With a ``threshold`` the factor is
1 + threshold sqrt(2 (1 - rho) / ((1 + rho) m)).
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.filters.belief import Belief, Number
from robins.filters.checks import one_of
from robins.filters.chi_square import MOST, limits, within
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Rule
from robins.filters.rules import _fading
from robins.filters.rules._robust import HARDLY, scale_to_quantile, weighed, widened_to_dof
from robins.filters.values import Numbers, is_factor, is_probability, is_share, kind, number, value

Fade = Literal["projected", "multiple"]
Robust = Literal["huber", "gate"]

# Threshold of the original specification [standard deviations]; in nine of ten runs of 6000
# measurements chance exceeds it.
PUBLISHED = 3.0


class DiscriminatorVerdict(IntEnum):
    """Classification of a measurement, noted as ``discriminator.state``."""

    CLEAN = 0
    OUTLIER = 1
    MODEL = 2


class _DiscriminatorMemory(NamedTuple):
    power: dict[str, Array]  # (m,) averaged squares of each sensor's whitened residuals
    counter: dict[str, Array]  # () measurements in a row that were too large to be chance


@value
class Discriminator(Rule):
    """Rule of `discriminator`: it counts c innovations in a row with r' S^-1 r > k2."""

    patience: Numbers  # () measurements in a row
    quantile: Numbers  # (MOST + 1,) k2 by the number of components used
    rho: Numbers  # () forgetting factor of V
    levels: Numbers  # (MOST + 1,) limit of tr V over its expectation, by number of components
    limit: Numbers  # () greatest lambda
    weights: Numbers | None  # (n,) a_j, the greatest 1
    fade: Fade = kind()
    robust: Robust = kind()

    name = "discriminator"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> _DiscriminatorMemory:
        _fading.check_size(self.name, self.weights, belief)
        power = {name: jnp.ones(m) for name, m in dims.items()}
        return _DiscriminatorMemory(power, {name: jnp.zeros((), int) for name in dims})

    def before(self, memory: _DiscriminatorMemory, prior: Belief, o: Observation):
        seen = normalised(o)
        quantile = within(self.quantile, o.residual)[seen.dof]
        longer = jnp.where(seen.nis > quantile, memory.counter[o.sensor] + 1, 0)
        count = jnp.where(seen.dof == 0, memory.counter[o.sensor], longer)
        row, some = count.astype(float), seen.dof > 0
        outlier = some & (count > 0) & (row < self.patience)
        opens = some & (row == self.patience) & (seen.nis * HARDLY > quantile)
        stands, white = outlier | opens, _fading.whitened(o)
        power = memory.power[o.sensor]
        power = jnp.where(stands, power, _fading.averaged(power, white, self.rho))
        total = _fading.total(power, white)
        level = within(self.levels, white.residual)[white.dof.astype(int)]
        excess = ~stands & _fading.exceeds(total, white, level)
        N = jnp.where(excess, total - white.dof, 0.0)
        S, factor = _fading.faded(prior.factor, white, N, self.fade, self.weights, self.limit)
        S = widened_to_dof(opens, Belief(prior.mean, S), o, seen).factor
        if self.robust == "gate":
            weight = jnp.where(outlier, 0.0, 1.0)
            o = o._replace(accepted=o.accepted & ~outlier)
        else:
            o, weight = weighed(o, jnp.where(outlier, scale_to_quantile(o, quantile, seen), 1.0))
        wrong = (factor > 1.0) | (some & (row >= self.patience))
        state = jnp.where(
            outlier,
            int(DiscriminatorVerdict.OUTLIER),
            jnp.where(wrong, int(DiscriminatorVerdict.MODEL), 0),
        )
        o = o.noted(self.name, weight=weight, lambda_=factor, counter=count, state=state)
        memory = _DiscriminatorMemory(
            {**memory.power, o.sensor: power}, {**memory.counter, o.sensor: count}
        )
        return memory, Belief(prior.mean, S), o


def discriminator(
    patience: int = 30,
    probability: Number = 0.999,
    rho: Number = 0.98,
    fade: Fade = "projected",
    robust: Robust = "huber",
    threshold: Number | None = None,
    limit: Number = 1e3,
    weights: _fading.Weights = None,
    *,
    false_alarm: Number = 0.01,
    looks: Number = 10_000,
) -> Rule:
    r"""Treat short excess of innovations as outliers, lasting excess as model error (own method).

    c counts measurements of a sensor in a row with g = r' S^-1 r above k2, a chi-square quantile.

        0 < c < patience   outlier: R becomes s R with r' (H P H' + s R)^-1 r = k2
                           ("huber"), or the measurement is refused ("gate"); V is unchanged
        c = patience       if g > 100 k2, the prior is widened once until g = m; V is unchanged
        otherwise          V = rho V + (1 - rho) r r', from V = R; if V is significantly above
                           H P H' + R the model is wrong, and the prior is faded by
                           lambda = (tr V - m) / tr H P H'

    with r, H whitened by R^-1/2 as in `strong_tracking`. A sensor fault that lasts ``patience``
    measurements or longer is taken as a model error.

    Notes: ``discriminator.weight`` (1 / s, 0 if refused), ``.lambda``, ``.counter`` (c) and
    ``.state`` (a `DiscriminatorVerdict`: 2 if faded, or c >= patience). Components missing, refused
    before or without noise do not count. ``probability=1, limit=1`` is the Kalman filter.

    Args:
        patience: longest sensor fault in measurements, plus one; with 1 nothing is an outlier.
        probability: share of correct measurements with g <= k2, in (0, 1].
        rho: forgetting factor of V, in (0, 1].
        fade: form of `strong_tracking`. "multiple" adapts faster, but unobserved states may grow.
        robust: treatment of outliers. "gate" is safer if they last long.
        threshold: standard deviations, such as `PUBLISHED`, in place of false_alarm and looks.
        limit: upper bound of lambda, at least 1.
        weights: (n,) a_j >= 0 of the states for "multiple"; None: equal, which fades all of P.
        false_alarm: probability of a false model error in a run, per sensor, in (0, 1).
        looks: number of measurements of a sensor in a run, at least 1.

    Raises:
        ValueError: an argument is out of its range; at `init`, weights is not one number per state.
    """
    keep = number("discriminator rho must lie in (0, 1]", rho, is_share)
    one_of("discriminator fade", fade, Fade)
    one_of("discriminator robust", robust, Robust)
    share = number("discriminator probability must lie in (0, 1]", probability, is_share)
    return Discriminator(
        patience=number("discriminator patience must be at least 1", patience, lambda c: c >= 1.0),
        quantile=limits(share),
        rho=keep,
        levels=_levels(keep, threshold, false_alarm, looks),
        limit=number("discriminator limit must be at least 1 and finite", limit, is_factor),
        weights=_fading.checked_weights("discriminator", weights, fade),
        fade=fade,
        robust=robust,
    )


def _levels(rho: Numbers, threshold: Number | None, false_alarm: Number, looks: Number) -> Numbers:
    """(MOST + 1,) limits of tr V over its expectation, by false_alarm or by a threshold."""
    chance = number("discriminator false_alarm must lie in (0, 1)", false_alarm, is_probability)
    often = number("discriminator looks must be at least 1 and finite", looks, is_factor)
    if threshold is None:
        return _fading.chance_levels(float(rho), MOST, float(chance / often))
    negative = "discriminator threshold must not be negative"
    sigmas = number(negative, threshold, lambda x: x >= 0.0)
    dof = np.maximum(np.arange(MOST + 1.0), 1.0)
    with np.errstate(invalid="ignore"):  # with rho = 1 V is constant and exceeds nothing
        return 1.0 + sigmas * (2.0 * (1.0 - rho) / ((1.0 + rho) * dof)) ** 0.5
