"""The airship's instruments: simulation of each, measurements for a filter, its h(x) and R.

By the errors of `model`, true minus estimated, at heading psi (clockwise from north) and pitch
theta, with v_air = C_b^n v_air_b:

    radar (43) and barometer   dz = [dp_N, dp_E, dpsi, -dp_D]
    stars                      dz = [dtheta, droll, dpsi]
    wind (22)                  dz = [[v_air x] phi + dv]_NE + dw

        dtheta =  phi_E cos(psi) - phi_N sin(psi)
        droll  = (phi_E sin(psi) + phi_N cos(psi)) / cos(theta)
        dpsi   =  phi_D + tan(theta) (phi_E sin(psi) + phi_N cos(psi))

(22) is the paper's constraint *velocity over the ground = velocity through the air + wind*. It
depends on data, so it is a sensor: the assumed wind measures [v - C v_air]_NE + dw. The filters
use Jacobians or sigma points of h(x), so the only H written out here are those of the paper, as
printed: (44), (45), (48) and the constraint (49), (50).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, earth_rate_n, transport_rate_n
from robins.filters import Sensor
from robins.ins.frames import swap
from robins.ins.mechanise import Nav
from robins.manifold import Angle, wrap
from robins.rotation import Rotation, to_euler
from robins.sim.air_data import observe_air, observe_height
from robins.sim.random import Component
from robins.sim.sar import SarErrorModel, observe_sar
from robins.sim.star_sensor import observe_euler
from robins.systems.airship.error_model import error_from_tangent
from robins.systems.airship.model import WithWind, navigation
from robins.systems.airship.parameters import AirData, Airship
from robins.systems.airship.world import AIR, AirshipCourse, AirshipWorld, Datum, sampled_at
from robins.systems.study import Instrument, SensorAxes

SAR = "sar_barometer"  # of the paper's first local filter: one vector
STAR = "star"
STAR_EARLY = "star_early"  # the sights of an epoch except the last
WIND, WIND_OF_STAR = "wind", "wind_of_star"  # the same sensor, one for each local filter

FLOOR = 1e-3  # m/s, sigma of an exact constraint: (51) needs invertible covariances

Keys = Callable[[Component], Array]
_EULER = SensorAxes("rad", "Euler", ("pitch", "roll", "heading"))


# ----------------------------------------------------------------------- radar and barometer


def level(datum: Datum, p: Geodetic) -> Array:
    """Horizontal position (..., 2) [m], north and east of the datum."""
    away = jnp.stack([p.lat - datum.lat, wrap(p.lon - datum.lon)], -1)
    return away * jnp.broadcast_to(datum.metres, away.shape)


def read_sar(datum: Datum, x: Any, aux: Any) -> tuple[Array, Angle, Array]:
    """Horizontal position from the datum [m, north east], heading, and height [m] (1,)."""
    q_nb, _, p = navigation(x)
    return level(datum, p), Angle(q_nb.as_euler()[2]), jnp.reshape(p.alt, (1,))


def _measure_sar(given: Airship, course: AirshipCourse, key: Keys, world: AirshipWorld):
    """Measurements as `read_sar`: (E, 2) position, (E,) heading, (E, 1) height."""
    s, b, (q, _, position) = given.sar, given.barometer, world.truth
    errors = SarErrorModel(s.position, s.heading, s.outlier_share, s.outlier_factor)
    seen, baro_present = (jnp.asarray(sampled_at(course.epoch_s, of)) for of in (s, b))
    fix = observe_sar(errors, key(Component.SAR), position, to_euler(q.wxyz)[2], seen)
    height = observe_height(key(Component.BAROMETER), position.alt, b.height, baro_present)
    return level(course.datum, fix.position), Angle(fix.heading_rad), height[:, None]


def _believed_sar(given: Airship, course: AirshipCourse) -> Sensor:
    s = given.sar
    sigma = jnp.array([s.position, s.position, s.heading, given.barometer.height])
    return Sensor(Partial(read_sar, course.datum), sigma, 4, SAR)


RADAR = Instrument(
    SAR,
    SensorAxes("m, rad", "NED", ("north [m]", "east [m]", "heading [rad]", "up [m]")),
    _measure_sar,
    _believed_sar,
)


# ------------------------------------------------------------------------------------- stars


class EarlySights(NamedTuple):
    """Inputs for the star sights before the end of an epoch, besides the state."""

    turned_b: ArrayLike  # (S - 1, 3) rad, raw turn of the body from each to the end
    age_s: ArrayLike  # (S - 1,) s, time from each to the end


def read_euler(x: Any, aux: Any) -> tuple[Angle, Angle, Angle]:
    """Pitch, roll, heading [rad]."""
    return _angles(navigation(x).q_nb)


def read_early(x: WithWind, early: EarlySights) -> tuple[Angle, ...]:
    """Pitch, roll, heading [rad] at each of the early sights, concatenated.

    The body is rotated back by the gyro increments since, the navigation frame by its own rotation:
    q(t - age) = exp(omega_in age) q(t) exp(-turned).
    """
    (q_nb, v_n, p), out = x.nav, ()
    omega = earth_rate_n(p.lat) + transport_rate_n(p.lat, p.alt, v_n)
    turned, age = jnp.asarray(early.turned_b), jnp.asarray(early.age_s)
    for j in range(age.shape[0]):
        turn = turned[j] - age[j] * x.base.gyro_bias
        q = Rotation.from_rotvec(omega * age[j]) @ q_nb @ Rotation.from_rotvec(-turn)
        out = (*out, *_angles(q))
    return out


def _angles(q_nb: Rotation) -> tuple[Angle, Angle, Angle]:
    roll, pitch, heading = q_nb.as_euler()
    return Angle(pitch), Angle(roll), Angle(heading)


def _measure_star(given: Airship, course: AirshipCourse, key: Keys, world: AirshipWorld) -> Array:
    """(E, S, 3) rad, pitch, roll, heading at all sights."""
    there, sigma = jnp.asarray(sampled_at(course.sight_s, given.star)), given.star.attitude
    seen = observe_euler(key(Component.STAR_SENSOR), world.path.q_nb.wxyz, sigma, there)
    return seen.reshape(len(course.epoch_s), course.sights, 3)


def _believed_star(given: Airship, course: AirshipCourse) -> Sensor:
    return Sensor(read_euler, jnp.full(3, given.star.attitude), 3, STAR)


def _believed_early(given: Airship, course: AirshipCourse) -> Sensor | None:
    count = 3 * (course.sights - 1)
    sigma = jnp.full(count, given.star.attitude)
    return Sensor(read_early, sigma, count, STAR_EARLY) if count else None


def _columns(angles: Array) -> tuple[Angle, ...]:
    return tuple(Angle(angles[:, i]) for i in range(angles.shape[1]))


def _taken_early(world: AirshipWorld):
    early = world.since.shape[1]
    sights = world.readings[STAR][:, :-1].reshape(-1, 3 * early)
    dt = world.epoch_increments.dt[:, None] / (early + 1.0)
    age = dt * jnp.arange(early, 0, -1).astype(float)[None]
    return _columns(sights), EarlySights(world.since, age)


STARS = Instrument(
    *(STAR, _EULER, _measure_star, _believed_star),
    lambda world: (_columns(world.readings[STAR][:, -1]), None),
)
EARLY_STARS = Instrument(STAR_EARLY, _EULER, None, _believed_early, _taken_early)


# --------------------------------------------------------------------- air data and the wind


def read_wind(x: Any, v_air_b: ArrayLike) -> Array:
    """Assumed wind (2,) [m/s], north and east: (22)."""
    q_nb, v_n, _ = navigation(x)
    thought = (v_n - q_nb.apply(jnp.asarray(v_air_b)))[:2]
    return thought + x.wind_error if isinstance(x, WithWind) else thought


def _measure_air(given: Airship, course: AirshipCourse, key: Keys, world: AirshipWorld) -> Array:
    """(E, 3) m/s, velocity through the air, body axes."""
    there = jnp.asarray(sampled_at(course.epoch_s, given.air_data))
    own = jax.random.fold_in(key(Component.AIR_DATA), AIR)
    return observe_air(own, world.air_b, given.air_data.noise, there)


def _wind(world: AirshipWorld, wind: Array, air_b: Array) -> tuple[Array, Array]:
    """Wind, NaN where there are no air data, and velocity through the air, as filter inputs."""
    there = jnp.isfinite(world.readings[WIND][:, :1])
    return jnp.where(there, wind, jnp.nan), jnp.where(there, air_b, 0.0)


def as_measured(world: AirshipWorld) -> tuple[Array, Array]:
    """Air data and the forecast of the wind."""
    return _wind(world, world.wind + world.wind_error, world.readings[WIND])


def true_air(world: AirshipWorld) -> tuple[Array, Array]:
    """True wind and true velocity through the air."""
    return _wind(world, world.wind, world.air_b)


def steady(world: AirshipWorld) -> tuple[Array, Array]:
    """Air data, and the steady part of the wind."""
    return _wind(world, jnp.broadcast_to(world.steady_wind, world.wind.shape), world.readings[WIND])


def forward_airspeed(world: AirshipWorld) -> tuple[Array, Array]:
    """Airspeed along the forward axis, as in the paper, and the forecast of the wind."""
    speed = jnp.linalg.norm(world.readings[WIND], axis=1)
    air_b = speed[:, None] * jnp.array([[1.0, 0.0, 0.0]])
    return _wind(world, world.wind + world.wind_error, air_b)


def wind_of(
    name: str,
    sigma: Callable[[AirData], float],
    taken: Callable[[AirshipWorld], tuple[Array, Any]] = as_measured,
    read: Callable[..., Array] = read_wind,
    linear: Callable[..., Any] | None = None,
) -> Instrument:
    """The wind as a constraint with an assumed sigma [m/s] on each axis."""

    def believed(given: Airship, course: AirshipCourse) -> Sensor:
        return Sensor(read, jnp.full(2, sigma(given.air_data)), 2, name, linear)

    axes = SensorAxes("m/s", "NED", ("north", "east"))
    return Instrument(name, axes, _measure_air if name == WIND else None, believed, taken)


AIR_DATA = wind_of(WIND, lambda a: a.noise)
SOFT = wind_of(WIND, lambda a: float(np.hypot(a.noise, a.wind_error)))
"""A single white noise for air data and wind, for filters without states for the wind error."""


def wind_constraints(**given: Any) -> tuple[Instrument, Instrument]:
    """Exact wind constraints, one for each local filter; further arguments as of `wind_of`."""
    one, other = (wind_of(name, lambda a: FLOOR, **given) for name in (WIND, WIND_OF_STAR))
    return one, other


ABOARD = (EARLY_STARS, RADAR, STARS, AIR_DATA)
"""All instruments of the airship, in the order of the updates."""

HARD = wind_constraints()
INSTRUMENTS = (*ABOARD, HARD[1])
"""All instruments that are simulated and shown."""


# -------------------------------------------------------------------------------- as printed
# Zhao, Gao, Ding & Wei (2017), sections 4.2 and 4.3; errors there are computed minus true, in ENU.


def printed_attitude_rows(
    roll_rad: ArrayLike, pitch_rad: ArrayLike, heading_rad: ArrayLike
) -> Float[Array, "3 3"]:
    """Eq. (44) to the letter: errors of pitch, roll, heading by phi_E, phi_N, phi_U.

    It mixes two senses of heading: the first row is right for a clockwise one, the other two for a
    counterclockwise one, and two of their terms for neither. So with either sense, at a heading of
    east an entry that should be 1 is -1, which makes a filter amplify its error.
    """
    (s, c), (sin_pitch, cos_pitch) = _sin_cos(heading_rad), _sin_cos(pitch_rad)
    sin_roll, cos_roll = _sin_cos(roll_rad)
    t, o = sin_pitch / cos_pitch, jnp.zeros(())
    north = c - 2.0 * sin_pitch * sin_roll * cos_roll * s
    rows = (
        (-c, s, o),
        (s / cos_pitch, -north / cos_pitch, o),
        (-s * t / cos_pitch, c * t / cos_pitch, o - 1.0),
    )
    return jnp.stack([jnp.stack(row) for row in rows])


def printed_constraint(
    heading_rad: ArrayLike, air_speed_error: ArrayLike
) -> tuple[Float[Array, "2 9"], Float[Array, "2"]]:
    """D and d of (49), (50) to the letter, except for the wind error in d, which is unknown.

    dv_E and dv_N are components already, and yet are multiplied by sine and cosine of the heading;
    in d the two are swapped. D loses rank at cardinal headings. The airspeed error () [m/s] is
    the dv_a of (50), see `printed_wind`.
    """
    s, c = _sin_cos(heading_rad)
    D = jnp.zeros((2, 9)).at[0, 3].set(s).at[1, 4].set(c)
    return D, jnp.asarray(air_speed_error, float) * jnp.stack([c, s])


def _printed_sar(datum: Datum, x: Any, aux: Any):
    """Reading and Jacobian of (45), with the heading row as printed."""
    heading = _rotated(x)[2]
    H = jnp.zeros((4, 9)).at[[0, 1, 3], [6, 7, 8]].set(jnp.array([1.0, 1.0, -1.0]))
    return read_sar(datum, x, aux), H.at[2, :3].set(heading)


def _printed_euler(x: Any, aux: Any):
    """Reading and Jacobian of (48)."""
    return read_euler(x, aux), jnp.concatenate([_rotated(x), jnp.zeros((3, 6))], 1)


def _rotated(x: Nav) -> Array:
    """(3, 3) derivative of pitch, roll, heading by phi (true minus estimated, NED) as in (44)."""
    return -swap(printed_attitude_rows(*to_euler(x.q_nb.wxyz)))


def printed_wind(x: Any, air: tuple[ArrayLike, Array]):
    """(49), (50): D x = d with x computed minus true, as a residual that should be zero.

    Arguments are a `Nav`, the measured velocity through the air (3,) and the assumed wind (2,),
    north east [m/s]. The airspeed error dv_a is |v - wind| of the SINS less the measured airspeed.
    """
    speed = jnp.linalg.norm(jnp.asarray(air[0]))
    wind = jnp.concatenate([jnp.asarray(air[1])[::-1], jnp.zeros(1)])  # east north up
    excess = jnp.linalg.norm(swap(x.v_n) - wind) - speed
    D, d = printed_constraint(x.q_nb.as_euler()[2], excess)
    return -d, D @ error_from_tangent(x.position.lat, x.position.alt)


def _taken_printed(world: AirshipWorld):
    wind, air_b = as_measured(world)
    return 0.0 * wind, (air_b, jnp.nan_to_num(wind))


PRINTED_RADAR = RADAR._replace(
    believed=lambda given, course: replace(
        _believed_sar(given, course), linear=Partial(_printed_sar, course.datum)
    )
)
PRINTED_STARS = STARS._replace(
    believed=lambda given, course: replace(_believed_star(given, course), linear=_printed_euler)
)
PRINTED_WIND = wind_constraints(
    taken=_taken_printed, read=lambda x, air: printed_wind(x, air)[0], linear=printed_wind
)


def _sin_cos(angle: ArrayLike) -> tuple[Array, Array]:
    a = jnp.asarray(angle, float)
    return jnp.sin(a), jnp.cos(a)
