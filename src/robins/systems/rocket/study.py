"""The two studies of the rocket: filters, their assumptions and their inputs.

The paper's filter is "federated-vector-stukf": two local unscented filters, for gyro and
magnetometer, each with strong tracking in its simplified (lumped) form; shares by the observability
of each state; information shared as A^-1/2 P A^-1/2 ("half"), with a reset at every step. It is not
an upper bound (`robins.filters.federated`), hence the warning that is silenced here: the study is
about it.
"""

from __future__ import annotations

import math
import warnings
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.tree_util import Partial
from jaxtyping import Array

from robins import filters
from robins.filters import Belief, Filter, Model, Motion, Rule, Sensor, kalman
from robins.filters.composite.fusion import Sharing
from robins.filters.rules import discriminator, gate, huber, only, strong_tracking
from robins.filters.rules.discriminator import PUBLISHED
from robins.results import array
from robins.rotation import Rotation
from robins.systems.aboard import Taken, filter_instruments, measurements_of
from robins.systems.parts import NED
from robins.systems.rocket import angles, field
from robins.systems.rocket.angles import GYRO, MAGNETIC, angle_state
from robins.systems.rocket.claims import CLAIMS, angle_metrics, field_metrics
from robins.systems.rocket.field import FIELD, SNAPSHOT, FieldState
from robins.systems.rocket.parameters import FieldVector, MagneticAttitude, RocketFlight
from robins.systems.rocket.world import (
    BODY,
    EULER,
    RocketCourse,
    RocketWorld,
    body_of,
    faults,
    instruments,
    lay_out,
    simulate,
    start_of,
    with_angle_errors,
)
from robins.systems.study import Case, Contender, Norm, Recipe, StateBlock, Study, View
from robins.systems.tables import block_array

PROBABILITY = 0.999  # of the chi-square tests
PATIENCE = 30  # samples: 3 s, longer than a burst, shorter than a tolerable loss of track
FORGETS = (10.0, 10.0)  # rad, rad/s: noise of a step that removes all past information
ANGLES_SEEN, RATES_SEEN = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
_POINTS = filters.unscented(alpha=0.5, beta=2.0, kappa=0.0)

# ------------------------------------------------------------------------- parts of the filters


def ukf(*rules: Rule) -> Filter:
    """Unscented filter with the sigma points of the studies."""
    return kalman(_POINTS, rules)


def fading(fade: Literal["lumped", "multiple", "projected"] = "lumped", beta: float = 1.0) -> Rule:
    """Strong tracking; "lumped", the simplified form, as the paper prints it."""
    return strong_tracking(0.95, beta, fade, "classic", limit=1e3)


def patient_gate() -> Rule:
    """A gate that reopens after too many consecutive refusals, and reports it."""
    return gate(PROBABILITY, PATIENCE, "inflate")


def discriminator_of(sensor: str, given: MagneticAttitude) -> Rule:
    """Rule that separates outliers from model errors; it fades the states the sensor measures."""
    rates = sensor == GYRO and given.gyro_reads == "rate"
    seen = RATES_SEEN if rates else ANGLES_SEEN
    rule = discriminator(PATIENCE, PROBABILITY, 0.98, "multiple", threshold=PUBLISHED, weights=seen)
    return only((sensor,), rule)


def projected_discriminator(robust: Literal["huber", "gate"], looks: int) -> Rule:
    """The same for a single vector, which observes each state only in part.

    Information faded by mistake is not recovered there, so the threshold follows from the length
    of the run.
    """
    return discriminator(PATIENCE, PROBABILITY, 0.98, "projected", robust, looks=looks)


def sensors_of(
    given: RocketFlight, course: RocketCourse, names: tuple[str, ...]
) -> tuple[tuple[Sensor, ...], Taken]:
    """`filter_instruments` for the instruments of these names."""
    return filter_instruments([i for i in instruments(given) if i.name in names], given, course)


def bank(driver: str, *off: str) -> Filter:
    """A bank with the sigma points of the studies.

    Args:
        driver: instrument that drives the motion, "motion" where none does.
        off: sensors that may be faulty.
    """
    return filters.adaptive(linearise=_POINTS, parts={driver: slice(None)}, off=off)


# ------------------------------------------------------------------------------- magnetic attitude


class AngleFilter(NamedTuple):
    """Definition of a filter of the study "magnetic-attitude"."""

    sharing: Sharing | None = None  # between two local filters; None: a single filter
    rule: Rule | None = None
    sensors: tuple[str, ...] = (GYRO, MAGNETIC)
    raw: bool = False  # its sensor is used directly, without a motion model
    discriminates: bool = False  # outliers from model errors, of each sensor
    adapts: bool = False  # a bank over the process noise


ANGLE_FILTERS: dict[str, AngleFilter] = {
    "gyro": AngleFilter(sensors=(GYRO,), raw=True),
    "magnetic-raw": AngleFilter(sensors=(MAGNETIC,), raw=True),
    "magnetometer": AngleFilter(sensors=(MAGNETIC,)),
    "gyro-ukf": AngleFilter(sensors=(GYRO,)),
    "ukf": AngleFilter(),
    "federated-scalar-ukf": AngleFilter("scalar"),
    "federated-vector-ukf": AngleFilter("half"),
    "federated-root": AngleFilter("root"),
    "stukf": AngleFilter(None, fading()),
    "federated-scalar-stukf": AngleFilter("scalar", fading()),
    "federated-vector-stukf": AngleFilter("half", fading()),
    "federated-vector-multiple": AngleFilter("half", fading("multiple")),
    "federated-vector-weakened": AngleFilter("half", fading(beta=4.0)),
    "huber": AngleFilter(None, huber(PROBABILITY)),
    "gate": AngleFilter(None, patient_gate()),
    "discriminator": AngleFilter(discriminates=True),
    "adaptive": AngleFilter(adapts=True),
    "federated-root-discriminator": AngleFilter("root", discriminates=True),
}


def angle_filter(given: MagneticAttitude, chosen: AngleFilter) -> Filter:
    """Make the filter. Two local filters are reset at every step; scalar shares are halves."""

    def own(*sensors: str) -> Filter:
        rules = [discriminator_of(s, given) for s in sensors] if chosen.discriminates else []
        return ukf(*rules, *(() if chosen.rule is None else (chosen.rule,)))

    if chosen.raw:
        return kalman(filters.taylor())
    if chosen.adapts:
        # Of two sensors of the angles, the integrated gyro becomes wrong: its error accumulates.
        adds_up = given.gyro_reads == "attitude"
        return bank("motion", GYRO, *(() if adds_up else (MAGNETIC,)))
    if chosen.sharing is None:
        return own(*chosen.sensors)
    channels = [filters.channel((sensor,), own(sensor)) for sensor in chosen.sensors]
    shares = "equal" if chosen.sharing == "scalar" else shares_by_state(given)  # pyright: ignore[reportArgumentType] frozen, so hashable
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "sharing='half'", UserWarning)
        return filters.federated(
            channels, "fusion-reset", chosen.sharing, shares, linearise=_POINTS
        )


@cache  # half a second, the same for all filters of a scenario
def shares_by_state(given: MagneticAttitude) -> np.ndarray:
    """(2, 6) shares by the initial observability of each state from gyro and magnetometer."""
    q, omega = start_of(given)
    start = angle_state(with_angle_errors(q, given.start.attitude_error), omega)
    channels = [filters.channel((sensor,), kalman()) for sensor in (GYRO, MAGNETIC)]
    model = angle_model(given, lay_out(given), ANGLE_FILTERS["ukf"])
    return filters.observability_shares(
        model, Belief(start, jnp.diag(angle_sigma(given))), channels
    )


def angle_sigma(given: MagneticAttitude) -> Array:
    """Initial sigma (6,) of angles [rad] and rates [rad/s]."""
    return jnp.repeat(jnp.array([given.start.attitude, given.start.rate]), 3)


def angle_model(given: MagneticAttitude, course: RocketCourse, chosen: AngleFilter) -> Model:
    """Motion and sensors assumed by a filter."""
    b, T, white = given.believed, given.step, given.gyro.white
    sensors, _ = sensors_of(given, course, chosen.sensors)
    if not chosen.raw:
        noise = np.array([b.attitude_noise, b.rate_noise]) * np.sqrt(T)
        motion = Motion(Partial(angles.step, coefficients(given)), jnp.repeat(noise, 3))
    elif chosen.sensors == (GYRO,) and given.gyro_reads == "rate":  # dead reckoning
        noise = jnp.repeat(jnp.array([T * white, white]), 3)
        motion, sensors = Motion(Partial(angles.dead_reckoned, jnp.asarray(T)), noise), ()
    else:
        motion = Motion(angles.no_motion, jnp.repeat(jnp.array(FORGETS), 3))
    return Model(motion, sensors)


def coefficients(given: MagneticAttitude) -> angles.AngleCoefficients:
    """Coefficients of the assumed motion: the paper's equation with an error of some per cent."""
    wrong = 1.0 + given.believed.error
    kinematic = wrong if given.believed.wrong == "all" else 1.0
    e1, e2, e3 = (wrong * e for e in body_of(given))
    return angles.AngleCoefficients(*map(jnp.asarray, (e1, e2, e3, kinematic, given.step)))


def angle_case(of: Taken, sigma: Array, world: RocketWorld) -> Case:
    """Case of a filter of "magnetic-attitude" in a run; pure."""
    return Case(
        start=Belief(angle_state(world.start_q_nb, world.start_omega_b), jnp.diag(sigma)),
        u=field.bridged(world.theta_b).theta_b,
        truth=angle_state(world.q_nb[1:], world.omega_b[1:]),
        **measurements_of(of, world),
    )


def angle_contender(given: MagneticAttitude, course: RocketCourse, name: str) -> Contender:
    """A filter of "magnetic-attitude" with its model and its data."""
    chosen = ANGLE_FILTERS[name]
    model = angle_model(given, course, chosen)
    _, of = sensors_of(given, course, tuple(model.dims))
    case = Recipe(angle_case, (of,), angle_sigma(given))
    return Contender(angle_filter(given, chosen), model, case)


# ------------------------------------------------------------------------------------ field vector


class FieldFilter(NamedTuple):
    """Definition of a filter of the study "field-vector"."""

    filter: Filter = ukf()
    sensors: tuple[str, ...] = (FIELD,)  # or SNAPSHOT, the field without a motion model
    scaled: bool = False  # scale factors of the gyro are states
    # how outliers are treated by a rule that separates them from model errors; replaces `filter`
    discriminates: Literal["huber", "gate"] | None = None


FIELD_FILTERS: dict[str, FieldFilter] = {
    "gyro": FieldFilter(kalman(filters.taylor()), ()),
    "magnetometer": FieldFilter(kalman(filters.taylor()), (SNAPSHOT,)),
    "usque": FieldFilter(),
    "huber": FieldFilter(ukf(huber(PROBABILITY))),
    "gate": FieldFilter(ukf(patient_gate())),
    "discriminator": FieldFilter(discriminates="huber"),
    "discriminator-gate": FieldFilter(discriminates="gate"),
    "adaptive": FieldFilter(bank(GYRO, FIELD), scaled=True),
    "strong-tracking": FieldFilter(ukf(fading())),
    "strong-tracking-projected": FieldFilter(ukf(fading("projected"))),
    "gate-scale-factor": FieldFilter(ukf(patient_gate()), scaled=True),
    "usque-scale-factor": FieldFilter(scaled=True),
}


def field_model(given: FieldVector, course: RocketCourse, chosen: FieldFilter) -> Model:
    """Motion and sensor assumed by a filter."""
    g, T = given.gyro, given.step
    # random walk in a step equivalent to a drift of correlation time tau
    walk = g.drift * math.sqrt(2.0 * T / g.drift_time)
    angle = FORGETS[0] if SNAPSHOT in chosen.sensors else g.white * T
    motion = field.field_motion(field.GyroNoise(*map(jnp.asarray, (angle, walk, T))))
    sensors, _ = sensors_of(given, course, chosen.sensors)
    return Model(motion, sensors)


def field_sigma(given: FieldVector, chosen: FieldFilter) -> Array:
    """Initial sigma (n,) of attitude [rad], bias [rad/s] and scale factors."""
    bias = 0.0 if SNAPSHOT in chosen.sensors else math.hypot(given.gyro.bias, given.gyro.drift)
    scale = [given.scale_factor_sigma] if chosen.scaled else []
    return jnp.repeat(jnp.array([given.start.attitude, bias, *scale]), 3)


def field_case(scaled: bool, of: Taken, numbers: tuple[Array, Array], world: RocketWorld) -> Case:
    """Case of a filter of "field-vector" in a run, with or without scale factor states; pure.

    ``numbers`` are the initial sigma (n,) and the field (E, 3) [T] in n.
    """
    sigma, field_n = numbers
    world = world._replace(field_n=field_n)
    start, zero = Rotation(world.start_q_nb), jnp.zeros(3)
    q_nb, scale = world.q_nb[1:], jnp.broadcast_to(world.errors.scale_factor, field_n.shape)
    errors = (world.bias, scale) if scaled else (world.bias,)
    return Case(
        start=Belief(FieldState(start, *(zero for _ in errors)), jnp.diag(sigma)),
        u=field.bridged(world.theta_b),
        truth=FieldState(Rotation(q_nb), *errors),
        rows=field.rows_of(q_nb, field_n, len(sigma)),
        **measurements_of(of, world),
    )


def field_contender(given: FieldVector, course: RocketCourse, name: str) -> Contender:
    """A filter of "field-vector" with its model and its data."""
    chosen = FIELD_FILTERS[name]
    _, of = sensors_of(given, course, chosen.sensors)
    numbers = field_sigma(given, chosen), jnp.asarray(course.field_n)
    case = Recipe(field_case, (chosen.scaled, of), numbers)
    filter_ = chosen.filter
    if chosen.discriminates is not None:
        filter_ = ukf(projected_discriminator(chosen.discriminates, len(course.time_s)))
    return Contender(filter_, field_model(given, course, chosen), case)


def _view(given: RocketFlight, course: RocketCourse, **own: Any) -> View:
    """Common report of both studies: path and field for figures, and the unobserved direction."""
    height = array("context", course.alt_m, "height", unit="m", display_unit="km")
    block = StateBlock("field_n", slice(0, 3), "T", "uT", "launch NED", NED)
    about = {"long_name": "geomagnetic field", "dims": "time axis_field_n"}
    notes = []
    if np.any(course.seen):
        measured = np.where(course.seen[:, None], course.field_n, np.nan)
        notes.append(field.sentence(field.unobserved(measured, given.magnetometer.noise)))
    return View(
        epoch_s=course.time_s,
        context=xr.Dataset(height | block_array("context", block, course.field_n, **about)),
        count_from=int(np.searchsorted(course.time_s, given.counted_from + 1e-9)),
        windows=course.bursts,
        sensors={i.name: i.axes for i in instruments(given)},
        notes=notes,
        faults=faults(given, course.time_s, FIELD if isinstance(given, FieldVector) else MAGNETIC),
        **own,
    )


def angle_view(given: MagneticAttitude, course: RocketCourse) -> View:
    """Report of "magnetic-attitude"."""
    return _view(
        given,
        course,
        blocks=(
            StateBlock("attitude", slice(0, 3), "rad", "deg", "launch NED", EULER),
            StateBlock("rate", slice(3, 6), "rad/s", "deg/s", "FRD", ("p", "q", "r")),
        ),
        metrics=partial(angle_metrics, course),
    )


def field_view(given: FieldVector, course: RocketCourse) -> View:
    """Report of "field-vector"."""
    across = ("about", "level", "upright")
    return _view(
        given,
        course,
        blocks=(
            StateBlock("attitude", slice(0, 3), "rad", "deg", "FRD", BODY),
            StateBlock("field_attitude", slice(3, 6), "rad", "deg", "field", across),
            StateBlock("gyro_bias", slice(6, 9), "rad/s", "deg/h", "FRD", BODY),
        ),
        metrics=partial(field_metrics, course),
        norms=(Norm("across_field", (4, 5)),),
    )


MAGNETIC_ATTITUDE = Study(
    MagneticAttitude, tuple(ANGLE_FILTERS), simulate, angle_contender, angle_view, lay_out, CLAIMS
)
FIELD_VECTOR = Study(
    FieldVector, tuple(FIELD_FILTERS), simulate, field_contender, field_view, lay_out, CLAIMS
)
