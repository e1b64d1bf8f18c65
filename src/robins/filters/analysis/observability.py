r"""Observability: information of the measurements in a window about the state at its start.

The observability Gramian of the linearised system, in comparable units of states and sensors
(Ham & Brown 1983; Chen 1999, ch. 6),

    W_k = sum_{j <= k} D Phi_j' H_j' R_j^-1 H_j Phi_j D,

with D the prior standard deviations and Phi_j the transition from the start to step j. An
eigenvalue of W is the ratio of measured to prior information along its eigenvector.

The Gramian itself is never summed: Phi may grow without bound, and small eigenvalues would be lost
in the rounding of large ones. The recursion carries two factors, of the error e_0 at the start and
e_k now, given the measurements so far and no process noise,

    e_0 = D L_k z,  e_k = M_k z,  z ~ N(0, I),  L_k L_k' = (I + W_k)^-1.

A measurement multiplies both by the factor T of the posterior covariance of z, by one QR.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins import linalg
from robins.errors import require
from robins.filters.analysis.bound import Linearised, Use, linearised
from robins.filters.belief import Belief
from robins.filters.checks import square
from robins.filters.model import Data, Model
from robins.filters.observation import left_out
from robins.manifold import State

# Eigenvalue below which a direction is unobservable: the prior has a million times the information.
NOTHING = 1e-6


def observability(
    model: Model,
    start: Belief,
    truth: State,
    y: Mapping[str, Data],
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
    use: Use | None = None,
    window: int | None = None,
) -> Array:
    """Factors L of (I + W)^-1 after every step of a run; may be batched by `jax.vmap`.

    Arguments and errors are those of `robins.filters.analysis.bound.linearised`, the standard
    deviations of ``start`` being the units, and of `observability_along`.

    Returns:
        (E, n, n) factors, for `bits`, `gramian` and `spectrum`.
    """
    line = linearised(model, start, truth, y, u, aux)
    return observability_along(line, start.sigma, use, window)


def observability_along(
    line: Linearised, sigma: Array, use: Use | None = None, window: int | None = None
) -> Array:
    """Factors L of (I + W)^-1 along a linearised model, by one scan.

    Args:
        line: from `robins.filters.analysis.bound.linearised`.
        sigma: (n,) units of the states, their prior standard deviations.
        use: (S,) bool, sensors of the model to use; all by default.
        window: steps after which L starts again with the same units; None: never, and then an
            unobserved unstable direction overflows after some 700 of its time constants.

    Raises:
        ValueError: the window is shorter than one step.
    """
    require(window is None or window >= 1, f"a window of {window} steps: at least one is wanted")
    unit, D = jnp.eye(sigma.shape[0]), jnp.diag(sigma)
    use = jnp.ones(len(line.sights), bool) if use is None else jnp.asarray(use, bool)

    def step(carry: tuple[Array, Array], item: tuple[Array, Linearised]):
        fresh, row = item
        L, M = (jnp.where(fresh, a, b) for a, b in zip((unit, D), carry, strict=True))
        M = row.F @ M
        for i, sight in enumerate(row.sights):
            if sight is not None:
                spread, excess, noise, _, _ = left_out(sight.seen_with(M, use[i]))
                T = linalg.block_factor(spread, (excess, noise), unit)[2]
                L, M = L @ T, M @ T
        return (L, M), L

    number = jnp.arange(line.F.shape[0])
    fresh = jnp.zeros(number.shape, bool) if window is None else number % window == 0
    return jax.lax.scan(step, (unit, D), (fresh, line))[1]


def bits(L: ArrayLike) -> np.ndarray:
    """(..., n) mutual information between each state and the measurements [bit].

    Each bit halves the standard deviation; inf where the state was measured exactly.
    """
    left = np.sqrt(np.sum(np.asarray(L) ** 2, axis=-1))
    with np.errstate(divide="ignore"):
        return np.maximum(-np.log2(left), 0.0)


def gramian(L: ArrayLike) -> np.ndarray:
    """(n, n) Gramian W in units of the prior; not finite after an exact measurement."""
    values, vectors = spectrum(L)
    return (vectors * values) @ vectors.T


def spectrum(L: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """(n,) eigenvalues of W, ascending, and (n, n) unit eigenvectors as columns.

    Eigenvectors of values below `NOTHING` are an arbitrary basis of the unobservable directions;
    `unobservable` finds a sparse one.

    Raises:
        TypeError: L is not of real numbers.
        ValueError: L is not square, or not finite, as after an overflow.
    """
    vectors, left, _ = np.linalg.svd(square("L", L))
    with np.errstate(divide="ignore"):
        values = np.maximum((1.0 - left) * (1.0 + left) / left**2, 0.0)
    return values, vectors


def unobservable(values: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """(n, d) sparse basis of the unobservable directions.

    Gauss-Jordan elimination on the eigenvectors of values below `NOTHING`: each column has one
    state in which all others are zero.
    """
    basis = vectors[:, values < NOTHING].copy()
    free = np.ones(len(basis), bool)
    for column in range(basis.shape[1]):
        row = int(np.argmax(np.where(free, np.max(np.abs(basis[:, column:]), axis=1), -1.0)))
        pick = column + int(np.argmax(np.abs(basis[row, column:])))
        basis[:, [column, pick]] = basis[:, [pick, column]]
        basis[:, column] /= basis[row, column]
        others = np.arange(basis.shape[1]) != column
        basis[:, others] -= np.outer(basis[:, column], basis[row, others])
        free[row] = False
    return basis / np.linalg.norm(basis, axis=0)


def direction_in_words(vector: np.ndarray, names: Sequence[str]) -> str:
    """Composition of a direction in words, such as "82 % heading against 17 % gyro bias z".

    The shares are squares of the components, in units of the prior; "with" joins a state of the
    same sign as the largest, "against" one of the opposite sign. At most four states are named,
    none of less than 1 %.

    Raises:
        ValueError: the vector is not of one number per name, is zero, or is not finite.
    """
    shape = np.shape(vector)
    fits = shape == (len(names),)
    require(fits, f"a vector of shape {shape} has not a number for each of {len(names)} names")
    length = float(np.linalg.norm(vector))
    require(0.0 < length < np.inf, "no direction: the length of the vector is", length)
    order = np.argsort(-np.round(np.abs(vector), 9), kind="stable")[:4]  # ties keep their order
    text = ""
    for i in order:
        share = 100.0 * vector[i] ** 2 / float(np.sum(vector**2))
        if share < 1.0 and text:
            break
        joint = "with" if vector[i] * vector[order[0]] > 0.0 else "against"
        text += f" {joint} " if text else ""
        text += f"{math.floor(share + 0.5)} % {names[i]}"
    return text
