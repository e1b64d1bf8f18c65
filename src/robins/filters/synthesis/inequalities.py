"""Linear matrix inequalities of filter designs, in the symbols of their equations.

They have a channel of white noise w and one of a modelling error n; equations are numbered as in
docs/filters/mixed.md. A function takes the optional module `cvxpy`, the plant's matrices by name
and the aim; it returns the unknowns by symbol and the matrices that must be positive semidefinite.
Gains K are those of an observer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from robins.filters.synthesis.plant import Plant

if TYPE_CHECKING:
    from cvxpy import Expression as Expr
else:
    Expr = Any

Aim = Literal["h2", "mixed"]
"""Least Trace(H) for w alone, or also with a gain from n of at most 1."""

Blocks = Mapping[str, Expr]
Inequalities = tuple[dict[str, Expr], list[Expr]]


def common(cp: ModuleType, plant: Blocks, aim: Aim) -> Inequalities:
    """Inequalities (9) and (10): one Lyapunov matrix X for both channels; K = X^-1 Y."""
    X = cp.Variable(plant["A"].shape, symmetric=True, name="X")
    Y = cp.Variable(plant["C"].T.shape, name="Y")
    H = _trace_matrix(cp, plant)
    error = (_energy if aim == "h2" else _gain)(cp, plant, X, X, X, Y)
    return {"X": X, "Y": Y, "H": H}, [_noise(cp, plant, H, X, X, Y), error]


def slack(cp: ModuleType, plant: Blocks, aim: Aim) -> Inequalities:
    """Inequalities (9), (10) with a Lyapunov matrix per channel, X2, Xi, and G; K = G^-1 Y."""
    A = plant["A"]
    G = cp.Variable(A.shape, name="G")
    Y = cp.Variable(plant["C"].T.shape, name="Y")
    H, X2 = _trace_matrix(cp, plant), cp.Variable(A.shape, symmetric=True, name="X2")
    unknowns, corner = {"G": G, "Y": Y, "H": H, "X2": X2}, G + G.T - X2
    matrices = [_noise(cp, plant, H, corner, G, Y), _energy(cp, plant, corner, X2, G, Y)]
    if aim == "mixed":
        Xi = unknowns["Xi"] = cp.Variable(A.shape, symmetric=True, name="Xi")
        matrices.append(_gain(cp, plant, G + G.T - Xi, Xi, G, Y))
    return unknowns, matrices


def full(cp: ModuleType, plant: Blocks, aim: Aim) -> Inequalities:
    """Inequalities (6), (7): full-order filter by R, P, S, Q, U of (8); always for aim "mixed"."""
    A, Bw, Bn, C, Dw, Dn, L = (plant[name] for name in Plant._fields)
    R, P = (cp.Variable(A.shape, symmetric=True, name=name) for name in "RP")
    S, Q = cp.Variable(A.shape, name="S"), cp.Variable(C.T.shape, name="Q")
    U, H, moved = cp.Variable(L.shape, name="U"), _trace_matrix(cp, plant), P @ A + Q @ C
    error = _symmetric(
        cp,
        [R, R, R @ A, R @ A, R @ Bn, 0],
        [P, moved + S, moved, P @ Bn + Q @ Dn, 0],
        [R, R, 0, (L - U).T],
        [P, 0, L.T],
        [np.eye(Bn.shape[1]), 0],
        [np.eye(L.shape[0])],
    )
    noise = _symmetric(cp, [H, (R @ Bw).T, (P @ Bw + Q @ Dw).T], [R, R], [P])
    return {"R": R, "P": P, "S": S, "Q": Q, "U": U, "H": H}, [noise, error]


def _trace_matrix(cp: ModuleType, plant: Blocks) -> Expr:
    """H, whose trace bounds the squared H2 norm."""
    p = plant["Bw"].shape[1]
    return cp.Variable((p, p), symmetric=True, name="H")


def _noise(cp: ModuleType, plant: Blocks, H: Expr, corner: Expr, X: Expr, Y: Expr) -> Expr:
    """Inequality (9)."""
    return _symmetric(cp, [H, (X @ plant["Bw"] - Y @ plant["Dw"]).T], [corner])


def _energy(cp: ModuleType, plant: Blocks, corner: Expr, X: Expr, G: Expr, Y: Expr) -> Expr:
    """Inequality (10) without the row and the column of n."""
    L = plant["L"]
    return _symmetric(
        cp, [corner, G @ plant["A"] - Y @ plant["C"], 0], [X, L.T], [np.eye(L.shape[0])]
    )


def _gain(cp: ModuleType, plant: Blocks, corner: Expr, X: Expr, G: Expr, Y: Expr) -> Expr:
    """Inequality (10)."""
    L, Bn = plant["L"], plant["Bn"]
    error, disturbed = G @ plant["A"] - Y @ plant["C"], G @ Bn - Y @ plant["Dn"]
    return _symmetric(
        cp,
        [corner, error, disturbed, 0],
        [X, 0, L.T],
        [np.eye(Bn.shape[1]), 0],
        [np.eye(L.shape[0])],
    )


def _symmetric(cp: ModuleType, *rows: Sequence[Any]) -> Expr:
    """Symmetric block matrix from the blocks on and above its diagonal; 0 is a zero block."""
    size = [row[0].shape[0] for row in rows]
    whole: list[list[Any]] = [[None] * len(rows) for _ in rows]
    for i, row in enumerate(rows):
        for j, block in enumerate(row, start=i):
            entry = np.zeros((size[i], size[j])) if isinstance(block, int) else block
            whole[i][j], whole[j][i] = entry, entry if i == j else entry.T
    return cp.bmat(whole)
