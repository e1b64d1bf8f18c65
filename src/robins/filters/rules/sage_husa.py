"""Variances of measurement or process noise estimated from the innovations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import manifold
from robins.filters.belief import Belief, Number, StepInfo
from robins.filters.checks import one_of
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.rules import _variances
from robins.filters.values import Numbers, is_known, kind, value


class VarianceScale(NamedTuple):
    """Variances as multiples of the nominal ones, and the number of samples of each."""

    ratio: Array  # (k,) variance over nominal variance
    samples: Array  # (k,) int


class LastStep(NamedTuple):
    """Quantities of a step from which the next one forms a sample of Q."""

    moved: Array  # (n,) diagonal of F P F' + Omega
    nominal: Array  # (n,) diagonal of the model's Q
    posterior: Array  # (n,) diagonal of P after the last update
    correction: Array  # (n,) sum of the corrections of the mean
    measured: Array  # () bool, a component was used


@value
class SageHusa(Rule):
    """Rule of `sage_husa`: R_k and Q_k from moments of the innovation, weighted by age."""

    forgetting: Numbers  # () b
    floor: Numbers  # () least ratio
    ceiling: Numbers  # () greatest ratio
    endless: bool = kind()  # b is 1, for which d_k has another form
    of_sensor: bool = kind()  # estimate R
    of_motion: bool = kind()  # estimate Q

    name = "sage_husa"

    def learnt(self, old: VarianceScale, sample: Array, here: Array) -> VarianceScale:
        """Scale after a sample of the components in the mask ``here``."""
        k, b = (old.samples + 1).astype(float), self.forgetting
        d = 1.0 / (k + 1.0) if self.endless else (1.0 - b) / (1.0 - b ** (k + 1.0))
        new = jnp.clip((1.0 - d) * old.ratio + d * sample, self.floor, self.ceiling)
        return VarianceScale(jnp.where(here, new, old.ratio), old.samples + here.astype(int))

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        n = belief.factor.shape[0]

        def nominal(k: int) -> VarianceScale:
            return VarianceScale(jnp.ones(k), jnp.zeros(k, int))

        sensors = {name: nominal(m) for name, m in dims.items()} if self.of_sensor else {}
        nothing = jnp.zeros(n)
        last = LastStep(nothing, nothing, nothing, nothing, jnp.zeros((), bool))
        return sensors, (nominal(n), last) if self.of_motion else ()

    def process(self, memory: Memory, transition: Transition):
        if not self.of_motion:
            return memory, transition
        sensors, (scale, last) = memory
        sample = _variances.ratio(last.correction**2 + last.posterior - last.moved, last.nominal)
        scale = self.learnt(scale, sample, last.measured & (last.nominal > 0.0))
        moved = _variances.variance(transition.spread) + _variances.variance(transition.excess)
        if transition.deficit is not None:
            moved = moved - transition.deficit**2
        nominal, nothing = _variances.variance(transition.noise), jnp.zeros_like(moved)
        last = LastStep(moved, nominal, nothing, nothing, jnp.zeros((), bool))
        noise = _variances.scaled(transition.noise, scale.ratio)
        return (sensors, (scale, last)), transition._replace(noise=noise)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        if not self.of_sensor:
            return memory, prior, o
        sensors, motion = memory
        R = _variances.variance(o.noise)
        here = o.accepted & o.present & (R > 0.0)
        e = jnp.where(here, o.residual, 0.0)
        sample = _variances.ratio(e**2 - _variances.reading_variance(o), R)
        scale = self.learnt(sensors[o.sensor], sample, here)
        o = o._replace(noise=_variances.scaled(o.noise, scale.ratio))
        return ({**sensors, o.sensor: scale}, motion), prior, o

    def after(self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        sensors, motion = memory
        notes = dict(info.notes)
        if self.of_sensor:
            notes |= _variances.numbered("sage_husa.r_scale", sensors[o.sensor].ratio)
        if self.of_motion:
            scale, last = motion
            notes |= _variances.numbered("sage_husa.q_scale", scale.ratio)
            last = last._replace(
                posterior=_variances.variance(posterior.factor),
                correction=last.correction + manifold.local(o.prior.mean, posterior.mean),
                measured=last.measured | jnp.any(info.used),
            )
            motion = scale, last
        return (sensors, motion), posterior, info._replace(notes=notes)


def sage_husa(
    forgetting: Number = 0.98,
    adapt: Literal["R", "Q", "QR"] = "R",
    floor: Number = 0.1,
    ceiling: Number = 10.0,
) -> Rule:
    """Noise variances from moments of the innovation (Sage & Husa 1969), weighted by age.

    With e the innovation, P- the predicted covariance, b the forgetting factor and k = 1, 2, ...
    the samples of a component:

        d_k = (1 - b) / (1 - b^(k+1))
        R_k = (1 - d_k) R_(k-1) + d_k diag(e e' - H P- H')               used in update k
        Q_k = (1 - d_k) Q_(k-1) + d_k diag(K e e' K' + P+ - F P F')      used in prediction k + 1

    The argument of diag may be negative, so only variances are estimated (the nominal correlations
    are kept), and each is clipped to [floor, ceiling] times its nominal value after every sample.
    The nominal values are those of the model at that step; for R, the noise after earlier rules: so
    put a gate before this rule, and weights of single samples after it. A component that is missing
    or refused does not count.

    R and Q are not identifiable together from e: either explains an innovation that is too large.
    "QR" is for comparison with papers; use "R", or "Q" if the noise of the sensor is known. With
    "R" a motion error is taken as sensor noise, and the filter then ignores the sensor.

    Notes, one number per component: ``sage_husa.r_scale.i`` and ``sage_husa.q_scale.i``, the ratios
    in use. floor = ceiling = 1 is the Kalman filter, bit for bit.

    Args:
        forgetting: b, in (0, 1]: about 1 / (1 - b) samples are remembered, 1 remembers all.
        adapt: noise to estimate, "R", "Q" or "QR".
        floor: least variance, as a share of the nominal one.
        ceiling: greatest variance, as a multiple of the nominal one.

    Raises:
        ValueError: a parameter is out of its range.
    """
    known = _variances.bounded("sage_husa", forgetting, floor, ceiling)
    one_of("sage_husa adapt", adapt, ("R", "Q", "QR"))
    return SageHusa(
        **known,
        endless=is_known(forgetting) and bool(np.all(forgetting == 1.0)),
        of_sensor="R" in adapt,
        of_motion="Q" in adapt,
    )
