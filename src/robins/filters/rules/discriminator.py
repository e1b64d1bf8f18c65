"""Tell outliers from model errors by how long they last; weigh outliers down, fade for errors."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.checks import one_of
from robins.filters.chi_square import limits, within
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Rule, hooks
from robins.filters.rules import _fading
from robins.filters.rules._robust import (
    is_hopeless,
    scale_to_quantile,
    weighed,
    widened_to_dof,
)

Fade = Literal["projected", "multiple"]
Robust = Literal["huber", "gate"]

# Deviations of the specification; in nine of ten runs of 6000 measurements chance exceeds them.
PUBLISHED = 3.0


class Verdict(IntEnum):
    """What the discriminator takes a measurement for; noted as ``discriminator.state``."""

    CLEAN = 0
    OUTLIER = 1
    MODEL = 2


class _Memory(NamedTuple):
    power: dict[str, Array]  # (m,) averaged squares of each sensor's whitened residuals
    counter: dict[str, Array]  # () measurements in a row that were too large to be chance


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
    r"""Short excess is a fault of the sensor, lasting excess one of the model (a rule of robins).

    g = r' S^-1 r is compared with the chi-square quantile k2 of the components present; c counts
    the measurements of a sensor, one after the other, for which g > k2.

        0 < c < patience   outlier: R becomes s R with r' (H P H' + s R)^-1 r = k2
                           ("huber"), or the measurement is refused ("gate"); V stands
        c = patience       where g > 100 k2 too, the prior is widened until g = m, once (`widened`
                           in `robins.filters.rules._robust`), and V stands
        otherwise          V = rho V + (1 - rho) r r', from V = R; where V is significantly above
                           H P H' + R the model is wrong, and the prior is faded by
                           lambda = (tr V - m) / tr H P H'

    with r, H whitened by R^-1/2 as in `strong_tracking`. "Significantly" is by a factor that chance
    alone exceeds in a whole run with about the probability ``false_alarm``: each of the run's
    ``looks`` may fail with false_alarm / looks (Bonferroni), and the factor is the quantile of such
    an average of squares (`chance_levels` in `robins.filters.rules._fading`). Neighbouring averages
    are nearly the same number, so with rho = 0.98 false alarms are three to four times rarer than
    stated; with rho = 0.9 they are 1.3 times as many. With a ``threshold`` the factor is
    1 + threshold sqrt(2 (1 - rho) / ((1 + rho) m)), as in `strong_tracking`.

    "projected" fades only what the channel sees, P + (lambda-1) P H' (H P H')^+ H P; "multiple"
    fades by weights a_j, Lam^1/2 P Lam^1/2 with Lam_j = max(1, a_j lambda).

    A true change with g > k2 from the start goes unnoticed for ``patience`` measurements, and a
    fault of the sensor that lasts longer is taken for a change of the model: patience is a
    statement about how long the sensor's faults last.

    Notes: ``discriminator.weight`` (1 / s, 0 if refused), ``.lambda``, ``.counter`` (c) and
    ``.state`` (a `Verdict`: 0 clean, 1 outlier, 2 the model is wrong: faded, or c >= patience).
    A component that is missing, refused before or without noise does not change V and c. The
    Kalman filter is ``probability=1`` with ``threshold=inf`` or ``limit=1``.

    Args:
        patience: how many measurements in a row a fault of the sensor may spoil, plus one; 1 knows
            no outliers.
        probability: share of right measurements with g <= k2, in (0, 1].
        rho: forgetting factor of V, in (0, 1].
        fade: which part of the prior is faded. "multiple" adapts faster after a change, but where
            a sensor does not see all that has weight, the unseen grows without bound.
        robust: what is done to outliers. "gate" is safer where they last long.
        threshold: standard deviations by which tr V must exceed what is expected, such as
            `PUBLISHED`; None to have it follow from ``false_alarm`` and ``looks``.
        limit: upper bound of lambda, at least 1.
        weights: (n,) a_j >= 0 of the states for "multiple"; None is all alike, which fades all P.
        false_alarm: probability, in (0, 1), that chance alone is taken for an error of the model at
            some time of a run, for each sensor.
        looks: measurements of a sensor in a run, at least 1.

    Raises:
        ValueError: an argument is out of its range; when the filter starts, if the weights are not
            one a state.
    """
    require(patience >= 1, "discriminator patience must be at least 1", patience)
    require(0.0 < probability <= 1.0, "discriminator probability must lie in (0, 1]", probability)
    require(0.0 < rho <= 1.0, "discriminator rho must lie in (0, 1]", rho)
    one_of("discriminator fade", fade, Fade)
    one_of("discriminator robust", robust, Robust)
    positive = threshold is None or threshold >= 0.0
    require(positive, "discriminator threshold must not be negative", threshold)
    require(0.0 < false_alarm < 1.0, "discriminator false_alarm must lie in (0, 1)", false_alarm)
    require(1.0 <= looks < math.inf, "discriminator looks must be at least 1 and finite", looks)
    require(1.0 <= limit < math.inf, "discriminator limit must be at least 1 and finite", limit)
    a = _fading.checked_weights("discriminator", weights, fade)

    def init(belief: Belief, dims):
        _fading.check_size("discriminator", a, belief)
        power = {name: jnp.ones(m) for name, m in dims.items()}
        return _Memory(power, {name: jnp.zeros((), int) for name in dims})

    def significant(total: Array, white: _fading.White):
        if threshold is not None:
            return _fading.significant(total, white, rho, threshold)
        levels = _fading.chance_levels(float(rho), len(white.residual), false_alarm / looks)
        return _fading.exceeds(total, white, jnp.asarray(levels)[white.dof.astype(int)])

    def before(memory: _Memory, prior: Belief, o: Observation):
        seen = normalised(o)
        # quantile by number of components used; none used is never too much
        quantile = within(limits(probability), o.residual)[seen.dof]
        count, power = memory.counter[o.sensor], memory.power[o.sensor]
        longer = jnp.where(seen.nis > quantile, count + 1, 0)
        count = jnp.where(seen.dof == 0, count, longer)
        outlier = (seen.dof > 0) & (count > 0) & (count < patience)
        opens = (seen.dof > 0) & (count == patience) & is_hopeless(seen, quantile)

        white, stands = _fading.whitened(o), outlier | opens
        power = jnp.where(stands, power, _fading.averaged(power, white, rho))
        total = _fading.total(power, white)
        N = jnp.where(~stands & significant(total, white), total - white.dof, 0.0)
        S, factor = _fading.faded(prior.factor, white, N, fade, a, limit)
        S = widened_to_dof(opens, Belief(prior.mean, S), o, seen).factor

        if robust == "gate":
            weight = jnp.where(outlier, 0.0, 1.0)
            o = o._replace(accepted=o.accepted & ~outlier)
        else:
            s = jnp.where(outlier, scale_to_quantile(o, quantile, seen), 1.0)
            o, weight = weighed(o, s)
        wrong = (factor > 1.0) | ((seen.dof > 0) & (count >= patience))
        state = jnp.where(outlier, int(Verdict.OUTLIER), jnp.where(wrong, int(Verdict.MODEL), 0))
        memory = _Memory(
            {**memory.power, o.sensor: power},
            {**memory.counter, o.sensor: count},
        )
        o = o.noted("discriminator", weight=weight, lambda_=factor, counter=count, state=state)
        return memory, Belief(prior.mean, S), o

    return hooks(init=init, before=before, name="discriminator")
