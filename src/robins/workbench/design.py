"""The command `design`: filters with constant gains, and the cost of a bound on the worst case.

Examples::

    robins design attitude-axis
    robins design my.toml --gamma "1, 0.8" --methods riccati,retuned-slack --json
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import xarray as xr

from robins.filters.synthesis import METHODS, Attempt, Design, TradeOff, trade_off
from robins.report.numbers import csv_of
from robins.results import Outcome, Progress, array, ignore_progress, variable
from robins.results.summary import dumps, plain
from robins.workbench.design_problem import DesignProblem, read_problem
from robins.workbench.errors import InputError, refusing
from robins.workbench.options import Option

GAINS, TABLE = "gains.json", "trade_off.csv"
_NUMBERS = ("h2", "hinf", "hinf_sweep", "bound", "radius", "lambda_", "seconds")
_MISSING = "robins[design]"  # in the message of a method whose packages are not installed


def as_text(gammas: Sequence[float]) -> list[str]:
    """Gammas with as few digits as distinguish them, four at least."""
    for digits in range(4, 18):
        texts = [f"{gamma:.{digits}g}" for gamma in gammas]
        if len(set(texts)) == len(texts):
            return texts
    return [repr(gamma) for gamma in gammas]


def cell(attempt: Attempt) -> str:
    """Entry of a table where a method has no design."""
    if np.isfinite(attempt.least):
        return f"cannot, least {attempt.least:.4g}"
    return "not certified"


def metrics_of(found: TradeOff) -> dict[str, dict[str, float | str | None]]:
    """Norms by method and gamma."""
    columns: dict[str, dict[str, float | str | None]] = {
        "kalman": {"h2": found.kalman.h2, "hinf": found.kalman.hinf}
    }
    for gamma, text in zip(found.gammas, as_text(found.gammas), strict=True):
        for attempt in (a for a in found.attempts if a.gamma == gamma):
            column = columns.setdefault(attempt.method, {})
            made = attempt.design
            column[f"h2_at_gamma_{text}"] = cell(attempt) if made is None else made.h2
            column[f"hinf_at_gamma_{text}"] = None if made is None else made.hinf
    return columns


def solution_of(problem: DesignProblem, found: TradeOff) -> xr.Dataset:
    """Norms as arrays (design, gamma); the first is the method."""
    methods = list(dict.fromkeys(a.method for a in found.attempts))

    def numbers(name: str) -> np.ndarray:
        values = np.full((len(methods), len(found.gammas)), np.nan)
        for a in found.attempts:
            if a.design is not None:
                at = methods.index(a.method), found.gammas.index(a.gamma)
                values[at] = getattr(a.design, name)
        return values

    z, gain, least = problem.unit_z, problem.unit_gain, found.least.reached
    gamma = variable("gamma", np.array(found.gammas), gain, "bound on the H-infinity norm")
    return xr.Dataset(
        array("trade_off_h2", numbers("h2"), unit=z)
        | array(
            "trade_off_hinf", numbers("hinf"), unit=gain, least=least, least_of=_gain_set(found)
        )
        | array("trade_off_bound", numbers("bound"), unit=z)
        | array("kalman_h2", found.kalman.h2, unit=z)
        | array("kalman_hinf", found.kalman.hinf, unit=gain),
        {"design": methods, "gamma": gamma},
    )


def gains_of(problem: DesignProblem, found: TradeOff) -> dict[str, Any]:
    """Every gain with full digits, and the methods without one."""
    made = [("kalman", found.kalman)]
    made += [(o.method, o.design) for o in found.attempts if o.design is not None]
    refused = [o for o in found.attempts if o.design is None]
    return {
        "problem": problem.name,
        "form": problem.form,
        "blocks": problem.blocks,
        "least_gamma": found.least.reached,
        "least_gamma_of": _gain_set(found),
        "least_gamma_proved": found.least.proved,
        "least_gamma_step": found.least.step,
        "designs": [_design_row(name, design) for name, design in made],
        "not_reached": [
            {"method": o.method, "gamma": o.gamma, "why": o.why, "least": o.least} for o in refused
        ],
        "left_out": found.left_out,
    }


def _design_row(name: str, design: Design) -> dict[str, Any]:
    row: dict[str, Any] = {"method": name, "gamma": design.gamma, "order": design.order}
    if design.filter is None:
        row["K"] = design.gain
    else:
        row |= dict(zip(("Ah", "Bh", "Gh"), design.filter, strict=True))
    row |= {number.rstrip("_"): getattr(design, number) for number in _NUMBERS}
    return row | {"status": design.status}


def table_of(found: TradeOff) -> bytes:
    """The curve as CSV, a row for each method and gamma."""
    rows = [["method", "gamma", *(n.rstrip("_") for n in _NUMBERS), "not_reached"]]
    kalman = Attempt("kalman", np.inf, found.kalman, "", np.nan)
    for o in (kalman, *found.attempts):
        numbers = [repr(float(getattr(o.design, n))) if o.design else "" for n in _NUMBERS]
        rows.append([o.method, repr(o.gamma), *numbers, o.why])
    return csv_of(rows)


def advice(problem: DesignProblem, found: TradeOff) -> list[str]:
    """Conclusions from the numbers, in sentences."""
    own, gain = found.kalman, _unit(problem.unit_gain)
    least = found.least
    reach = f"the least Hinf of {_gain_set(found)} is {least.reached:.4g}{gain}"
    if least.reached == 0.0:
        reach = "no Hinf is too small to be reached"
    elif least.exact:
        reach += f" (the Riccati recursion of the game proves it at step {least.step})"
    else:
        reach += f"; a smaller one is refuted only below {least.proved:.4g}"
    notes = [
        f"The Kalman filter has H2 {own.h2:.4g}{_unit(problem.unit_z)} and Hinf {own.hinf:.4g}"
        f"{gain}; {reach}."
    ]
    for gamma, text in zip(found.gammas, as_text(found.gammas), strict=True):
        if (best := found.best(gamma)) is not None and best.design is not None:
            cost = best.design.h2 / own.h2 - 1.0 if own.h2 > 0.0 else np.nan
            notes.append(
                f"gamma {text}: least H2 {best.design.h2:.4g}{_unit(problem.unit_z)} by "
                f"{best.method}, {cost:+.1%} of the Kalman filter's."
            )
        else:
            notes.append(f"gamma {text}: no method of these reaches it.")
    missing = [name for name, why in found.left_out.items() if _MISSING in why]
    if missing:
        notes.append(
            f"Left out: {', '.join(missing)}; they need cvxpy and Clarabel: "
            f"pip install '{_MISSING}'. They may reach a gamma that the others do not."
        )
    for name, why in found.left_out.items():
        if name not in missing:
            notes.append(f"Left out: {name}: {why}.")
    return notes


def _gain_set(found: TradeOff) -> str:
    """Set of gains that the least gamma refers to."""
    return "any gain" if found.least.exact or found.least.reached == 0.0 else "the gains found"


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def gammas_of(text: str | None) -> list[float] | None:
    """Gammas of a text, "1, 0.8".

    Raises:
        InputError: one of them is not a number.
    """
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError('give numbers, such as "1, 0.8".', f"--gamma {text!r}") from error


def design(
    given: Annotated[str, Option(metavar="PROBLEM")],
    *,
    gamma: Annotated[
        str | None, Option("Bounds on the H-infinity norm. [default: a range]", metavar="a,b")
    ] = None,
    methods: Annotated[
        Sequence[str], Option("Which methods to compare.", metavar="a,b", names=True)
    ] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Design constant gains for PROBLEM, a TOML file with the matrices of a plant or an example.

    It compares methods that keep the gain from a modelling error to the estimate below gamma, by
    the true norm from noise to the estimate. Examples: attitude-axis, attitude-axis-drift,
    baro-height, two-states.

    Args:
        given: the path of a problem, or the name of an example.
        gamma: bounds on the H-infinity norm, "1, 0.8"; by default those of the problem, or a range.
        methods: to compare; by default all.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError: the problem, a gamma or a method cannot be used.
    """
    asked = gammas_of(gamma)
    problem = read_problem(given)
    with refusing(given):
        found = trade_off(
            problem.plant,
            problem.gammas if asked is None else asked,
            methods or METHODS,
            lambda done, total, what: progress(done / max(total, 1), what),
        )
    return Outcome(
        solution_of(problem, found),
        metrics_of(found),
        files={
            GAINS: dumps(plain(gains_of(problem, found))).encode(),
            TABLE: table_of(found),
        },
        notes=advice(problem, found),
        scenario=f"design/{problem.name}",
        parameters=problem.text,
        title=problem.title,
        last_lines=[
            f"Gains:  {{out}}/{GAINS}   (every digit; {TABLE} has the curve)",
            _next(given, problem, found),
        ],
    )


def _next(given: str, problem: DesignProblem, found: TradeOff) -> str:
    usable = [o for g in found.gammas if (o := found.best(g)) is not None and o.design is not None]
    if not usable:
        within = f"{1.05 * found.least.reached:.4g}"
        return f'Next:   robins design {given} --gamma "{within}"   is in reach'
    inflated = [
        o.design
        for o in found.attempts
        if o.method == "riccati" and o.design is not None and o.design.lambda_ > 0.0
    ]
    if inflated and not np.any(problem.blocks.get("Dn", 0.0)):
        middle = inflated[len(inflated) // 2]
        return (
            f"Next:   kalman(taylor(), [channel_inflation({middle.lambda_:.6g}, Bn)])   is the "
            f"filter for gamma {middle.gamma:.4g}"
        )
    return 'Next:   kalman(taylor(), [constant_gain({"sensor": K})])   runs with a gain of these'
