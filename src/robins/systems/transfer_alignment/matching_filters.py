"""The filters of the study "attitude-matching", and what is known of them without a run.

All work in radians. The paper's H-infinity filter has R = I and L = I in an unstated unit u of
angle, which is R = u^2 and gamma in u here; with its P0 that is all a unit changes. Covariances do
not depend on data in this system, so neither do gamma_min and feasibility.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins import units
from robins.errors import require_known
from robins.filters import Filter, Step, kalman, run
from robins.filters.rules.h_infinity import Infeasible, h_infinity, with_gamma
from robins.rotation import Rotation
from robins.sim.flexure import Flexure
from robins.systems.study import Case, Contender
from robins.systems.transfer_alignment.attitude_matching import (
    ATTITUDE,
    STATES,
    STATES_FLEXIBLE,
    AttitudeMatching,
    Spread,
    attitude_matching,
)
from robins.systems.transfer_alignment.bank_turn import BankTurn
from robins.systems.transfer_alignment.matching_claims import NO_RESULT
from robins.systems.transfer_alignment.matching_parameters import FILTERS, Matching

ARCMIN = units.parse("1 arcmin", "angle")

# The paper's filter: unit of R = I, L = I and gamma; and whether P0 = I in that unit too.
IN_UNIT = {
    "hinf-rad": ("rad", False),
    "hinf-rad-identity": ("rad", True),
    "hinf-deg": ("deg", False),
    "hinf-deg-inf": ("deg", False),
    "hinf-arcmin": ("arcmin", False),
}


class World(NamedTuple):
    """What a run simulates: the measurement, and the true states."""

    measured: Any  # (E, 3) rad, NaN where nothing came
    phi: Any  # (E, 3) rad
    gyro_bias: Any  # (3,) rad/s
    mounting: Any  # (3,) rad
    flexure: Any  # (E, 3) rad
    flexure_rate: Any  # (E, 3) rad/s


def case_of(start: Any, F: Any, H: Any, world: World) -> Case:
    """What a filter of 9 or 15 states is given, and what it should find.

    Args:
        start: a belief, or the state a filter begins with.
        F: (E, n, n).
        H: (E, 3, n).
        world: the run.
    """
    shape = world.phi.shape
    parts = [world.phi, *(jnp.broadcast_to(x, shape) for x in (world.gyro_bias, world.mounting))]
    if F.shape[-1] == STATES_FLEXIBLE:
        parts += [world.flexure, world.flexure_rate]
    truth = jnp.concatenate(parts, axis=1)
    return Case(start, F, {ATTITUDE: world.measured}, {ATTITUDE: H}, truth)


@cache
def kalman_filter() -> Filter:
    """One object, so that all Kalman filters of the study share what was compiled."""
    return kalman()


@cache
def central_filter() -> Filter:
    """H-infinity with L = I [rad]; gamma is data."""
    return kalman(rules=[h_infinity(np.inf, np.eye(STATES))])


@cache
def weighted_filter() -> Filter:
    """H-infinity on the attitude alone, in arcminutes; gamma is data."""
    return kalman(rules=[h_infinity(np.inf, np.eye(STATES)[:3] / ARCMIN)])


class Existence(NamedTuple):
    """Whether a filter exists over a whole run, in the units of its L x."""

    gamma: float
    gamma_min: float
    margin: float  # least 1 - bound^2 / gamma^2; NaN where it does not exist
    update: int | None  # number of the update, from 1, at which it ceases to exist
    time_s: float | None


def existence(
    filter_: Filter,
    system: AttitudeMatching,
    sigma_rad: float,
    gamma: float | None,
    heard: np.ndarray,
    epoch_s: np.ndarray,
    over_least: float = 1.0,
) -> Existence:
    """Feasibility of an H-infinity filter, found by running it over nothing but zeros.

    Args:
        filter_: with one `h_infinity` rule.
        system: what it is told of the run.
        sigma_rad: measurement noise it is told.
        gamma: asked for; None: ``over_least`` times the least.
        heard: (E,) bool, updates at which there is a measurement.
        epoch_s: (E,) their times.
        over_least: see gamma.
    """
    model, (u, aux) = system.model(sigma_rad), system.inputs()
    y = np.where(heard[:, None], np.zeros((len(heard), 3)), np.nan)
    first = filter_.init(system.start(), model.dims)

    def attempt(gamma: float):
        state = with_gamma(first, gamma)
        return run(filter_, model, state, y, u, aux, keep=_existing, time_s=epoch_s).steps

    # No gamma below the largest local bound of the Kalman filter exists, and the refusal says
    # which one would.
    least, largest = 0.0, float(np.max(attempt(np.inf)[0]))
    try:
        if largest > 0.0:  # something is measured
            attempt(largest * (1.0 - 1e-9))
    except Infeasible as refused:
        least = refused.gamma_min if refused.gamma_min is not None else np.nan
    asked = over_least * least if gamma is None else gamma
    try:
        margin = float(np.min(attempt(asked)[1]))
    except Infeasible as refused:
        return Existence(asked, least, np.nan, refused.step + 1, refused.time_s)
    return Existence(asked, least, margin, None, None)


def _existing(step: Step):
    """Local bound and margin of a step, where it counts."""
    info = step.info[ATTITUDE]
    counts = jnp.any(info.used)
    bound, margin = (info.notes[f"h_infinity.{name}"] for name in ("bound", "margin"))
    return jnp.where(counts, bound, 0.0), jnp.where(counts, margin, 1.0)


def facts_of(found: Existence, per_unit: float) -> dict[str, Any]:
    """What is known of an H-infinity filter without a run; gamma in its own unit.

    A filter that does not exist has no result: its figures are there, and empty.
    """
    feasible = found.update is None
    facts = {
        "gamma": found.gamma / per_unit,
        "gamma_min": found.gamma_min / per_unit,
        "gamma_over_gamma_min": found.gamma / found.gamma_min if found.gamma_min else np.inf,
        "margin": found.margin,
        "largest_inflation": 1.0 / found.margin,
        "feasible": feasible,
        "infeasible_at_update": found.update,
        "infeasible_at_s": found.time_s,
    }
    return facts if feasible else facts | NO_RESULT


def contenders(
    given: Matching,
    turn: BankTurn,
    flexure: Flexure,
    heard: np.ndarray,
    epoch_s: np.ndarray,
    filters: tuple[str, ...],
) -> Mapping[str, Contender]:
    """The filters of a scenario by name.

    Args:
        given: the scenario.
        turn: its manoeuvre.
        flexure: its structure.
        heard: (E,) bool, updates at which the master's attitude arrives.
        epoch_s: (E,) times of the updates.
        filters: which ones.

    Raises:
        ValueError: there is no filter of a name.
    """
    for name in filters:
        require_known("filter", name, FILTERS)
    b = given.believed
    spread = Spread(b.attitude, b.gyro_bias, b.mounting, given.slave.gyro_noise)
    nominal = np.asarray(Rotation.from_rotvec(given.mounting.nominal).as_dcm())
    make = partial(attitude_matching, turn, given.period, len(epoch_s), spread, nominal)
    rigid = make()
    noise, flutter = given.master.attitude_noise, given.flexure.flutter
    swing = float(np.sqrt(np.mean(np.square(given.flexure.sigma))))
    told = {
        "kf": noise,
        "kf-told-flutter": float(np.hypot(noise, flutter)),
        "kf-inflated": float(np.sqrt(noise**2 + flutter**2 + swing**2)),
    }

    def central(name: str) -> Contender:
        unit, identity = IN_UNIT[name]
        one = units.parse(f"1 {unit}", "angle")
        system = rigid._replace(sigma=np.full(STATES, one)) if identity else rigid
        gamma = np.inf if name.endswith("-inf") else given.h_infinity.gamma * one
        found = existence(central_filter(), system, one, gamma, heard, epoch_s)
        return _bounded(central_filter(), system, one, found, one)

    def of(name: str) -> Contender:
        if name in told:
            return _kalman(rigid, told[name])
        if name == "kf-flexure":
            flexible = make(
                flexure=flexure._replace(
                    sigma_rad=b.flexure_sigma_factor * np.asarray(flexure.sigma_rad),
                    tau_s=b.flexure_time_factor * np.asarray(flexure.tau_s),
                )
            )
            return _kalman(flexible, told["kf-told-flutter"])
        if name == "hinf-weighted":
            share = given.h_infinity.weighted_over_least
            found = existence(weighted_filter(), rigid, noise, None, heard, epoch_s, share)
            return _bounded(weighted_filter(), rigid, noise, found, 1.0)
        return central(name)

    return {name: of(name) for name in filters}


def _kalman(system: AttitudeMatching, sigma_rad: float) -> Contender:
    u, aux = system.inputs()
    rows = np.eye(STATES, u.shape[-1]) if u.shape[-1] > STATES else None
    case = Partial(case_of, system.start(), u, aux[ATTITUDE])
    return Contender(kalman_filter(), system.model(sigma_rad), case, rows)


def _bounded(
    filter_: Filter, system: AttitudeMatching, sigma_rad: float, found: Existence, per_unit: float
) -> Contender:
    u, aux = system.inputs()
    model = system.model(sigma_rad)
    start = with_gamma(filter_.init(system.start(), model.dims), found.gamma)
    case = Partial(case_of, start, u, aux[ATTITUDE])
    bounds = bool(np.isfinite(found.gamma))
    return Contender(filter_, model, case, bounds=bounds, facts=facts_of(found, per_unit))
