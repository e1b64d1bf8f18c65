"""Worst-case gain of a filter over a run, and the least gamma of an H-infinity filter.

The worst-case gain is

    sup of sqrt( sum_k |L e_k|^2 / (|x0 - x0_hat|^2_{P0^-1} + sum |w_k|^2_{Q^-1} + |v_k|^2_{R^-1}) )

over all initial errors and noises, e_k being the error of the estimate. An H-infinity filter keeps
it below its gamma. `worst_case_gain` computes it from the gains alone, without a Riccati equation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, ArrayLike

from robins import linalg, manifold
from robins.errors import require
from robins.filters.analysis.bound import delayed_by_one
from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import matrix, positive, square
from robins.filters.kalman import kalman
from robins.filters.linearise import Linearisation, taylor
from robins.filters.model import Data, Model, Motion, Sensor
from robins.filters.rules._inflation import Weight, as_weight, rows_of
from robins.filters.rules.h_infinity import Estimate, HInfinity, h_infinity, least_gamma
from robins.filters.run import Solution, Step, run
from robins.manifold import State


def gamma_min(
    model: Model,
    start: Belief,
    y: Data,
    weight: Weight,
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
    linearise: Linearisation | None = None,
    rtol: float = 1e-4,
    estimate: Estimate = "a-posteriori",
    count_missing: bool = False,
) -> float:
    """Least gamma for which the H-infinity filter exists over a whole run.

    The largest local bound of the Kalman filter is a lower bound; from there gamma is doubled until
    the filter exists, then bisected. The result grows with the horizon and with outages; for a
    linear model it depends on the data only through missing measurements.

    Arguments are those of `run` and of `h_infinity`, and rtol, the largest relative excess of the
    result; the filter exists for the result itself.

    Raises:
        ValueError: the Kalman filter itself cannot take every step, or rtol is below 1e-12.
    """
    require(rtol >= 1e-12, "rtol must be 1e-12 or more, for numbers have no more digits", rtol)
    of = partial(h_infinity, weight=weight, estimate=estimate, count_missing=count_missing)

    def bounds(step: Step) -> Array:
        last = [info.notes["h_infinity.bound"] for info in step.info.values()][-1:]
        counts = count_missing | _used(step.info)
        return jnp.where(counts, jnp.max(jnp.array(last), initial=0.0), 0.0)

    @jax.jit  # so that nothing is raised where the filter does not exist
    def attempt(rule: HInfinity):
        done = run(kalman(linearise, [rule]), model, start, y, u, aux, bounds)
        return done.final.memory[0], done.log_likelihood, done.steps

    def exists(gamma: float) -> bool:
        one = of(gamma)
        return one.first_infeasible(attempt(one)[0]) is None

    _, log_likelihood, noted = attempt(of(np.inf))
    if not np.isfinite(log_likelihood):
        raise ValueError("gamma_min: a step of the Kalman filter cannot be taken: see its codes")
    lower = float(np.max(noted, initial=0.0))
    return least_gamma(exists, lower, rtol) if lower > 0.0 else 0.0


def _used(info: Mapping[str, StepInfo]) -> Array:
    """() or (T,) bool: some sensor used a component in the step."""
    some = [jnp.any(one.used, axis=-1) for one in info.values()]
    return jnp.any(jnp.stack(some), axis=0) if some else jnp.array(False)


class SensorChannel(NamedTuple):
    """Sensor over a run: an update maps the error e to (I - K H) e - K W v, v of unit variance."""

    K: np.ndarray  # (T, n, m) gain, zero columns where nothing was used
    H: np.ndarray  # (T, m, n)
    W: np.ndarray  # (T, m, k) noise factor, R = W W'


def error_operator(
    S0: np.ndarray,
    F: np.ndarray,
    G: np.ndarray,
    channels: Sequence[SensorChannel],
    weight: np.ndarray,
    gain_on: np.ndarray | None = None,
) -> np.ndarray:
    """Matrix (T r, p + T (q + k)) from initial error and noises of unit weight to the errors L e.

    Args:
        S0: (n, p) factor of the initial covariance.
        F: (T, n, n) transitions.
        G: (T, n, q) factors of the process noise.
        channels: sensors in the order in which they update; k is the number of all their noises.
        weight: (T, r, n) rows L of each step; zero rows do not count.
        gain_on: (T, n, n) factor of the correction from which the filter predicts; the error
            *before* the measurement then counts. None: the error after it counts.
    """
    T, n, q = G.shape
    width = q + sum(c.W.shape[2] for c in channels)
    E = np.zeros((n, S0.shape[1] + T * width))
    E[:, : S0.shape[1]] = S0
    out = np.zeros((T, weight.shape[1], E.shape[1]))
    for k in range(T):
        at = S0.shape[1] + k * width
        E = F[k] @ E
        E[:, at : at + q] += G[k]
        predicted = E.copy()
        at += q
        for c in channels:
            E = E - c.K[k] @ (c.H[k] @ E)
            E[:, at : at + c.W.shape[2]] -= c.K[k] @ c.W[k]
            at += c.W.shape[2]
        if gain_on is None:
            out[k] = weight[k] @ E
        else:
            out[k] = weight[k] @ predicted
            E = predicted + gain_on[k] @ (E - predicted)
    return out.reshape(-1, E.shape[1])


def spectral_norm(matrix: np.ndarray) -> float:
    """Largest singular value, from the smaller Gram matrix, which is accurate for the largest."""
    gram = matrix @ matrix.T if matrix.shape[0] <= matrix.shape[1] else matrix.T @ matrix
    last = len(gram) - 1
    (value,) = scipy.linalg.eigvalsh(gram, subset_by_index=[last, last])
    return float(np.sqrt(max(value, 0.0)))


def worst_case_gain(
    model: Model,
    start: Belief,
    solution: Solution,
    weight: Weight,
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
    estimate: Estimate = "a-posteriori",
    count_missing: bool = False,
) -> float:
    """Worst-case gain from initial error and noises to the error L e of a run.

    It is the 2-norm of the matrix that stacks the error recursion with the gains of the run. The
    model is linearised about the means of the run, so for a nonlinear one the gain holds for small
    disturbances. Arguments are those of the run, its solution with all steps, and those of
    `h_infinity`: "a-posteriori" counts the error after the measurements of a step, "a-priori" and
    "predictor" the error before them.

    Raises:
        ValueError: the run did not keep its steps.
    """
    steps = solution.steps
    kept = hasattr(steps, "prediction")
    require(kept, "worst_case_gain needs a run that kept its steps: leave `keep` alone")
    S0, F, G, channels, L = _linearised(model, start, steps, weight, u, dict(aux or {}))
    counts = np.ones(len(F), bool) if count_missing else np.asarray(_used(steps.info))
    L = np.where(counts[:, None, None], L, 0.0)
    gain_on = None
    if estimate != "a-posteriori":
        gain_on = np.tile(np.eye(F.shape[1]), (len(F), 1, 1))
        last = [steps.info[s.name].notes for s in model.sensors if s.name in steps.info][-1:]
        gamma = [notes["h_infinity.gamma"] for notes in last if "h_infinity.gamma" in notes]
        if steps.prediction.origin is not None and gamma:
            # P~ L'L / gamma^2, P~ the inflated covariance with which the next prediction started
            scaled = L[:-1] / np.asarray(gamma[0])[:-1, None, None]
            wide = np.asarray(steps.prediction.origin.covariance)[1:]
            gain_on[:-1] += wide @ np.swapaxes(scaled, 1, 2) @ scaled
    return spectral_norm(error_operator(S0, F, G, channels, L, gain_on))


def _linearised(
    model: Model, start: Belief, steps: Step, weight: Weight, u: Data, aux: Mapping[str, Data]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[SensorChannel], np.ndarray]:
    """Arguments S0, F, G, channels and L of `error_operator` along a run."""
    prediction = steps.prediction
    if prediction.origin is not None:
        before = prediction.origin.mean
    else:
        before = delayed_by_one(start.mean, steps.posterior.mean)
    F, G = _motion_along(model.motion, before, u)
    mean, channels = prediction.belief.mean, []
    for sensor in model.sensors:
        if sensor.name not in steps.info:
            continue
        info = steps.info[sensor.name]
        H, W, mean = _sensor_along(sensor, mean, info, aux.get(sensor.name))
        channels.append(SensorChannel(np.asarray(info.gain), np.asarray(H), np.asarray(W)))
    name = "worst_case_gain"
    rows = as_weight(weight, name)
    L = np.asarray(jax.vmap(lambda mean: rows_of(rows, mean, name))(steps.posterior.mean))
    return np.asarray(start.factor), np.asarray(F), np.asarray(G), channels, L


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def _motion_along(motion: Motion, mean: State, u: Data) -> tuple[Array, Array]:
    """Transitions and noise factors at the means before the steps."""
    unit = jnp.eye(manifold.dim(mean))  # so that a spread is the Jacobian
    t = taylor().transition(Belief(mean, unit), motion, u)
    return t.spread, t.noise


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0))
def _sensor_along(
    sensor: Sensor, mean: State, info: StepInfo, aux: Data
) -> tuple[Array, Array, State]:
    """Jacobians and noise factors of a sensor, and the means after its updates."""
    z = sensor.read(mean, aux) if sensor.linear is None else sensor.linear(mean, aux)[0]
    o = taylor().observation(Belief(mean, jnp.eye(manifold.dim(mean))), sensor, z, aux)
    residual = jnp.where(info.used, info.innovation, 0.0)
    return o.spread, o.noise, manifold.retract(mean, info.gain @ residual)


class SteadyHInfinity(NamedTuple):
    """A time-invariant Kalman or H-infinity filter."""

    P_pred: np.ndarray  # (n, n) covariance before the measurement
    P: np.ndarray  # (n, n) covariance after it
    K: np.ndarray  # (n, m) gain P H' R^-1 of the estimate after the measurement
    K_a_priori: np.ndarray  # (n, m) gain P~ H' R^-1 of the estimate before it; P~ is P inflated


def _matrices(
    F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Matrices of a time-invariant system, checked for their shapes."""
    F = square("F", F)
    Q, H = matrix("Q", Q, *F.shape), matrix("H", H, None, len(F))
    return F, Q, H, matrix("R", R, len(H), len(H))


def steady_kalman(F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike) -> SteadyHInfinity:
    """Steady gain and covariances of the Kalman filter of a time-invariant system.

    For x' = F x + w, y = H x + v with noise covariances Q and R, by the discrete algebraic Riccati
    equation (DARE), accurate to rounding even for states in very different units
    (`robins.filters.synthesis.kalman_gain`).

    Raises:
        TypeError: a matrix is not of real numbers.
        ValueError: a matrix is of another shape or not finite, Q or R is not a covariance, or there
            is no steady state, with the reason.
    """
    # Imported here to keep designs out of the imports of filters.
    from robins.filters.synthesis import current_form, kalman_gain
    from robins.filters.synthesis.norms import gramian

    F, Q, H, R = _matrices(F, Q, H, R)
    G, W = np.asarray(linalg.factor(Q, "Q")), np.asarray(linalg.factor(R, "R"))
    K = kalman_gain(current_form(F, G, np.zeros((len(F), 0)), H, W))
    left = np.eye(len(F)) - K @ H
    P = gramian(left @ F, np.hstack([left @ G, -K @ W]))
    return SteadyHInfinity(F @ P @ F.T + Q, P, K, K)


def steady_h_infinity(
    F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike, weight: ArrayLike, gamma: float | int
) -> SteadyHInfinity:
    """Steady state of `h_infinity` on a time-invariant system.

    The stabilising solution of the Riccati equation of F' and [H' L'] with weights R and -gamma^2 I
    (Hassibi, Sayed & Kailath 1999, ch. 4), checked for existence and against the recursion.
    Arguments are those of `steady_kalman`, the weight L (q, n) and the bound gamma; inf gives the
    Kalman filter.

    Raises:
        TypeError: a matrix is not of real numbers.
        ValueError: as `steady_kalman`, or gamma is not positive.
    """
    F, Q, H, R = _matrices(F, Q, H, R)
    L = matrix("weight", weight, None, len(F))
    positive("gamma", gamma, "the Kalman filter")
    linalg.factor(Q, "Q")
    require(len(H), "H has no rows: nothing is measured")
    if not np.all(np.diag(linalg.factor(R, "R")) > 0.0):
        raise ValueError("R is singular: a reading without noise has no steady filter of this form")
    q = len(L)
    missing = f"no steady H-infinity filter with gamma = {gamma:g} exists: "
    with np.errstate(over="ignore"):
        C = np.concatenate([H, L / gamma])
    weights = scipy.linalg.block_diag(R, -np.eye(q))
    try:
        P_pred = scipy.linalg.solve_discrete_are(F.T, C.T, Q, weights)
    except ValueError as error:  # which those of linear algebra are too
        raise ValueError(
            missing + "its Riccati equation has no stabilising solution; give a larger gamma, and "
            "see that H sees what F does not let decay"
        ) from error
    P_pred = (P_pred + P_pred.T) / 2.0
    S = H @ P_pred @ H.T + R
    K = np.linalg.solve(S, H @ P_pred).T
    A = np.eye(len(F)) - K @ H
    P = A @ P_pred @ A.T + K @ R @ K.T
    bound = np.sqrt(max(np.linalg.eigvalsh(L @ P @ L.T)[-1], 0.0))
    scale = max(np.max(np.abs(P_pred)), np.finfo(float).tiny)
    if np.linalg.eigvalsh(P_pred)[0] < -1e-9 * scale:
        raise ValueError(missing + "the solution of its Riccati equation is not a covariance")
    if not bound < gamma:
        raise ValueError(missing + f"its local bound sqrt(lambda_max(L P L')) would be {bound:.6g}")
    inner = gamma**2 * np.eye(q) - L @ P @ L.T if np.isfinite(gamma) else None
    wide = P if inner is None else P + P @ L.T @ np.linalg.solve(inner, L @ P)
    residual = F @ wide @ F.T + Q - P_pred
    if np.max(np.abs(residual)) > 1e-8 * scale:
        raise ValueError(missing + "the solution of its Riccati equation does not satisfy it")
    return SteadyHInfinity(P_pred, P, K, np.linalg.solve(R, H @ wide).T)
