"""The study "velocity-attitude": a patent's adaptive H-infinity filter among Kalman filters.

A slave navigates unaided; each filter estimates its errors from the reports of a master, with the
twelve states of `velocity_attitude.model`, open loop. Scenarios disturb the measurement (flexure,
outliers), the motion (gyro noise, a step of drift), both, or have mounting angles without a state.

Filters assume white noise of a given variance at each time. The plain ones use the stated noise of
sensors and master; slow gyro drift (`PairSlave`) is modelled as a random walk. "told-r" also knows
the variance of flexure and outliers, but not that flexure is correlated in time, which a white R
cannot express. "told-q" also knows the gyro noise in its window, and from the step of the drift on
assumes a random walk that reaches the size of the step at the end. The model is linearised about
the reports of the master.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
import xarray as xr
from jax.tree_util import Partial
from jaxtyping import Array

from robins import units
from robins.earth import curvature_radii
from robins.filters import Belief, Filter, gamma_min, kalman
from robins.filters.rules import adaptive_h_infinity, h_infinity
from robins.ins.frames import swap, swap_q
from robins.ins.increments import Increments
from robins.results import Probability, array
from robins.rotation import Rotation, multiply, to_euler
from robins.scenario import Parameters, Quantity, default
from robins.systems.judgement import Metric, ratio_claims, rms_by_axis
from robins.systems.parts import ENU, RFU, Names, Runs, refuse_unsettled, warn_of_large_angles
from robins.systems.study import (
    Case,
    Contender,
    Limit,
    Scenario,
    SensorAxes,
    StateBlock,
    Study,
    View,
)
from robins.systems.transfer_alignment.product import world as product
from robins.systems.transfer_alignment.product.parameters import (
    PairDisturbance,
    PairParameters,
    Structure,
)
from robins.systems.transfer_alignment.product.study import SENSORS as PRODUCT_SENSORS
from robins.systems.transfer_alignment.product.study import faults, product_contender
from robins.systems.transfer_alignment.velocity_attitude import model as va

ARCMIN = units.parse("1 arcmin", "angle")
ATTITUDE_ROWS = np.eye(va.STATES)[va.PHI] / ARCMIN  # L of the H-infinity filters

# Knowledge of the Kalman filters in addition to the stated noise.
TOLD = {"kf": (), "kf-told-r": ("r",), "kf-told-q": ("q",), "kf-told-both": ("r", "q")}
FIXED = {"hinf-fixed": 1.05, "hinf-fixed-3": 3.0}  # gamma over gamma_min
ADAPTIVE: dict[str, dict[str, Any]] = {
    "adaptive-hinf": {"weight": ATTITUDE_ROWS},
    "adaptive-hinf-mild": {"weight": ATTITUDE_ROWS, "zeta": 0.01},
    "adaptive-hinf-compensated": {"weight": ATTITUDE_ROWS, "compensate_first": True},
    "hinf-patent-weights": {"weight": np.ones(va.STATES)},  # L = I, and R = I below
}
# Filters of the product model: closed loop, with mounting states. A scenario has the first by
# default; the others, one filter under two names, are the bank of seven that runs in addition.
PRODUCT = ("product", "adaptive", "product-adaptive")
FILTERS = (*TOLD, *FIXED, *ADAPTIVE, *PRODUCT)


class AssumedDisturbances(Parameters):
    """Disturbances that the "told" filters assume, whether they happen or not."""

    flexure: Structure = pydantic.Field(default_factory=Structure)
    disturbance: PairDisturbance = pydantic.Field(default_factory=PairDisturbance)


class VelocityAttitude(Scenario, PairParameters):
    """A pair to be aligned open loop, by velocity and Euler angles."""

    system: str = "transfer-alignment"
    study: str = "velocity-attitude"
    title: str = "Transfer alignment by velocity and attitude, open loop"
    runs: Runs = 100
    filters: Names = FILTERS[:-2]
    claims: tuple[str, ...] | None = ()
    told: AssumedDisturbances = pydantic.Field(default_factory=AssumedDisturbances)
    # metrics are pooled from here on
    settle: Annotated[float, Quantity("time", least="0 s")] = default("30 s")


class VelocityAttitudeWorld(NamedTuple):
    """One run: the pair, and the open-loop errors that the filters of twelve states estimate."""

    pair: Any  # a `PairRun`, for the filters of the product model
    flight: va.SlaveFlight  # linearisation point over each interval; leading axis E
    C_nb: Any  # (E, 3, 3) at the epochs
    velocity: Any  # (E, 2) m/s, slave minus master
    attitude: Any  # (E, 3) rad, heading, pitch, roll likewise
    error: Any  # (E, 12) the true state


@dataclass(frozen=True)
class VelocityAttitudeCourse:
    """Data common to all runs."""

    given: VelocityAttitude
    pair: product.PairCourse

    @cached_property
    def least_gamma(self) -> float:
        """Least gamma [arcmin] of attitude errors under the stated noise, along an error-free run.

        It is set by the initial uncertainty: the local bound is largest at the first measurement.
        """
        K, E = self.pair.each, len(self.pair.epoch_s)
        theta, dv = (np.asarray(a).reshape(E, K, 3) for a in self.pair.nominal[1:3])
        perfect = Increments(self.pair.dt.reshape(E, K), theta, dv)
        start = va.start_with_error(self.pair.start, np.zeros(9))
        own, flight = jax.jit(va.navigate)(start, perfect)
        zeros = (jnp.zeros((E, n)) for n in (2, 3, va.STATES))
        world = VelocityAttitudeWorld(None, flight, va.dcm_enu(own.q_nb.wxyz), *zeros)
        case = _case_of(self.given, "hinf-fixed", self.pair.epoch_s)(world)
        return gamma_min(va.MODEL, case.start, case.y, ATTITUDE_ROWS, case.u, case.aux)


def lay_out(given: VelocityAttitude) -> VelocityAttitudeCourse:
    """Set up everything that does not depend on the run.

    Warns where errors will outgrow the linear model.

    Raises:
        ValueError: the pair cannot be laid out, has a lever arm or a delay, or pitches too steeply;
            or no epoch is left to evaluate.
    """
    if any(given.lever_arm) or given.master.delay:
        raise ValueError(
            "lever_arm and master.delay must be zero in the study 'velocity-attitude', whose model "
            "takes both as compensated; the study 'product' knows them"
        )
    pair = product.lay_out(given)
    end_s, d, seat = float(pair.epoch_s[-1]), given.disturbance, given.mounting
    refuse_unsettled("settle", given.settle, end_s)
    va.refuse_steep(pair.epoch_s, np.asarray(pair.path.q_nb.wxyz))
    since = 0.0 if d.drift_step_time is None else end_s - d.drift_step_time
    warn_of_large_angles(
        {
            "start.attitude": 3.0 * np.max(given.start.attitude),
            "mounting": np.max(np.abs(seat.error) + 3.0 * np.asarray(seat.sigma)),
            "disturbance.drift_step": since * np.max(np.abs(d.drift_step)),
        }
    )
    return VelocityAttitudeCourse(given, pair)


def simulate(
    given: VelocityAttitude, course: VelocityAttitudeCourse, seed: int, index: Array
) -> VelocityAttitudeWorld:
    """One run, from its number, which may be traced; pure."""
    pair = product.simulate_pair(given, course.pair, seed, index)
    own, flown = va.navigate(va.start_with_error(pair.start, pair.initial_error), pair.increments)
    # with the slave's mounting
    master_q = multiply(pair.master.q_nb.wxyz, jnp.asarray(course.pair.q_nominal))
    master = pair.master._replace(q_nb=Rotation(master_q))
    flight, C_nb = va.corrected_by_master(own, flown, master)
    assert pair.truth is not None
    return VelocityAttitudeWorld(
        pair=pair,
        flight=flight,
        C_nb=C_nb,
        velocity=swap(own.v_n - pair.master.v_n)[..., :2],
        attitude=va.euler_difference(swap_q(own.q_nb.wxyz), swap_q(master_q)),
        error=va.true_errors(own, pair.truth.ins),
    )


# ------------------------------------------------------------------------- assumptions of filters


class BelievedNoises(NamedTuple):
    """Assumed noise at each epoch, standard deviations."""

    process: Any  # (E, 12)
    velocity: Any  # (E, 2) m/s
    attitude: Any  # (E, 3) rad, heading, pitch, roll


def believed_noise(given: VelocityAttitude, name: str, epoch_s: np.ndarray) -> BelievedNoises:
    """Noise assumed by a filter: that of the data sheets, of the worst axis where axes differ.

    A filter "told r" adds the variance of outliers in all measurements and of flexure in attitude;
    one "told q" the gyro noise in its window, and a random walk of the drift from its step on.
    """
    s, m, told, d = given.slave, given.master, TOLD.get(name, ()), given.told.disturbance
    sigma = va.process_sigma(max(s.gyro_noise), max(s.accel_noise), 1.0 / m.rate)
    # where it is stated, the slow drift of (6) adds a random walk to the constant of (5)
    sigma[va.EPS] = np.abs(swap(s.gyro_walk)) / math.sqrt(m.rate)
    (north, east, _), tilt = m.velocity_noise, max(m.attitude_noise[:2])
    rows = (sigma, [east, north], [m.attitude_noise[2], tilt, tilt])
    process, velocity, attitude = (np.tile(row, (len(epoch_s), 1)) for row in rows)
    if name == "hinf-patent-weights":  # R = I in SI units, whatever that means
        return BelievedNoises(process, np.ones_like(velocity), np.ones_like(attitude))
    if "r" in told:
        factor = math.sqrt(1.0 + d.outlier_share * (d.outlier_factor**2 - 1.0))
        roll, pitch, heading = given.told.flexure.sigma
        velocity = velocity * factor
        attitude = np.hypot(attitude * factor, [heading, pitch, roll])
    begin = epoch_s - epoch_s[0] + 1e-9  # of the interval that ends at an epoch; all are equal
    if "q" in told and d.gyro_noise_window is not None:
        inside = (begin >= d.gyro_noise_window.begin) & (begin < d.gyro_noise_window.end)
        process[inside, va.PHI] *= d.gyro_noise_factor
    if "q" in told and d.drift_step_time is not None:
        after = begin >= d.drift_step_time
        step = np.abs(np.asarray(swap(np.asarray(d.drift_step))))
        walk = step / math.sqrt(max(np.count_nonzero(after), 1))
        process[after, va.EPS] = np.hypot(process[after, va.EPS], walk)
    return BelievedNoises(process, velocity, attitude)


def start_sigma(given: VelocityAttitude) -> np.ndarray:
    """(12,) standard deviations of the initial state."""
    s, start, place = given.slave, given.start, given.manoeuvre
    meridian, transverse = (float(r) + place.height for r in curvature_radii(place.latitude))
    sigma = np.zeros(va.STATES)
    east = transverse * math.cos(place.latitude)
    sigma[va.POSITION] = start.position[0] / meridian, start.position[1] / east
    sigma[va.VELOCITY] = start.velocity[1], start.velocity[0]
    sigma[va.PHI] = np.abs(swap(np.asarray(start.attitude)))
    sigma[va.NABLA] = np.abs(swap(s.accel_left))[:2]
    sigma[va.EPS] = np.abs(swap(s.gyro_sigma))
    return sigma


def _case(noise: BelievedNoises, sigma: Array, dt_s: Array, world: VelocityAttitudeWorld) -> Case:
    """Case of a filter of twelve states in a run; pure, and its numbers are data."""
    count = world.error.shape[0]
    return Case(
        start=Belief(jnp.zeros(va.STATES), jnp.diag(sigma)),
        u=va.Interval(world.flight, jnp.broadcast_to(dt_s, (count,)), noise.process),
        y={va.VELOCITY_SENSOR: world.velocity, va.ATTITUDE_SENSOR: world.attitude},
        aux={
            va.VELOCITY_SENSOR: noise.velocity,
            va.ATTITUDE_SENSOR: (world.C_nb, noise.attitude),
        },
        truth=world.error,
    )


def _case_of(
    given: VelocityAttitude, name: str, epoch_s: np.ndarray
) -> Callable[[VelocityAttitudeWorld], Case]:
    noise = BelievedNoises(*(jnp.asarray(a) for a in believed_noise(given, name, epoch_s)))
    return Partial(
        _case, noise, jnp.asarray(start_sigma(given)), jnp.asarray(1.0 / given.master.rate)
    )


def make_filter(name: str, gamma: float = math.inf) -> Filter:
    """The filter of a name; gamma [arcmin] is that of the filters of `FIXED`."""
    if name in TOLD:
        return kalman()
    if name in FIXED:
        return kalman(rules=[h_infinity(gamma, ATTITUDE_ROWS)])
    return kalman(rules=[adaptive_h_infinity(**ADAPTIVE[name])])


def contender(given: VelocityAttitude, course: VelocityAttitudeCourse, name: str) -> Contender:
    """A filter of `FILTERS` with its assumptions."""
    if name in PRODUCT:
        return of_product(given, name)
    facts: dict[str, Any] = {}
    if name in FIXED:
        least, over = course.least_gamma, FIXED[name]
        facts = {"gamma_min": least, "gamma": over * least, "gamma_over_gamma_min": over}
    return Contender(
        filter=make_filter(name, facts.get("gamma", math.inf)),
        model=va.MODEL,
        case=_case_of(given, name, course.pair.epoch_s),
        reported=np.eye(va.STATES)[np.r_[va.PHI, va.VELOCITY, va.EPS, va.NABLA]],
        bounds=name not in TOLD,
        facts=facts,
    )


def of_product(given: VelocityAttitude, name: str) -> Contender:
    """A filter of the product model with the assumptions and reported blocks of the plain ones."""
    blocks = ("attitude", "velocity", "gyro_bias", "accel_bias")
    made = product_contender(given, name, blocks=blocks, frame="ENU")
    assert made.reported is not None
    level = np.r_[0:3, 3:5, 6:9, 9:11]  # without the vertical channel
    return replace(made, case=Partial(_of_pair, made.case), reported=made.reported[level])


def _of_pair(case: Callable[[product.PairRun], Case], world: VelocityAttitudeWorld) -> Case:
    return case(world.pair)


def view(given: VelocityAttitude, course: VelocityAttitudeCourse) -> View:
    """Contents of the report of every filter; errors are true minus estimated."""
    epoch_s, path = course.pair.epoch_s, course.pair.path
    roll, _, heading = (np.asarray(a) for a in to_euler(jnp.asarray(path.q_nb.wxyz)))
    return View(
        epoch_s=epoch_s,
        faults=faults(given, epoch_s),
        blocks=(
            StateBlock("attitude", slice(0, 3), "rad", "arcmin", "ENU", ENU),
            StateBlock("velocity", slice(3, 5), "m/s", "m/s", "ENU", ENU[:2]),
            StateBlock("gyro_bias", slice(5, 8), "rad/s", "deg/h", "RFU", RFU),
            StateBlock("accel_bias", slice(8, 10), "m/s^2", "mg", "RFU", RFU[:2]),
        ),
        sensors={
            va.VELOCITY_SENSOR: SensorAxes("m/s", "ENU", ENU[:2]),
            va.ATTITUDE_SENSOR: SensorAxes("rad", "Euler", ("heading", "pitch", "roll")),
            **PRODUCT_SENSORS,
        },
        metrics=partial(metrics_of, epoch_s),
        context=xr.Dataset(
            array("context", roll, "roll", unit="rad")
            | array("context", heading, "heading", unit="rad")
        ),
        count_from=int(np.searchsorted(epoch_s, given.settle + 1e-9)),
        limits=(
            Limit("1_arcmin", "attitude", ARCMIN),
            Limit("5_arcmin", "attitude", 5.0 * ARCMIN),
        ),
    )


def metrics_of(epoch_s: np.ndarray, statistics: Any) -> dict[str, Metric]:
    """Metrics of one filter from its campaign statistics, over the evaluation epochs.

    Lists run east, north, up and right, forward, up. A run has settled below a limit when its worst
    attitude axis stays there to the end; the settling time is the median over runs, infinite where
    most never settle.
    """
    out = rms_by_axis(statistics, all_axes=("attitude",))
    for limit in statistics.limits:
        settled = statistics.settled(limit.name)
        # E means never; settling within the last second is no evidence
        times = np.append(np.insert(epoch_s[:-1], 0, 0.0), np.inf)[settled]
        out[f"share_below_{limit.name}"] = Probability.among(settled <= statistics.count_from)
        out[f"settled_share_{limit.name}"] = Probability.among(times < epoch_s[-1] - 1.0)
        out[f"settled_median_{limit.name}_s"] = float(np.median(times))
    out["error_over_sigma"] = statistics.overall_ratio().tolist()
    for sensor in statistics.sensors:
        out[f"nis_{sensor}"] = statistics.nis(sensor).value
    out["diverged_runs"] = statistics.diverged
    return out


# ------------------------------------------------------------------------------------------ claims

RMS = "attitude_rms_all_arcmin"
# ratio up to which one filter is better than the other, and is so in part; beyond, both are as good
_BETTER, _FAIRLY = (0.0, 0.95), (0.0, 0.98)
_ADAPTIVE = "adaptive-hinf"
_RATIOS = {
    "beats-kf": (_ADAPTIVE, ("kf",), (RMS,), _BETTER, _FAIRLY),
    "kf-suffers": ("kf", ("kf-told-both",), (RMS,), (1.0 / 0.95, None), (1.0 / 0.98, None)),
    "beats-fixed": (_ADAPTIVE, ("hinf-fixed",), (RMS,), _BETTER, _FAIRLY),
    "compensation": (f"{_ADAPTIVE}-compensated", (_ADAPTIVE,), (RMS,), _BETTER, _FAIRLY),
}
_TEXTS = {
    "beats-kf": "Under noise that is unknown and not Gaussian the adaptive H-infinity filter "
    "aligns more accurately than a Kalman filter that assumes the stated noise alone (the "
    "patent); value: ratio of their attitude RMS over all axes",
    "kf-suffers": "Without knowledge of the noise, a Kalman filter loses accuracy (the "
    "patent); value: its attitude RMS over that of one that knows it",
    "beats-fixed": "A bound that adapts to the environment serves better than a fixed one (the "
    "patent), here 1.05 times the least there is; value: ratio of attitude RMS",
    "compensation": "Compensating P where the bound does not hold raises the accuracy (the "
    "patent); value: attitude RMS with compensation over that without",
}
CLAIMS = ratio_claims(_RATIOS, _TEXTS)

STUDY = Study(VelocityAttitude, FILTERS, simulate, contender, view, lay_out, CLAIMS)
