"""The study "attitude-matching": filters, their properties without a run, and claims.

All filters work in radians and differ in their assumptions. The paper's H-infinity filter has
R = I and L = I in an unstated unit u of angle, which is R = u^2 and gamma in u here; apart from P0,
the unit changes nothing else. Covariances do not depend on data in this system, so neither do
gamma_min and feasibility.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.tree_util import Partial

from robins import units
from robins.filters import Filter, Step, kalman, run
from robins.filters.rules.h_infinity import Infeasible, h_infinity, with_gamma
from robins.results import Probability, array
from robins.sim.flexure import Flexure
from robins.systems.judgement import Claim, Metric, Metrics, graded, ratio, rms_by_axis
from robins.systems.parts import ENU, RFU
from robins.systems.study import Case, Contender, Limit, SensorAxes, StateBlock, Study, View
from robins.systems.transfer_alignment.attitude_matching import model as am
from robins.systems.transfer_alignment.attitude_matching import structures
from robins.systems.transfer_alignment.attitude_matching.parameters import AttitudeMatching
from robins.systems.transfer_alignment.attitude_matching.world import (
    MatchingCourse,
    MatchingWorld,
    lay_out,
    simulate,
)

ARCMIN = units.parse("1 arcmin", "angle")
FIVE_ARCMIN = Limit("5_arcmin", "attitude", 5.0 * ARCMIN)

# Kalman filters: errors whose variance is in R. "kf-flexure" has flexure states.
TOLD = {
    "kf": ("noise",),
    "kf-told-flutter": ("noise", "flutter"),
    "kf-inflated": ("noise", "flutter", "swing"),
    "kf-flexure": ("noise", "flutter"),
}


# The paper's filter: the unit in which R = I, L = I and gamma. Of its variants some have P0 = I in
# that unit too, some no bound: gamma = inf.
IN_UNIT = {
    "hinf-rad": "rad",
    "hinf-rad-identity": "rad",
    "hinf-deg": "deg",
    "hinf-deg-inf": "deg",
    "hinf-arcmin": "arcmin",
}
IDENTITY, UNBOUNDED = {"hinf-rad-identity"}, {"hinf-deg-inf"}
FILTERS = (*TOLD, *IN_UNIT, "hinf-weighted", "adaptive")


def central_filter() -> Filter:
    """H-infinity with L = I [rad]; `with_gamma` gives it a bound."""
    return kalman(rules=[h_infinity(np.inf, np.eye(am.STATES))])


def weighted_filter() -> Filter:
    """H-infinity on the attitude alone, in arcminutes; `with_gamma` gives it a bound."""
    return kalman(rules=[h_infinity(np.inf, np.eye(am.STATES)[am.PHI] / ARCMIN)])


def contender(given: AttitudeMatching, course: MatchingCourse, name: str) -> Contender:
    """A filter of `FILTERS` with its assumptions."""
    flexure, updates = given.flexure, len(course.epoch_s)
    sizes = {
        "noise": given.master.attitude_noise,
        "flutter": flexure.flutter,
        "swing": math.sqrt(np.mean(np.square(flexure.sigma))),
    }
    sigma = math.hypot(*(sizes[part] for part in TOLD.get(name, ("noise",))))
    if name == "kf-flexure":
        believed = Flexure(
            given.believed.flexure_sigma_factor * np.asarray(flexure.sigma),
            given.believed.flexure_time_factor * np.asarray(flexure.time),
            flexure.damping,
        )
        return _contender(kalman(), am.linear_system(given, updates, believed), sigma)
    if name == "adaptive":
        system = am.linear_system(given, updates, structures.START)
        filter_ = structures.structure_bank(system, given.master.attitude_noise, given.period)
        return _contender(filter_, system, sigma)
    system = am.linear_system(given, updates)
    if name in TOLD:
        return _contender(kalman(), system, sigma)
    if name == "hinf-weighted":
        share = given.h_infinity.weighted_over_least
        facts = existence(weighted_filter(), system, sigma, course, over_least=share)
        return _contender(weighted_filter(), system, sigma, facts)
    one = units.parse(f"1 {IN_UNIT[name]}", "angle")
    if name in IDENTITY:
        system = system._replace(sigma=np.full(am.STATES, one))
    gamma = np.inf if name in UNBOUNDED else given.h_infinity.gamma * one
    facts = existence(central_filter(), system, one, course, gamma)
    return _contender(central_filter(), system, one, facts, one)


def _contender(
    filter_: Filter,
    system: am.LinearSystem,
    sigma: float,
    facts: Mapping[str, Metric] | None = None,
    unit: float = 1.0,
) -> Contender:
    """A filter of a system; with facts, an H-infinity filter whose gamma has a unit."""
    model, start, (F, aux) = system.model(sigma), system.start(), system.inputs()
    rows = np.eye(am.STATES, F.shape[-1]) if F.shape[-1] > am.STATES else None
    known: dict[str, Any] = dict(facts or {})
    gamma = known.get("gamma", np.inf)
    if facts:
        filter_ = with_gamma(filter_, gamma)
        known |= {key: known[key] / unit for key in ("gamma", "gamma_min")}
    case = Partial(_case, start, F, aux[am.ATTITUDE])
    return Contender(filter_, model, case, rows, bounds=bool(np.isfinite(gamma)), facts=known)


def _case(start: Any, F: Any, H: Any, world: MatchingWorld) -> Case:
    """Case of a filter of n states in a run; F is (E, n, n) and H (E, 3, n)."""
    truth = world.state[:, : F.shape[-1]]
    return Case(start, F, {am.ATTITUDE: world.measured}, {am.ATTITUDE: H}, truth)


def existence(
    filter_: Filter,
    system: am.LinearSystem,
    sigma_rad: float,
    course: MatchingCourse,
    gamma: float = np.nan,
    over_least: float | None = None,
) -> dict[str, Metric]:
    """Existence and least gamma of an H-infinity filter, found by running it on zero data.

    A filter that does not exist has no result: its metrics are present, and empty. The filter has
    one `h_infinity` rule and is given the system and a measurement noise [rad]; gamma is in the
    units of its L x, or `over_least` times the least.
    """
    model, (u, aux) = system.model(sigma_rad), system.inputs()
    y = np.where(course.received[:, None], np.zeros((len(course.received), 3)), np.nan)

    def attempt(gamma: float):
        return run(
            with_gamma(filter_, gamma),
            model,
            system.start(),
            y,
            u,
            aux,
            keep=_existing,
            time_s=course.epoch_s,
        ).steps

    # No gamma below the largest local bound of the Kalman filter exists, and the refusal names
    # the least one that would.
    least, largest = 0.0, float(np.max(attempt(np.inf)[0]))
    try:
        if largest > 0.0:  # there are measurements
            attempt(largest * (1.0 - 1e-9))
    except Infeasible as refused:
        least = refused.gamma_min if refused.gamma_min is not None else np.nan
    asked = gamma if over_least is None else over_least * least
    facts = {
        "gamma": asked,
        "gamma_min": least,
        "gamma_over_gamma_min": asked / least if least else np.inf,
        "feasible": True,
        "infeasible_at_update": None,
        "infeasible_at_s": None,
    }
    try:
        margin = float(np.min(attempt(asked)[1]))  # least 1 - bound^2 / gamma^2
    except Infeasible as refused:
        at = {"infeasible_at_update": refused.step + 1, "infeasible_at_s": refused.time_s}
        none = {"margin": np.nan, "largest_inflation": np.nan, "feasible": False}
        return facts | none | at | NO_RESULT
    return facts | {"margin": margin, "largest_inflation": 1.0 / margin}


def _existing(step: Step):
    """Local bound and margin of a step, where there is a measurement."""
    info = step.info[am.ATTITUDE]
    counts = jnp.any(info.used)
    bound, margin = (info.notes[f"h_infinity.{name}"] for name in ("bound", "margin"))
    return jnp.where(counts, bound, 0.0), jnp.where(counts, margin, 1.0)


def view(given: AttitudeMatching, course: MatchingCourse) -> View:
    """Contents of the report of every filter."""
    roll, count = am.roll_rad(given.manoeuvre, course.epoch_s), len(course.epoch_s)
    return View(
        epoch_s=course.epoch_s,
        blocks=(
            StateBlock("attitude", am.PHI, "rad", "arcmin", "ENU", ENU),
            StateBlock("gyro_bias", am.EPS, "rad/s", "deg/h", "RFU", RFU),
            StateBlock("mounting", am.MU, "rad", "arcmin", "RFU", RFU),
        ),
        sensors={am.ATTITUDE: SensorAxes("rad", "ENU", ENU)},
        metrics=metrics_of,
        faults={
            "flexure": np.full(count, any(given.flexure.sigma) or any(given.flexure.bending)),
            am.ATTITUDE: np.full(count, given.flexure.flutter > 0.0),
        },
        context=xr.Dataset(
            array("context", roll, "roll", unit="rad")
            | array("context", course.load[course.at], "load_factor", unit="1")
            | array("outage", (~course.received).astype(np.int8), long_name="no attitude")
        ),
        count_from=int(np.searchsorted(course.epoch_s, given.settle - 1e-9)),
        limits=(FIVE_ARCMIN,),
    )


NO_RESULT: dict[str, Any] = {
    "attitude_rms_arcmin": [np.nan] * 3,
    "attitude_rms_all_arcmin": np.nan,
    "mounting_rms_arcmin": [np.nan] * 3,
    "gyro_bias_rms_deg_per_h": [np.nan] * 3,
    "share_below_5_arcmin": np.nan,
}
"""Metrics of a filter that does not exist."""


def metrics_of(statistics: Any) -> dict[str, Metric]:
    """Metrics of one filter from its campaign statistics, over the evaluation epochs."""
    settled = statistics.settled(FIVE_ARCMIN.name)
    return rms_by_axis(statistics, all_axes=("attitude",)) | {
        "share_below_5_arcmin": Probability.among(settled <= statistics.count_from),
        "diverged_runs": statistics.diverged,
    }


# ------------------------------------------------------------------------------------------ claims

PUBLISHED = ("hinf-rad", "hinf-rad-identity", "hinf-deg", "hinf-arcmin")
UNITS = ("hinf-rad", "hinf-deg", "hinf-arcmin")
ALL = "attitude_rms_all_arcmin"


def _axes(metrics: Mapping[str, Any]) -> np.ndarray:
    return np.asarray(metrics["attitude_rms_arcmin"])


def _best(metrics: Metrics) -> float | None:
    """Worst-axis error of the best published filter that exists."""
    ran = [metrics[name] for name in PUBLISHED if name in metrics]
    worst = [float(np.max(_axes(m))) for m in ran if m.get("feasible", True)]
    return min(worst, default=float("nan")) if ran else None


def _kf_lost(metrics: Metrics) -> str:
    best = _best(metrics)
    within = best is not None and best < 5.0
    return graded(within and np.all(_axes(metrics["kf"]) >= 10.0), within)


def _gained(metrics: Metrics) -> str:
    left = ratio("hinf-deg", "hinf-deg-inf", ALL)(metrics)
    return graded(left <= 0.9, left <= 0.98)


def _existing_units(metrics: Metrics) -> int | None:
    if any(name not in metrics for name in UNITS):
        return None
    return sum(bool(metrics[name]["feasible"]) for name in UNITS)


def _by_axis(metrics: Metrics) -> np.ndarray:
    return _axes(metrics["hinf-deg"]) / _axes(metrics["kf"])


CLAIMS: dict[str, Claim] = {
    "five-arcmin": Claim(
        "From 15 s on the H-infinity filter with gamma = 50 is within 5' on every axis, the "
        "Kalman filter at tens of arcminutes (Gu & Qin 2005); RMS over the runs, in the unit of "
        "angle that suits it best; value: its worst axis [arcmin]",
        ("kf",),
        _best,
        (0.0, 5.0),
        verdict=_kf_lost,
    ),
    "gamma-50": Claim(
        "gamma = 50 makes it robust (Gu & Qin 2005): in degrees it is at least 10 % more accurate"
        " than the same filter with gamma = inf, a Kalman filter with R = (1 deg)^2; value: the "
        "largest difference of their RMS on an axis [arcmin]",
        ("hinf-deg", "hinf-deg-inf"),
        lambda m: float(np.max(np.abs(_axes(m["hinf-deg"]) - _axes(m["hinf-deg-inf"])))),
        None,
        verdict=_gained,
    ),
    "units": Claim(
        "With R = I, L = I and gamma = 50 the filter exists over the whole run in any unit of "
        "angle; value: in how many of radians, degrees and arcminutes it does",
        (),
        _existing_units,
        (3, 3),
        (1, 3),
    ),
    "beats-kf": Claim(
        "Told nothing of the flexure, the H-infinity filter in degrees is more accurate than the "
        "Kalman filter with R = (1')^2 (Gu & Qin 2005) on every axis; value: the largest ratio of"
        " their RMS on an axis",
        ("hinf-deg", "kf"),
        lambda metrics: float(np.max(_by_axis(metrics))),
        (0.0, 1.0),
        verdict=lambda m: graded(np.all(_by_axis(m) < 1.0), np.any(_by_axis(m) < 1.0)),
    ),
    "saves-the-model": Claim(
        "It saves modelling the flexure (Gu & Qin 2005): in degrees its RMS over all axes is at "
        "most 1.1 times that of a Kalman filter with flexure states; value: that ratio",
        ("hinf-deg", "kf-flexure"),
        ratio("hinf-deg", "kf-flexure", ALL),
        (0.0, 1.1),
        (0.0, 1.5),
    ),
}

STUDY = Study(AttitudeMatching, FILTERS, simulate, contender, view, lay_out, CLAIMS)
