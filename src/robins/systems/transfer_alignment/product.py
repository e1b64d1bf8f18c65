"""Transfer alignment as a product: the slave's whole navigation state, its mounting, its flexure.

The mean is the navigation state itself, so the estimate is fed back by construction, and it lives
on a manifold, so no attitude is singular and large initial errors are linearised about what was
learnt so far. NED/FRD; with s the slave's axes and m the master's,

    C_ns = C_nm C_ms,     C_ms = exp(lambda x) C_nominal exp(mu x)

The slave's gyros feel the flexure, so its attitude includes it: flexure has no part in the slave's
mechanisation, only in what the master is expected to read. A record of the master stamped t is of
t - delay, so the slave is taken back there by what its own inertial unit felt since (`Lag`); the
master reads then

    attitude   C_nm = C_ns (exp((lambda - lambda' delay) x) C_nominal exp(mu x))^-1
    velocity   v_ns - C_nm ((omega_im_m - C_mn omega_in) x r)
    position   p_s - C_nm r

all of t - delay. What drove the flexure since is not known: it leaves sqrt(4 zeta wn^3 delay^3 / 3)
of its sigma in the attitude, 1 % for 60 ms and 3 s, which the noise of the records has to cover.
The Jacobians of attitude and velocity are analytic; that of the position follows by
differentiation.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from robins import _float64, linalg  # noqa: F401
from robins.earth import Geodetic, earth_rate_n, gravity_n, transport_rate_n
from robins.filters import Model, Motion, Sensor
from robins.ins.errors import frame_dynamics
from robins.ins.increments import Increments
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear
from robins.rotation import Rotation, skew
from robins.sim.flexure import Flexure, transition

ATTITUDE, VELOCITY, POSITION = "master_attitude", "master_velocity", "master_position"


class ProductState(NamedTuple):
    """Slave, mounting and flexure; without flexure the pytree does not hold it."""

    ins: InsState  # of the slave: 15 components, no scale factors
    mounting_rad: Array  # (3,) mu, slave axes
    flexure_rad: Array | None = None  # (3,) lambda, master axes
    flexure_rate_rad_s: Array | None = None  # (3,)


class Installation(NamedTuple):
    """Where the slave sits, as far as it is known."""

    q_ms: Rotation  # C_nominal, slave axes to master axes
    lever_m: Array  # (3,) m, master to slave, master axes


class Lag(NamedTuple):
    """What a reading of the master needs besides the state.

    The slave's raw increments from when the record was true to now, and the master's turn rate.
    """

    dt: ArrayLike  # () s, how old the record is
    theta: ArrayLike  # (3,) rad, turn of the slave over dt, body axes
    dv: ArrayLike  # (3,) m/s, velocity gained over dt, body axes now
    omega_m: ArrayLike  # (3,) rad/s, omega_im of the master when the record was true


class Sigmas(NamedTuple):
    """How well the master's records are known, standard deviations."""

    attitude_rad: ArrayLike  # (3,) rotation vector, north east down
    velocity_m_s: ArrayLike  # (3,) north east down
    position_m: ArrayLike | None = None  # (3,) north east down; None: no position matching


# ---------------------------------------------------------------------------------- the motion


class _Drive(NamedTuple):
    noise: InsNoise
    mounting_rw: Array  # (3,) rad/sqrt(s)
    flexure: Flexure | None


def _flexed(drive: _Drive, dt: Array) -> tuple[Array, Array]:
    """Step of (lambda, lambda') of all axes, in tangent order: (6, 6) and a factor (6, 6)."""
    flexure = drive.flexure
    assert flexure is not None
    given = (flexure.sigma_rad, flexure.tau_s, flexure.damping)
    three = [jnp.broadcast_to(jnp.asarray(x, float), 3) for x in given]
    Phi, L = jax.vmap(partial(transition, dt_s=dt))(*three)

    def spread(blocks):
        """Blocks (3, 2, 2) of (angle, rate) by axis to angles first, then rates."""
        rows = [jnp.concatenate([jnp.diag(blocks[:, i, j]) for j in range(2)], 1) for i in range(2)]
        return jnp.concatenate(rows)

    return spread(Phi), spread(L)


def _swing(x: ProductState) -> Array | None:
    """(6,) lambda and its rate, where they are states."""
    if x.flexure_rad is None or x.flexure_rate_rad_s is None:
        return None
    return jnp.concatenate([x.flexure_rad, x.flexure_rate_rad_s])


def _swung(x: ProductState, Phi: Array, before: Array) -> ProductState:
    after = Phi @ before
    return x._replace(flexure_rad=after[:3], flexure_rate_rad_s=after[3:])


def _step(drive: _Drive, x: ProductState, block: Increments) -> ProductState:
    new, swing = x._replace(ins=propagate(x.ins, block, drive.noise)), _swing(x)
    if swing is None:
        return new
    return _swung(new, _flexed(drive, jnp.sum(jnp.asarray(block.dt)))[0], swing)


def _step_linear(drive: _Drive, x: ProductState, block: Increments):
    ins, Phi, L = propagate_linear(x.ins, block, drive.noise, segments=1)
    new, swing = x._replace(ins=ins), _swing(x)
    dt = jnp.sum(jnp.asarray(block.dt))
    blocks = [(Phi, L), (linalg.identity(3), jnp.diag(drive.mounting_rw * jnp.sqrt(dt)))]
    if swing is not None:
        blocks.append(_flexed(drive, dt))
        new = _swung(new, blocks[-1][0], swing)
    Phis, Ls = zip(*blocks, strict=True)
    return new, _diagonal(Phis), _diagonal(Ls)


def _noise(drive: _Drive, x: ProductState, block: Increments):
    return _step_linear(drive, x, block)[2]


def _diagonal(blocks) -> Array:
    """Block-diagonal matrix."""
    total = sum(len(b) for b in blocks)
    rows, at = [], 0
    for b in blocks:
        n = len(b)
        rows.append(jnp.pad(b, ((0, 0), (at, total - at - n))))
        at += n
    return jnp.concatenate(rows)


# ---------------------------------------------------------------------------------- the master


class _Then(NamedTuple):
    """The slave and the master when the record was true."""

    v_n: Array  # (3,) of the slave
    q_ns: Rotation
    q_nm: Rotation
    flexure: Array  # (3,) lambda
    omega_in: Array  # (3,)
    gained_n: Array  # (3,) m/s by the specific force since


def _then(at: Installation, x: ProductState, lag: Lag) -> _Then:
    dt = jnp.asarray(lag.dt, float)
    ins, p = x.ins, x.ins.position
    omega_ie = earth_rate_n(p.lat)
    omega_en = transport_rate_n(p.lat, p.alt, ins.v_n)
    turned = Rotation.from_rotvec(ins.gyro_bias * dt - lag.theta)
    q_ns = Rotation.from_rotvec((omega_ie + omega_en) * dt) @ ins.q_nb @ turned
    gained_n = ins.q_nb.apply(lag.dv - ins.accel_bias * dt)
    coriolis = jnp.cross(2.0 * omega_ie + omega_en, ins.v_n)
    v_n = ins.v_n - gained_n - (gravity_n(p.lat, p.alt) - coriolis) * dt
    swing = _swing(x)
    flexure = jnp.zeros(3) if swing is None else swing[:3] - swing[3:] * dt
    q_ms = Rotation.from_rotvec(flexure) @ at.q_ms @ Rotation.from_rotvec(x.mounting_rad)
    return _Then(v_n, q_ns, q_ns @ q_ms.inverse(), flexure, omega_ie + omega_en, gained_n)


def _read_attitude(at: Installation, x: ProductState, lag: Lag) -> Rotation:
    return _then(at, x, lag).q_nm


def _arm_velocity(at: Installation, then: _Then, lag: Lag) -> Array:
    """Velocity [m/s, NED] of the slave about the master."""
    turning = then.q_nm.apply(jnp.cross(jnp.asarray(lag.omega_m), at.lever_m))
    return turning - jnp.cross(then.omega_in, then.q_nm.apply(at.lever_m))


def _read_velocity(at: Installation, x: ProductState, lag: Lag) -> Array:
    then = _then(at, x, lag)
    return then.v_n - _arm_velocity(at, then, lag)


def _read_position(at: Installation, x: ProductState, lag: Lag) -> Geodetic:
    then = _then(at, x, lag)
    dt = jnp.asarray(lag.dt, float)
    back = 0.5 * (x.ins.v_n + then.v_n) * dt
    return x.ins.position.retract(-back - then.q_nm.apply(at.lever_m))


def _left_jacobian(phi: Array) -> Float[Array, "3 3"]:
    """J with exp((phi + d) x) = exp(J d x) exp(phi x), to first order in d."""
    sq = jnp.sum(phi * phi)
    small = sq < 1e-2
    safe = jnp.where(small, 1.0, sq)
    angle = jnp.sqrt(safe)
    x = jnp.where(small, sq, 0.0)
    once = jnp.where(
        small,
        0.5 - x / 24.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0 * (1.0 - x / 90.0))),
        (1.0 - jnp.cos(angle)) / safe,
    )
    twice = jnp.where(
        small,
        1.0 / 6.0 - x / 120.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0 * (1.0 - x / 110.0))),
        (angle - jnp.sin(angle)) / (safe * angle),
    )
    turn = skew(phi)
    return jnp.eye(3) + once * turn + twice * turn @ turn


def _attitude_rows(at: Installation, x: ProductState, lag: Lag, then: _Then) -> Array:
    """(3, n) derivative of C_nm, as a rotation vector in n."""
    dt = jnp.asarray(lag.dt, float)
    frame_turn = then.omega_in * dt
    back = Rotation.from_rotvec(frame_turn).as_dcm()
    C_now, C_ns, C_nm = x.ins.q_nb.as_dcm(), then.q_ns.as_dcm(), then.q_nm.as_dcm()
    # rows 0 to 2 of the frame's dynamics are minus the derivative of omega_in
    by_frame = -dt * _left_jacobian(frame_turn) @ frame_dynamics(x.ins)[:3, 3:]
    turned = x.ins.gyro_bias * dt - jnp.asarray(lag.theta)
    columns = [
        back,
        by_frame,
        dt * back @ C_now @ _left_jacobian(turned),
        jnp.zeros((3, 3)),
        -C_ns @ _left_jacobian(-x.mounting_rad),
    ]
    if x.flexure_rad is not None:
        by_flexure = C_nm @ _left_jacobian(then.flexure)
        columns += [-by_flexure, dt * by_flexure]
    return jnp.concatenate(columns, 1)


def _linear_attitude(at: Installation, x: ProductState, lag: Lag):
    then = _then(at, x, lag)
    return then.q_nm, _attitude_rows(at, x, lag, then)


def _linear_velocity(at: Installation, x: ProductState, lag: Lag):
    then = _then(at, x, lag)
    dt = jnp.asarray(lag.dt, float)
    free = frame_dynamics(x.ins)
    H = jnp.zeros((3, free.shape[0] + (9 if x.flexure_rad is None else 15)))
    H = H.at[:, 0:3].set(skew(then.gained_n))
    H = H.at[:, 3:9].set(-dt * free[3:6, 3:]).at[:, 3:6].add(jnp.eye(3))
    H = H.at[:, 12:15].set(dt * x.ins.q_nb.as_dcm())
    # the arm turns with the master, and omega_in with velocity and place
    C_nm, omega_m = then.q_nm.as_dcm(), jnp.asarray(lag.omega_m)
    arm = skew(C_nm @ at.lever_m)
    by_attitude = skew(C_nm @ jnp.cross(omega_m, at.lever_m)) - skew(then.omega_in) @ arm
    H = H + by_attitude @ _attitude_rows(at, x, lag, then)
    H = H.at[:, 3:9].add(arm @ free[:3, 3:])
    return then.v_n - _arm_velocity(at, then, lag), H


# ---------------------------------------------------------------------------------- the model


def product_model(
    noise: InsNoise,
    installation: Installation,
    sigmas: Sigmas,
    flexure: Flexure | None = None,
    mounting_rw: ArrayLike = 0.0,
) -> Model:
    """Transfer alignment with mounting states, and flexure states where a flexure is given.

    Args:
        noise: of the slave's inertial sensors.
        installation: nominal mounting and lever arm.
        sigmas: of the master's records; its flutter belongs to the attitude.
        flexure: sigma, time constant and damping of each axis as the filter believes them; tails
            and bending are not modelled.
        mounting_rw: rad/sqrt(s), a number or (3,): how the mounting creeps.

    Returns:
        A model of `ProductState` whose input is a block of the slave's raw `Increments`, and whose
        sensors are "master_attitude" (a `Rotation`), "master_velocity" ((3,) NED) and, where its
        sigma is given, "master_position" (a `Geodetic`); the aux of each is a `Lag`.
    """
    creep = jnp.broadcast_to(jnp.asarray(mounting_rw, float), 3)
    drive = _Drive(noise, creep, flexure)
    motion = Motion(
        step=Partial(_step, drive),
        noise=Partial(_noise, drive),
        linear=Partial(_step_linear, drive),
    )

    def sensor(name, read, sigma, linear=None):
        noisy = jnp.broadcast_to(jnp.asarray(sigma, float), 3)
        bound = None if linear is None else Partial(linear, installation)
        return Sensor(Partial(read, installation), noisy, 3, name, bound)

    sensors = [
        sensor(ATTITUDE, _read_attitude, sigmas.attitude_rad, _linear_attitude),
        sensor(VELOCITY, _read_velocity, sigmas.velocity_m_s, _linear_velocity),
    ]
    if sigmas.position_m is not None:
        sensors.append(sensor(POSITION, _read_position, sigmas.position_m))
    return Model(motion, tuple(sensors))


def lag_of(increments: Increments, delay_s: ArrayLike, omega_m: ArrayLike) -> Lag:
    """How each record of the master lags behind, from the slave's own increments.

    Args:
        increments: raw blocks of the slave, dt (E, K), theta and dv (E, K, 3); epoch e is the end
            of block e.
        delay_s: () a record used at an epoch was true so long before it; not negative.
        omega_m: (E, 3) rad/s, the master's turn rate as recorded; NaN counts as zero.

    Returns:
        `Lag` with a leading axis of E. Before the first increment the motion is taken to have been
        as in it.
    """
    dt = jnp.asarray(increments.dt, float)
    epochs, width = dt.shape
    flat = [jnp.asarray(a, float).reshape(epochs * width, -1) for a in increments[:3]]
    age = jnp.broadcast_to(jnp.asarray(delay_s, float), epochs)
    last = (jnp.arange(epochs) + 1) * width - 1

    def back(carry):
        """Add the sample before, as much of it as the delay reaches into."""
        k, left, q, dv = carry
        lasts, theta, push = (a[jnp.maximum(last - k, 0)] for a in flat)
        taken = jnp.minimum(left, lasts[:, 0])
        share = (taken / jnp.where(lasts[:, 0] > 0.0, lasts[:, 0], 1.0))[:, None]
        # axes at the beginning of the piece, as seen from those of the epoch
        q = q @ Rotation.from_rotvec(-share * theta)
        return k + 1, left - taken, q, dv + q.apply(share * push)

    def reaches(carry):
        k, left, *_ = carry
        return jnp.any(left > 1e-12) & (k < epochs * width)

    none = Rotation(jnp.broadcast_to(Rotation.identity().wxyz, (epochs, 4)))
    start = (jnp.zeros((), int), age, none, jnp.zeros((epochs, 3)))
    _, _, q, dv = jax.lax.while_loop(reaches, back, start)
    rate = jnp.asarray(omega_m, float)
    rate = jnp.where(jnp.isfinite(rate), rate, 0.0)
    return Lag(age, q.inverse().as_rotvec(), dv, rate)
