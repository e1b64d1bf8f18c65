"""The belief of a filter, the information of an update, and the outcomes of a step."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from robins import linalg, manifold
from robins.errors import require
from robins.filters.checks import finite_numbers
from robins.filters.values import Numbers
from robins.manifold import State

# A number given by a user: an int is no float at run time, and tracers and batches are arrays.
Number = float | int | Numbers


class Belief(NamedTuple):
    """Mean and covariance of the state at one instant.

    The true state is ``retract(mean, e)`` with e ~ N(0, factor factor').
    """

    mean: State  # pytree on a manifold, tangent dimension n
    factor: Array  # (n, n) lower triangular

    @classmethod
    def of(cls, mean: State, covariance: ArrayLike) -> Belief:
        """Belief from a mean and a covariance; it checks both, so it cannot run inside `jit`.

        Raises:
            TypeError: the mean holds something that is not a real number, or is a list or tuple of
                plain numbers: JAX takes each of these for a part of the state, not of an array.
            ValueError: the mean is not finite, or the covariance is not positive semidefinite or
                has the wrong size.
        """
        plain = [isinstance(leaf, float | int) for leaf in manifold.leaves(mean)]
        if type(mean) in (list, tuple) and plain and all(plain):
            given = f"a {type(mean).__name__} of numbers"
            raise TypeError(f"initial mean is {given}: give an array, jnp.array({list(mean)})")
        mean = jax.tree_util.tree_map(
            lambda leaf: jnp.asarray(finite_numbers("initial mean", leaf)), mean
        )
        factor, n = linalg.factor(covariance, "initial covariance"), manifold.dim(mean)
        fits = factor.shape == (n, n)
        require(fits, f"initial covariance is {factor.shape}, the state needs ({n}, {n})")
        return cls(mean, factor)

    @property
    def covariance(self) -> Array:
        """(..., n, n) covariance of the tangent components."""
        return self.factor @ jnp.swapaxes(self.factor, -1, -2)

    @property
    def sigma(self) -> Array:
        """(..., n) standard deviation of each tangent component."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=-1))


class Code(IntEnum):
    """Outcome of a step; `SENTENCES` states its meaning and remedy."""

    DONE = 0
    MISSING = 1
    PARTLY_MISSING = 2
    REFUSED = 3
    INDEFINITE = 4
    NOT_FINITE = 5
    INFEASIBLE = 6
    TOO_OLD = 7
    NOT_PREDICTED = 8
    CONTRADICTED = 9
    APART = 10


# Codes of steps that were not taken, or in which a rule failed.
FAILURES = (
    Code.INDEFINITE,
    Code.NOT_FINITE,
    Code.INFEASIBLE,
    Code.NOT_PREDICTED,
    Code.CONTRADICTED,
)


def is_failure(code: Array) -> Array:
    """() bool: the code is one of `FAILURES`."""
    return jnp.any(code == jnp.array([int(one) for one in FAILURES]))


SENTENCES: dict[Code, str] = {
    Code.DONE: "the measurement was used",
    Code.MISSING: "no component of the measurement was there, so the belief stands",
    Code.PARTLY_MISSING: "components that were missing or refused were left out, the others used",
    Code.REFUSED: "a rule of the filter refused the measurement, so the belief stands",
    Code.INDEFINITE: (
        "the step would have made a covariance indefinite and was not taken: use form='sqrt', or "
        "sigma points with kappa and beta not negative"
    ),
    Code.NOT_FINITE: (
        "the step would have made the state infinite or NaN and was not taken: look at the model, "
        "the units and the size of the measurement"
    ),
    Code.INFEASIBLE: (
        "the bound asked of an H-infinity filter does not exist here and the step was not taken: "
        "raise gamma above gamma_min, or choose a policy"
    ),
    Code.TOO_OLD: (
        "the measurement is older than the buffer of the filter reaches back, so the belief stands"
    ),
    Code.NOT_PREDICTED: (
        "the prediction before it was not taken, so the belief is of an earlier time than the "
        "measurement, and stands"
    ),
    Code.CONTRADICTED: (
        "a component without noise, a constraint or bounds contradict what is known exactly, or "
        "each other, and were left out: give the sensor, the constraint or the initial state the "
        "noise that it has, or look at the bounds"
    ),
    Code.APART: (
        "the measurement was used, but its local filter and another one differ by more than 5 "
        "standard deviations"
    ),
}


def with_notes(
    known: Mapping[str, Numbers], rule: str, notes: Mapping[str, Numbers]
) -> dict[str, Numbers]:
    """Notes extended by those of a rule as ``rule.name``; a trailing ``_`` of a name is dropped."""
    return dict(known) | {f"{rule}.{name.rstrip('_')}": value for name, value in notes.items()}


class StepInfo(NamedTuple):
    """Innovation, gain and outcome of an update; m is the tangent dimension."""

    innovation: Array  # (m,) y minus its prediction; NaN where missing
    expected: Array  # (m,) innovation standard deviation, before a robust rule raises the noise
    factor: Array  # (m, m) lower factor of the innovation covariance; identity rows where not used
    gain: Array  # (n, m); zero columns where not used
    used: Array  # (m,) bool: present, not refused, and independent of the components above
    # normalised innovation squared, chi-square of `dof`; infinite if a component is CONTRADICTED
    nis: Float[Array, ""]
    dof: Array  # number of components used
    log_likelihood: Float[Array, ""]
    code: Array  # a `Code`
    notes: dict[str, Numbers]  # added by rules, each as ``rule.name``

    def noted(self, rule: str, **notes: Numbers) -> StepInfo:
        """Copy with notes of a rule (`with_notes`)."""
        return self._replace(notes=with_notes(self.notes, rule, notes))

    def contradicted_where(self, wrong: Array) -> StepInfo:
        """Copy with code `Code.CONTRADICTED` and likelihood zero where a rule failed.

        A rule that notes a failure also reports it here, so that the tally of a run counts it.
        """
        return self._replace(
            nis=jnp.where(wrong, jnp.inf, self.nis),
            log_likelihood=jnp.where(wrong, -jnp.inf, self.log_likelihood),
            code=jnp.where(wrong, int(Code.CONTRADICTED), self.code),
        )

    @property
    def sigma(self) -> Array | np.ndarray:
        """(..., m) ``expected``; NaN where a component was not used."""
        xp = np if isinstance(self.used, np.ndarray) else jnp
        return xp.where(self.used, self.expected, jnp.nan)
