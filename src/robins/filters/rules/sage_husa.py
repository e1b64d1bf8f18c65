"""Estimate the variance of measurement or process noise from the innovations."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins import manifold
from robins.filters.belief import Belief, Number, StepInfo
from robins.filters.checks import one_of
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule, hooks
from robins.filters.rules import _variances


class Scale(NamedTuple):
    """Variances as multiples of the nominal ones, and how many samples each was learnt from."""

    ratio: Array  # (k,)
    samples: Array  # (k,) int


class LastStep(NamedTuple):
    """What a step leaves for the next one to learn Q from."""

    moved: Array  # (n,) diagonal of F P F' + Omega
    nominal: Array  # (n,) diagonal of the model's Q
    posterior: Array  # (n,) diagonal of P after the last update
    correction: Array  # (n,) sum of what the updates moved the mean by
    measured: Array  # () bool


def sage_husa(
    forgetting: Number = 0.98,
    adapt: Literal["R", "Q", "QR"] = "R",
    floor: Number = 0.1,
    ceiling: Number = 10.0,
) -> Rule:
    """Noise by moments of the innovation (Sage & Husa 1969), weighed by age.

    With e the innovation, P- the predicted covariance, b the forgetting and k = 1, 2, ... the
    samples a component was measured in:

        d_k = (1 - b) / (1 - b^(k+1))
        R_k = (1 - d_k) R_(k-1) + d_k diag(e e' - H P- H')               used in update k
        Q_k = (1 - d_k) Q_(k-1) + d_k diag(K e e' K' + P+ - F P F')      used in prediction k + 1

    The bracket may be negative, so positivity has a guard: only variances are learnt (the nominal
    correlations stay), and each is clipped to [floor, ceiling] times its nominal value after every
    sample. The nominal values are those of the model at that step. For R that is the noise as the
    rules before this one leave it; so put a gate before it, and weights that belong to one
    sample after it. A component that is missing or refused does not count.

    R and Q are not identifiable together from e: either explains an innovation that is too large.
    "QR" is for comparison with papers that do it; keep to "R", or to "Q" where the sensor is known.
    In "R" a wrong model of motion is taken for a noisy sensor, and the filter stops listening.

    Notes, a number a component: ``sage_husa.r_scale.i`` and ``sage_husa.q_scale.i``, the ratios in
    use. floor = ceiling = 1 is the Kalman filter, bit for bit.

    Args:
        forgetting: b, in (0, 1]: about 1 / (1 - b) samples are remembered, 1 remembers all.
        adapt: what to learn.
        floor: least variance, as a share of the nominal one.
        ceiling: greatest variance, as a multiple of the nominal one.

    Raises:
        ValueError: a parameter is not of its range.
    """
    _variances.check("sage_husa", forgetting, floor, ceiling)
    one_of("sage_husa adapt", adapt, ("R", "Q", "QR"))
    of_sensor, of_motion = "R" in adapt, "Q" in adapt

    def nominal(k: int) -> Scale:
        return Scale(jnp.ones(k), jnp.zeros(k, int))

    def learn(old: Scale, sample: Array, here: Array) -> Scale:
        k = (old.samples + 1).astype(float)
        d = (
            1.0 / (k + 1.0)
            if forgetting == 1.0
            else (1.0 - forgetting) / (1.0 - forgetting ** (k + 1.0))
        )
        new = jnp.clip((1.0 - d) * old.ratio + d * sample, floor, ceiling)
        return Scale(jnp.where(here, new, old.ratio), old.samples + here.astype(int))

    def init(belief: Belief, dims):
        n = belief.factor.shape[0]
        sensors = {name: nominal(m) for name, m in dims.items()} if of_sensor else {}
        nothing = jnp.zeros(n)
        last = LastStep(nothing, nothing, nothing, nothing, jnp.zeros((), bool))
        return sensors, (nominal(n), last) if of_motion else ()

    def process(memory, t: Transition):
        sensors, (scale, last) = memory
        sample = _variances.ratio(last.correction**2 + last.posterior - last.moved, last.nominal)
        scale = learn(scale, sample, last.measured & (last.nominal > 0.0))
        moved = _variances.variance(t.spread) + _variances.variance(t.excess)
        if t.deficit is not None:
            moved = moved - t.deficit**2
        nothing = jnp.zeros_like(moved)
        last = LastStep(moved, _variances.variance(t.noise), nothing, nothing, jnp.zeros((), bool))
        return (sensors, (scale, last)), t._replace(noise=_variances.scaled(t.noise, scale.ratio))

    def before(memory, prior: Belief, o: Observation):
        sensors, motion = memory
        R = _variances.variance(o.noise)
        here = o.accepted & o.present & (R > 0.0)
        e = jnp.where(here, o.residual, 0.0)
        scale = learn(
            sensors[o.sensor], _variances.ratio(e**2 - _variances.reading_variance(o), R), here
        )
        o = o._replace(noise=_variances.scaled(o.noise, scale.ratio))
        return ({**sensors, o.sensor: scale}, motion), prior, o

    def after(memory, posterior: Belief, info: StepInfo, o: Observation):
        sensors, motion = memory
        notes = dict(info.notes)
        if of_sensor:
            notes |= _variances.numbered("sage_husa.r_scale", sensors[o.sensor].ratio)
        if of_motion:
            scale, last = motion
            notes |= _variances.numbered("sage_husa.q_scale", scale.ratio)
            last = last._replace(
                posterior=_variances.variance(posterior.factor),
                correction=last.correction + manifold.local(o.prior.mean, posterior.mean),
                measured=last.measured | jnp.any(info.used),
            )
            motion = scale, last
        return (sensors, motion), posterior, info._replace(notes=notes)

    rule = hooks(init=init, after=after, name="sage_husa")
    rule = rule._replace(before=before) if of_sensor else rule
    return rule._replace(process=process) if of_motion else rule
