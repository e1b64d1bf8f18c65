r"""Tightly coupled GNSS of a road vehicle: wheels and yaw gyro move it, pseudoranges correct it.

The state is in a north-east-down frame fixed at a place o, with C = C_en there::

    p      position [m]
    c      a vector (north, east): direction of travel, its length the odometer scale factor
    b      bias of the yaw gyro [rad/s]
    t, f   receiver clock [m] and its drift [m/s]
    s      clocks of the other systems against the first [m]
    d      delay of each satellite's signal [m]; filters without delays have no such states

With speed v and yaw rate w (positive to the right) over a step h, and the turn a = (w - b) h::

    c' = T(a) c,   p' = p + v h T(a/2) (c, 0),   t' = t + f h
    d' = m + k (d - m),   k = exp(-h/tau - |v| h/L),   Q_d = sigma_d^2 (1 - k^2)

k is zero for a satellite that is received for the first time.

The model is linear in c, unlike in heading and scale, so the start needs no heading: c is zero with
a sigma of 1/sqrt(2) on each axis. After some distance, |c| = 1 is measured with the sigma of the
scale. The pseudorange of a satellite at r, with q = o + C p, is ::

    rho = |r - q| + w_ie (r_x q_y - r_y q_x) / light + t + s + d

where r is the satellite's position at transmission, in the Earth-fixed axes of that time; the
second term is the Earth's rotation while the signal travels (Sagnac; Groves 2013, eq. 8.32, to
first order). It shortens a signal from the east, towards which the Earth carries the receiver.

The clock's noise is that of Brown & Hwang (2012, sec. 9.3)::

    S_t = light^2 h0 / 2,   S_f = 2 pi^2 light^2 h_-2
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins.earth import OMEGA_E, Geodetic, dcm_en, geodetic_from_ecef
from robins.filters import Belief, Model, Motion, Sensor
from robins.filters.belief import Number
from robins.filters.values import Numbers
from robins.systems.gnss.parameters import Delays, GnssAssumptions, ReceiverClock
from robins.systems.parts import NED
from robins.systems.study import SensorAxes, StateBlock

LIGHT = 299_792_458.0  # m/s
RANGES, LENGTH = "pseudorange", "wheel_scale"
POSITION = StateBlock("position", slice(0, 3), "m", "m", "NED", NED)
_START_M = 300.0  # sigma of the first fix by least squares, on each axis
_FREE_M, _FREE_CLOCK_M = 1e3, 1e5  # process noise per epoch for least squares: no memory


class GnssState(NamedTuple):
    """State of tight GNSS, or states of a run with leading axis E."""

    position: Any  # (3,) m, NED
    direction: Any  # (2,) north, east
    yaw_bias: Any  # () rad/s
    clock: Any  # (2,) m, m/s
    systems: Any  # (K,) m
    delay: Any  # (N,) m, or (0,)


class MotionStep(NamedTuple):
    """Input of a step of the motion."""

    dt: Any  # () s
    speed: Any  # () m/s, mean over the step, negative in reverse
    yaw_rate: Any  # () rad/s, positive to the right
    speed_sigma: Any  # () m/s
    yaw_sigma: Any  # () rad/s
    delay_mean: Any  # (N,) m
    delay_sigma: Any  # (N,) m
    fresh: Any = 0.0  # (N,) one where a satellite is received for the first time, else zero


class Sky(NamedTuple):
    """Inputs of the pseudoranges of an epoch, besides the state."""

    satellite_e: Any  # (N, 3) m, ECEF; arbitrary where a satellite is not measured
    sigma: Any  # (N,) m


class LocalFrame(NamedTuple):
    """Local north-east-down frame of the state."""

    origin_e: Numbers  # (3,) m
    C_en: Numbers  # (3, 3)

    @classmethod
    def at(cls, origin_e: ArrayLike) -> LocalFrame:
        """The frame at an Earth-fixed position."""
        lat, lon, _ = geodetic_from_ecef(jnp.asarray(origin_e, float))
        return cls(jnp.asarray(origin_e, float), dcm_en(lat, lon))

    def ecef(self, position: ArrayLike) -> Array:
        """Earth-fixed positions (..., 3) [m] of local ones (..., 3) [m, NED]."""
        along = jnp.asarray(position) @ self.C_en.T
        return along + jnp.broadcast_to(self.origin_e, along.shape)

    def local(self, r_e: ArrayLike) -> Array:
        """Local positions (..., 3) [m, NED] of Earth-fixed ones (..., 3) [m]."""
        r_e = jnp.asarray(r_e)
        return (r_e - jnp.broadcast_to(self.origin_e, r_e.shape)) @ self.C_en

    def geodetic(self, position: ArrayLike) -> Geodetic:
        """Latitude, longitude and height of local positions (..., 3) [m, NED]."""
        return Geodetic.from_ecef(self.ecef(position))


class GnssModelKind(NamedTuple):
    """Options of the model of a filter."""

    delays: bool = False  # a state for the delay of each satellite
    memory: bool = True  # False: each epoch is independent, as in least squares


def sagnac_m(satellite_e: Numbers, receiver_e: Numbers) -> Numbers:
    """Contribution (...) [m] of the Earth's rotation to a range; positions (..., 3) [m, ECEF]."""
    x, y = satellite_e[..., 0], satellite_e[..., 1]
    return OMEGA_E / LIGHT * (x * receiver_e[..., 1] - y * receiver_e[..., 0])


def clock_density(clock: ReceiverClock) -> tuple[float, float]:
    """Noise densities of clock [m/sqrt(s)] and drift [m/s/sqrt(s)]."""
    return LIGHT * math.sqrt(clock.h0 / 2.0), LIGHT * math.pi * math.sqrt(2.0 * clock.h2)


def delay_law(delays: Delays, elevation_rad: Number, cn0_dbhz: Number) -> tuple[Number, Number]:
    """Mean and standard deviation [m] of the delay of a signal, from its elevation and C/N0.

    With P the probability that it is blocked and u = 2 a cos(e), where a is the mean distance of
    the walls, the mean is P u and the mean square 2 P u^2 (exponential distances), to which the
    variance of multipath in direct sight is added.
    """
    d, xp = delays, jnp if isinstance(cn0_dbhz, jax.Array) else np
    blocked = xp.clip((d.clear_dbhz - cn0_dbhz) / (d.clear_dbhz - d.blocked_dbhz), 0.02, 0.98)
    reach = 2.0 * d.reflector * xp.cos(elevation_rad)
    mean = blocked * reach
    return mean, xp.sqrt(d.multipath**2 + 2.0 * blocked * reach**2 - mean**2)


def _rotated(angle: Array, c: Array) -> Array:
    s, k = jnp.sin(angle), jnp.cos(angle)
    return jnp.stack([k * c[0] - s * c[1], s * c[0] + k * c[1]])


def _kept(scales: Array, u: MotionStep) -> Array:
    kept = jnp.exp(-u.dt / scales[0] - jnp.abs(u.speed) * u.dt / scales[1])
    return jnp.where(jnp.asarray(u.fresh) > 0.0, 0.0, kept)


def _step(scales: Array, x: GnssState, u: MotionStep) -> GnssState:
    turn = (u.yaw_rate - x.yaw_bias) * u.dt
    way = u.speed * u.dt * _rotated(0.5 * turn, x.direction)
    delay = x.delay
    if delay.shape[0]:
        delay = u.delay_mean + _kept(scales, u) * (delay - u.delay_mean)
    return x._replace(
        position=x.position + jnp.concatenate([way, jnp.zeros(1)]),
        direction=_rotated(turn, x.direction),
        clock=x.clock + jnp.stack([x.clock[1] * u.dt, jnp.zeros(())]),
        delay=delay,
    )


def _noise(memory: bool, numbers: tuple[Array, Array], x: GnssState, u: MotionStep) -> Array:
    (rise, clock, drift), scales = numbers
    root = jnp.sqrt(u.dt)
    slip, sway = u.speed_sigma * u.dt, u.yaw_sigma * u.dt
    climb = rise * jnp.sqrt(jnp.abs(u.speed) * u.dt)
    place, time = jnp.stack([slip, slip, climb]), clock * root
    if not memory:
        place, time = jnp.full(3, _FREE_M), jnp.asarray(_FREE_CLOCK_M)
    rest = [jnp.stack([sway, sway, jnp.zeros(()), time, drift * root]), jnp.zeros(x.systems.shape)]
    if x.delay.shape[0]:
        rest.append(u.delay_sigma * jnp.sqrt(1.0 - _kept(scales, u) ** 2))
    return jnp.concatenate([place, *rest])


def _noise_kept(numbers: tuple[Array, Array], x: GnssState, u: MotionStep) -> Array:
    return _noise(True, numbers, x, u)


def _noise_free(numbers: tuple[Array, Array], x: GnssState, u: MotionStep) -> Array:
    return _noise(False, numbers, x, u)


def pseudoranges(place: LocalFrame, member: Array, x: GnssState, sky: Sky) -> Array:
    """Pseudoranges (N,) [m] predicted from a state."""
    q = place.ecef(x.position)
    r = jnp.sqrt(jnp.sum((sky.satellite_e - q[None, :]) ** 2, axis=-1))
    rho = r + sagnac_m(sky.satellite_e, q) + x.clock[0] + member @ x.systems
    return rho + x.delay if x.delay.shape[0] else rho


def _sigma(x: GnssState, sky: Sky) -> Array:
    return sky.sigma


def _length(x: GnssState, aux: Array | None) -> Array:
    square = jnp.sum(x.direction**2)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)[None]


def gnss_model(
    believed: GnssAssumptions, kind: GnssModelKind, place: LocalFrame, member: np.ndarray
) -> Model:
    """Motion and sensors of a filter.

    Args:
        believed: assumptions on clock, wheels and delays.
        kind: options of the model.
        place: origin of the state.
        member: (N, K) one where satellite n belongs to the k-th system after the first.
    """
    scales = jnp.array([believed.delays.time, believed.delays.distance])
    walks = jnp.array([believed.wheels.rise, *clock_density(believed.clock)])
    noise = Partial(_noise_kept if kind.memory else _noise_free, (walks, scales))
    membership = jnp.asarray(member, float)
    return Model(
        Motion(Partial(_step, scales), noise),
        (
            Sensor(Partial(pseudoranges, place, membership), _sigma, len(member), RANGES),
            Sensor(_length, jnp.array([believed.wheels.scale]), 1, LENGTH),
        ),
    )


def start_belief(
    believed: GnssAssumptions,
    kind: GnssModelKind,
    fix: Numbers,
    place: LocalFrame,
    systems: int,
    u: MotionStep,
) -> Belief:
    """Initial belief from the first fix; the heading is unknown.

    Args:
        believed: assumptions on clock, wheels and delays.
        kind: options of the model.
        fix: (4 + K,) of `first_fix`.
        place: origin of the state.
        systems: number K of systems besides the first.
        u: the first step, for mean and sigma of the delays.
    """
    b, n = believed, len(u.delay_mean) if kind.delays else 0
    mean = GnssState(
        position=place.local(fix[:3]),
        direction=jnp.zeros(2),
        yaw_bias=jnp.zeros(()),
        clock=jnp.stack([fix[3], jnp.zeros(())]),
        systems=jnp.zeros(systems),
        delay=jnp.asarray(u.delay_mean)[:n],
    )
    sigma = [
        jnp.full(3, _START_M),
        jnp.full(2, math.sqrt(0.5)),
        jnp.array([b.wheels.yaw_bias, 10.0 * _START_M, b.clock.drift]),
        jnp.full(systems, b.clock.system_bias),
        jnp.asarray(u.delay_sigma)[:n],
    ]
    return Belief(mean, jnp.diag(jnp.concatenate(sigma)))


def first_fix(y: Numbers, sky: Sky, member: Numbers, system_bias_m: Number) -> Array:
    """Position [ECEF], clock and system clocks (4 + K,) [m] by least squares.

    Gauss-Newton from the Earth's centre on the measured pseudoranges, modelled as in `pseudoranges`
    without delays and weighted by their sigmas; the system clocks have prior mean zero.

    Args:
        y: (N,) [m], NaN where a satellite is not measured; at least four are.
        sky: of the epoch.
        member: (N, K) as in `gnss_model`.
        system_bias_m: prior sigma of the system clocks.
    """
    member = jnp.asarray(member, float)
    there = jnp.isfinite(y)
    y, weight = jnp.where(there, y, 0.0), jnp.where(there, 1.0 / sky.sigma, 0.0)
    known = jnp.concatenate([jnp.zeros(4), jnp.full(member.shape[1], 1.0 / system_bias_m)])

    def predicted(x: Array) -> Array:
        r = jnp.sqrt(jnp.sum((sky.satellite_e - x[None, :3]) ** 2, axis=-1))
        return r + sagnac_m(sky.satellite_e, x[:3]) + x[3] + member @ x[4:]

    def better(_, x: Array) -> Array:
        H = weight[:, None] * jax.jacfwd(predicted)(x)
        normal = H.T @ H + jnp.diag(known**2)
        gradient = H.T @ (weight * (y - predicted(x))) - known**2 * x
        return x + jnp.linalg.solve(normal, gradient)

    return jax.lax.fori_loop(0, 12, better, jnp.zeros(4 + member.shape[1]))


def sensor_axes(satellites: tuple[str, ...]) -> dict[str, SensorAxes]:
    """Units and names of the components of the innovations."""
    return {
        RANGES: SensorAxes("m", "line of sight", satellites),
        LENGTH: SensorAxes("1", "vehicle", ("scale",)),
    }


def heading_rad(direction: Numbers) -> np.ndarray:
    """Heading (E,) [rad], clockwise from north, of directions (E, 2)."""
    c = np.asarray(direction)
    return np.arctan2(c[:, 1], c[:, 0])
