"""Tell outliers from model errors by how long they last; weigh outliers down, fade for errors."""

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
from robins.filters.observation import Normalised, Observation, normalised
from robins.filters.rule import Rule
from robins.filters.rules import _fading
from robins.filters.rules._robust import (
    is_hopeless,
    scale_to_quantile,
    weighed,
    widened_to_dof,
)
from robins.filters.values import Numbers, kind, number, value

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


@value
class Discriminator(Rule):
    """The rule of `discriminator`: c innovations in a row, r' S^-1 r > k^2 of each."""

    patience: Numbers  # () measurements in a row
    quantile: Numbers  # (most + 1,) k^2 by the number of components used
    rho: Numbers  # ()
    levels: Numbers  # (most + 1,) of tr V over what is expected, by the number that count
    limit: Numbers  # () of lambda
    weights: Numbers | None  # (n,) a_j, greatest 1
    fade: Fade = kind()
    robust: Robust = kind()

    name = "discriminator"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> _Memory:
        _fading.check_size(self.name, self.weights, belief)
        power = {name: jnp.ones(m) for name, m in dims.items()}
        return _Memory(power, {name: jnp.zeros((), int) for name in dims})

    def before(self, memory: _Memory, prior: Belief, o: Observation):
        seen = normalised(o)
        # quantile by number of components used; none used is never too much
        quantile = within(self.quantile, o.residual)[seen.dof]
        longer = jnp.where(seen.nis > quantile, memory.counter[o.sensor] + 1, 0)
        count = jnp.where(seen.dof == 0, memory.counter[o.sensor], longer)
        row, some = count.astype(float), seen.dof > 0
        outlier = some & (count > 0) & (row < self.patience)
        opens = some & (row == self.patience) & is_hopeless(seen, quantile)
        power, S, factor = self.faded(outlier | opens, memory.power[o.sensor], prior, o)
        S = widened_to_dof(opens, Belief(prior.mean, S), o, seen).factor
        o, weight = self.weighed(outlier, quantile, o, seen)
        wrong = (factor > 1.0) | (some & (row >= self.patience))
        state = jnp.where(outlier, int(Verdict.OUTLIER), jnp.where(wrong, int(Verdict.MODEL), 0))
        o = o.noted(self.name, weight=weight, lambda_=factor, counter=count, state=state)
        memory = _Memory(
            {**memory.power, o.sensor: power},
            {**memory.counter, o.sensor: count},
        )
        return memory, Belief(prior.mean, S), o

    def faded(self, stands: Array, power: Array, prior: Belief, o: Observation):
        """V, the prior's factor, and lambda; as they were where V stands."""
        white = _fading.whitened(o)
        power = jnp.where(stands, power, _fading.averaged(power, white, self.rho))
        total = _fading.total(power, white)
        level = within(self.levels, white.residual)[white.dof.astype(int)]
        wrong = ~stands & _fading.exceeds(total, white, level)
        N = jnp.where(wrong, total - white.dof, 0.0)
        S, factor = _fading.faded(prior.factor, white, N, self.fade, self.weights, self.limit)
        return power, S, factor

    def weighed(
        self, outlier: Array, quantile: Array, o: Observation, seen: Normalised
    ) -> tuple[Observation, Array]:
        """The measurement and its weight: less, or none, of an outlier."""
        if self.robust == "gate":
            weight = jnp.where(outlier, 0.0, 1.0)
            return o._replace(accepted=o.accepted & ~outlier), weight
        return weighed(o, jnp.where(outlier, scale_to_quantile(o, quantile, seen), 1.0))


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
    lasting = number("discriminator patience must be at least 1", patience, lambda c: c >= 1.0)
    share = "discriminator probability must lie in (0, 1]"
    quantile = limits(number(share, probability, _is_share))
    keep = number("discriminator rho must lie in (0, 1]", rho, _is_share)
    one_of("discriminator fade", fade, Fade)
    one_of("discriminator robust", robust, Robust)
    if threshold is not None:
        negative = "discriminator threshold must not be negative"
        threshold = number(negative, threshold, lambda x: x >= 0.0)
    rare = "discriminator false_alarm must lie in (0, 1)"
    chance = number(rare, false_alarm, lambda p: (p > 0.0) & (p < 1.0))
    often = number("discriminator looks must be at least 1 and finite", looks, _is_finite)
    return Discriminator(
        patience=lasting,
        quantile=quantile,
        rho=keep,
        levels=_levels(keep, threshold, chance / often),
        limit=number("discriminator limit must be at least 1 and finite", limit, _is_finite),
        weights=_fading.checked_weights("discriminator", weights, fade),
        fade=fade,
        robust=robust,
    )


def _is_share(x: Numbers) -> Numbers:
    return (x > 0.0) & (x <= 1.0)


def _is_finite(x: Numbers) -> Numbers:
    return (x >= 1.0) & (x < np.inf)


def _levels(rho: Numbers, threshold: Numbers | None, chance: Numbers) -> Numbers:
    """(MOST + 1,) of what tr V exceeds by chance alone, or by a threshold of deviations."""
    if threshold is None:
        return _fading.chance_levels(float(rho), MOST, float(chance))
    dof = np.maximum(np.arange(MOST + 1.0), 1.0)
    with np.errstate(invalid="ignore"):  # V that never moves exceeds nothing
        return 1.0 + threshold * (2.0 * (1.0 - rho) / ((1.0 + rho) * dof)) ** 0.5
