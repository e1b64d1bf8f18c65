"""Measurement noise estimated together with the state, by variational Bayes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief, Number, StepInfo
from robins.filters.observation import Observation, left_out
from robins.filters.rule import Rule
from robins.filters.rules import _variances
from robins.filters.values import Numbers, kind, number, value


class InverseGamma(NamedTuple):
    """Distribution of each variance over its nominal value; the estimate is rate / shape."""

    shape: Array  # (m,) alpha, half the equivalent number of samples
    rate: Array  # (m,) beta
    scale: Array  # (m,) multiple in use; between updates rate / shape


def _left(factor: Array, residual: Array, noise: Array) -> Array:
    """(m,) expected square of the posterior residual, from measurement quantities alone.

    With S = H P- H' + R,

        y - H x+ = R S^-1 e,        H P+ H' = R - R S^-1 R.
    """
    R = noise @ noise.T
    white = linalg.solve_lower(factor, jnp.concatenate([residual[:, None], R], axis=1))
    G = white[:, 1:]
    return (G.T @ white[:, 0]) ** 2 + jnp.maximum(jnp.diagonal(R) - jnp.sum(G**2, axis=0), 0.0)


Known = dict[str, InverseGamma]  # by sensor


@value
class VariationalBayes(Rule):
    """Rule of `variational_bayes`: R = diag(b / a), with b from the posterior residual."""

    forgetting: Numbers  # () rho
    floor: Numbers  # () least scale
    ceiling: Numbers  # () greatest scale
    initial_dof: Numbers  # () equivalent number of samples of the nominal noise
    iterations: int = kind()

    name = "variational_bayes"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Known:
        half = 0.5 * self.initial_dof
        return {
            name: InverseGamma(jnp.full(m, half), jnp.full(m, half), jnp.ones(m))
            for name, m in dims.items()
        }

    def before(self, memory: Known, prior: Belief, o: Observation):
        known = memory[o.sensor]
        scale = self.iterated(known, o)
        memory = {**memory, o.sensor: known._replace(scale=scale)}
        return memory, prior, o._replace(noise=_variances.scaled(o.noise, scale))

    def iterated(self, known: InverseGamma, o: Observation) -> Array:
        """(m,) multiples of the nominal variance for the update; unchanged where not used."""
        a, b = self.forgetting * known.shape + 0.5, self.forgetting * known.rate
        scale = jnp.clip(b / a, self.floor, self.ceiling)
        spread, excess, noise, deficit, used = left_out(o._replace(accepted=o.accepted & o.present))
        reading = linalg.tria(spread, excess) if self.iterations > 1 else spread
        e, nominal = jnp.where(used, o.residual, 0.0), _variances.variance(noise)
        for _ in range(self.iterations - 1):
            R_root = _variances.scaled(noise, jnp.where(used, scale, 1.0))
            S_root = linalg.tria(reading, R_root)
            if deficit is not None:
                S_root = linalg.downdate(S_root, deficit)
            left = _variances.ratio(_left(S_root, e, R_root), nominal)
            scale = jnp.clip((b + 0.5 * left) / a, self.floor, self.ceiling)
        return jnp.where(used, scale, known.scale)

    def after(self, memory: Known, posterior: Belief, info: StepInfo, o: Observation):
        known = memory[o.sensor]
        # weights by rules after this one are part of the nominal noise
        R = _variances.variance(o.noise)
        here = info.used & (R > 0.0)
        noise = jnp.where(here[:, None], o.noise, 0.0)
        left = _variances.ratio(
            _left(info.factor, jnp.where(here, o.residual, 0.0), noise), R / known.scale
        )
        a = self.forgetting * known.shape + 0.5
        b = self.forgetting * known.rate + 0.5 * left
        shape = jnp.where(here, a, known.shape)
        rate = jnp.where(here, jnp.clip(b, self.floor * a, self.ceiling * a), known.rate)
        memory = {**memory, o.sensor: InverseGamma(shape, rate, rate / shape)}
        notes = info.notes | _variances.numbered("variational_bayes.r_scale", known.scale)
        return memory, posterior, info._replace(notes=notes)


def variational_bayes(
    forgetting: Number = 0.98,
    iterations: int = 2,
    initial_dof: Number = 10.0,
    floor: Number = 0.01,
    ceiling: Number = 1000.0,
) -> Rule:
    """Unknown measurement noise by variational Bayes, VB-AKF (Särkkä & Nummenmaa 2009).

    State and variances are estimated together, as a Gaussian times inverse gammas: with a-, b- of
    variance i before the sample, in multiples of the nominal one,

        a = rho a- + 1/2
        repeat:  R = diag(b / a);  x+, P+ from the Kalman update with this R;
                 b = rho b- + ( (y - H x+)_i^2 + (H P+ H')_ii ) / 2

    The update uses the last R, the next sample starts with the last b. With the *posterior*
    residual and its covariance b is positive. rho b- / a is the first R, so the estimate from one
    sample is less than its square; the mean over many is unbiased.

    Nominal correlations are kept: rows of the noise factor are scaled. The nominal noise is that of
    the model at the step, after earlier rules. The estimate uses the weights of later rules: so put
    gates and weights after this rule, where they use the estimated noise. A component that is
    missing, or refused by any rule, does not change the estimate.

    Notes, one number per component: ``variational_bayes.r_scale.i``, the multiples in use.
    floor = ceiling = 1 is the Kalman filter, bit for bit.

    Args:
        forgetting: rho, in (0, 1]: about 1 / (1 - rho) samples are remembered, 1 remembers all.
        iterations: updates per sample, the final one included. A third changes the mean of the
            estimate by one per cent and costs 15 % of a step.
        initial_dof: equivalent number of samples of the nominal noise at the start.
        floor: least variance, as a share of the nominal one.
        ceiling: greatest variance, as a multiple of the nominal one.

    Raises:
        ValueError: a parameter is out of its range.
    """
    known = _variances.bounded("variational_bayes", forgetting, floor, ceiling)
    require(iterations >= 1, "variational_bayes iterations must be 1 or more", iterations)
    wrong = "variational_bayes initial_dof must be positive and finite"
    dof = number(wrong, initial_dof, lambda x: (x > 0.0) & (x < np.inf))
    return VariationalBayes(**known, initial_dof=dof, iterations=iterations)
