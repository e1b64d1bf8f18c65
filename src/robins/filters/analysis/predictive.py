"""Predictive score of a filter: the log density of each measurement, before it is used.

The density is that of the belief alone, before rules refuse or weigh the measurement, so that
filters of any kind can be compared, and refusing more measurements is not an advantage.
"""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy import integrate, optimize, special, stats

from robins import linalg
from robins.filters.belief import Belief
from robins.filters.kalman import Advanced, Filter, FilterState, FilterWrapper, Follow, Updated
from robins.filters.linearise import taylor
from robins.filters.model import Data, Motion, Sensor
from robins.filters.observation import Normalised, normalised
from robins.filters.run import Step
from robins.filters.values import value

OUTLIERS = 0.02  # e, share of outliers
WIDER = 10.0  # k, their standard deviation over that of other measurements
_RULE = "predicted"


class Predicted(NamedTuple):
    """Score of a step, or of several with leading axes."""

    log_density: Float[Array, "..."]  # sum over all its measurements
    components: Array  # number of their components


@cache
def scale(m: int) -> float:
    """Factor c_m of `log_density`, by quadrature: without it 0.987 of the true sigma scores best.

    For z normal with covariance S, the expected score is stationary at S if q = z' S^-1 z / c^2 has
    E[w(q) q] = m. The weight w is the average of 1 (normal part) and 1 / k^2 (outliers) under their
    posterior probabilities: the consistency factor of an M-estimate of scale (Huber & Ronchetti
    2009, sec. 5.2 and 8.4). By symmetry that holds for all directions of S at once.
    """

    def excess(c: float) -> float:
        def weighted(q: float) -> float:
            x = q / c**2
            far = math.log(OUTLIERS / (1.0 - OUTLIERS)) - m * math.log(WIDER)
            outlier = special.expit(far + 0.5 * x * (1.0 - WIDER**-2))
            return (1.0 - outlier * (1.0 - WIDER**-2)) * x * stats.chi2.pdf(q, m)

        spans = (0.0, 0.5 * m, m + 10.0, 4.0 * m + 100.0)  # no mass beyond
        parts = [integrate.quad(weighted, *span)[0] for span in itertools.pairwise(spans)]
        return sum(parts) - m

    if not 0 < m <= 16:  # above 16 c is one to 1e-9
        return 1.0
    return float(optimize.root_scalar(excess, bracket=(0.9, 1.01), xtol=1e-12).root)


def log_density(innovation: Normalised) -> Float[Array, ""]:
    """Log density of an innovation z of dimension m with covariance S.

    A normal density, contaminated by a share e of outliers of k times the size (Tukey 1960):

        p(z) = (1 - e) N(z; 0, c_m^2 S) + e N(z; 0, k^2 c_m^2 S)

    With a purely normal density one outlier would dominate the score; leaving outliers out would
    reward a filter that makes many. `scale` gives c_m, with which the true S scores best if z is
    normal.
    """
    m = innovation.dof.astype(float)
    c = jnp.asarray([scale(n) for n in range(len(innovation.used) + 1)])[innovation.dof]
    nis = innovation.nis / c**2
    normal = math.log1p(-OUTLIERS) - 0.5 * nis
    wide = math.log(OUTLIERS) - m * math.log(WIDER) - 0.5 * nis / WIDER**2
    spread = linalg.log_diagonal(innovation.factor, innovation.used) + m * jnp.log(c)
    return jnp.logaddexp(normal, wide) - spread - 0.5 * m * math.log(2.0 * math.pi)


@value
class Scored(FilterWrapper):
    """Filter made by `scored`."""

    # `Filter` wraps both for steps that are not taken; here the inner filter does so itself.
    @jax.jit
    def predict(self, state: FilterState, motion: Motion, u: Data = None) -> Advanced:
        return self.inner.predict(state, motion, u)

    @jax.jit
    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data = None) -> Updated:
        innovation = normalised(taylor().observation(state.belief, sensor, y, aux))
        there = innovation.dof > 0
        density = jnp.where(there, jnp.where(state.current, log_density(innovation), -jnp.inf), 0.0)
        new, info = self.inner.update(state, sensor, y, aux)
        return new, info.noted(_RULE, log_density=density, components=innovation.dof)

    def members(self, state: FilterState) -> tuple[tuple[Belief, ...], Follow]:
        return self.inner.members(state)


def scored(filter_: Filter) -> Filter:
    """Wrap a filter so that its updates note the score of the measurement, for `predicted`.

    Measurements are linearised about the mean of the belief (first-order Taylor). After a
    prediction that was not taken the score is -inf.
    """
    return Scored(filter_)


def predicted(step: Step) -> Predicted:
    """Score of a step of a `scored` filter, for ``run(..., keep=predicted)``."""
    notes = [info.notes for info in step.info.values()]
    density = sum((n[f"{_RULE}.log_density"] for n in notes), jnp.zeros(()))
    return Predicted(density, sum((n[f"{_RULE}.components"] for n in notes), jnp.zeros((), int)))
