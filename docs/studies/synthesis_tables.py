"""Cost of mixed designs: by LMI, retuned, by Riccati equation, in closed form and by search.

python docs/studies/synthesis_tables.py

Five tables, each figure beside its reference value, which is that of an independent prototype. The
plants are those of the tests: two states of which the one not measured is disturbed, the attitude
of one axis with its gyro bias [arcsec], the quaternion, and the patent's. Norms are true ones.
"""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from robins.filters.synthesis import (
    Plant,
    Unreachable,
    closed_form,
    kalman_design,
    least_gamma,
    plant,
    riccati,
    spectral_radius,
)
from robins.filters.synthesis.inequalities import full as full_order_inequalities
from robins.filters.synthesis.lmi import full, observer, retuned
from robins.filters.synthesis.programs import packages

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "filters" / "synthesis"))

from design_plants import attitude_axis, kinematics, quaternion, two_states
from gain_search import best_by_search

furthest: dict[str, float] = {}


def beside(here: float, reference: float, table: str) -> str:
    """A figure, its reference value, and a note of the largest difference of the table."""
    furthest[table] = max(furthest.get(table, 0.0), abs(here / reference - 1.0))
    return f"{here:11.7g} ({reference:.7g})"


def row(*cells: object) -> None:
    print(" | ".join(str(cell) for cell in cells), flush=True)


def two_orders() -> None:
    """Bounds of full-order filters and observers, and what is true of the former."""
    print("\nTwo states: bound of the full order, of the observer; true H2, Hinf of the full order")
    reference = {
        5.0: (0.6623110, 0.65715, 1.68498),
        2.0: (0.7024540, 0.66110, 1.55597),
        1.0: (1.2603915, 0.98380, 0.95739),
        0.8: (2.1827261, 1.62766, 0.77846),
        0.7: (3.4650439, 2.59164, 0.68947),
    }
    for gamma, (bound, h2, hinf) in reference.items():
        own, inside = full(two_states(), gamma), observer(two_states(), gamma)
        row(
            f"gamma {gamma:<4g}",
            beside(own.bound, bound, "bounds"),
            beside(inside.bound, bound, "bounds"),
            beside(own.h2, h2, "norms of full-order filters"),
            beside(own.hinf, hinf, "norms of full-order filters"),
        )
    least = beside(least_gamma(two_states()).proved, 0.594542, "least gamma")
    row("least gamma", least)


def letter(rate_rad_s: float, step_s: float, ss: float = 0.5) -> Plant:
    """The patent's plant: w in the state alone, the star error in n, I + T Omega / 2."""
    euler = quaternion(rate_rad_s * step_s, euler=True)
    Bn = np.hstack([0.5 * step_s * kinematics([1, 0, 0, 0]), np.zeros((4, 4))])
    Dn = np.hstack([np.zeros((4, 3)), ss * np.eye(4)])
    return plant(euler.A, np.eye(4), Bn, np.eye(4), None, Dn)


def infeasible() -> None:
    """Print the answers of Clarabel to full-order LMIs that have no solution."""
    print(
        "\nFull order for a quaternion, gamma 3: rho(A), R >= this, the solver's status, sqrt(cost)"
    )
    cp = packages()
    for rate, step in ((0.1, 0.1), (1.0, 0.5)):
        published = letter(rate, step)._replace(Bn=letter(rate, step).Bn / 3.0)
        published = published._replace(Dn=published.Dn / 3.0)  # n scaled: gamma is 1
        for floor in (1e-9, 1e-4, 1e-2):
            unknowns, matrices = full_order_inequalities(cp, published._asdict(), "mixed")
            kept = [M >> 0 for M in matrices] + [unknowns["R"] >> floor * np.eye(4)]
            problem = cp.Problem(cp.Minimize(cp.trace(unknowns["H"])), kept)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    problem.solve(solver=cp.CLARABEL)
                said, cost = str(problem.status), problem.value
            except cp.SolverError:
                said, cost = "solver_error", None
            answer = f"{np.sqrt(cost):.6f}" if cost is not None and np.isfinite(cost) else ""
            row(f"{spectral_radius(published.A):.7f}", f"{floor:g}", said, answer)
        try:
            full(letter(rate, step), 3.0)
        except ValueError as refusal:
            row("robins", refusal)


def quaternions() -> None:
    """Common (bound), slack, Riccati, closed form."""
    print("\nQuaternion: H2, Hinf of common, slack, Riccati, closed form; bound of common")
    reference = {
        5.0: (3.7660, 1.6922, 3.7637, 1.7707, 3.7637, 1.7707, 3.7637, 1.7707, 3.8050),
        1.5: (3.9514, 1.1880, 3.8594, 1.3275, 3.7947, 1.5000, 3.7947, 1.5000, 4.2075),
        1.0: (4.3472, 0.8963, 4.2310, 0.9577, 4.1634, 1.0000, 4.1633, 1.0000, 4.6785),
        0.7: (5.0747, 0.6690, 4.9689, 0.6921, 4.9352, 0.7000, 4.9351, 0.7000, 5.3690),
        0.52: (6.1367, 0.5174, 6.1116, 0.5199, 6.1106, 0.5200, 6.1106, 0.5200, 6.1957),
    }
    given = quaternion()
    for gamma, expected in reference.items():
        designs = (
            observer(given, gamma),
            observer(given, gamma, "slack"),
            riccati(given, gamma),
            closed_form(given, gamma),
        )
        found = [norm for design in designs for norm in (design.h2, design.hinf)]
        pairs = zip([*found, designs[0].bound], expected, strict=True)
        row(f"gamma {gamma:<4g}", *(beside(a, b, "quaternion") for a, b in pairs))


def prices(name: str, given: Plant, reference: dict[float, tuple]) -> None:
    """H2 of each method that meets gamma."""
    own = kalman_design(given)
    print(f"\n{name} (Kalman filter: H2 {own.h2:.7g}, Hinf {own.hinf:.7g}): H2 by gamma")
    row("gamma", "common", "slack", "common retuned", "slack retuned", "Riccati", "best by search")
    methods: list[Callable] = [
        lambda gamma: observer(given, gamma).h2,
        lambda gamma: observer(given, gamma, "slack").h2,
        lambda gamma: retuned(given, gamma, "common").h2,
        lambda gamma: retuned(given, gamma).h2,
        lambda gamma: riccati(given, gamma).h2,
        lambda gamma: best_by_search(given, gamma, observer(given, gamma).gain),
    ]
    for gamma, expected in reference.items():
        cells = []
        for method, value in zip(methods, expected, strict=True):
            try:
                here = method(gamma)
            except Unreachable:
                cells.append("cannot" if value is None else "MISSED")
            else:
                cells.append(f"{here:.5g}" if value is None else beside(here, value, name))
        row(f"{gamma:<6g}", *cells)


def main() -> None:
    two_orders()
    infeasible()
    quaternions()
    prices(
        "Attitude of an axis, n on the rate",
        attitude_axis(),
        {
            4.9576: (3.0198, 2.9781, None, 2.8924, 2.8924, 2.8924),
            3.8559: (3.1423, 3.0873, None, 2.9706, 2.9706, 2.9706),
            2.7542: (3.4032, 3.3303, None, 3.1984, 3.1983, 3.1983),
            1.6525: (4.0087, 3.9063, None, 3.7716, 3.7716, 3.7716),
            1.1017: (4.6355, 4.5068, None, 4.3789, 4.3788, 4.3788),
            0.5508: (5.8806, 5.7113, None, 5.6129, 5.6129, 5.6128),
        },
    )
    prices(
        "Two states, n on the one not measured",
        two_states(),
        {
            1.0: (0.9838, 0.9539, None, 0.9066, 0.9420, 0.8746),
            0.8: (1.6276, 1.5835, None, 1.5006, 1.6678, 1.4393),
            0.7: (2.5916, 2.5272, None, 2.4225, None, 2.3286),
        },
    )
    print("\nFurthest from the reference:")
    for table, difference in furthest.items():
        row(table, f"{difference:.1e}")


if __name__ == "__main__":
    main()
