"""Semidefinite programs of filter designs, built once per shape and solved for many plants.

For a small design cvxpy spends most of its time on the canonical form of expressions. With
disciplined *parametrised* programming, the plant's matrices being parameters, this is done once.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from threading import Lock
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from robins.errors import RobinsError
from robins.filters.synthesis import inequalities
from robins.filters.synthesis.inequalities import Aim
from robins.filters.synthesis.plant import Plant

if TYPE_CHECKING:
    from cvxpy import Problem
else:
    Problem = Any

Form = Literal["common", "slack", "full"]

# If gamma is tight, R and thus the full-order problem are nearly singular; more refinement of each
# linear solve gains a digit there and costs a tenth more time elsewhere.
_CLARABEL = {"iterative_refinement_max_iter": 30, "iterative_refinement_stop_ratio": 2.0}
_LOCK = Lock()  # a program's parameters belong to one solve at a time


class MissingExtra(RobinsError, ImportError):
    """The packages for designs by LMI are not installed."""

    bad_input = False


class SolverAnswer(NamedTuple):
    """Unchecked answer of a solver."""

    status: str
    value: float  # Trace(H); nan without a solution
    unknowns: dict[str, np.ndarray]  # by the symbols of the equations; empty without a solution


def solve(plant: Plant, form: Form, aim: Aim) -> SolverAnswer:
    """Solve a design program: "common" is (9) and (10), "slack" their slack form, "full" (6), (7).

    Numbers of the plant should be of order one, and the gain from n to z at most 1
    (`robins.filters.synthesis.scaling`).

    Raises:
        MissingExtra: cvxpy or Clarabel is not installed.
    """
    cp = packages()
    with _LOCK:
        sizes = (*plant.Bw.shape, plant.Bn.shape[1], len(plant.C), len(plant.L))
        problem = build(form, aim, *sizes)
        for name, parameter in problem.param_dict.items():
            parameter.value = getattr(plant, name)
        try:
            # No warnings, since true norms are checked; no warm start, which keeps the scaling of
            # the first plant.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                problem.solve(solver=cp.CLARABEL, warm_start=False, **_CLARABEL)
        except cp.SolverError:
            return SolverAnswer("solver_error", np.nan, {})
        found = {name: unknown.value for name, unknown in problem.var_dict.items()}
        status = str(problem.status)
        if any(value is None or not np.isfinite(value).all() for value in found.values()):
            return SolverAnswer(status, np.nan, {})
        return SolverAnswer(status, float(problem.value), found)  # type: ignore[arg-type]


@lru_cache(maxsize=64)
def build(form: Form, aim: Aim, n: int, p: int, q: int, m: int, r: int) -> Problem:
    """Program for n states, p and q components of w and n, m measurements and r outputs."""
    cp = packages()
    sizes = (n, n), (n, p), (n, q), (m, n), (m, p), (m, q), (r, n)
    named = zip(Plant._fields, sizes, strict=True)
    parameters = {name: cp.Parameter(size, name=name) for name, size in named}
    unknowns, matrices = getattr(inequalities, form)(cp, parameters, aim)
    cost = cp.trace(unknowns["H"])
    return cp.Problem(cp.Minimize(cost), [matrix >> 0 for matrix in matrices])


def packages() -> ModuleType:
    """Import the optional module cvxpy, which takes a second.

    Raises:
        MissingExtra: cvxpy or Clarabel is not installed.
    """
    try:
        import clarabel  # noqa: F401  # pyright: ignore[reportUnusedImport]
        import cvxpy
    except ImportError as error:
        raise MissingExtra(
            f"designs by LMI need cvxpy and Clarabel ({error}): pip install 'robins[design]'. The "
            "Riccati designs (robins.filters.synthesis.riccati) do without"
        ) from error
    return cvxpy
