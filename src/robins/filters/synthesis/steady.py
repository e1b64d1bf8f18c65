"""Why a plant has no steady Kalman filter.

The Riccati equation has a stabilising solution if (A, C) is detectable and

    [A - zI  B;  C  D]

has full row rank for every z on the unit circle (Kailath, Sayed & Hassibi, *Linear Estimation*,
2000, app. E): the noise drives every mode there, and reaches every combination of measurements.
"""

from __future__ import annotations

import numpy as np

_CIRCLE = 1e-6  # eigenvalues as near to the unit circle count as on it
_RANK = 1e-10  # relative singular value that counts as zero
_ANYWHERE = (1.7 + 0.0j, 0.6 + 2.1j, -0.3 + 0.4j)  # points at which the rank is that of almost all
_MEND = "give each measurement noise of its own in Dw (Dv in the current form)"


def why_not_steady(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> str:
    """The condition that is violated, in a sentence.

    Args:
        A: (n, n), in units in which numbers are of order one; so are the others.
        B: (n, p) how the noise moves the state.
        C: (m, n).
        D: (m, p) how the noise enters the measurement.
    """
    n, m = len(A), len(C)
    none, noise = "the Kalman filter has no steady state: ", f"Dw has rank {_rank(D)}, not {m}, and"

    def system(z: complex) -> np.ndarray:
        return np.block([[A - z * np.eye(n), B], [C, D]])

    if lost := n + m - max(_rank(system(z)) for z in _ANYWHERE):
        which = "one combination" if lost == 1 else f"{lost} combinations"
        return (
            f"{none}{noise} the noise w does not reach {which} of the measurements through the "
            "state either: known beforehand and free of noise, so that C P C' + Dw Dw' is "
            f"singular; {_MEND}"
        )
    for value in np.linalg.eigvals(A):
        if abs(abs(value) - 1.0) < _CIRCLE and _rank(system(complex(value))[:n]) < n:
            return (
                f"{none}the mode of A at {value:.6g} on the unit circle is not driven by w: give "
                "it noise in Bw"
            )
    if _rank(D) < m:
        angle = min(
            np.linspace(0.0, np.pi, 721),
            key=lambda angle: np.linalg.svd(system(np.exp(1j * angle)), compute_uv=False)[-1],
        )
        return (
            f"{none}{noise} near z = exp({angle:.4g} i) the noise w does not reach some "
            f"combination of the measurements through the state either; {_MEND}"
        )
    return f"{none}its Riccati equation was not solved; are numbers of A, Bw, C, Dw far apart?"


def _rank(matrix: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=_RANK * np.linalg.norm(matrix, ord=2)))
