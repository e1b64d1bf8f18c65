"""Equality constraints on a belief: exact or noisy, linear or not, nearest in any metric.

A constraint g(x) = d is a measurement d of g(x), without noise if exact; components already known
are left out. Only its gain may differ: with V = P the constrained state is the most probable one,
with V = W^-1 the one nearest to the mean in the metric W,

    G = V D' (D V D')^-1,   x* = x - G (g(x) - d),   P* = (I - G D) P (I - G D)' + G R_d G'

(Simon & Chia 2002, sec. II), D the Jacobian of g and R_d the covariance of the constraint's error.
No covariances are subtracted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.iterated import iterated
from robins.filters.kalman import updated
from robins.filters.linearise import taylor
from robins.filters.model import Data, Given, Sensor, as_noise
from robins.filters.observation import Observation, contradicted, normalised
from robins.filters.values import as_data, is_known
from robins.manifold import State

Function = Given | Callable[[State], Data]  # a matrix D, for D x, or a function of the state
Weight = Literal["covariance", "identity"] | Given

ITERATIONS = 4

# Least residual of a row of unit length orthogonal to those above; cond(D D') is then below 1e12.
_INDEPENDENT = 1e-6


class Constrained(NamedTuple):
    """Belief under a constraint of c components, and the residual before it was applied."""

    belief: Belief
    residual: Array  # (c,) d - g(x) before
    used: Array  # (c,) bool: not known already, and independent of the components above
    # () squared residual normalised by D P D' + R_d, chi-square of `dof`; infinite if an exact
    # component contradicts exact knowledge or the components above it
    nis: Array
    dof: Array  # () number of components that were not known already


def constrain(
    belief: Belief,
    g: Function,
    d: Data = None,
    weight: Weight = "covariance",
    noise: Given | None = None,
    hard: bool = False,
    iterations: int = ITERATIONS,
) -> Constrained:
    """Constrain a belief to ``g(x) = d``; may be compiled, with D, d, weight and noise as data.

    Without noise the mean is put on the constraint, with no variance across it. With noise the
    constraint is used as a measurement.

    Args:
        belief: belief to constrain.
        g: (c, n) matrix D, for D x with x the numbers of a state of arrays in tangent order; or a
            function of the state, with values in an array or in elements such as `Angle`.
        d: value of g(x), of the same form; zero by default.
        weight: metric W in which the constrained state is nearest to the mean: "covariance" for
            P^-1 (the only one that weighs noise), "identity", or a positive definite (n, n) matrix
            in tangent coordinates.
        noise: (c,) standard deviations of the constraint's error, or a (c, k) factor of R_d.
        hard: put the mean on a noisy constraint, and its noise into the covariance, as weights
            other than "covariance" always do. Worse than no constraint if R_d exceeds D P D'.
        iterations: number of linearisations of a function, by Gauss-Newton.

    Raises:
        ValueError: shapes do not fit, a matrix is given for a state that holds elements, or
            iterations is not positive.
    """
    sensor, target = as_sensor(belief.mean, g, d, noise)
    way = iterated(iterations=iterations if callable(g) else 1)
    before = taylor().observation(belief, sensor, target, None)
    judged = normalised(before)
    metric, root = metric_of(belief, weight)

    if metric is belief and (noise is None or not hard):
        seen = way.observation(belief, sensor, target, None)
        posterior, info = updated(belief, seen, "sqrt")
        used = info.used
    else:
        exact = Sensor(sensor.read, jnp.zeros((sensor.dim, 0)), sensor.dim, "", sensor.linear)
        seen = way.observation(metric, exact, target, None)
        mean, G, used, _ = nearest(metric, seen)
        S = belief.factor
        rest = S - G @ (seen.spread if root is None else seen.spread @ (root.T @ S))
        if noise is None:
            factor = linalg.tria(rest)
            factor = jnp.where(linalg.lost_in_rounding(factor, belief.sigma), 0.0, factor)
        else:
            factor = linalg.tria(rest, G @ sensor.noise)
        posterior = Belief(mean, jnp.where(jnp.any(used), factor, S))
    nis = jnp.where(jnp.any(contradicted(before, judged)), jnp.inf, judged.nis)
    return Constrained(posterior, before.residual, used, nis, judged.dof)


def nearest(metric: Belief, o: Observation) -> tuple[State, Array, Array, Array]:
    """State nearest to the mean that satisfies an exact observation, its gain, and two masks.

    The masks are of the components used, and of those that contradict exact knowledge.
    """
    seen = normalised(o)
    spread = jnp.where(seen.used[:, None], o.spread, 0.0)
    cross = metric.factor @ linalg.solve_lower(seen.factor, spread).T
    gain = linalg.solve_lower_transposed(seen.factor, cross.T).T
    mean = manifold.retract(metric.mean, cross @ seen.white)
    return mean, gain, seen.used, contradicted(o, seen)


def as_sensor(mean: State, g: Function, d: Data, noise: Given | None) -> tuple[Sensor, Data]:
    """Sensor that represents a constraint, and its measurement."""
    read, linear, value = (g, None, g(mean)) if callable(g) else _by_matrix(mean, g)
    c = manifold.dim(value)
    if d is not None:
        target = jax.tree_util.tree_map(
            lambda x: jnp.asarray(x, float), d, is_leaf=lambda x: isinstance(x, list)
        )
    elif any(manifold.is_element(leaf) for leaf in manifold.leaves(value)):
        raise ValueError("a constraint on angles or rotations needs d, its value")
    else:
        target = jax.tree_util.tree_map(jnp.zeros_like, value)
    root = jnp.zeros((c, 0)) if noise is None else as_noise(noise, c, "the constraint")
    return Sensor(Partial(_of_state, as_data(read)), root, c, "constraint", linear), target


def _by_matrix(mean: State, matrix: Given) -> tuple[Partial, Partial, Array]:
    # D x as a function, as a function with its Jacobian, and a value of its shape
    if any(manifold.is_element(leaf) for leaf in manifold.leaves(mean)):
        raise ValueError(
            "a matrix constrains a state of plain arrays, this one holds elements: "
            "give the constraint as a function of the state"
        )
    D = jnp.asarray(matrix, float)
    if D.ndim != 2 or D.shape[1] != manifold.dim(mean):
        raise ValueError(
            f"D is {D.shape}: one column for each of {manifold.dim(mean)} states is wanted"
        )
    return Partial(_product, D), Partial(_product_linear, D), jnp.zeros(len(D))


def _of_state(read: Callable[[State], Data], x: State, aux: Data) -> Data:
    return read(x)


def _product(D: Array, x: State) -> Array:
    return D @ jnp.concatenate([jnp.reshape(leaf, -1) for leaf in manifold.leaves(x)])


def _product_linear(D: Array, x: State, aux: Data) -> tuple[Array, Array]:
    return _product(D, x), D


def metric_of(belief: Belief, weight: Weight) -> tuple[Belief, Array | None]:
    """Belief of covariance W^-1, and a factor of W; the belief itself and None for W = P^-1."""
    n = belief.factor.shape[0]
    if isinstance(weight, str):
        known = weight in ("covariance", "identity")
        require(known, "weight must be 'covariance', 'identity' or a matrix", repr(weight))
        if weight == "covariance":
            return belief, None
        unit = jnp.eye(n)
        return Belief(belief.mean, unit), unit
    W = jnp.asarray(weight, float)
    require(W.shape == (n, n), f"weight is {W.shape}, the state needs ({n}, {n})")
    root = linalg.cholesky(W)
    return Belief(belief.mean, linalg.solve_lower_transposed(root, jnp.eye(n))), root


def check_rows(rule: str, D: np.ndarray, d: np.ndarray, exact: np.ndarray) -> None:
    """Refuse constraints D x = d with dependent rows among those that are ``exact``, (c,) bool.

    Raises:
        ValueError: a row of D is zero, or depends on those above it; the message states the row,
            the rank, and whether d contradicts the rows above.
    """
    length = np.linalg.norm(D, axis=1)
    zero = length <= 1e-14 * np.max(length, initial=0.0)
    unit = D / np.where(zero, 1.0, length)[:, None]
    kept, fault = [], None
    for row in np.flatnonzero(exact):
        share = np.linalg.lstsq(unit[kept].T, unit[row])[0] if kept else np.zeros(0)
        rest = unit[row] - share @ unit[kept]
        if np.linalg.norm(rest) > _INDEPENDENT and not zero[row]:
            kept.append(row)
        elif fault is None:
            fault = row, list(kept)
    if fault is None:
        return
    row, above = fault
    share = np.linalg.lstsq(D[above].T, D[row])[0] if above else np.zeros(0)
    scale = np.abs(d[row]) + np.abs(share) @ np.abs(d[above])
    contradicts = np.abs(d[row] - share @ d[above]) > 1e-9 * scale
    what = "is zero" if zero[row] else "depends on those above it"
    fix = "and d contradicts them" if contradicts else "and says nothing new: leave it out"
    raise ValueError(
        f"{rule}: D has rank {len(kept)} for {np.sum(exact)} exact rows: "
        f"row {row}, counted from 0, {what} {fix}"
    )


def as_weight(rule: str, weight: Weight) -> Weight:
    """Metric W of a rule, checked: a name, or a matrix as a leaf."""
    if isinstance(weight, str):
        sentence = f"{rule} weight must be 'covariance', 'identity' or a matrix"
        require(weight in ("covariance", "identity"), sentence, repr(weight))
        return weight
    if not is_known(weight):
        return weight
    W = np.asarray(weight, float)
    if not np.all(np.diag(linalg.factor(W, f"{rule} weight")) > 0.0):
        raise ValueError(f"{rule} weight is not positive definite: each state needs a weight")
    return W


def check_size(rule: str, weight: Weight, n: int) -> None:
    """Refuse a metric W whose size is not that of the state."""
    if not isinstance(weight, str) and np.shape(weight) != (n, n):
        raise ValueError(f"{rule} weight is {np.shape(weight)}, the state needs ({n}, {n})")
