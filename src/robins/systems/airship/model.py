"""The airship's navigation models: nine states as in the paper, and those that a product needs.

The mean is the navigation state itself, so the estimate is fed back to the inertial navigation by
construction, and the paper's nonlinear error model (40) (see `error_model`) is the difference of
two such states. On top of the nine states of attitude, velocity and position there may be

- the error w of what is thought to be the wind, a Gauss-Markov process of the two level axes, and
- the biases of gyros and accelerometers.

With v_air the velocity through the air, in body axes, what is thought to be the wind should read

    v_w,thought = [v - C_b^n v_air]_NE + w

which is the constraint of the paper (22), made of data, so it is a sensor. The paper's own D (49)
and d (50), and its measurement rows (44), are there as a literal option: see `measurement_rows`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401
from robins.earth import earth_rate_n, transport_rate_n
from robins.filters import Model, Motion, Sensor
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav, step
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear
from robins.manifold import Angle, wrap
from robins.rotation import Rotation

SAR = "sar_barometer"  # of the paper's first local filter: one vector
STAR = "star"
STAR_EARLY = "star_early"  # the sights of an epoch but the last
WIND, WIND_OF_STAR = "wind", "wind_of_star"  # the second is the same, for the other local filter


class WindNav(NamedTuple):
    """Navigation state and the error of the wind: eleven components."""

    nav: Nav
    wind_error: Array  # (2,) m/s north east, thought minus true


class WindIns(NamedTuple):
    """Navigation state, biases of the inertial unit and the error of the wind: seventeen."""

    ins: InsState
    wind_error: Array  # (2,) m/s north east, thought minus true

    @property
    def nav(self) -> Nav:
        """Attitude, velocity and position alone."""
        return self.ins.nav


class WindNoise(NamedTuple):
    """First-order Gauss-Markov error of the wind."""

    sigma: Array  # () m/s, each axis
    time_s: Array  # ()


class Datum(NamedTuple):
    """Where horizontal positions are counted from, and the metres in a radian there."""

    lat: Array
    lon: Array
    metres: Array  # (2,) of latitude, longitude


class Early(NamedTuple):
    """What sights before the end of an epoch need besides the state."""

    turned_b: ArrayLike  # (S - 1, 3) rad, raw turn of the body from each to the end
    age_s: ArrayLike  # (S - 1,)


class Air(NamedTuple):
    """What the wind's reading needs besides the state."""

    v_air_b: ArrayLike  # (3,) m/s, body axes
    sigma: ArrayLike  # (2,) m/s
    wind: ArrayLike  # (2,) m/s north east, what is thought; only the paper's own form asks for it


# ---------------------------------------------------------------------------------- the motion


def walk(gyro_noise: ArrayLike, accel_noise: ArrayLike, dt: ArrayLike) -> Float[Array, "9 9"]:
    """Noise factor of attitude, velocity and position over a step of constant white noise.

    Position and velocity as of a random walk of velocity, Q = q^2 [[dt, dt^2/2], [., dt^3/3]].
    """
    root, eye, zero = jnp.sqrt(jnp.asarray(dt)), jnp.eye(3), jnp.zeros((3, 3))
    phi, v = (root * jnp.asarray(s) * eye for s in (gyro_noise, accel_noise))
    shift, own = 0.5 * dt * v, dt / jnp.sqrt(12.0) * v
    return jnp.block([[phi, zero, zero], [zero, v, zero], [zero, shift, own]])


def _wind_step(noise: WindNoise, dt: Array) -> tuple[Array, Array]:
    """Decay and driving sigma over a step."""
    decay = jnp.exp(-dt / noise.time_s)
    return decay, noise.sigma * jnp.sqrt(-jnp.expm1(-2.0 * dt / noise.time_s))


def _step(x: Nav, block: Increments) -> Nav:
    return step(x, block)


def _step_wind(noise: WindNoise, x: WindNav, block: Increments) -> WindNav:
    decay, _ = _wind_step(noise, jnp.asarray(block.dt))
    return WindNav(step(x.nav, block), decay * x.wind_error)


def _noise(spread: Array, x: Nav, block: Increments) -> Array:
    return walk(spread[0], spread[1], block.dt)


def _noise_wind(spread: Array, noise: WindNoise, x: WindNav, block: Increments) -> Array:
    _, drive = _wind_step(noise, jnp.asarray(block.dt))
    return _diagonal(walk(spread[0], spread[1], block.dt), drive * jnp.eye(2))


def _linear(spread: Array, x: Nav, block: Increments):
    """The step and its slope, which is that of a state whose biases nobody asks for."""
    one = jax.tree.map(lambda a: jnp.asarray(a, float)[None], block)
    still = InsNoise(spread[0], spread[1])
    zero = jnp.zeros(3)
    new, Phi, _ = propagate_linear(InsState(*x, zero, zero), one, still, segments=1)
    return new.nav, Phi[:9, :9], walk(spread[0], spread[1], block.dt)


def _linear_wind(spread: Array, noise: WindNoise, x: WindNav, block: Increments):
    nav, Phi, L = _linear(spread, x.nav, block)
    decay, drive = _wind_step(noise, jnp.asarray(block.dt))
    eye = jnp.eye(2)
    return (
        WindNav(nav, decay * x.wind_error),
        _diagonal(Phi, decay * eye),
        _diagonal(L, drive * eye),
    )


def _diagonal(a: Array, b: Array) -> Array:
    corner = jnp.zeros((a.shape[0], b.shape[1]))
    return jnp.block([[a, corner], [jnp.zeros((b.shape[0], a.shape[1])), b]])


def _step_ins(noise: InsNoise, wind: WindNoise, x: WindIns, block: Increments) -> WindIns:
    decay, _ = _wind_step(wind, jnp.sum(jnp.asarray(block.dt)))
    return WindIns(propagate(x.ins, block, noise), decay * x.wind_error)


def _linear_ins(noise: InsNoise, wind: WindNoise, x: WindIns, block: Increments):
    ins, Phi, L = propagate_linear(x.ins, block, noise, segments=1)
    decay, drive = _wind_step(wind, jnp.sum(jnp.asarray(block.dt)))
    eye = jnp.eye(2)
    new = WindIns(ins, decay * x.wind_error)
    return new, _diagonal(Phi, decay * eye), _diagonal(L, drive * eye)


def _noise_ins(noise: InsNoise, wind: WindNoise, x: WindIns, block: Increments) -> Array:
    return _linear_ins(noise, wind, x, block)[2]


# --------------------------------------------------------------------------------- the sensors


def navigation(x: Any) -> Nav:
    """Attitude, velocity and position of any state of this study."""
    return x if isinstance(x, Nav) else x.nav


def read_sar(datum: Datum, x: Any, aux: Any) -> tuple[Array, Angle, Array]:
    """Horizontal position from the datum [m, north east], heading, and height [m] (1,)."""
    q_nb, _, p = navigation(x)
    away = jnp.stack([p.lat - datum.lat, wrap(p.lon - datum.lon)])
    return away * datum.metres, Angle(q_nb.as_euler()[2]), jnp.reshape(p.alt, (1,))


def read_euler(x: Any, aux: Any) -> tuple[Angle, Angle, Angle]:
    """Pitch, roll, heading."""
    roll, pitch, heading = navigation(x).q_nb.as_euler()
    return Angle(pitch), Angle(roll), Angle(heading)


def read_early(x: WindIns, early: Early) -> tuple[Angle, ...]:
    """Pitch, roll, heading at each of the early sights, one after the other.

    The body is taken back by what the gyros felt since, and the navigation frame by its turn:
    q(t - age) = exp(omega_in age) q(t) exp(-turned).
    """
    (q_nb, v_n, p), out = x.nav, ()
    omega = earth_rate_n(p.lat) + transport_rate_n(p.lat, p.alt, v_n)
    turned, age = jnp.asarray(early.turned_b), jnp.asarray(early.age_s)
    for j in range(age.shape[0]):
        turn = turned[j] - age[j] * x.ins.gyro_bias
        q = Rotation.from_rotvec(omega * age[j]) @ q_nb @ Rotation.from_rotvec(-turn)
        roll, pitch, heading = q.as_euler()
        out = (*out, Angle(pitch), Angle(roll), Angle(heading))
    return out


def read_wind(x: Any, air: Air) -> Array:
    """(2,) m/s north east, what should be thought to be the wind."""
    q_nb, v_n, _ = navigation(x)
    thought = (v_n - q_nb.apply(jnp.asarray(air.v_air_b)))[:2]
    return thought + x.wind_error if hasattr(x, "wind_error") else thought


def _air_sigma(x: Any, air: Air) -> Any:
    return air.sigma


class Sigmas(NamedTuple):
    """Standard deviations of what the sensors read."""

    sar: Array  # (4,) m north east, rad, m of height
    euler: Array  # (3,) rad


def sensors(datum: Datum, sigmas: Sigmas, early: int) -> tuple[Sensor, ...]:
    """Sights before the end of an epoch, radar with barometer, stars, and wind for either local.

    Args:
        datum: of horizontal positions.
        sigmas: believed.
        early: sights of the stars in an epoch before the one at its end.
    """
    repeated = jnp.tile(sigmas.euler, early)
    return (
        Sensor(read_early, repeated, 3 * early, STAR_EARLY),
        Sensor(Partial(read_sar, datum), sigmas.sar, 4, SAR),
        Sensor(read_euler, sigmas.euler, 3, STAR),
        Sensor(read_wind, _air_sigma, 2, WIND),
        Sensor(read_wind, _air_sigma, 2, WIND_OF_STAR),
    )


def nine_states(gyro_noise: ArrayLike, accel_noise: ArrayLike, looks: tuple[Sensor, ...]) -> Model:
    """The paper's states as `Nav`; input of a step: one increment.

    Args:
        gyro_noise: believed, rad/sqrt(s).
        accel_noise: believed, m/s/sqrt(s).
        looks: from `sensors`.
    """
    spread = jnp.stack([jnp.asarray(gyro_noise), jnp.asarray(accel_noise)])
    return Model(Motion(_step, Partial(_noise, spread), Partial(_linear, spread)), looks)


def wind_states(
    gyro_noise: ArrayLike, accel_noise: ArrayLike, wind: WindNoise, looks: tuple[Sensor, ...]
) -> Model:
    """With two states for the error of the wind, as `WindNav`; input as of `nine_states`."""
    spread = jnp.stack([jnp.asarray(gyro_noise), jnp.asarray(accel_noise)])
    motion = Motion(
        step=Partial(_step_wind, wind),
        noise=Partial(_noise_wind, spread, wind),
        linear=Partial(_linear_wind, spread, wind),
    )
    return Model(motion, looks)


def product_states(noise: InsNoise, wind: WindNoise, looks: tuple[Sensor, ...]) -> Model:
    """With biases too, as `WindIns`; input of a step: K increments."""
    motion = Motion(
        step=Partial(_step_ins, noise, wind),
        noise=Partial(_noise_ins, noise, wind),
        linear=Partial(_linear_ins, noise, wind),
    )
    return Model(motion, looks)
