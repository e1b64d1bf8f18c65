"""The filters that are compared: what each is made of, what it believes, what it is given.

The paper's filters have two local ones, for radar with barometer and for stars, fused by its (51);
the locals go on from their own means and covariances (`distributed`). What it does not state is
chosen as the specification does: AEKF adapts R (Sage-Husa), RAUKF has IGG-III weights and an
innovation fading factor. The constrained filters differ in what they take for the constraint, how
firmly they believe it, and where it comes in.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins.filters import (
    Belief,
    Filter,
    Rule,
    Sensor,
    at_master,
    channel,
    distributed,
    federated,
    guarded,
    intersecting,
    kalman,
    taylor,
    unscented,
)
from robins.filters.distributed import Feedback
from robins.filters.rules import (
    gate,
    huber,
    igg3,
    innovation_fading,
    only,
    projection,
    sage_husa,
)
from robins.ins.frames import swap
from robins.ins.state import InsNoise, InsState
from robins.manifold import Angle, retract
from robins.systems.airship.error_form import Fed, error_states, feedback
from robins.systems.airship.measurement_rows import (
    error_from_tangent,
    printed_air_speed_error,
    printed_attitude_rows_ned,
    printed_constraint,
)
from robins.systems.airship.model import (
    SAR,
    STAR,
    STAR_EARLY,
    WIND,
    WIND_OF_STAR,
    Air,
    Datum,
    Early,
    Sigmas,
    WindIns,
    WindNav,
    WindNoise,
    nine_states,
    product_states,
    read_euler,
    read_sar,
    sensors,
    wind_states,
)
from robins.systems.airship.parameters import FILTERS, Airship
from robins.systems.airship.world import Course, World, start_sigma
from robins.systems.system import Case, Contender

States = Literal["nine", "errors", "wind", "product"]
Given = Literal["measured", "exact", "constant", "sideslip"]  # of air data and wind
Firm = Literal["exact", "white", "noise"]  # how firmly the constraint is believed

FLOOR = 1e-3  # m/s, of a constraint taken for exact: (51) needs covariances that have an inverse
COMMON = 9  # states that all local filters have

# The metric W = I of the paper, whose D has columns of velocity alone. Those of attitude weigh 10
# m/s a radian: under a plain I they would take nearly all of the correction (244 m).
LEVEL = np.diag([1e12] * 3 + [1.0] * 6)

SENSORS_1, SENSORS_2 = (SAR,), (STAR,)
CONSTRAINED_1, CONSTRAINED_2 = (SAR, WIND), (STAR, WIND_OF_STAR)


class Kind(NamedTuple):
    """A filter of the study."""

    make: Callable[[], Filter]
    sensors: tuple[str, ...]
    states: States = "nine"
    given: Given = "measured"
    firm: Firm = "exact"
    printed: Literal["", "rows", "constraint"] = ""  # taken from the paper as it stands


def ukf(*rules: Rule) -> Filter:
    """The paper's sigma points, with a spread that rounding does not swamp (its alpha is 1e-4)."""
    return kalman(unscented(alpha=1.0, beta=2.0, kappa=0.0), rules)


def robust() -> Filter:
    """A local filter of RAUKF: equivalent weights, then fading by what they leave.

    Judged are radar and stars, not the wind, whose errors have states. The stars show no position,
    which the fading of their filter would blow up without end.
    """
    weights = igg3(1.5, 4.0, 1e-4, patience=None)
    fading = innovation_fading(10, 5.0, reach=1e3)
    return ukf(only((SAR, STAR), weights), only((SAR, STAR), fading))


def _two(
    local: Callable[[], Filter],
    first: tuple[str, ...] = SENSORS_1,
    second: tuple[str, ...] = SENSORS_2,
    feedback: Feedback = "own",
    common: int | None = None,
) -> Filter:
    """Two local filters of one kind."""
    channels = [channel(first, local()), channel(second, local())]
    return distributed(channels, feedback, common=common)


def _constrained(*rules: Rule) -> Filter:
    """The constraint in both local filters."""
    return _two(lambda: ukf(*rules), CONSTRAINED_1, CONSTRAINED_2)


def _gated(constrained: Filter, assumption: tuple[str, ...]) -> Filter:
    """The constraint as long as the filter without it does not speak against it.

    Level velocity and position are judged. The ratio is higher than its default because the filter
    without, fused by (51), is overconfident (NEES of velocity 1.95 a state).
    """
    groups = ((3, 4), (6, 7))
    return guarded(constrained, _two(ukf), assumption, judges=SAR, groups=groups, ratio=3.0)


def _product() -> Filter:
    patient = gate(0.9999, 5, "inflate")
    return kalman(taylor(), [only((SAR,), huber(0.999)), only((WIND,), patient)])


BOTH = (*CONSTRAINED_1, *CONSTRAINED_2)
PLAIN = (*SENSORS_1, *SENSORS_2)
FIRST = (*CONSTRAINED_1, *SENSORS_2)

KINDS: dict[str, Kind] = {
    "ekf": Kind(lambda: _two(lambda: kalman(taylor())), PLAIN),
    "aekf": Kind(lambda: _two(lambda: kalman(taylor(), [sage_husa(0.98)])), PLAIN),
    "ukf": Kind(lambda: _two(ukf), PLAIN),
    "raukf": Kind(lambda: _two(robust), PLAIN),
    "cukf-hard": Kind(_constrained, BOTH),
    "cukf-soft": Kind(lambda: _two(ukf, CONSTRAINED_1), FIRST, firm="white"),
    "cukf-wind-states": Kind(
        lambda: _two(ukf, CONSTRAINED_1, common=COMMON), FIRST, "wind", firm="noise"
    ),
    "cukf-robust": Kind(
        lambda: _two(robust, CONSTRAINED_1, common=COMMON),
        FIRST,
        "wind",
        firm="noise",
    ),
    "cukf-exact": Kind(_constrained, BOTH, given="exact"),
    "cukf-printed": Kind(
        lambda: _two(lambda: kalman(taylor()), CONSTRAINED_1, CONSTRAINED_2),
        BOTH,
        printed="constraint",
    ),
    "cukf-master": Kind(lambda: at_master(_two(ukf), (WIND,)), FIRST, firm="white"),
    "cukf-identity": Kind(lambda: _constrained(projection((WIND, WIND_OF_STAR), LEVEL)), BOTH),
    "cukf-unprojected": Kind(
        lambda: _constrained(projection((WIND, WIND_OF_STAR), project_covariance=False)), BOTH
    ),
    "cukf-wind-known": Kind(_constrained, BOTH, given="constant"),
    "cukf-sideslip": Kind(_constrained, BOTH, given="sideslip"),
    "cukf-hard-gated": Kind(lambda: _gated(_constrained(), (WIND, WIND_OF_STAR)), BOTH),
    "cukf-soft-gated": Kind(lambda: _gated(_two(ukf, CONSTRAINED_1), (WIND,)), FIRST, firm="white"),
    "cukf-wind-known-gated": Kind(
        lambda: _gated(_constrained(), (WIND, WIND_OF_STAR)), BOTH, given="constant"
    ),
    "cukf-sideslip-gated": Kind(
        lambda: _gated(_constrained(), (WIND, WIND_OF_STAR)), BOTH, given="sideslip"
    ),
    "ukf-printed-h": Kind(lambda: _two(lambda: kalman(taylor())), PLAIN, printed="rows"),
    "centralised": Kind(ukf, PLAIN),
    "centralised-errors": Kind(lambda: ukf(feedback()), PLAIN, "errors"),
    "federated": Kind(
        lambda: federated(
            [channel(SENSORS_1, ukf()), channel(SENSORS_2, ukf())],
            linearise=unscented(alpha=1.0, beta=2.0, kappa=0.0),
        ),
        PLAIN,
    ),
    "intersection": Kind(
        lambda: intersecting([channel(SENSORS_1, ukf()), channel(SENSORS_2, ukf())], "det"), PLAIN
    ),
    "distributed-mean": Kind(lambda: _two(ukf, feedback="mean"), PLAIN),
    "distributed-full": Kind(lambda: _two(ukf, feedback="full"), PLAIN),
    "product": Kind(_product, (STAR_EARLY, *FIRST), "product", firm="noise"),
}


@cache
def make_filter(name: str) -> Filter:
    """The filter of a name; the same object each time, so that what was compiled serves again.

    Raises:
        ValueError: there is no filter of this name.
    """
    if name not in KINDS:
        raise ValueError(f"no filter '{name}' in this study; it has {', '.join(FILTERS)}")
    return KINDS[name].make()


# --------------------------------------------------------------------------- what a filter believes


def believed_sigmas(given: Airship) -> Sigmas:
    """Of the sensors, as their data sheets state."""
    s = given.sar
    return Sigmas(
        jnp.array([s.position, s.position, s.heading, given.barometer.height]),
        jnp.full(3, given.star.attitude),
    )


def wind_sigma(given: Airship, firm: Firm) -> float:
    """How firmly the constraint is believed, each axis [m/s]."""
    a = given.air_data
    return {"exact": FLOOR, "white": float(np.hypot(a.noise, a.wind_error)), "noise": a.noise}[firm]


def _looks(given: Airship, course: Course, kind: Kind) -> tuple[Sensor, ...]:
    start = course.start.position
    datum = Datum(start.lat, start.lon, jnp.asarray(course.metres_per_radian))
    sigmas = believed_sigmas(given)
    looks = {s.name: s for s in sensors(datum, sigmas, course.sights - 1)}
    if kind.printed == "rows":
        looks[SAR] = Sensor(looks[SAR].read, sigmas.sar, 4, SAR, Partial(_printed_sar, datum))
        looks[STAR] = Sensor(looks[STAR].read, sigmas.euler, 3, STAR, _printed_euler)
    if kind.printed == "constraint":
        for name in (WIND, WIND_OF_STAR):  # what d leaves over should be zero
            looks[name] = Sensor(_printed_zero, looks[name].noise, 2, name, _printed_wind)
    return tuple(s for s in looks.values() if s.name in kind.sensors and s.dim > 0)


def _printed_sar(datum: Datum, x: Any, aux: Any):
    """(45): the heading's row as printed."""
    heading = printed_attitude_rows_ned(x.q_nb.wxyz)[2]
    H = jnp.zeros((4, 9)).at[[0, 1, 3], [6, 7, 8]].set(jnp.array([1.0, 1.0, -1.0]))
    return read_sar(datum, x, aux), H.at[2, :3].set(heading)


def _printed_euler(x: Any, aux: Any):
    """(48)."""
    rows = printed_attitude_rows_ned(x.q_nb.wxyz)
    return read_euler(x, aux), jnp.concatenate([rows, jnp.zeros((3, 6))], 1)


def _printed_zero(x: Any, air: Air) -> Array:
    return _printed_wind(x, air)[0]


def _printed_wind(x: Any, air: Air):
    """(49), (50): D x = d with x computed minus true.

    Read with d's wind error as zero, and its air speed error as what velocity less wind differs
    from the measured air speed by.
    """
    heading = x.q_nb.as_euler()[2]
    speed = jnp.linalg.norm(jnp.asarray(air.v_air_b))
    wind = jnp.concatenate([jnp.asarray(air.wind)[::-1], jnp.zeros(1)])  # east north up
    error = printed_air_speed_error(swap(x.v_n), wind, speed)
    D, d = printed_constraint(heading, error, jnp.zeros(2))
    p = x.position
    return -d, D @ error_from_tangent(p.lat, p.alt)


def believed_model(given: Airship, course: Course, kind: Kind):
    """The model of a kind of filter."""
    looks, b, a = _looks(given, course, kind), given.believed, given.air_data
    wind = WindNoise(jnp.asarray(a.wind_error), jnp.asarray(a.wind_time))
    if kind.states == "nine":
        return nine_states(b.gyro_noise, b.accel_noise, looks)
    if kind.states == "errors":
        return error_states(b.gyro_noise, b.accel_noise, course.metres_per_radian, looks)
    if kind.states == "wind":
        return wind_states(b.gyro_noise, b.accel_noise, wind, looks)
    imu = given.imu
    shaken = b.accel_noise_factor * jnp.asarray(imu.accel_noise)
    return product_states(InsNoise(jnp.asarray(imu.gyro_noise), shaken), wind, looks)


# ------------------------------------------------------------------------------ what it is given


class Numbers(NamedTuple):
    """Data of a contender, so that contenders that differ in these alone compile once."""

    sigma: Array  # (n,) initial
    wind_sigma: Array  # (2,) m/s, believed of the constraint
    constant: Array  # (2,) m/s, the wind that always blows
    metres: Array  # (2,) in a radian of latitude, longitude
    origin: Array  # (2,) rad


def as_case(
    states: States,
    given: Given,
    sensors_: tuple[str, ...],
    printed: bool,
    n: Numbers,
    world: World,
) -> Case:
    """What a filter takes of a run; pure."""
    start: Any = retract(world.start, -world.initial_error)
    truth: Any = world.truth
    count = world.wind.shape[0]
    if states == "errors":
        start, truth = Fed(start, jnp.zeros(9)), Fed(truth, jnp.zeros((count, 9)))
    if states == "wind":
        start, truth = WindNav(start, jnp.zeros(2)), WindNav(truth, world.wind_error)
    if states == "product":
        zero = jnp.zeros(3)
        gyro, accel = (jnp.tile(b, (count, 1)) for b in (world.gyro_bias, world.accel_bias))
        start = WindIns(InsState(start.q_nb, start.v_n, start.position, zero, zero), jnp.zeros(2))
        own = InsState(truth.q_nb, truth.v_n, truth.position, gyro, accel)
        truth = WindIns(own, world.wind_error)
    p = world.sar_position
    away = jnp.stack([p.lat, p.lon], 1) - n.origin[None]
    thought, air_b = air_and_wind(given, n, world)
    y: dict[str, Any] = {
        SAR: (away * n.metres[None], Angle(world.sar_heading), world.height[:, None]),
        STAR: tuple(Angle(world.euler[:, -1, i]) for i in range(3)),
        WIND: thought,
        WIND_OF_STAR: thought,
    }
    air = Air(air_b, jnp.broadcast_to(n.wind_sigma, (count, 2)), jnp.nan_to_num(thought))
    if printed:
        y[WIND] = y[WIND_OF_STAR] = 0.0 * thought
    aux: dict[str, Any] = {name: air for name in (WIND, WIND_OF_STAR) if name in sensors_}
    early = world.since.shape[1]
    if early and STAR_EARLY in sensors_:
        sights = world.euler[:, :-1].reshape(count, -1)
        y[STAR_EARLY] = tuple(Angle(sights[:, i]) for i in range(3 * early))
        dt = world.whole.dt[:, None] / (early + 1.0)
        aux[STAR_EARLY] = Early(world.since, dt * jnp.arange(early, 0, -1).astype(float)[None])
    return Case(
        start=Belief(start, jnp.diag(n.sigma)),
        u=world.parts if states == "product" else world.whole,
        y={name: y[name] for name in y if name in sensors_},
        aux=aux,
        truth=truth,
    )


def air_and_wind(given: Given, n: Numbers, world: World) -> tuple[Array, Array]:
    """What is taken for the wind (E, 2), NaN where no air data come, and for the air velocity."""
    measured, thought = world.air_measured_b, world.wind + world.wind_error
    if given == "exact":
        measured, thought = world.air_b, world.wind
    if given == "constant":
        thought = jnp.broadcast_to(n.constant, thought.shape)
    if given == "sideslip":
        speed = jnp.linalg.norm(measured, axis=1)
        measured = speed[:, None] * jnp.array([[1.0, 0.0, 0.0]])
    there = jnp.isfinite(world.air_measured_b[:, :1])
    return jnp.where(there, thought, jnp.nan), jnp.where(there, measured, 0.0)


def contender(given: Airship, course: Course, name: str) -> Contender:
    """A filter with its model, its data, and what it reports.

    Raises:
        ValueError: there is no filter of this name.
    """
    filter_, kind = make_filter(name), KINDS[name]
    wind = given.wind.constant * np.array([np.cos(given.wind.towards), np.sin(given.wind.towards)])
    sigma, rows = [start_sigma(given)], None
    if kind.states == "errors":
        rows = reported_errors(course.metres_per_radian)
        sigma = [np.abs(np.linalg.inv(rows) @ reported(COMMON)) @ sigma[0]]
    if kind.states == "product":
        sigma += [np.asarray(given.imu.gyro_bias), np.asarray(given.imu.accel_bias)]
    if kind.states in ("wind", "product"):
        sigma.append(np.full(2, given.air_data.wind_error))
    origin = course.start.position
    numbers = Numbers(
        jnp.asarray(np.concatenate(sigma)),
        jnp.full(2, wind_sigma(given, kind.firm)),
        jnp.asarray(wind),
        jnp.asarray(course.metres_per_radian),
        jnp.stack([origin.lat, origin.lon]),
    )
    printed = kind.printed == "constraint"
    return Contender(
        filter=filter_,
        model=believed_model(given, course, kind),
        case=Partial(_case(kind.states, kind.given, kind.sensors, printed), numbers),
        reported=reported(len(numbers.sigma)) if rows is None else rows,
    )


@cache
def _case(states: States, given: Given, sensors_: tuple[str, ...], printed: bool):
    """The same function for the same choice, so that what was compiled serves again."""

    def case(numbers: Numbers, world: World) -> Case:
        return as_case(states, given, sensors_, printed, numbers, world)

    return case


def reported(n: int) -> np.ndarray:
    """(9, n) attitude, velocity and position, turned from north east down to east north up."""
    enu = np.asarray(swap(np.eye(3)))
    out = np.zeros((COMMON, n))
    for i in range(3):
        out[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = enu
    return out


def reported_errors(metres_per_radian: np.ndarray) -> np.ndarray:
    """(9, 9) the same of `Fed`: errors of velocity and position are the other way round."""
    north, east = metres_per_radian
    return np.diag([1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -east, -north, -1.0])
