"""The airship's study: filters and the instruments they take, report, claims.

The paper's filters have two local ones, for radar with barometer and for stars, fused by its (51);
the local filters keep their own means and covariances (`distributed`). Details that it does not
state follow the specification: AEKF adapts R (Sage-Husa), RAUKF has IGG-III weights and an
innovation fading factor. The constrained filters differ in the form of the constraint, its sigma,
and the filter to which it is applied.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import filters
from robins.filters import Belief, Filter, Model, Rule, kalman, rules, taylor
from robins.manifold import retract
from robins.systems.aboard import Taken, filter_instruments, measurements_of
from robins.systems.airship import instruments
from robins.systems.airship.error_model import ERRORS, Feedback
from robins.systems.airship.instruments import SAR, STAR, WIND, WIND_OF_STAR
from robins.systems.airship.model import NINE, PRODUCT, WIND_STATES, States
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import AirshipCourse, AirshipWorld, lay_out, simulate
from robins.systems.judgement import Claim, Metric, ratio_claims
from robins.systems.parts import ENU
from robins.systems.study import Case, Contender, Instrument, Norm, Recipe, StateBlock, Study, View

# --------------------------------------------------------------------------------- the filters

# The metric W = I of the paper, whose D has columns of velocity only. Attitude is weighted by
# 10 m/s per radian: with W = I it would take nearly all of the correction (244 m).
LEVEL = np.diag([1e12] * 3 + [1.0] * 6)

COMMON = 9  # states that all local filters have
DRIVEN = {"gyros": range(0, 3), "accelerometers": range(3, 9)}  # components, by instrument
BOTH = (WIND, WIND_OF_STAR)


POINTS = filters.unscented(alpha=1.0, beta=2.0, kappa=0.0)
"""The paper's sigma points, with a spread well above rounding (its alpha is 1e-4)."""


def ukf(*of: Rule) -> Filter:
    """Unscented Kalman filter."""
    return kalman(POINTS, of)


def ekf(*of: Rule) -> Filter:
    """Extended Kalman filter."""
    return kalman(taylor(), of)


def robust() -> Filter:
    """A local filter of RAUKF: equivalent weights, then fading by the weighted innovations.

    They apply to radar and stars, not to the wind, whose errors have states. Stars do not observe
    position, whose covariance the fading of their filter would inflate without bound.
    """
    weights = rules.igg3(1.5, 4.0, 1e-4, patience=None)
    fading = rules.innovation_fading(10, 5.0, reach=1e3)
    return ukf(rules.only((SAR, STAR), weights), rules.only((SAR, STAR), fading))


def _locals(local: Callable[[], Filter], wind: Sequence[str] = ()) -> list[filters.Channel]:
    """Two local filters of one kind, for radar and stars; one or both use the constraint."""
    channels = (SAR, *wind[:1]), (STAR, *wind[1:])
    return [filters.channel(sensors, local()) for sensors in channels]


def _two(local: Callable[[], Filter], wind: Sequence[str] = (), **how: Any) -> Filter:
    """Two local filters of one kind, fused by (51); further arguments as of `distributed`."""
    return filters.distributed(_locals(local, wind), **how)


def _gated(constrained: Filter, assumption: tuple[str, ...]) -> Filter:
    """The constrained filter, while the unconstrained one does not contradict it.

    Horizontal velocity and position are tested. The ratio is higher than its default because the
    unconstrained filter, fused by (51), is overconfident (NEES of velocity 1.95 a state).
    """
    groups = ((3, 4), (6, 7))
    return filters.guarded(constrained, _two(ukf), assumption, SAR, groups=groups, ratio=3.0)


def _product() -> Filter:
    patient = rules.gate(0.9999, 5, "inflate")
    return ekf(rules.only((SAR,), rules.huber(0.999)), rules.only((WIND,), patient))


class Candidate(NamedTuple):
    """A filter of the study, with its instruments and states."""

    make: Callable[[], Filter]
    instruments: tuple[Instrument, ...]
    states: States = NINE


PLAIN = (instruments.RADAR, instruments.STARS)
HARD = (*PLAIN, *instruments.HARD)
SOFT = (*PLAIN, instruments.SOFT)
WINDY = (*PLAIN, instruments.AIR_DATA)
KNOWN = (*PLAIN, *instruments.wind_constraints(taken=instruments.steady))
EXACT = (*PLAIN, *instruments.wind_constraints(taken=instruments.true_air))
PRINTED = (instruments.PRINTED_RADAR, instruments.PRINTED_STARS)
SIDESLIP = (*PLAIN, *instruments.wind_constraints(taken=instruments.forward_airspeed))

CANDIDATES: dict[str, Candidate] = {
    "ekf": Candidate(lambda: _two(ekf), PLAIN),
    "aekf": Candidate(lambda: _two(lambda: ekf(rules.sage_husa(0.98))), PLAIN),
    "ukf": Candidate(lambda: _two(ukf), PLAIN),
    "raukf": Candidate(lambda: _two(robust), PLAIN),
    "cukf-hard": Candidate(lambda: _two(ukf, BOTH), HARD),
    "cukf-soft": Candidate(lambda: _two(ukf, (WIND,)), SOFT),
    "cukf-wind-states": Candidate(lambda: _two(ukf, (WIND,), common=COMMON), WINDY, WIND_STATES),
    "cukf-exact": Candidate(lambda: _two(ukf, BOTH), EXACT),
    "cukf-printed": Candidate(lambda: _two(ekf, BOTH), (*PLAIN, *instruments.PRINTED_WIND)),
    "cukf-robust": Candidate(lambda: _two(robust, (WIND,), common=COMMON), WINDY, WIND_STATES),
    "cukf-master": Candidate(lambda: filters.at_master(_two(ukf), (WIND,)), SOFT),
    "cukf-identity": Candidate(
        lambda: _two(lambda: ukf(rules.projection(BOTH, LEVEL)), BOTH), HARD
    ),
    "cukf-unprojected": Candidate(
        lambda: _two(lambda: ukf(rules.projection(BOTH, project_covariance=False)), BOTH), HARD
    ),
    "cukf-wind-known": Candidate(lambda: _two(ukf, BOTH), KNOWN),
    "cukf-sideslip": Candidate(lambda: _two(ukf, BOTH), SIDESLIP),
    "cukf-hard-gated": Candidate(lambda: _gated(_two(ukf, BOTH), BOTH), HARD),
    "cukf-soft-gated": Candidate(lambda: _gated(_two(ukf, (WIND,)), (WIND,)), SOFT),
    "cukf-wind-known-gated": Candidate(lambda: _gated(_two(ukf, BOTH), BOTH), KNOWN),
    "cukf-sideslip-gated": Candidate(lambda: _gated(_two(ukf, BOTH), BOTH), SIDESLIP),
    "ukf-printed-h": Candidate(lambda: _two(ekf), PRINTED),
    "centralised": Candidate(ukf, PLAIN),
    "centralised-errors": Candidate(lambda: ukf(Feedback()), PLAIN, ERRORS),
    "federated": Candidate(lambda: filters.federated(_locals(ukf), linearise=POINTS), PLAIN),
    "intersection": Candidate(lambda: filters.intersecting(_locals(ukf), "det"), PLAIN),
    "distributed-mean": Candidate(lambda: _two(ukf, feedback="mean"), PLAIN),
    "distributed-full": Candidate(lambda: _two(ukf, feedback="full"), PLAIN),
    "product": Candidate(_product, instruments.ABOARD, PRODUCT),
    # "product" for a motion model that may be wrong at unknown times
    "adaptive": Candidate(lambda: filters.adaptive(parts=DRIVEN), instruments.ABOARD, PRODUCT),
}
"""Every filter of the study."""


def as_case(states: States, of: Taken, sigma: Array, world: AirshipWorld) -> Case:
    """Case of a filter with these sensors, errors at the start of sigma (n,); pure."""
    estimate, zero = retract(world.start, -world.initial_error), jnp.zeros(3)
    count = world.wind.shape[0]
    gyro, accel = (jnp.tile(b, (count, 1)) for b in (world.gyro_bias, world.accel_bias))
    return Case(
        start=Belief(states.of(estimate, zero, zero, jnp.zeros(2)), jnp.diag(sigma)),
        u=world.parts if states.in_parts else world.epoch_increments,
        truth=states.of(world.truth, gyro, accel, world.wind_error),
        **measurements_of(of, world),
    )


def contender(given: Airship, course: AirshipCourse, name: str) -> Contender:
    """A filter with its model, its data and its reported blocks."""
    make, taking, states = CANDIDATES[name]
    sensors, of = filter_instruments(taking, given, course)
    sigma = jnp.concatenate([jnp.asarray(s) for s in states.sigma(given, course)])
    return Contender(
        filter=make(),
        model=Model(states.motion(given, course), sensors),
        case=Recipe(as_case, (states, of), sigma),
        reported=np.pad(states.reported(course), ((0, 0), (0, len(sigma) - COMMON))),
        facts=published(name, given.wind.gusty),
    )


# ----------------------------------------------------------------------------------------- report

BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcsec", "ENU", ENU),
    StateBlock("velocity", slice(3, 6), "m/s", "m/s", "ENU", ENU),
    StateBlock("position", slice(6, 9), "m", "m", "ENU", ENU),
)
"""Blocks reported by every filter of the study, errors being true minus estimated."""

_AROUND_LOSS_S = (-1.0, 100.0, 200.0, 299.0, 350.0, 500.0)  # after the loss begins


def view(given: Airship, course: AirshipCourse) -> View:
    """Contents of the report of every filter."""
    # an epoch that ends a span belongs to it: 200 s to 800 s are the epochs 200.0 to 800.0
    first, last = (
        int(np.searchsorted(course.epoch_s, t))
        for t in (given.counted.begin - 1e-9, given.counted.end + 1e-9)
    )
    at_s = [lost.begin + t for lost in given.sar.lost[:1] for t in _AROUND_LOSS_S]
    span, time = given.wind.span, course.epoch_s
    # an epoch covers the step before it
    blown = (time > span.begin + 1e-9) & (time <= span.end + 1e-9) & given.wind.gusty
    return View(
        epoch_s=course.epoch_s,
        blocks=BLOCKS,
        sensors={i.name: i.axes for i in instruments.INSTRUMENTS},
        metrics=partial(airship_metrics, course.epoch_s, at_s),
        count_from=first,
        count_to=last,
        norms=(Norm("horizontal", (6, 7)), Norm("velocity", (3, 4))),
        bound_of="product",
        faults={"accelerometers": blown & (given.imu.unsensed > 0.0)},
    )


def published(name: str, windy: bool) -> dict[str, float]:
    """The row of the paper's table for a filter, if there is one."""
    row = PUBLISHED["wind" if windy else "calm"].get(name, ())
    return {f"published_{key}": value for key, value in zip(METRICS, row, strict=False)}


def airship_metrics(
    epoch_s: np.ndarray, at_s: Sequence[float], statistics: Any
) -> dict[str, Metric]:
    """Metrics of one filter from its campaign statistics, over the evaluation epochs.

    Means and standard deviations over time are of the length of the horizontal error, averaged over
    the runs; the NEES per state is one for a consistent filter.
    """
    position, velocity = (np.mean(statistics.norm(n), axis=0) for n in ("horizontal", "velocity"))
    out: dict[str, Any] = dict(zip(METRICS, map(float, [*position, *velocity]), strict=True))
    out |= statistics.mean_nees()
    out["anees_share_inside"] = statistics.anees_share_inside()
    horizontal = np.sqrt(np.sum(statistics.rms[:, 6:8] ** 2, axis=1))
    for time in at_s:
        k = int(np.searchsorted(epoch_s, time - 1e-6))
        if k < len(epoch_s):
            out[f"horizontal_rms_at_{time:g}_s_m"] = float(horizontal[k])
    out["diverged_runs"] = statistics.diverged
    return out


AEKF, UKF, RAUKF, CUKF = "aekf", "ukf", "raukf", "cukf-wind-states"

# Table 1 of the paper: position and velocity error, mean and standard deviation [m, m/s]
PUBLISHED: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = {
    "calm": {
        AEKF: (2.37, 1.53, 0.326, 0.178),
        RAUKF: (1.50, 0.50, 0.120, 0.066),
        CUKF: (1.63, 0.51, 0.123, 0.070),
    },
    "wind": {
        AEKF: (4.56, 2.36, 0.496, 0.361),
        RAUKF: (3.01, 1.56, 0.309, 0.276),
        CUKF: (2.02, 1.26, 0.151, 0.121),
    },
}
METRICS = ("horizontal_mean_m", "horizontal_std_m", "velocity_mean_m_s", "velocity_std_m_s")


_RATIOS: dict[str, Any] = {
    "aekf-worse": (RAUKF, (AEKF,), METRICS[:1], (0.0, 0.98), (0.0, 1.0)),
    "ekf-is-why": ("ekf", (UKF,), METRICS[:1], (1.05, None), (1.01, None)),
    "equal-in-calm": (CUKF, (RAUKF,), METRICS[2:3], (0.9, 1.1), (0.8, 1.25)),
    "best-in-wind": (CUKF, (AEKF, RAUKF), METRICS[0:3:2], (0.0, 0.98), (0.0, 1.0)),
    "survives-loss": (CUKF, (UKF,), ("horizontal_rms_at_699_s_m",), (0.0, 0.3), (0.0, 0.7)),
}
_TEXTS = {
    "aekf-worse": "The robust adaptive UKF is more accurate than the adaptive EKF; value: ratio of "
    "the mean horizontal errors, RAUKF to AEKF",
    "ekf-is-why": "The EKF family is worse because it linearises; value: mean horizontal error of "
    "the EKF over that of the UKF",
    "equal-in-calm": "Without wind the constrained UKF is as accurate as RAUKF; value: ratio of "
    "the mean velocity errors, CUKF to RAUKF",
    "best-in-wind": "In wind the constrained UKF is more accurate than AEKF and RAUKF; value: the "
    "larger of its ratios of mean position and velocity error to the better of the two",
    "survives-loss": "Without radar and barometer the wind keeps the position (not in the paper: "
    "the case in which the constraint earns its place); value: horizontal RMS at the end of the "
    "loss, CUKF with wind states over UKF",
}
CLAIMS: dict[str, Claim] = ratio_claims(_RATIOS, _TEXTS) | {
    "absolute": Claim(
        "The constrained UKF navigates to 2.02 m and 0.151 m/s in wind (Table 1); value: mean "
        "horizontal error [m] of the one with wind states",
        (CUKF,),
        lambda metrics: metrics[CUKF][METRICS[0]],
        (0.0, 2.02 * 1.15),
        (0.0, 2.02 * 1.5),
    ),
    "at-the-bound": Claim(
        "With states for biases and wind the filter is as good as its sensors allow (ours); value: "
        "the larger of its RMS position and velocity errors over the covariance bound",
        ("product",),
        lambda metrics: max(
            metrics["product"][f"{b}_over_bound"] for b in ("position", "velocity")
        ),
        (0.0, 1.15),
    ),
}
"""Every claim that a scenario may state."""

NAVIGATION = Study(
    parameters=Airship,
    filters=tuple(CANDIDATES),
    simulate=partial(simulate, instruments.INSTRUMENTS),
    contender=contender,
    view=view,
    lay_out=lay_out,
    claims=CLAIMS,
)
