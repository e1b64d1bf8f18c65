"""The study "attitude-loop": each filter with its assumptions in the loop, and claims.

Claims are the patent's, and those of robins, marked "(ours)".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.tree_util import Partial
from jaxtyping import Array

from robins.errors import require_known
from robins.filters import Loop
from robins.filters.rules import with_gains
from robins.filters.synthesis import MissingExtra
from robins.results import array
from robins.systems.judgement import Metric, ratio_claims
from robins.systems.parts import during
from robins.systems.satellite import design, model, stepwise
from robins.systems.satellite.design import GainSpec, SensorNoise
from robins.systems.satellite.gyro import ARCSEC, equivalent_walk
from robins.systems.satellite.model import Build, make_filter
from robins.systems.satellite.nodes import (
    STAR,
    LoopConstants,
    NoiseFreeInputs,
    StepInputs,
    begin,
    react,
)
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.world import SatelliteCourse, SatelliteWorld, lay_out, simulate
from robins.systems.study import (
    Case,
    Contender,
    Norm,
    Output,
    Recipe,
    SensorAxes,
    StateBlock,
    Study,
    System,
    View,
)

AXES = ("x", "y", "z (boresight)")
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcsec", "body", AXES),
    StateBlock("gyro_bias", slice(3, 6), "rad/s", "arcsec/s", "body", AXES),
)


class FilterSpec(NamedTuple):
    """A filter of the study."""

    build: Build
    gain: GainSpec | None = None  # design of its gains, or of the inflation of a Kalman filter's Q
    drift: float | None = None  # factor on the variance of the bias walk; None: the true walk
    on_host: str = ""  # as of a `Contender`; such a filter runs only where it is named


FILTERS: Mapping[str, FilterSpec] = {
    # the star sensor's attitude, propagated by the gyro
    "raw": FilterSpec("fixed", GainSpec("raw"), 1.0),
    "mekf": FilterSpec("mekf", None, 1.0),  # multiplicative EKF
    "mekf-gate": FilterSpec("gated", None, 1.0),  # the same with a gate that reopens
    # a bank of them over the scale of the process noise
    "adaptive": FilterSpec("adaptive", None, 1.0),
    "mekf-tuned": FilterSpec("mekf", None, 30.0),  # the same, noise of the bias times 30
    "mekf-informed": FilterSpec("mekf", None, None),  # the same, given the true drift
    "ekf-quaternion": FilterSpec("quaternion", None, 1.0),  # additive EKF of seven states
    "h2": FilterSpec("fixed", GainSpec("h2"), 1.0),  # steady Kalman gain
    "mixed-lmi": FilterSpec("fixed", GainSpec("lmi", 0.5), 1.0),  # mixed, by LMI, n on the rate
    # the same, solved again at every star frame for the current rate
    "mixed-lmi-step": FilterSpec(
        "redesigned", GainSpec("lmi", 0.5), 1.0, "it solves an LMI in Python at every star frame"
    ),
    # mixed, by Riccati, n on the rate
    "mixed-riccati": FilterSpec("fixed", GainSpec("riccati", 0.5), 1.0),
    # the same, gamma halved
    "mixed-riccati-quarter": FilterSpec("fixed", GainSpec("riccati", 0.25), 1.0),
    # mixed, by Riccati, n on the bias
    "mixed-bias-half": FilterSpec("fixed", GainSpec("riccati", 0.5, "bias"), 1.0),
    # the same, gamma halved
    "mixed-bias": FilterSpec("fixed", GainSpec("riccati", 0.25, "bias"), 1.0),
    # the same with the gate
    "mixed-bias-gate": FilterSpec("fixed-gated", GainSpec("riccati", 0.25, "bias"), 1.0),
    # MEKF with the noise of mixed-bias
    "mekf-inflated": FilterSpec("mekf", GainSpec("riccati", 0.25, "bias"), 1.0),
    "hinf": FilterSpec("fixed", GainSpec("riccati", 0.1), 1.0),  # worst case first: gamma a tenth
}


def believed_walk(given: AttitudeLoop, spec: FilterSpec) -> float:
    """Gyro rate random walk assumed by a filter [rad/s/sqrt(s)]."""
    g = given.gyro
    true = equivalent_walk(g.rate_walk, g.markov, g.markov_time)
    if spec.drift is None:
        return true
    believed = true if given.believed.drift is None else given.believed.drift
    return math.sqrt(spec.drift) * believed


class FilterEnvironment(NamedTuple):
    """Environment of a filter as data: the loop, the first belief, and a constant gain."""

    given: LoopConstants
    steps: NoiseFreeInputs  # leading axis E
    due: Array  # (E,) bool
    attitude_rad: Array  # initial sigma
    bias_rad_s: Array
    gain: Array  # (6, 3); zeros where there is none
    frozen: Any  # `stepwise.FrozenPlant`, or None


# keyed by `additive`: True for filters that add to the quaternion's components
_REACTS = {False: partial(react, model.MULTIPLICATIVE), True: partial(react, model.ADDITIVE)}


def as_case(additive: bool, build: Build, around: FilterEnvironment, world: SatelliteWorld) -> Case:
    """Case of a filter in a run; pure."""
    given = around.given._replace(gyro_matrix=world.gyro_matrix, star_key=world.star_key)
    rows = StepInputs(around.steps, world.gyro_angle, world.gyro_bias, world.star_error)
    start: Any = model.start(world.start_q_ib, around.attitude_rad, around.bias_rad_s, additive)
    if build.startswith("fixed"):
        start = with_gains(make_filter(build).init(start, {STAR: 3}), {STAR: around.gain})
    if around.frozen is not None:
        state = make_filter(build).init(start, {STAR: 3})
        start = stepwise.initial_state(state, around.frozen, around.gain)
    loop = Loop(
        Partial(_REACTS[additive], given), begin(given, world.craft), rows, {STAR: around.due}
    )
    return Case(start=start, u=None, y={}, aux={}, truth=None, loop=loop)


def contender(given: AttitudeLoop, course: SatelliteCourse, name: str) -> Contender:
    """A filter with its model and its data.

    Raises:
        ValueError: there is no filter of this name, or its design needs a package that is not
            installed.
    """
    require_known("filter", name, FILTERS)
    spec = FILTERS[name]
    walk = believed_walk(given, spec)
    noise = model.noise_of(given.gyro.random_walk, walk, given.step)
    sensors = SensorNoise(given.gyro.random_walk, walk, given.star.period, given.star.noise)
    gain, facts, frozen = np.zeros((6, 3)), {}, None
    if spec.gain is not None:
        try:
            facts = dict(design.facts(sensors, spec.gain))
        except MissingExtra as error:
            raise ValueError(f"filter '{name}': {error}; or choose others by --filters") from error
        if spec.build.startswith("fixed"):
            gain = design.gain(sensors, spec.gain)
        elif spec.build == "redesigned":
            gain = design.gain(sensors, spec.gain)
            frozen = stepwise.frozen(sensors, spec.gain, given.step)
        else:
            more = design.inflation(sensors, spec.gain) * math.sqrt(given.step / given.star.period)
            noise = noise._replace(factor=jnp.concatenate([noise.factor, more], axis=1))
    start = (jnp.asarray(given.believed.attitude), jnp.asarray(given.believed.bias))
    around = FilterEnvironment(
        course.given, course.steps, jnp.asarray(course.due), *start, jnp.asarray(gain), frozen
    )
    additive = spec.build == "quaternion"
    return Contender(
        filter=make_filter(spec.build),
        model=model.model(noise, given.star.noise, additive, given.star.camera is not None),
        case=Recipe(as_case, (additive, spec.build), around),
        lasting=spec.build.startswith("fixed") or frozen is not None,
        facts=facts,
        on_host=spec.on_host,
    )


def attitude_metrics(statistics: Any) -> dict[str, Metric]:
    """Metrics of "attitude-loop": components 0 to 2 are the attitude's, body axes.

    ``attitude_rms_arcsec`` is the root sum square of the three axes of the error of attitude
    determination, pooled over epochs and runs, ``attitude_rms_spread_arcsec`` the standard
    deviation of the same figure from run to run, ``pointing_rms_arcsec`` that of the
    pointing error, control included. Peaks are the greatest lengths of each, mean over the runs.
    """
    s = statistics
    axes = np.sqrt(np.mean(s.run_rms[:, :3] ** 2, axis=0)) / ARCSEC
    by_run = np.linalg.norm(s.run_rms[:, :3], axis=1) / ARCSEC
    pointing = np.linalg.norm(s.run_output_rms("pointing"), axis=1) / ARCSEC
    out: dict[str, Any] = {
        "attitude_rms_arcsec": float(np.linalg.norm(axes)),
        "attitude_rms_spread_arcsec": float(np.std(by_run, ddof=1)) if s.runs > 1 else float("nan"),
        "pointing_rms_arcsec": float(np.sqrt(np.mean(pointing**2))),
        **{f"{a}_rms_arcsec": float(x) for a, x in zip("xyz", axes, strict=True)},
        "attitude_peak_arcsec": float(np.mean(s.norm_peaks("attitude"))) / ARCSEC,
        "pointing_peak_arcsec": float(np.mean(s.run_output_worst("pointing"))) / ARCSEC,
        "bias_rms_arcsec_s": float(np.linalg.norm(np.sqrt(np.mean(s.run_rms[:, 3:6] ** 2, axis=0))))
        / ARCSEC,
    }
    out["nees_attitude"] = s.mean_nees()["nees_attitude"]
    out["anees_share_inside"] = s.anees_share_inside()
    out["diverged_runs"] = s.diverged
    return out


RMS, POINTING, SPREAD = "attitude_rms_arcsec", "pointing_rms_arcsec", "attitude_rms_spread_arcsec"
BETTER, PARTLY = (0.0, 0.9), (0.0, 1.0)


_RATIOS = {
    "improves-on-star": ("mixed-lmi", ("raw",), (RMS,), BETTER, PARTLY),
    "improves-on-mekf": ("mixed-lmi", ("mekf",), (RMS,), BETTER, PARTLY),
    "improves-on-tuned": ("mixed-lmi", ("mekf-tuned",), (RMS,), BETTER, PARTLY),
    "improves-on-informed": ("mixed-lmi", ("mekf-informed",), (RMS,), BETTER, PARTLY),
    "steadier": ("mixed-bias", ("mekf",), (SPREAD,), (0.0, 0.5), PARTLY),
    "bias-better": ("mixed-bias", ("mixed-riccati-quarter",), (POINTING,), BETTER, PARTLY),
}
_IMPROVES = (
    "The mixed filter improves the precision of attitude determination; read against {}, "
    "value: RMS error of mixed-lmi over that of {}"
)
_TEXTS = {
    "improves-on-star": _IMPROVES.format("the star sensor alone", "raw"),
    "improves-on-mekf": _IMPROVES.format("a Kalman filter that believes the nominal noise", "mekf"),
    "improves-on-tuned": _IMPROVES.format(
        "a Kalman filter with more noise on the bias", "mekf-tuned"
    ),
    "improves-on-informed": _IMPROVES.format(
        "a Kalman filter with the true drift", "mekf-informed"
    ),
    "steadier": "The mixed filter's error varies less from run to run (ours); value: the spread of "
    "its RMS error over that of the nominal MEKF",
    "bias-better": "The modelling error belongs on the bias, not on the rate (ours); value: "
    "pointing error of mixed-bias over that of mixed-riccati-quarter, both a quarter of the Kalman "
    "filter's gain",
}
CLAIMS = ratio_claims(_RATIOS, _TEXTS)
"""Every claim that a scenario may state."""


def faults(given: AttitudeLoop, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """Masks (E,) of the epochs at which gyro and star sensor differ from the filters' model.

    Noise, modelled drift and false stars are not faults.
    """
    g, star, believed = given.gyro, given.star, given.believed.drift
    true = equivalent_walk(g.rate_walk, g.markov, g.markov_time)
    drifts = believed is not None and not math.isclose(believed, true, rel_tol=0.1)
    gyro = drifts or g.scale_factor > 0.0 or g.misalignment > 0.0
    spans = [fault for fault in star.faults if fault.kind != "sign"]
    return {
        "gyro": np.full(len(time_s), gyro),
        STAR: during(spans, time_s) | (star.low_frequency > 0.0),
    }


def view(given: AttitudeLoop, course: SatelliteCourse) -> View:
    """Report: attitude, gyro bias, pointing error, momentum of the wheels."""
    counted = int(np.searchsorted(course.time_s, given.counted_from + 1e-9))
    lost = (course.due & ~np.asarray(course.steps.star.seen)).astype(np.int8)
    outage = array("outage", lost, long_name="star sensor lost") if np.any(lost) else {}
    wheels = tuple(f"wheel {i}" for i in range(len(given.wheels.axes)))
    where = "Where the craft points against where it should."
    held = f"Momentum of the wheels, first run; each holds {given.wheels.momentum:g} N m s."
    return View(
        epoch_s=course.time_s,
        blocks=BLOCKS,
        sensors={STAR: SensorAxes("rad", "body", AXES, "arcsec")},
        metrics=attitude_metrics,
        context=xr.Dataset(outage),
        count_from=counted,
        outputs=(
            Output("pointing", "rad", "arcsec", "reference", ("x", "y", "z"), where, is_error=True),
            Output("wheel_momentum", "N m s", "N m s", "wheel axes", wheels, held),
        ),
        norms=(Norm("attitude", (0, 1, 2)),),
        windows=(slice(counted, len(course.time_s)),),
        faults=faults(given, course.time_s),
    )


STUDY = Study(
    parameters=AttitudeLoop,
    filters=tuple(FILTERS),
    on_request=tuple(name for name, spec in FILTERS.items() if spec.on_host),
    lay_out=lay_out,
    simulate=simulate,
    contender=contender,
    view=view,
    claims=CLAIMS,
)
SYSTEM = System(name="satellite", studies={"attitude-loop": STUDY}, default="adaptive")
