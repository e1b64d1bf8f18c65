"""Orientation from gyro, accelerometer and magnetometer: the motion and the sensors.

With q body to NED, C = C(q), f the specific force, w the measured rate::

    q' = q (w + M w - b) / 2,   v' = C (f - b_a) + g,   p' = v
    b' = white,   M' = 0,   b_a' = white,   field' = white
    declination' = -declination / T + white while moving,   0 at rest
    azimuths' = 0,   gravity g' = 0

A step is a block of samples, integrated beforehand (`Block`); the transition matrix is in
`advance_linear`, the process noise in `_factor`. Peculiarities:

- the accelerometer is integrated, not used as a measurement: a tilt error would make velocity and
  position drift, which the bounded travel contradicts. A swing of the hand then disturbs the
  attitude only by its mean;
- scale factors and misalignments of the gyros are nine states. They cause most of the drift of a
  good MEMS gyro in motion, and are observable through tilt;
- the magnetometer gives heading and no tilt. North is the direction of the horizontal field at the
  start. The azimuth of the field of other places is a state, `declination`, which is constant at
  rest: reading the same place again adds no information.

Samples become blocks by `integrate`; `causal_attitudes` and `smoothed_attitudes` turn states at the
ends of blocks into an attitude at every sample.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from robins import rotation
from robins.filters import Model, Motion
from robins.manifold import Angle
from robins.program.scanned import mapped_rows
from robins.rotation import Rotation, left_jacobian, skew
from robins.systems.marg.parameters import MargReplay
from robins.systems.parts import NED, seen_by
from robins.systems.study import SensorAxes, StateBlock

XYZ = ("x", "y", "z")
TRAVEL, REST, MAGNETOMETER, REVISIT = "travel", "rest", "magnetometer", "revisit"
SITES = 4  # places of rest; the azimuth of the field at each is a state
_TRAVELLED = [
    f"{what} {axis} [{u}]" for what, u in (("velocity", "m/s"), ("place", "m")) for axis in NED
]
_AT_REST = [f"velocity {axis} [m/s]" for axis in NED] + [f"rate {axis} [rad/s]" for axis in XYZ]
SENSORS = {
    TRAVEL: SensorAxes("m/s, m", "NED", tuple(_TRAVELLED)),
    REST: SensorAxes("m/s, rad/s", "NED, body", tuple(_AT_REST)),
    MAGNETOMETER: SensorAxes("rad, T", "NED", ("azimuth [rad]", "horizontal [T]", "down [T]")),
    REVISIT: SensorAxes("rad", "NED", ("azimuth",)),
}


class MargState(NamedTuple):
    """State; 32 tangent components in this order."""

    q_nb: Rotation  # body to north-east-down, north that of the field at the start
    v_n: Array  # (3,) m/s
    p_n: Array  # (3,) m, from the centre of the unit's motion
    gyro_bias: Array  # (3,) rad/s
    gyro_gain: Array  # (3, 3) true rate = (I + gain) measured rate - bias
    accel_bias: Array  # (3,) m/s^2
    declination: Array  # () rad, of the present field, clockwise from north
    field: Array  # (2,) T, horizontal strength and down
    azimuths: Array  # (SITES,) rad, of the field at each site, clockwise from north
    gravity: Array  # () m/s^2, as read by the accelerometers


HEADING, GAINS, DECLINATION, FIELD = 2, slice(12, 21), 24, slice(25, 27)
AZIMUTHS, GRAVITY = slice(27, 27 + SITES), 27 + SITES
DIM = GRAVITY + 1
_NINE = tuple(f"{a} from {b}" for a in XYZ for b in XYZ)
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "deg", "NED", NED),
    StateBlock("velocity", slice(3, 6), "m/s", "m/s", "NED", NED),
    StateBlock("gyro_bias", slice(9, 12), "rad/s", "deg/s", "body", XYZ),
    StateBlock("gyro_gain", slice(12, 21), "1", "%", "body", _NINE),
    StateBlock("accel_bias", slice(21, 24), "m/s^2", "mg", "body", XYZ),
    StateBlock("declination", slice(24, 25), "rad", "deg", "NED", ("here",)),
    StateBlock("field", slice(25, 27), "T", "uT", "NED", ("horizontal", "down")),
    StateBlock("azimuths", AZIMUTHS, "rad", "deg", "NED", tuple(f"site {k}" for k in range(SITES))),
    StateBlock("gravity", slice(GRAVITY, GRAVITY + 1), "m/s^2", "m/s^2", "NED", ("read",)),
)


class Integrals(NamedTuple):
    """Integrals of the raw samples of a block, in body axes at its start."""

    dt_s: ArrayLike  # ()
    turn: ArrayLike  # (4,) quaternion, body axes at the end to those at the start
    dv: ArrayLike  # (3,) m/s, integral of specific force
    turn_time: ArrayLike  # (3, 3) s, integral of R(t), body axes at t to those at the start
    turn_rates: ArrayLike  # (3, 9) rad, integral of R_ij(t) times the k-th rate, at 3 j + k
    angle: ArrayLike  # () rad, sum of the angles turned


class Block(NamedTuple):
    """Input of a step."""

    samples: Integrals
    still: ArrayLike  # () 1 where the unit lies still, else 0
    lost_turn: ArrayLike  # (3,) or () rad, sigma of the rotation that was not sampled, body axes
    lost_dv: ArrayLike  # () m/s, the same for velocity


class MargNoise(NamedTuple):
    """Process noise, and sigmas of the measurements of travel, rest and field."""

    gyro: ArrayLike  # rad/sqrt(s)
    turn_error: ArrayLike  # rad per rad turned
    accel: ArrayLike  # m/s/sqrt(s)
    gyro_bias_still: ArrayLike  # rad/s/sqrt(s)
    gyro_bias_moving: ArrayLike  # rad/s/sqrt(s)
    accel_bias: ArrayLike  # m/s^2/sqrt(s)
    declination: ArrayLike  # rad, sigma of the stationary Gauss-Markov process
    declination_time: ArrayLike  # s
    field_walk: ArrayLike  # T/sqrt(s)
    velocity: ArrayLike  # m/s, moving
    place: ArrayLike  # m, moving
    velocity_still: ArrayLike  # m/s
    field: ArrayLike  # T, of a reading


def correction(x: MargState, block: Block) -> Array:
    """Rotation (3,) [rad] that bias and gain add to a block, in body axes at its start."""
    gain = jnp.asarray(block.samples.turn_rates) @ x.gyro_gain.reshape(9)
    return gain - jnp.asarray(block.samples.turn_time) @ x.gyro_bias


def persistence(noise: MargNoise, block: Block) -> Array:
    """Decay factor of the declination over a block; 1 while the unit lies still."""
    moving_s = jnp.asarray(block.samples.dt_s) * (1.0 - jnp.asarray(block.still))
    return jnp.exp(-moving_s / noise.declination_time)


def _velocity_gain(x: MargState, block: Block) -> Array:
    """Velocity gain (3,) [m/s], NED, without gravity; rotated by half the attitude correction."""
    dv = jnp.asarray(block.samples.dv)
    dv = dv + jnp.cross(0.5 * correction(x, block), dv)
    return x.q_nb.apply(dv - jnp.asarray(block.samples.turn_time) @ x.accel_bias)


def advance(noise: MargNoise, x: MargState, block: Block) -> MargState:
    """The state after a block."""
    dt = jnp.asarray(block.samples.dt_s)
    gained = _velocity_gain(x, block) + jnp.array([0.0, 0.0, 1.0]) * x.gravity * dt
    turned = rotation.multiply(
        rotation.from_rotvec(correction(x, block)), jnp.asarray(block.samples.turn)
    )
    return x._replace(
        q_nb=Rotation(rotation.normalise(rotation.multiply(x.q_nb.wxyz, turned))),
        v_n=x.v_n + gained,
        p_n=x.p_n + (x.v_n + 0.5 * gained) * dt,
        declination=x.declination * persistence(noise, block),
    )


def _factor(noise: MargNoise, x: MargState, block: Block) -> Array:
    """Process noise factor (32, 32): diagonal but for attitude, whose noise is in body axes."""
    dt, moving = jnp.asarray(block.samples.dt_s), 1.0 - jnp.asarray(block.still)
    root = jnp.sqrt(dt)
    kept = persistence(noise, block)
    angle = noise.turn_error * jnp.asarray(block.samples.angle)
    turn = jnp.sqrt((noise.gyro * root) ** 2 + angle**2 + jnp.asarray(block.lost_turn) ** 2)
    turn = jnp.broadcast_to(turn, (3,))
    push = jnp.sqrt((noise.accel * root) ** 2 + jnp.asarray(block.lost_dv) ** 2)
    walk = jnp.where(moving > 0.0, noise.gyro_bias_moving, noise.gyro_bias_still) * root
    # sqrt(1 - kept^2), with a finite derivative at kept = 1
    lost = -jnp.expm1(2.0 * jnp.log(kept))
    drift = jnp.where(lost > 0.0, jnp.sqrt(jnp.where(lost > 0.0, lost, 1.0)), 0.0)
    parts = [
        jnp.zeros(3),
        jnp.broadcast_to(push, (3,)),
        jnp.zeros(3),
        jnp.broadcast_to(walk, (3,)),
        jnp.zeros(9),
        jnp.broadcast_to(noise.accel_bias * root, (3,)),
        (noise.declination * drift)[None],
        jnp.broadcast_to(noise.field_walk * root, (2,)),
        jnp.zeros(SITES + 1),
    ]
    return jnp.diag(jnp.concatenate(parts)).at[0:3, 0:3].set(x.q_nb.as_dcm() * turn[None, :])


def advance_linear(noise: MargNoise, x: MargState, block: Block):
    """`advance`, its Jacobian (32, 32) between tangent spaces, and the noise factor."""
    dt, dv = jnp.asarray(block.samples.dt_s), jnp.asarray(block.samples.dv)
    rate_map = jnp.concatenate(
        [-jnp.asarray(block.samples.turn_time), jnp.asarray(block.samples.turn_rates)], axis=1
    )
    R = x.q_nb.as_dcm()
    turn = R @ left_jacobian(correction(x, block), first_order=True) @ rate_map
    push = -0.5 * R @ skew(dv) @ rate_map
    tilt = -skew(_velocity_gain(x, block))
    lean = -R @ jnp.asarray(block.samples.turn_time)
    F = jnp.eye(DIM)
    F = F.at[0:3, 9:21].set(turn)
    for rows, share in ((slice(3, 6), 1.0), (slice(6, 9), 0.5 * dt)):
        F = F.at[rows, 0:3].set(share * tilt)
        F = F.at[rows, 9:21].set(share * push)
        F = F.at[rows, 21:24].set(share * lean)
        F = F.at[rows.stop - 1, GRAVITY].set(share * dt)
    F = F.at[6:9, 3:6].set(dt * jnp.eye(3))
    F = F.at[DECLINATION, DECLINATION].set(persistence(noise, block))
    return advance(noise, x, block), F, _factor(noise, x, block)


def _travel_linear(x: MargState, _: Array | None):
    return jnp.concatenate([x.v_n, x.p_n]), jnp.eye(6, DIM, 3)


def _travel_sigma(noise: MargNoise) -> Array:
    sigma = jnp.stack([jnp.asarray(noise.velocity), jnp.asarray(noise.place)])
    return jnp.repeat(sigma, 3)


def _rest_linear(x: MargState, seen_b: Array):
    """Velocity and corrected rate, both zero at rest."""
    rate_b = seen_b[:3]
    read = jnp.concatenate([x.v_n, rate_b + x.gyro_gain @ rate_b - x.gyro_bias])
    gain = jnp.kron(jnp.eye(3), rate_b[None])
    H = jnp.zeros((6, DIM)).at[0:3, 3:6].set(jnp.eye(3))
    H = H.at[3:6, 9:12].set(-jnp.eye(3)).at[3:6, 12:21].set(gain)
    return read, H


def _rest_sigma(noise: MargNoise, x: MargState, seen_b: Array):
    velocity, rate = jnp.asarray(noise.velocity_still), jnp.asarray(seen_b)[3]
    return jnp.repeat(jnp.stack([velocity, rate]), 3)


def _level(x: MargState, field_b: Array):
    """Horizontal strength, differentiable at zero, and the field in navigation axes."""
    m = x.q_nb.apply(field_b)
    square = m[0] ** 2 + m[1] ** 2
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0), m


def _magnetometer_linear(x: MargState, field_b: Array):
    strength, m = _level(x, field_b)
    there = strength > 0.0
    azimuth = jnp.arctan2(jnp.where(there, m[1], 0.0), jnp.where(there, m[0], 1.0))
    read = Angle(azimuth - x.declination), jnp.stack([strength, m[2]]) - x.field
    H = jnp.zeros((3, DIM)).at[0, HEADING].set(1.0).at[0, DECLINATION].set(-1.0)
    return read, H.at[1:, FIELD].set(-jnp.eye(2))


def _magnetometer_sigma(noise: MargNoise, x: MargState, field_b: Array):
    strength, _ = _level(x, field_b)
    # A vertical field has no azimuth: its sigma saturates at half a turn.
    azimuth = jnp.pi * jnp.tanh(noise.field / jnp.maximum(strength, 1e-3 * noise.field) / jnp.pi)
    return jnp.stack([azimuth, jnp.asarray(noise.field), jnp.asarray(noise.field)])


def _site_linear(x: MargState, seen_b: Array):
    """Azimuth of the measured field relative to that of a site; `seen_b` is aux of "revisit"."""
    _, m = _level(x, seen_b[:3])
    H = jnp.zeros((1, DIM)).at[0, HEADING].set(1.0).at[0, AZIMUTHS].set(-seen_b[4:])
    return Angle(jnp.arctan2(m[1], m[0]) - seen_b[4:] @ x.azimuths), H


def _site_sigma(x: MargState, seen_b: Array):
    return jnp.asarray(seen_b)[3:4]


def model_of(parameters: MargReplay) -> Model:
    """Model propagated by gyro and accelerometer, updated by travel, rest and magnetometer.

    The Jacobian of the magnetometer has no columns of tilt: a disturbed field cannot tilt the
    attitude, at the cost of the little information on tilt that it has.

    Returns:
        A model with sensors, in order: "travel" ((6,) zeros while the unit moves, else NaN), "rest"
        ((6,) zeros at rest, else NaN; aux (4,) mean measured rate and its sigma) and, where the
        field is used, "magnetometer" ((`Angle(0)`, (2,) zeros); aux (3,) field in body axes [T])
        and "revisit" (`Angle(0)` where a site is read; aux (4 + SITES,) field [T], sigma of its
        azimuth [rad] and 1 for the site). Measurements are zero, and h(x) is the reading in
        aux corrected by the state, so the innovation is -h(x).
    """
    gyro, accelerometer = parameters.gyro, parameters.accelerometer
    magnetometer, travel, rest = parameters.magnetometer, parameters.travel, parameters.rest
    noise = MargNoise(
        gyro=gyro.noise,
        turn_error=gyro.turn_error,
        accel=accelerometer.noise,
        gyro_bias_still=gyro.bias_walk,
        gyro_bias_moving=gyro.bias_walk_moving,
        accel_bias=accelerometer.bias_walk,
        declination=magnetometer.declination,
        declination_time=magnetometer.declination_time,
        field_walk=magnetometer.field_walk,
        velocity=travel.velocity,
        place=travel.place,
        velocity_still=rest.velocity,
        field=magnetometer.noise,
    )
    noise = jax.tree_util.tree_map(lambda x: jnp.asarray(x, float), noise)
    sensors = [
        seen_by(_travel_linear, _travel_sigma(noise), 6, TRAVEL),
        seen_by(_rest_linear, Partial(_rest_sigma, noise), 6, REST),
    ]
    if parameters.use_magnetometer != "never":
        sigma = Partial(_magnetometer_sigma, noise)
        sensors.append(seen_by(_magnetometer_linear, sigma, 3, MAGNETOMETER))
        sensors.append(seen_by(_site_linear, _site_sigma, 1, REVISIT))
    motion = Motion(
        step=Partial(advance, noise),
        noise=Partial(_factor, noise),
        linear=Partial(advance_linear, noise),
    )
    return Model(motion, tuple(sensors))


# ------------------------------------------------------------------------------ samples and blocks


class Samples(NamedTuple):
    """Increments in blocks of n; a short block is padded with increments of zero duration."""

    dt_s: Any  # (K, n)
    theta: Any  # (K, n, 3) rad, rotation vector of each interval
    dv: Any  # (K, n, 3) m/s
    field_b: Any  # (K, n, 3) T at the end of each interval; NaN where there is none


def of_block(samples: Samples) -> tuple[Integrals, Array]:
    """Integrals of one block, leading axis n, and its mean field as in `integrate`."""

    def add(q, row):
        dt, theta, dv, field_b = row
        half = rotation.to_dcm(rotation.multiply(q, rotation.from_rotvec(0.5 * theta)))
        pushed = rotation.rotate(q, dv)
        q = rotation.multiply(q, rotation.from_rotvec(theta))
        there = jnp.all(jnp.isfinite(field_b))
        field = jnp.where(there, rotation.rotate(q, jnp.where(there, field_b, 0.0)), 0.0)
        rates = (half[:, :, None] * theta[None, None, :]).reshape(3, 9)
        angle = jnp.sqrt(jnp.sum(theta * theta))
        return q, (pushed, half * dt, rates, angle, field, there.astype(float))

    start = jnp.array([1.0, 0.0, 0.0, 0.0])
    q, rows = jax.lax.scan(add, start, tuple(samples))
    dv, turn_time, turn_rates, angle, field, count = (jnp.sum(r, axis=0) for r in rows)
    q = rotation.normalise(q)
    mean = field / jnp.where(count > 0.0, count, jnp.nan)
    field_b = rotation.rotate(rotation.conjugate(q), mean)
    return Integrals(jnp.sum(samples.dt_s), q, dv, turn_time, turn_rates, angle), field_b


def integrate(samples: Samples) -> tuple[Integrals, np.ndarray]:
    """Integrals of every block, leading axis K, and its mean field; in NumPy.

    The field is in body axes at the end of the block, (K, 3) T; NaN where there is none.
    """
    return mapped_rows(of_block, samples)


def _turns(bias: Array, gain: Array, dt: Array, theta: Array) -> Array:
    """Attitude (n, 4) at each sample relative to the start of the block."""

    def add(q, row):
        dt, theta = row
        true = theta + gain @ theta - bias * dt
        q = rotation.multiply(q, rotation.from_rotvec(true))
        return q, q

    return jax.lax.scan(add, jnp.array([1.0, 0.0, 0.0, 0.0]), (dt, theta))[1]


def causal_attitudes(
    start: MargState, posterior: MargState, samples: Samples
) -> Float[np.ndarray, "K n 4"]:
    """Attitude at every sample, by the causal filter.

    Inside a block the last posterior is propagated by the gyros; its end has the new posterior.
    `start` is the state before the first block, `posterior` those at the ends, leading axis K.
    """
    before = jax.tree_util.tree_map(
        lambda a, b: np.concatenate([np.asarray(a)[None], np.asarray(b)[:-1]]), start, posterior
    )
    given = before.q_nb.wxyz, before.gyro_bias, before.gyro_gain
    q = mapped_rows(_carried, (*given, samples.dt_s, samples.theta))
    q[:, -1] = posterior.q_nb.wxyz
    return q


def _carried(block: tuple[Array, Array, Array, Array, Array]) -> Array:
    q_nb, *given = block
    return rotation.normalise(rotation.multiply(q_nb[None], _turns(*given)))


def smoothed_attitudes(
    smoothed: MargState, samples: Samples
) -> tuple[Float[np.ndarray, "K n 4"], Float[np.ndarray, "4"]]:
    """Attitude at every sample from smoothed states at the ends of blocks, and at the start.

    The gyros propagate each state over the next block; the misclosure with the next state is
    distributed evenly over the samples. The first block is propagated backwards.
    """
    given = smoothed.gyro_bias, smoothed.gyro_gain, samples.dt_s, samples.theta
    q_end = np.asarray(smoothed.q_nb.wxyz)
    first = mapped_rows(_attitude_before, (q_end[:1], *(x[:1] for x in given)))
    start = np.concatenate([first, q_end[:-1]])
    return mapped_rows(_joined_attitudes, (start, q_end, *given)), first[0]


def _attitude_before(block: tuple[Array, Array, Array, Array, Array]) -> Array:
    """Attitude (4,) at the start of a block, from that at its end."""
    q_end, *given = block
    return rotation.normalise(rotation.multiply(q_end, rotation.conjugate(_turns(*given)[-1])))


def _joined_attitudes(block: tuple[Array, Array, Array, Array, Array, Array]) -> Array:
    """Attitudes (n, 4) in a block with known attitudes at start and end."""
    start, q_end, *given = block
    q = rotation.multiply(start[None], _turns(*given))
    missed = rotation.to_rotvec(rotation.multiply(q_end, rotation.conjugate(q[-1])))
    share = jnp.arange(1.0, len(q) + 1.0) / float(len(q))
    mend = rotation.from_rotvec(share[:, None] * missed[None])
    return rotation.normalise(rotation.multiply(mend, q))
