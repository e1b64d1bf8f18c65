"""The product model: navigation state, mounting and flexure of a slave that receives a master.

The mean is the navigation state itself, so the estimate is fed back by construction, and it lives
on a manifold, so no attitude is singular and large initial errors are linearised about the current
estimate. NED/FRD; n is the navigation frame, s the slave's axes, m the master's.

State, in tangent order (18 components, or 24 with flexure):

    phi, dv, dp    attitude, velocity, position of the slave     C_ns = exp(phi x) C_estimate
    bg, ba         biases of its gyros and accelerometers, s
    mu             mounting error, s
    l, l'          flexure and its rate, m

Motion: strapdown mechanisation of samples corrected for the biases, which may walk; a constant mu;
a flexure with independent axes (Kain & Cloutier 1989). The slave's gyros sense the flexure, so its
attitude includes it: flexure does not enter the slave's mechanisation.

    x' = F x + G w      F = diag(F_ins, 0, F_flexure)            Q = diag(Q_ins, 0, Q_flexure)   (1)
                        F_ins, Q_ins: `robins.ins.errors`, as Groves (2013), section 14.2
    l'' + 2 zeta wn l' + wn^2 l = q,  wn = 2.146 / tau,  q of density 4 zeta wn^3 sigma^2,       (2)
                        so by axis F_flexure = [0 1; -wn^2 -2 zeta wn]

Measurement: the predicted output of the master, through mounting, flexure and the lever arm r,

    C_ms = exp(l x) C_nominal exp(mu x)                                                          (3)
    C_nm = C_ns C_ms^T                                                   attitude                (4)
    v_m  = v_s - C_nm (omega_im x r) + omega_in x C_nm r                 velocity                (5)
    p_m  = p_s - C_nm r                                                  position                (6)

A record stamped t is valid at t - d. So (3) to (6) hold at t - d, to which the slave is propagated
back by theta and dv, the increments of its own inertial unit since then (`RecordDelay`):

    C_ns(t - d) = exp(omega_in d x) C_ns exp((bg d - theta) x)                                   (7)
    v_s(t - d)  = v_s - C_ns (dv - ba d) - (g - (2 omega_ie + omega_en) x v_s) d                 (8)
    p_s(t - d)  = p_s - (v_s + v_s(t - d)) d / 2                                                 (9)
    l(t - d)    = l - l' d                                                                      (10)

The noise that drove the flexure since then is unknown: it leaves sqrt(4 zeta wn^3 d^3 / 3) of the
flexure sigma in the attitude, 1 % for d = 60 ms and tau = 3 s, which the noise of the records must
cover. For small angles and d = 0, in columns phi, dv, dp, bg, ba, mu, l, l',

    H_attitude = [ I  0  0  0  0  -C_ns  -C_nm  0 ]                                             (11)
    H_velocity = [ 0  I  0 ... 0 ] + [(C_nm (omega_im x r)) x - omega_in x (C_nm r) x] H_attitude
               - [(C_nm r) x] d omega_in / d(dv, dp)                                            (12)

The code keeps whole angles, by J of exp((a + e) x) = exp((J(a) e) x) exp(a x) to first order in e,
and the delay. The Jacobian of the position follows by differentiation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins import _float64, linalg  # noqa: F401
from robins.earth import Geodetic, earth_rate_n, gravity_n, transport_rate_n
from robins.filters import Model, Sensor
from robins.ins.errors import frame_dynamics
from robins.ins.increments import Increments
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear
from robins.rotation import Rotation, left_jacobian, skew
from robins.sim.flexure import Flexure, swing
from robins.systems.parts import NED, ImuBlock, moved_by
from robins.systems.study import SensorAxes

ATTITUDE, VELOCITY, POSITION = "master_attitude", "master_velocity", "master_position"


class ProductState(NamedTuple):
    """Slave, mounting and flexure; the pytree has no flexure leaf where it is not modelled."""

    ins: InsState  # of the slave: 15 components, no scale factors
    mounting_rad: Array  # (3,) mu, slave axes
    flexure: Any = None  # (6,) l [rad], then l' [rad/s], master axes


class Installation(NamedTuple):
    """Nominal installation of the slave: mounting and lever arm."""

    q_ms: Rotation  # C_nominal, slave axes to master axes
    lever_m: Array  # (3,) m, master to slave, master axes


class RecordDelay(NamedTuple):
    """Inputs of a measurement of the master, besides the state.

    The slave's raw increments from the validity of the record to now, and the master's rate.
    """

    dt: ArrayLike  # () s, age of the record
    theta: ArrayLike  # (3,) rad, turn of the slave over dt, body axes
    dv: ArrayLike  # (3,) m/s, velocity gained over dt, body axes now
    omega_m: ArrayLike  # (3,) rad/s, omega_im of the master at the record's time of validity


_ProductNoise = tuple[InsNoise, Flexure | None]  # of the slave and of its mounting


def _swing(flexure: Flexure, block: ImuBlock) -> tuple[Array, Array]:
    """Flexure over a block by (2): Phi (6, 6) of (l, l'), and a factor (6, 6) of Q."""
    return swing(flexure, jnp.sum(jnp.asarray(block.increments.dt)))


def _step(drive: _ProductNoise, x: ProductState, block: ImuBlock) -> ProductState:
    noise, flexure = drive
    new = x._replace(ins=propagate(x.ins, block.increments, noise))
    if flexure is None:
        return new
    Phi, _ = _swing(flexure, block)
    return new._replace(flexure=Phi @ x.flexure)


def _step_linear(drive: _ProductNoise, x: ProductState, block: ImuBlock):
    """State after a block of samples by (1), Phi and a factor of Q."""
    noise, flexure = drive
    ins, Phi, L = propagate_linear(x.ins, block.increments, noise, segments=1)
    new = x._replace(ins=ins)
    Phis, Ls = [Phi, jnp.eye(3)], [L, jnp.zeros((3, 3))]
    if flexure is not None:
        Phi, L = _swing(flexure, block)
        new = new._replace(flexure=Phi @ x.flexure)
        Phis, Ls = [*Phis, Phi], [*Ls, L]
    return new, block_diag(*Phis), block_diag(*Ls) * block.noise_scale


# ---------------------------------------------------------------------------------- the master


class _DelayedState(NamedTuple):
    """The slave and the master at the record's time of validity."""

    v_n: Array  # (3,) of the slave
    q_ns: Rotation
    q_nm: Rotation
    flexure: Array  # (3,) l
    omega_in: Array  # (3,)
    gained_n: Array  # (3,) m/s, velocity gained by specific force since then


def _state_at_validity(at: Installation, x: ProductState, lag: RecordDelay) -> _DelayedState:
    """State at the record's time of validity: (3), (4), (7), (8), (10)."""
    dt = jnp.asarray(lag.dt, float)
    ins, p = x.ins, x.ins.position
    omega_ie = earth_rate_n(p.lat)
    omega_en = transport_rate_n(p.lat, p.alt, ins.v_n)
    turned = Rotation.from_rotvec(ins.gyro_bias * dt - lag.theta)
    q_ns = Rotation.from_rotvec((omega_ie + omega_en) * dt) @ ins.q_nb @ turned
    gained_n = ins.q_nb.apply(lag.dv - ins.accel_bias * dt)
    coriolis = jnp.cross(2.0 * omega_ie + omega_en, ins.v_n)
    v_n = ins.v_n - gained_n - (gravity_n(p.lat, p.alt) - coriolis) * dt
    flexure = jnp.zeros(3) if x.flexure is None else x.flexure[:3] - x.flexure[3:] * dt
    q_ms = Rotation.from_rotvec(flexure) @ at.q_ms @ Rotation.from_rotvec(x.mounting_rad)
    return _DelayedState(v_n, q_ns, q_ns @ q_ms.inverse(), flexure, omega_ie + omega_en, gained_n)


def _read_attitude(at: Installation, x: ProductState, lag: RecordDelay) -> Rotation:
    return _state_at_validity(at, x, lag).q_nm


def _arm_velocity(at: Installation, then: _DelayedState, lag: RecordDelay) -> Array:
    """Velocity [m/s, NED] of the slave relative to the master, from the lever arm."""
    turning = then.q_nm.apply(jnp.cross(jnp.asarray(lag.omega_m), at.lever_m))
    return turning - jnp.cross(then.omega_in, then.q_nm.apply(at.lever_m))


def _read_velocity(at: Installation, x: ProductState, lag: RecordDelay) -> Array:
    """Predicted velocity of the master, (5)."""
    then = _state_at_validity(at, x, lag)
    return then.v_n - _arm_velocity(at, then, lag)


def _read_position(at: Installation, x: ProductState, lag: RecordDelay) -> Geodetic:
    """Predicted position of the master, (6) and (9)."""
    then = _state_at_validity(at, x, lag)
    dt = jnp.asarray(lag.dt, float)
    back = 0.5 * (x.ins.v_n + then.v_n) * dt
    return x.ins.position.retract(-back - then.q_nm.apply(at.lever_m))


def _attitude_rows(
    at: Installation, x: ProductState, lag: RecordDelay, then: _DelayedState
) -> Array:
    """(3, n) derivative of C_nm, as a rotation vector in n; (11) where the delay is zero."""
    dt = jnp.asarray(lag.dt, float)
    frame_turn = then.omega_in * dt
    back = Rotation.from_rotvec(frame_turn).as_dcm()
    C_now, C_ns, C_nm = x.ins.q_nb.as_dcm(), then.q_ns.as_dcm(), then.q_nm.as_dcm()
    # rows 0 to 2 of the frame's dynamics are minus the derivative of omega_in
    by_frame = -dt * left_jacobian(frame_turn) @ frame_dynamics(x.ins)[:3, 3:]
    turned = x.ins.gyro_bias * dt - jnp.asarray(lag.theta)
    columns = [
        back,
        by_frame,
        dt * back @ C_now @ left_jacobian(turned),
        jnp.zeros((3, 3)),
        -C_ns @ left_jacobian(-x.mounting_rad),
    ]
    if x.flexure is not None:
        by_flexure = C_nm @ left_jacobian(then.flexure)
        columns += [-by_flexure, dt * by_flexure]
    return jnp.concatenate(columns, 1)


def _linear_attitude(at: Installation, x: ProductState, lag: RecordDelay):
    then = _state_at_validity(at, x, lag)
    return then.q_nm, _attitude_rows(at, x, lag, then)


def _linear_velocity(at: Installation, x: ProductState, lag: RecordDelay):
    """Predicted velocity (5) and its Jacobian, (12) where the delay is zero."""
    then = _state_at_validity(at, x, lag)
    dt = jnp.asarray(lag.dt, float)
    free = frame_dynamics(x.ins)
    of_attitude = _attitude_rows(at, x, lag, then)
    H = jnp.zeros_like(of_attitude)
    H = H.at[:, 0:3].set(skew(then.gained_n))
    H = H.at[:, 3:9].set(-dt * free[3:6, 3:]).at[:, 3:6].add(jnp.eye(3))
    H = H.at[:, 12:15].set(dt * x.ins.q_nb.as_dcm())
    # the arm rotates with the master; omega_in depends on velocity and position
    C_nm, omega_m = then.q_nm.as_dcm(), jnp.asarray(lag.omega_m)
    arm = skew(C_nm @ at.lever_m)
    by_attitude = skew(C_nm @ jnp.cross(omega_m, at.lever_m)) - skew(then.omega_in) @ arm
    H = H + by_attitude @ of_attitude
    H = H.at[:, 3:9].add(arm @ free[:3, 3:])
    return then.v_n - _arm_velocity(at, then, lag), H


class MasterQuantity(NamedTuple):
    """A quantity reported by the master, as used by simulator, filter and report."""

    axes: SensorAxes
    field: str  # of the master's `Nav`
    sigma: str  # among the parameters of the master, by axis
    struck: bool  # outliers affect it
    read: Callable[[Installation, ProductState, RecordDelay], Any]
    linear: Callable[..., Any] | None = None  # likewise, with the Jacobian


_NED = {unit: SensorAxes(unit, "NED", NED) for unit in ("rad", "m/s", "m")}
RECORDS = {
    ATTITUDE: MasterQuantity(
        _NED["rad"], "q_nb", "attitude_noise", True, _read_attitude, _linear_attitude
    ),
    VELOCITY: MasterQuantity(
        _NED["m/s"], "v_n", "velocity_noise", True, _read_velocity, _linear_velocity
    ),
    POSITION: MasterQuantity(_NED["m"], "position", "position_noise", False, _read_position),
}


def product_model(
    noise: InsNoise,
    installation: Installation,
    sigmas: Mapping[str, ArrayLike],
    flexure: Flexure | None = None,
) -> Model:
    """Transfer alignment with mounting states, and flexure states where a flexure is given.

    Args:
        noise: of the slave's inertial sensors.
        installation: nominal mounting and lever arm.
        sigmas: standard deviations of the `RECORDS` to match, a number or (3,) each: of the
            attitude [rad] as a rotation vector, of velocity [m/s] and position [m], all north east
            down. That of the attitude includes flutter of the structure.
        flexure: sigma, time constant and damping assumed for each axis; tails and bending are not
            modelled.

    Returns:
        A model of `ProductState` whose input is a `ImuBlock` of the slave's raw increments. Its
        sensors have the names of `sigmas`; an attitude is a `Rotation`, a velocity (3,) NED, a
        position a `Geodetic`; the aux of each is a `RecordDelay`.
    """
    motion = moved_by(_step, _step_linear, (noise, flexure))

    def sensor(name: str, sigma: ArrayLike) -> Sensor:
        record, noisy = RECORDS[name], jnp.broadcast_to(jnp.asarray(sigma, float), 3)
        linear = None if record.linear is None else Partial(record.linear, installation)
        return Sensor(Partial(record.read, installation), noisy, 3, name, linear)

    return Model(motion, tuple(sensor(*one) for one in sigmas.items()))


def lag_of(increments: Increments, delay_s: ArrayLike, omega_m: ArrayLike) -> RecordDelay:
    """Lag of each record of the master, from the slave's own increments.

    Args:
        increments: raw blocks of the slave, dt (E, K), theta and dv (E, K, 3); epoch e is the end
            of block e.
        delay_s: () time from the validity of a record to the epoch of its use [s]; not negative.
        omega_m: (E, 3) rad/s, recorded angular rate of the master; NaN counts as zero.

    Returns:
        `RecordDelay` with a leading axis of E. Motion before the first increment is taken equal to
        that within it.
    """
    dt = jnp.asarray(increments.dt, float)
    epochs, width = dt.shape
    flat = [jnp.asarray(a, float).reshape(epochs * width, -1) for a in increments[:3]]
    age = jnp.broadcast_to(jnp.asarray(delay_s, float), epochs)
    last = (jnp.arange(epochs) + 1) * width - 1

    def back(carry):
        """Add the preceding sample, or the part of it within the delay."""
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
    return RecordDelay(age, q.inverse().as_rotvec(), dv, rate)
