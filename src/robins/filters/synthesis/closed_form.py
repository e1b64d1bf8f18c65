"""Closed-form design for a plant whose transition is a scaled rotation and whose state is measured.

With A = rho U, U orthogonal, C = I, noise of variance sw^2 in every state and ss^2 in every
measurement, a gain K = k U leaves the error e(k+1) = f U e + ..., f = rho - k, and

    |T_we|_2^2 = |L|_F^2 (sw^2 + k^2 ss^2) / (1 - f^2),    |T_ne|_inf = l b / (1 - f),   0 <= f < 1

where b is the greatest singular value of Bn and l that of L, with L'L a multiple of the identity.
(The second value is attained if Bn drives an invariant direction of U with gain b, as the angular
rate does in a quaternion; otherwise it is a bound.) The attitude quaternion of a rotating body is
such a plant at every instant, with rho = 1.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from robins.errors import require
from robins.filters.synthesis.design import Design, Unreachable, certify
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.riccati import check_gamma

_SAME = 1e-9  # relative difference of equal numbers


class Isotropic(NamedTuple):
    """Parameters of a plant with a closed-form design (module docstring)."""

    rho: float  # |A|_2
    U: np.ndarray  # (n, n) orthogonal, A / rho
    sw: float  # standard deviation of the noise of each state
    ss: float  # standard deviation of the noise of each measurement
    b: float  # greatest singular value of Bn
    weight: float  # greatest singular value of L
    size: float  # |L|_F

    def kalman(self) -> float:
        """Gain k of the Kalman filter, rho p / (p + ss^2), p the predicted variance."""
        sw2, ss2 = self.sw**2, self.ss**2
        half = 0.5 * (sw2 - ss2 * (1.0 - self.rho**2))
        root = np.hypot(half, self.sw * self.ss)
        # The positive root without cancellation.
        p = half + root if half > 0.0 else (sw2 * ss2 / (root - half) if root > half else 0.0)
        return float(self.rho * p / (p + ss2)) if p + ss2 > 0.0 else self.rho

    def gain(self, gamma: Number) -> float:
        """Least k that meets gamma and is not below that of the Kalman filter.

        Raises:
            Unreachable: k would exceed rho, since gamma is below l b.
        """
        k = max(self.kalman(), self.rho - 1.0 + self.weight * self.b / gamma)
        if k > self.rho * (1.0 + 1e-12):
            least = self.weight * self.b
            raise Unreachable(
                f"no gain k <= rho = {self.rho:.6g} meets gamma {gamma:.6g}: the least gamma of "
                f"this form is {least:.6g}, at k = rho",
                least,
            )
        return min(k, self.rho)

    def h2(self, k: Number) -> float:
        """H2 norm for the gain k."""
        f = self.rho - k
        return float(self.size * np.sqrt((self.sw**2 + k**2 * self.ss**2) / (1.0 - f**2)))

    def hinf(self, k: Number) -> float:
        """H-infinity norm for the gain k, or a bound of it (module docstring)."""
        return float(self.weight * self.b / (1.0 - abs(self.rho - k)))


def isotropic(plant: Plant) -> Isotropic:
    """Parameters of a plant with a closed-form design.

    Raises:
        ValueError: the plant has no closed form; the message names the block.
    """
    n = len(plant.A)
    size = float(np.linalg.norm(plant.A, ord=2))
    require(size != 0.0, "no closed form: A is zero")
    spread, noise, each = plant.Bw @ plant.Bw.T, plant.Dw @ plant.Dw.T, plant.L.T @ plant.L
    sw2, ss2, eye = np.trace(spread) / n, np.trace(noise) / len(noise), np.eye(n)
    demands = (
        (_same(plant.A @ plant.A.T / size**2, eye), "A is no multiple of an orthogonal matrix"),
        (plant.C.shape == (n, n) and _same(plant.C, eye), "C is not the identity"),
        (_same(spread, sw2 * eye), "Bw Bw' is no multiple of the identity"),
        (_same(noise, ss2 * eye), "Dw Dw' is no multiple of the identity"),
        (np.abs(plant.Bw @ plant.Dw.T).max() <= _SAME * np.sqrt(sw2 * ss2), "w is in both x and y"),
        (not np.any(plant.Dn), "n enters the measurement"),
        (_same(each, np.trace(each) / n * eye), "L'L is no multiple of the identity"),
    )
    for met, why in demands:
        require(met, f"no closed form: {why}")
    b = float(np.linalg.norm(plant.Bn, ord=2)) if plant.Bn.size else 0.0
    weight, whole = float(np.linalg.norm(plant.L, ord=2)), float(np.linalg.norm(plant.L))
    sw, ss = float(np.sqrt(sw2)), float(np.sqrt(ss2))
    return Isotropic(size, plant.A / size, sw, ss, b, weight, whole)


def closed_form(plant: Plant, gamma: Number) -> Design:
    """Gain k U that meets gamma with the least H2 norm; the Kalman filter if gamma is inf.

    Raises:
        Unreachable: gamma is below the least of this form, which the message states.
        ValueError: the plant has no closed form, or gamma is not positive.
    """
    check_gamma(gamma)
    began = time.perf_counter()
    scalar = isotropic(plant)
    k = scalar.gain(gamma)
    seconds = time.perf_counter() - began
    return certify(
        plant, k * scalar.U, method="closed-form", gamma=gamma, bound=scalar.h2(k), seconds=seconds
    )


def _same(matrix: np.ndarray, wanted: np.ndarray) -> bool:
    alike = matrix.shape == wanted.shape
    return alike and bool(np.abs(matrix - wanted).max() <= _SAME * np.abs(wanted).max())
