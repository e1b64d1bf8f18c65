"""The velocity-attitude study: a patent's adaptive H-infinity filter among Kalman filters.

A slave navigates by itself; each filter estimates its errors from what a master reports, with the
twelve states of `velocity_attitude`, open loop. Scenarios disturb the measurement (flexure,
outliers), the motion (gyro noise, a step of drift), both, or leave mounting angles that no state
stands for.

What filters are told is white noise of a variance at each time. The plain ones believe in the
stated noise of sensors and master. "told-r" also knows the variance of flexure and outliers, but
not that flexure is correlated in time, for which a white R has no word. "told-q" also knows the
gyro noise in its window, and that from its step on the drift may walk, as far until the end as the
step was large. The model is linearised about what the master reports.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import cache, partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
import xarray as xr
from jax.tree_util import Partial
from jaxtyping import Array

from robins import units
from robins.earth import curvature_radii
from robins.errors import require_known
from robins.filters import Belief, Filter, gamma_min, kalman
from robins.filters.rules import adaptive_h_infinity, h_infinity
from robins.ins.frames import swap, swap_q
from robins.ins.increments import Increments
from robins.results import array
from robins.rotation import Rotation, multiply, to_euler
from robins.scenario import Parameters, Quantity, default
from robins.systems.judgement import judging
from robins.systems.parts import Names, Runs
from robins.systems.study import Case, Contender, Limit, Problem, Scenario, SensorAxes, StateBlock
from robins.systems.transfer_alignment import velocity_attitude as va
from robins.systems.transfer_alignment.open_loop import (
    as_master_sees,
    navigate,
    start_with_error,
    true_errors,
)
from robins.systems.transfer_alignment.patent_claims import CLAIMS, patent_metrics
from robins.systems.transfer_alignment.product.parameters import (
    Disturbance,
    PairParameters,
    Structure,
)
from robins.systems.transfer_alignment.product.study import SENSORS as PRODUCT_SENSORS
from robins.systems.transfer_alignment.product.study import product_contender
from robins.systems.transfer_alignment.product.world import Course, PairRun, lay_out, simulate_pair

ENU = ("east", "north", "up")
RFU = ("right", "forward", "up")
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcmin", "ENU", ENU),
    StateBlock("velocity", slice(3, 5), "m/s", "m/s", "ENU", ENU[:2]),
    StateBlock("gyro_bias", slice(5, 8), "rad/s", "deg/h", "RFU", RFU),
    StateBlock("accel_bias", slice(8, 10), "m/s^2", "mg", "RFU", RFU[:2]),
)
"""What every filter of the study reports, errors being true minus estimated."""

REPORTED = np.eye(va.STATES)[np.r_[va.PHI, va.VELOCITY, va.EPS, va.NABLA]]  # (10, 12)

SENSORS = {
    va.VELOCITY_SENSOR: SensorAxes("m/s", "ENU", ENU[:2]),
    va.ATTITUDE_SENSOR: SensorAxes("rad", "Euler", ("heading", "pitch", "roll")),
}
ARCMIN = units.parse("1 arcmin", "angle")
LIMITS = (Limit("1_arcmin", "attitude", ARCMIN), Limit("5_arcmin", "attitude", 5.0 * ARCMIN))
ATTITUDE_ROWS = np.eye(va.STATES)[va.PHI] / ARCMIN  # L of the H-infinity filters
LARGEST_RAD = units.parse("5 deg", "angle")  # of an error that the linear model may take

FIXED = {"hinf-fixed": 1.05, "hinf-fixed-3": 3.0}  # gamma over gamma_min
ADAPTIVE: dict[str, dict[str, Any]] = {
    "adaptive-hinf": {"weight": ATTITUDE_ROWS},
    "adaptive-hinf-mild": {"weight": ATTITUDE_ROWS, "zeta": 0.01},
    "adaptive-hinf-compensated": {"weight": ATTITUDE_ROWS, "compensate_first": True},
    "hinf-patent-weights": {"weight": np.ones(va.STATES)},  # L = I, and R = I below
}
TOLD = {"kf": (), "kf-told-r": ("r",), "kf-told-q": ("q",), "kf-told-both": ("r", "q")}
# Of `product.filters`: closed loop, with states for the mounting; the second costs seven filters.
PRODUCT = ("product", "product-adaptive")
FILTERS = (*TOLD, *FIXED, *ADAPTIVE, *PRODUCT)


class Told(Parameters):
    """What the told filters are told of, whether it happens or not."""

    flexure: Structure = pydantic.Field(default_factory=Structure)
    disturbance: Disturbance = pydantic.Field(default_factory=Disturbance)


class Patent(Scenario, PairParameters):
    """A pair to be aligned open loop, by velocity and Euler angles."""

    system: Literal["transfer-alignment"] = "transfer-alignment"
    study: Literal["velocity-attitude"] = "velocity-attitude"
    title: str = "Transfer alignment by velocity and attitude, open loop"
    runs: Runs = 100
    filters: Names = FILTERS[:-1]
    told: Told = pydantic.Field(default_factory=Told)
    # figures pooled over time count from here
    settle: Annotated[float, Quantity("time", least="0 s")] = default("30 s")
    claims: tuple[str, ...] = ()  # ids of those the scenario checks


class World(NamedTuple):
    """One run: the pair, and the open-loop errors that the filters of this module estimate."""

    pair: PairRun
    flight: va.Flight  # over each interval, as linearised about; leading axis E
    C_nb: Any  # (E, 3, 3) at the epochs
    velocity: Any  # (E, 2) m/s, slave minus master
    attitude: Any  # (E, 3) rad, heading, pitch, roll likewise
    error: Any  # (E, 12) the true state


def simulate(given: Patent, course: Course, seed: int, index: Array) -> World:
    """One run, from its number, which may be traced; pure."""
    pair = simulate_pair(given, course, seed, index)
    loop = navigate(start_with_error(pair.start, pair.initial_error), pair.increments)
    own = loop.nav
    # as the slave's box sits
    master_q = multiply(pair.master.q_nb.wxyz, jnp.asarray(course.q_nominal))
    master = pair.master._replace(q_nb=Rotation(master_q))
    flight, C_nb = as_master_sees(loop, master)
    assert pair.truth is not None
    t = pair.truth.ins
    return World(
        pair=pair,
        flight=flight,
        C_nb=C_nb,
        velocity=swap(own.v_n - pair.master.v_n)[..., :2],
        attitude=va.euler_difference(swap_q(own.q_nb.wxyz), swap_q(master_q)),
        error=true_errors(own, t.q_nb.wxyz, t.v_n, t.position, t.gyro_bias, t.accel_bias),
    )


class Noise(NamedTuple):
    """What a filter believes of the noise at each epoch, standard deviations."""

    process: Any  # (E, 12)
    velocity: Any  # (E, 2) m/s
    attitude: Any  # (E, 3) rad, heading, pitch, roll


def stated_noise(given: Patent, epoch_s: np.ndarray) -> Noise:
    """The noise that the data sheets state; worst axis where axes differ."""
    s, m, dt = given.slave, given.master, 1.0 / given.master.rate
    process = np.asarray(va.process_sigma(max(s.gyro_noise), max(s.accel_noise), dt))
    north, east, _ = m.velocity_noise
    east_tilt = max(m.attitude_noise[:2])
    rows = (process, [east, north], [m.attitude_noise[2], east_tilt, east_tilt])
    return Noise(*(np.tile(row, (len(epoch_s), 1)) for row in rows))


def told_of_measurement(noise: Noise, told: Told) -> Noise:
    """With the variance of outliers in all measurements and of flexure in attitude."""
    d = told.disturbance
    factor = math.sqrt(1.0 + d.outlier_share * (d.outlier_factor**2 - 1.0))
    roll, pitch, heading = told.flexure.sigma
    return noise._replace(
        velocity=noise.velocity * factor,
        attitude=np.hypot(noise.attitude * factor, [heading, pitch, roll]),
    )


def told_of_motion(noise: Noise, told: Told, epoch_s: np.ndarray) -> Noise:
    """With the gyro noise in its window, and a drift that walks from its step on."""
    d, process = told.disturbance, noise.process.copy()
    dt = float(epoch_s[0])  # epochs are even, and the first ends one after time zero
    begin = epoch_s - dt + 1e-9  # of the interval that ends with the epoch
    if d.gyro_noise_window is not None:
        inside = (begin >= d.gyro_noise_window.begin) & (begin < d.gyro_noise_window.end)
        process[inside, va.PHI] *= d.gyro_noise_factor
    if d.drift_step_time is not None:
        after = begin >= d.drift_step_time
        step = np.abs(np.asarray(swap(np.asarray(d.drift_step))))
        process[after, va.EPS] = step / math.sqrt(max(np.count_nonzero(after), 1))
    return noise._replace(process=process)


def believed_noise(given: Patent, name: str, epoch_s: np.ndarray) -> Noise:
    """The noise that a filter believes in."""
    noise = stated_noise(given, epoch_s)
    if name == "hinf-patent-weights":  # R = I in SI units, whatever that means
        ones = (np.ones_like(noise.velocity), np.ones_like(noise.attitude))
        return Noise(noise.process, *ones)
    told = TOLD.get(name, ())
    if "r" in told:
        noise = told_of_measurement(noise, given.told)
    return told_of_motion(noise, given.told, epoch_s) if "q" in told else noise


def start_sigma(given: Patent) -> np.ndarray:
    """(12,) standard deviations of the initial state."""
    s, start, place = given.slave, given.start, given.manoeuvre
    meridian, transverse = (float(r) + place.height for r in curvature_radii(place.latitude))
    sigma = np.zeros(va.STATES)
    east = transverse * math.cos(place.latitude)
    sigma[va.POSITION] = start.position[0] / meridian, start.position[1] / east
    sigma[va.VELOCITY] = start.velocity[1], start.velocity[0]
    sigma[va.PHI] = np.abs(swap(np.asarray(start.attitude)))
    sigma[va.NABLA] = np.abs(swap(np.asarray(s.accel_bias)))[:2]
    sigma[va.EPS] = np.abs(swap(np.asarray(s.gyro_bias)))
    return sigma


def as_case(noise: Noise, sigma: Array, dt_s: Array, world: World) -> Case:
    """What a filter of twelve states takes of a run; pure, and its numbers are data."""
    count = world.error.shape[0]
    return Case(
        start=Belief(jnp.zeros(va.STATES), jnp.diag(sigma)),
        u=va.Interval(world.flight, jnp.broadcast_to(dt_s, (count,)), noise.process),
        y={va.VELOCITY_SENSOR: world.velocity, va.ATTITUDE_SENSOR: world.attitude},
        aux={
            va.VELOCITY_SENSOR: noise.velocity,
            va.ATTITUDE_SENSOR: va.Sight(world.C_nb, noise.attitude),
        },
        truth=world.error,
    )


@cache
def make_filter(name: str, gamma: float = math.inf) -> Filter:
    """The filter of a name; gamma [arcmin] is that of the filters of `FIXED`.

    Equal arguments give the same object, so that what was compiled for it serves again.

    Raises:
        ValueError: there is no filter of this name.
    """
    require_known("filter", name, FILTERS)
    if name in TOLD:
        return kalman() if name == "kf" else make_filter("kf")
    if name in FIXED:
        return kalman(rules=[h_infinity(gamma, ATTITUDE_ROWS)])
    return kalman(rules=[adaptive_h_infinity(**ADAPTIVE[name])])


def least_gamma(given: Patent, course: Course) -> float:
    """Least gamma [arcmin] of attitude errors in units of the stated noise, along a perfect run.

    The initial uncertainty decides it: the first measurement leaves more than any later one.
    """
    K, E = course.each, len(course.epoch_s)
    theta, dv = (np.asarray(a).reshape(E, K, 3) for a in course.nominal[1:3])
    perfect = Increments(course.dt.reshape(E, K), theta, dv)
    loop = jax.jit(navigate)(start_with_error(course.start, np.zeros(9)), perfect)
    count = len(course.epoch_s)
    world = World(
        pair=None,  # type: ignore[arg-type]  # not looked at
        flight=loop.flight,
        C_nb=va.dcm_enu(loop.nav.q_nb.wxyz),
        velocity=jnp.zeros((count, 2)),
        attitude=jnp.zeros((count, 3)),
        error=jnp.zeros((count, va.STATES)),
    )
    case = _case_of(given, "hinf-fixed", course.epoch_s)(world)
    model = va.velocity_attitude_model()
    return gamma_min(model, case.start, case.y, ATTITUDE_ROWS, case.u, case.aux)


def _case_of(given: Patent, name: str, epoch_s: np.ndarray) -> Callable[[World], Case]:
    noise = Noise(*(jnp.asarray(a) for a in believed_noise(given, name, epoch_s)))
    sigma, dt = jnp.asarray(start_sigma(given)), jnp.asarray(1.0 / given.master.rate)
    return Partial(as_case, noise, sigma, dt)


def contender(given: Patent, name: str, epoch_s: np.ndarray, least: float) -> Contender:
    """A filter of this study.

    Args:
        given: the scenario.
        name: of the filter.
        epoch_s: (E,).
        least: `least_gamma`, for the filters of `FIXED`.

    Raises:
        ValueError: there is no filter of this name.
    """
    facts: dict[str, Any] = {}
    gamma = math.inf
    if name in FIXED:
        gamma = FIXED[name] * least
        facts = {"gamma_min": least, "gamma": gamma, "gamma_over_gamma_min": FIXED[name]}
    return Contender(
        filter=make_filter(name, gamma),
        model=va.velocity_attitude_model(),
        case=_case_of(given, name, epoch_s),
        reported=REPORTED,
        bounds=name not in TOLD,
        facts=facts,
    )


def _of_pair(case: Callable[[PairRun], Case], world: World) -> Case:
    return case(world.pair)


def joined(given: Patent, name: str) -> Contender:
    """A filter of the product model, told no more than the plain ones, that reports as they do."""
    blocks = ("attitude", "velocity", "gyro_bias", "accel_bias")
    made = product_contender(given, name, blocks=blocks, frame="ENU")
    assert made.reported is not None
    level = np.r_[0:3, 3:5, 6:9, 9:11]  # without the vertical channel
    return made._replace(case=Partial(_of_pair, made.case), reported=made.reported[level])


def patent_problem(given: Patent, filters: tuple[str, ...], seed: int) -> Problem:
    """The scenario as a problem for a campaign.

    Warns where errors will outgrow the linear model.

    Raises:
        ValueError: the pair cannot be laid out, has a lever arm or a delay, or points its nose too
            high; nothing is left to count; or a filter is unknown.
    """
    if any(given.lever_arm) or given.master.delay:
        raise ValueError(
            "lever_arm and master.delay must be zero in the study 'velocity-attitude', whose model "
            "takes both as compensated; the study 'product' knows them"
        )
    course = lay_out(given)
    epoch_s = course.epoch_s
    count_from = int(np.searchsorted(epoch_s, given.settle + 1e-9))
    if count_from == len(epoch_s):
        raise ValueError(
            f"settle = {given.settle:g} s leaves nothing to count of a run of {epoch_s[-1]:g} s: "
            "shorten it or lengthen the manoeuvre"
        )
    va.refuse_steep(epoch_s, np.asarray(course.path.q_nb.wxyz))
    if large := too_large(given, float(epoch_s[-1])):
        warnings.warn(
            f"{', '.join(large)}: the model is linear in the slave's errors and good below 5 deg; "
            "expect biased estimates",
            stacklevel=2,
        )
    least = least_gamma(given, course) if set(filters) & set(FIXED) else math.nan
    return Problem(
        simulate=partial(simulate, given, course, seed),
        contenders={
            name: joined(given, name) if name in PRODUCT else contender(given, name, epoch_s, least)
            for name in filters
        },
        epoch_s=epoch_s,
        blocks=BLOCKS,
        sensors=SENSORS | PRODUCT_SENSORS,
        context=_context(course),
        metrics=partial(patent_metrics, epoch_s),
        claims=judging(CLAIMS, given.claims),
        count_from=count_from,
        limits=LIMITS,
    )


def too_large(given: Patent, end_s: float) -> list[str]:
    """Errors of one axis that may reach more than 5 deg, for which the linear model fails."""
    d = given.disturbance
    since = 0.0 if d.drift_step_time is None else end_s - d.drift_step_time
    named = {
        "start.attitude": 3.0 * np.asarray(given.start.attitude),
        "mounting": np.abs(given.mounting.error) + 3.0 * np.asarray(given.mounting.sigma),
        "disturbance.drift_step": since * np.abs(d.drift_step),
    }
    return [
        f"{name} may reach {math.degrees(np.max(value)):.1f} deg"
        for name, value in named.items()
        if np.max(value) > LARGEST_RAD
    ]


def _context(course: Course) -> xr.Dataset:
    """The manoeuvre, for figures."""
    roll, _, heading = (np.asarray(a) for a in to_euler(jnp.asarray(course.path.q_nb.wxyz)))
    named = {"roll": roll, "heading": heading}
    data: dict[str, Any] = {}
    for of, angle in named.items():
        data |= array("context", angle, of, unit="rad")
    return xr.Dataset(data)
