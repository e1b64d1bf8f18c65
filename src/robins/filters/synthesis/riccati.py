"""Gains from Riccati equations: Kalman filters, also with the modelling error n as noise."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import scipy.linalg
import scipy.optimize

from robins.errors import require
from robins.filters.checks import positive
from robins.filters.synthesis import norms
from robins.filters.synthesis.design import Design, Unreachable, certify
from robins.filters.synthesis.plant import Plant, error_system

_DECADES = np.arange(-2.0, 12.1, 0.25)  # log10 of lambda over that which makes n as large as w
_FARTHER, _FARTHEST = 10.0**0.25, 1e12  # factor of lambda in a step beyond the grid, and in all
_FALLS = 1e-4  # least relative decrease of the norm in a step for another one beyond the grid
_RTOL = 1e-10  # relative tolerance of lambda
_STEPS = 60  # limit of Newton's iterations; convergence is quadratic

check_gamma = partial(positive, "gamma", of_infinity="no bound")


def kalman_gain(plant: Plant) -> np.ndarray:
    """Gain (n, m) of the steady Kalman filter, of least H2 norm; n is ignored.

    The Riccati equation includes the cross-covariance E[Bw w (Dw w)'] = Bw Dw'.

    Raises:
        ValueError: there is no steady state: a mode on the unit circle is not driven by w, or a
            combination of measurements is free of noise, at all frequencies or at one.
    """
    return _gain(plant, 0.0)


def kalman_design(plant: Plant) -> Design:
    """Design of the steady Kalman filter; errors are those of `kalman_gain`."""
    began = time.perf_counter()
    K = kalman_gain(plant)
    return certify(plant, K, method="kalman", lambda_=0.0, seconds=time.perf_counter() - began)


def inflated_gain(plant: Plant, lambda_: norms.Number) -> np.ndarray:
    """Kalman gain (n, m) for the noise [w, sqrt(lambda) n].

    Raises:
        ValueError: lambda is negative; or as `kalman_gain`.
    """
    require(0.0 <= lambda_ < np.inf, "lambda must be a number from 0 on", lambda_)
    return _gain(plant, float(lambda_))


def riccati(plant: Plant, gamma: norms.Number) -> Design:
    """Kalman filter for noise [w, sqrt(lambda) n], with the least lambda that meets gamma.

    lambda is the variance of n, treated as white noise, at which the true H-infinity norm from n to
    the error is gamma. Run with its own covariance it is the ordinary Kalman filter with
    Q + lambda Bn Bn' (`channel_inflation`), also at the start and in outages. If n drives measured
    states it is as good as any gain; if n drives a state that is not measured, a better gain can
    exist, and gamma can be infeasible for this form. With gamma = inf it is the Kalman filter.

    Raises:
        Unreachable: no lambda meets gamma; the message states the least feasible gamma.
        ValueError: gamma is not positive; or as `kalman_gain`.
    """
    check_gamma(gamma)
    began = time.perf_counter()
    K, lambda_ = _search(plant, float(gamma))
    seconds = time.perf_counter() - began
    return certify(plant, K, method="riccati", gamma=gamma, lambda_=lambda_, seconds=seconds)


def least_riccati_gamma(plant: Plant) -> float:
    """Least H-infinity norm of the `inflated_gain` over all lambda."""
    return _least(plant)[-1]


def _search(plant: Plant, gamma: float) -> tuple[np.ndarray, float]:
    """Gain for the least lambda that meets gamma, and that lambda."""

    def meets(K: np.ndarray) -> bool:
        e = error_system(plant, K)
        return norms.meets(e.A, e.Bn, e.L, gamma)

    K = _gain(plant, 0.0)
    if np.isinf(gamma) or meets(K):
        return K, 0.0
    grid, below = _grid(plant, K), 0.0
    for above in grid:
        K = _gain(plant, above, K)
        if meets(K):
            return _bisect(plant, meets, below, above, K)
        below = above
    K, above, least = _least(plant)
    if least <= gamma:
        below = max(grid[grid < above * (1.0 - _RTOL)], default=0.0)
        return _bisect(plant, meets, below, above, K)
    raise Unreachable(
        f"the Riccati equation cannot reach gamma {gamma:.6g} for any lambda tried: the least is "
        f"{least:.6g}, at lambda {above:.3g}. Raise gamma, or take the observer form of the LMI",
        least,
    )


def _bisect(
    plant: Plant, meets: Callable[[np.ndarray], bool], below: float, above: float, K: np.ndarray
) -> tuple[np.ndarray, float]:
    while above - below > _RTOL * above:
        middle = 0.5 * (below + above)
        if not below < middle < above:
            break
        gain = _gain(plant, middle, K)
        if meets(gain):
            above, K = middle, gain
        else:
            below = middle
    return K, above


def _least(plant: Plant) -> tuple[np.ndarray, float, float]:
    """Gain of least H-infinity norm, its lambda, and that norm."""

    def norm(K: np.ndarray) -> float:
        e = error_system(plant, K)
        return max(norms.hinf_norm(e.A, e.Bn, e.L), norms.peak_gain(e.A, e.Bn, e.L))

    def at(lambda_: float, near: np.ndarray | None) -> tuple[np.ndarray, float, float]:
        K = _gain(plant, lambda_, near)
        return K, lambda_, norm(K)

    found = [at(0.0, None)]
    for value in _grid(plant, found[0][0]):
        found.append(at(float(value), found[-1][0]))
    end = found[-1][1]
    while found[-1][2] < (1.0 - _FALLS) * found[-2][2] and found[-1][1] < _FARTHEST * end:
        found.append(at(_FARTHER * found[-1][1], found[-1][0]))
    best = int(np.argmin([least for _, _, least in found]))
    K, _, least = found[best]
    if 1 < best < len(found) - 1:
        fine = scipy.optimize.minimize_scalar(
            lambda exponent: at(float(np.exp(exponent)), K)[2],
            bounds=(np.log(found[best - 1][1]), np.log(found[best + 1][1])),
            method="bounded",
            options={"xatol": 1e-9},
        )
        finer = at(float(np.exp(fine.x)), K)
        if finer[2] < least:
            return finer
    return found[best]


def _grid(plant: Plant, K: np.ndarray) -> np.ndarray:
    """Values of lambda about the one that makes n as large as w in some state or output."""
    e = error_system(plant, K)
    P = norms.gramian(e.A, e.Bw)
    S = plant.C @ P @ plant.C.T + plant.Dw @ plant.Dw.T
    noise = np.concatenate([np.diagonal(P), np.diagonal(S)])[:, None]
    error = np.vstack([plant.Bn, plant.Dn]) ** 2
    share = np.divide(error, noise, out=np.zeros_like(error), where=noise > 0.0)
    largest = float(np.max(share, initial=0.0))
    return 10.0**_DECADES / (largest or 1.0)


def _gain(plant: Plant, lambda_: float, near: np.ndarray | None = None) -> np.ndarray:
    """Kalman gain for noise [w, sqrt(lambda) n]; ``near`` is a stabilising initial gain, if any."""
    A, C = plant.A, plant.C
    B = np.hstack([plant.Bw, np.sqrt(lambda_) * plant.Bn])
    D = np.hstack([plant.Dw, np.sqrt(lambda_) * plant.Dn])
    state = _sizes(B)[:, None]
    output = _sizes(np.hstack([D, C @ B]))
    scaled = A * state.T / state, B / state, C * state.T / output[:, None], D / output[:, None]
    start = _stabilising(scaled) if near is None else near * output / state
    return _polished(scaled, start) * state / output


def _stabilising(system: norms.System) -> np.ndarray:
    A, B, C, D = system
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, B @ B.T, D @ D.T, s=B @ D.T)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(why_not_steady(system)) from error
    K = _update(system, P)
    if not norms.spectral_radius(A - K @ C) < 1.0:
        raise ValueError(why_not_steady(system))
    return K


def _polished(system: norms.System, K: np.ndarray) -> np.ndarray:
    """Gain refined to rounding by Newton's iteration (Hewer 1971) from a stabilising one."""
    A, B, C, D = system
    change = np.inf
    for _ in range(_STEPS):
        better = _update(system, norms.gramian(A - K @ C, B - K @ D))
        before, change = change, float(np.max(np.abs(better - K)))
        size = float(np.max(np.abs(K)))
        close = change < 1e-7 * size
        if (close and change > 0.5 * before) or norms.spectral_radius(A - better @ C) >= 1.0:
            break
        K = better
        if change <= 1e-15 * size:
            break
    return K


def _update(system: norms.System, P: np.ndarray) -> np.ndarray:
    """Gain K = (A P C' + B D') (C P C' + D D')^-1."""
    A, B, C, D = system
    S = C @ P @ C.T + D @ D.T
    try:
        root = np.linalg.cholesky(S)
    except np.linalg.LinAlgError as error:
        raise ValueError(why_not_steady(system)) from error
    half = np.linalg.solve(root, C @ P @ A.T + D @ B.T)
    return np.linalg.solve(root.T, half).T


def _sizes(rows: np.ndarray) -> np.ndarray:
    """Norms of rows; 1 for a zero row."""
    size = np.linalg.norm(rows, axis=1)
    return np.where(size > 1e-150, size, 1.0)


_CIRCLE = 1e-6  # distance to the unit circle within which an eigenvalue counts as on it
_RANK = 1e-10  # relative singular value that counts as zero
_ANYWHERE = (1.7 + 0.0j, 0.6 + 2.1j, -0.3 + 0.4j)  # generic points for the normal rank
_MEND = "give each measurement noise of its own in Dw (Dv in the current form)"


def why_not_steady(system: norms.System) -> str:
    """Sentence on the violated condition of a steady state of x' = A x + B w, y = C x + D w.

    The Riccati equation has a stabilising solution if (A, C) is detectable and

        [A - zI  B;  C  D]

    has full row rank for every z on the unit circle (Kailath, Sayed & Hassibi, *Linear Estimation*,
    2000, app. E): the noise drives every mode there, and enters every combination of measurements.
    Entries of the matrices must be of order one.
    """
    A, B, C, D = system
    n, m = len(A), len(C)
    none, noise = "the Kalman filter has no steady state: ", f"Dw has rank {_rank(D)}, not {m}, and"

    def pencil(z: complex) -> np.ndarray:
        return np.block([[A - z * np.eye(n), B], [C, D]])

    if lost := n + m - max(_rank(pencil(z)) for z in _ANYWHERE):
        which = "one combination" if lost == 1 else f"{lost} combinations"
        return (
            f"{none}{noise} the noise w does not reach {which} of the measurements through the "
            "state either: known beforehand and free of noise, so that C P C' + Dw Dw' is "
            f"singular; {_MEND}"
        )
    for value in np.linalg.eigvals(A):
        if abs(abs(value) - 1.0) < _CIRCLE and _rank(pencil(complex(value))[:n]) < n:
            return (
                f"{none}the mode of A at {value:.6g} on the unit circle is not driven by w: give "
                "it noise in Bw"
            )
    if _rank(D) < m:
        angle = min(
            np.linspace(0.0, np.pi, 721),
            key=lambda angle: np.linalg.svd(pencil(np.exp(1j * angle)), compute_uv=False)[-1],
        )
        return (
            f"{none}{noise} near z = exp({angle:.4g} i) the noise w does not reach some "
            f"combination of the measurements through the state either; {_MEND}"
        )
    return f"{none}its Riccati equation was not solved; are numbers of A, Bw, C, Dw far apart?"


def _rank(matrix: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=_RANK * np.linalg.norm(matrix, ord=2)))
