"""Scaling of a plant to numbers of order one, and of its design back to the plant's units.

Interior-point solvers stop at absolute tolerances, so a plant in radians, or with an angle in
arcseconds and a bias a thousand times smaller, gets a wrong answer without warning. The states are
balanced by Osborne's method (*On pre-conditioning of matrices*, J. ACM 7, 1960): row and column of
each state get equal norms. The result does not depend on the units of the plant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.filters.synthesis.design import FullOrder
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant

_SWEEPS = 20  # limit of the sweeps
_SETTLED = 1e-2  # relative change of the scales that ends the sweeps


class Scales(NamedTuple):
    """Units of the scaled signals in units of the plant: state = x * scaled state, and so on.

    w, n and z are scalars, since their norms weigh all components equally.
    """

    x: np.ndarray  # (n,) state
    y: np.ndarray  # (m,) measurement
    w: float  # white noise
    n: float  # modelling error
    z: float  # output

    def plant(self, plant: Plant) -> Plant:
        """Plant of the scaled signals."""
        x, y = self.x, self.y
        return Plant(
            A=plant.A / x[:, None] * x,
            Bw=plant.Bw / x[:, None] * self.w,
            Bn=plant.Bn / x[:, None] * self.n,
            C=plant.C / y[:, None] * x,
            Dw=plant.Dw / y[:, None] * self.w,
            Dn=plant.Dn / y[:, None] * self.n,
            L=plant.L / self.z * x,
        )

    def gain(self, K: np.ndarray) -> np.ndarray:
        """Gain (n, m) in units of the plant."""
        return self.x[:, None] * K / self.y

    def full_order(self, Ah: np.ndarray, Bh: np.ndarray, Gh: np.ndarray) -> FullOrder:
        """Full-order filter in units of the plant."""
        x = self.x
        return Ah * x[:, None] / x, Bh * x[:, None] / self.y, Gh / x * self.z

    def h2(self, value: float) -> float:
        """H2 norm in units of the plant."""
        return value * self.z / self.w

    def hinf(self, value: float) -> float:
        """H-infinity norm in units of the plant."""
        return value * self.z / self.n


def balanced(plant: Plant, gamma: Number = np.inf) -> Scales:
    """Scales under which states, measurements, noise and output are of order one.

    gamma is the bound on the gain from n to z, which is scaled to 1; inf scales n to order one.
    """
    x, y, w, n, z = np.ones(len(plant.A)), np.ones(len(plant.C)), 1.0, 1.0, 1.0
    for _ in range(_SWEEPS):
        scaled = Scales(x, y, w, n, z).plant(plant)
        coupling = scaled.A - np.diag(np.diag(scaled.A))
        enters = _norms(coupling, scaled.Bw, scaled.Bn)
        leaves = _norms(coupling.T, scaled.C.T, scaled.L.T)
        both = (enters > 0.0) & (leaves > 0.0)
        change = np.sqrt(np.divide(enters, leaves, out=np.ones_like(x), where=both))
        x = x * change
        output = _norms(scaled.C, scaled.Dw, scaled.Dn)
        y = y * np.where(output > 0.0, output, 1.0)
        scaled = Scales(x, y, w, n, z).plant(plant)
        w = w / _size(scaled.Bw, scaled.Dw)
        z = z * _size(scaled.L)
        n = n / _size(scaled.Bn, scaled.Dn) if np.isinf(gamma) else z / gamma
        if np.max(np.abs(change - 1.0)) < _SETTLED:
            break
    return Scales(x, y, w, n, z)


def _norms(*blocks: np.ndarray) -> np.ndarray:
    """(n,) norms of the rows of blocks side by side."""
    return np.sqrt(sum(np.sum(block**2, axis=1) for block in blocks))


def _size(*blocks: np.ndarray) -> float:
    """Root mean square of the norms of nonzero rows; 1 if there is none."""
    squares = np.concatenate([np.sum(block**2, axis=1) for block in blocks])
    rows = np.count_nonzero(squares)
    return float(np.sqrt(squares.sum() / rows)) if rows else 1.0
