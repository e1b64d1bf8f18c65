"""Plant of a filter design: a linear system with white noise and a modelling error.

    x(k+1) = A x + Bw w + Bn n,     y = C x + Dw w + Dn n,     z = L x

w is white noise of unit covariance, n any signal of finite energy (a modelling error), z the output
to estimate. A gain K defines the observer ``x^(k+1) = A x^ + K (y - C x^)``, whose error
e = x - x^ obeys

    e(k+1) = (A - K C) e + (Bw - K Dw) w + (Bn - K Dn) n.

Results are independent of the units of the states.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.errors import require
from robins.filters.checks import Matrix, matrix

_MARGINAL = 1e-7  # distance inside the circle to which rounding may move a defective eigenvalue
_UNSEEN = 1e-9  # least singular value of the scaled Popov-Belevitch-Hautus matrix that counts as 0


class Plant(NamedTuple):
    """Matrices of a plant, float64; made by `plant` or `current_form`, which check them."""

    A: np.ndarray  # (n, n) transition
    Bw: np.ndarray  # (n, p) process noise
    Bn: np.ndarray  # (n, q) modelling error of the motion
    C: np.ndarray  # (m, n) measurement
    Dw: np.ndarray  # (m, p) measurement noise
    Dn: np.ndarray  # (m, q) modelling error of the measurement
    L: np.ndarray  # (r, n) rows to estimate


class ErrorSystem(NamedTuple):
    """Error dynamics of an observer: e(k+1) = A e + Bw w + Bn n, z - z^ = L e."""

    A: np.ndarray  # (n, n)
    Bw: np.ndarray  # (n, p)
    Bn: np.ndarray  # (n, q)
    L: np.ndarray  # (r, n)


def plant(
    A: Matrix,
    Bw: Matrix,
    Bn: Matrix,
    C: Matrix,
    Dw: Matrix | None = None,
    Dn: Matrix | None = None,
    L: Matrix | None = None,
) -> Plant:
    """Plant with K as predictor gain: x^(k+1) = A x^ + K (y - C x^).

    Arguments are the blocks of `Plant`; by default Dw and Dn are zero, and L is the identity.

    Raises:
        TypeError: a block is not made of real numbers.
        ValueError: a block is not a matrix, has the wrong shape or is not finite, or a mode that
            does not decay is unobservable in y. The message names the block or the mode.
    """
    A, Bw, Bn, C = (matrix(*one) for one in (("A", A), ("Bw", Bw), ("Bn", Bn), ("C", C)))
    n, m = A.shape[0], C.shape[0]
    require(A.shape[1] == n and n != 0, f"A is {A.shape}: the transition of a state must be square")
    require(m != 0, f"C is {C.shape}: nothing is measured")
    why = f"A says that x has {n} components"
    _require_shape("C", C, (m, n), why)
    _require_shape("Bw", Bw, (n, Bw.shape[1]), why)
    _require_shape("Bn", Bn, (n, Bn.shape[1]), why)
    Dw = _feedthrough(Dw, "Dw", m, Bw, "w")
    Dn = _feedthrough(Dn, "Dn", m, Bn, "n")
    L = np.eye(n) if L is None else matrix("L", L)
    require(
        L.shape[1] == n and L.shape[0] != 0,
        f"L is {L.shape}, must have one row for each number to be estimated and {n} columns: {why}",
    )
    _refuse_undetectable(A, C)
    return Plant(A, Bw, Bn, C, Dw, Dn, L)


def current_form(
    A: Matrix,
    Bw: Matrix,
    Bn: Matrix,
    C: Matrix,
    Dv: Matrix,
    L: Matrix | None = None,
    Dn: Matrix | None = None,
) -> Plant:
    """Plant with K as correction gain, as in navigation: x^ = x- + K (y - C x-), x- = A x^.

    The error after the correction obeys e(k+1) = (I - K C)(A e + Bw w + Bn n) - K (Dv v + Dn n),
    which is the error of a predictor for the plant with C A in place of C, noise [w, v],
    Bw = [Bw, 0], Dw = [C Bw, Dv] and Dn = C Bn + Dn. So the K of every design is the gain of the
    correction. (The gain of the predictor would be A K.)

    Arguments are those of `plant`, from one measurement to the next, and Dv (m, v), the factor of
    the measurement noise v, independent of w. Errors are those of `plant`.
    """
    given = plant(A, Bw, Bn, C, None, Dn, L)
    Dv = matrix("Dv", Dv)
    n, m = len(given.A), len(given.C)
    _require_shape("Dv", Dv, (m, Dv.shape[1]), f"C says that y has {m} components")
    Bw, Dw = np.hstack([given.Bw, np.zeros((n, Dv.shape[1]))]), np.hstack([given.C @ given.Bw, Dv])
    C, Dn = given.C @ given.A, given.C @ given.Bn + given.Dn
    return given._replace(Bw=Bw, C=C, Dw=Dw, Dn=Dn)


def error_system(plant: Plant, K: Matrix) -> ErrorSystem:
    """Error of the observer with gain K: A - K C, Bw - K Dw, Bn - K Dn and L.

    Raises:
        TypeError: K is not made of real numbers.
        ValueError: K is not (n, m) or not finite.
    """
    K = matrix("K", K)
    n, m = len(plant.A), len(plant.C)
    _require_shape("K", K, (n, m), f"x has {n} components and y has {m}")
    return ErrorSystem(
        plant.A - K @ plant.C, plant.Bw - K @ plant.Dw, plant.Bn - K @ plant.Dn, plant.L
    )


def _require_shape(name: str, block: np.ndarray, shape: tuple[int, int], why: str) -> None:
    require(block.shape == shape, f"{name} is {block.shape}, must be {shape}: {why}")


def _feedthrough(D: Matrix | None, name: str, m: int, B: np.ndarray, signal: str) -> np.ndarray:
    wanted = (m, B.shape[1])
    D = np.zeros(wanted) if D is None else matrix(name, D)
    why = f"C says that y has {m} components and B{signal} that {signal} has {wanted[1]}"
    if D.shape[0] == m:
        why += (
            f". If {signal} has parts of its own in y, give them columns: B{signal} = [B{signal}, "
            f"0] and {name} = [0, {name}]"
        )
    _require_shape(name, D, wanted, why)
    return D


def _refuse_undetectable(A: np.ndarray, C: np.ndarray) -> None:
    """Raise if a mode with |eigenvalue| >= 1 is unobservable in y (Popov-Belevitch-Hautus)."""
    values = np.linalg.eigvals(A)
    size = np.linalg.norm(C, axis=1, keepdims=True)
    rows = C / np.where(size > 0.0, size, 1.0)
    for value in values[np.abs(values) >= 1.0 - _MARGINAL]:
        # The computed eigenvalues of a defective block scatter, but their mean is accurate.
        cluster = values[np.abs(values - value) < 1e-4 * np.abs(value)]
        for eigenvalue in (complex(value), complex(cluster.mean())):
            if (direction := _unseen(A, rows, eigenvalue)) is not None:
                k = int(np.argmax(np.abs(direction)))
                raise ValueError(
                    f"(A, C) is not detectable: the mode of A at {_written(eigenvalue)} does not "
                    f"decay by itself and is not seen in y = C x (it lies mostly along state {k}, "
                    "counted from 0). Measure it, or leave it out of the state"
                )


def _unseen(A: np.ndarray, C: np.ndarray, eigenvalue: complex) -> np.ndarray | None:
    """Direction x with A x = eigenvalue x and C x = 0, or None.

    Columns are scaled to unit norm, so that the units of states do not matter.
    """
    test = np.vstack([A - eigenvalue * np.eye(len(A)), C])
    size = np.linalg.norm(test, axis=0)
    scale = np.where(size > 1e-13 * np.abs(eigenvalue), size, 1.0)
    _, singular, right = np.linalg.svd(test / scale)
    if singular[-1] > _UNSEEN:
        return None
    direction = right[-1].conj() / scale
    return direction / np.linalg.norm(direction)


def _written(eigenvalue: complex) -> str:
    if abs(eigenvalue.imag) < 1e-9 * abs(eigenvalue):
        return f"{eigenvalue.real:.6g}"
    return f"{eigenvalue.real:.6g} {eigenvalue.imag:+.6g}i"
