"""Smooth motion over the Earth, with consistent velocity, acceleration and angular rate.

A `MotionProfile` is two splines of fifth degree or more: latitude, longitude and height; and the
attitude quaternion. All else is their derivatives, so it is consistent with the path to rounding,
whatever the motion was made from, and the input of an ideal IMU has no steps. Offline, NumPy,
north-east-down and forward-right-down; time in seconds from the start of the motion.

    motion = sine_velocity(start, amplitude_mps=60.0, period_s=30.0)
    truth = motion.trajectory(motion.times_ns(rate_hz=10.0))

`robins.sim.commands` makes motions from a list of manoeuvres. `at_lever_arm` is the motion
of another point of the same rigid body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation as _Rotation

from robins import (
    _float64,  # noqa: F401
    earth,
)
from robins.dataset import Trajectory
from robins.earth import A_M, E2, OMEGA_E, Geodetic, dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.ins.mechanise import refuse_polar
from robins.rotation import from_dcm, to_dcm

Vehicle = Literal["ground", "aircraft"]
Values = float | int | Sequence | np.ndarray  # one for all axes, or a column of them

_DEGREE = 5
_SLOWEST = 0.1  # m/s; below it a course is not a heading


class Kinematics(NamedTuple):
    """A motion at N instants; NumPy."""

    lat: np.ndarray  # (N,) rad
    lon: np.ndarray  # (N,) rad, not wrapped
    alt: np.ndarray  # (N,) m
    v_n: np.ndarray  # (N, 3) m/s over the Earth, NED
    a_n: np.ndarray  # (N, 3) m/s^2, time derivative of the components v_n
    q_nb: np.ndarray  # (N, 4)
    omega_nb_b: np.ndarray  # (N, 3) rad/s, body relative to NED

    def rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Input of an ideal IMU: omega_ib_b [rad/s] and specific force f_b [m/s^2]."""
        omega_ie = np.zeros_like(self.v_n)
        omega_ie[:, 0], omega_ie[:, 2] = OMEGA_E * np.cos(self.lat), -OMEGA_E * np.sin(self.lat)
        meridian, transverse = _radii(self.lat)
        omega_en = np.empty_like(self.v_n)
        omega_en[:, 0] = self.v_n[:, 1] / (transverse + self.alt)
        omega_en[:, 1] = -self.v_n[:, 0] / (meridian + self.alt)
        omega_en[:, 2] = -omega_en[:, 0] * np.tan(self.lat)
        f_n = self.a_n + np.cross(2.0 * omega_ie + omega_en, self.v_n)
        f_n -= earth.gravity_n(self.lat, self.alt)
        to_body = _Rotation.from_quat(self.q_nb, scalar_first=True).inv()
        return self.omega_nb_b + to_body.apply(omega_ie + omega_en), to_body.apply(f_n)


@dataclass(frozen=True)
class MotionProfile:
    """A smooth path and attitude from time zero to `duration_s`."""

    duration_s: float
    start: Geodetic  # scalars
    path: BSpline  # (3,): latitude and longitude less the start's [rad], height [m]
    attitude: BSpline  # (4,): q_nb, not normalised

    def at(self, time_s: np.ndarray) -> Kinematics:
        """Kinematics at given times [s], which may lie slightly outside the motion."""
        t = np.asarray(time_s, float)
        (dlat, dlon, alt) = self.path(t).T
        lat_rate, lon_rate, climb = self.path(t, 1).T
        lat_rate2, lon_rate2, climb_rate = self.path(t, 2).T
        lat, lon = float(self.start.lat) + dlat, float(self.start.lon) + dlon
        s, c = np.sin(lat), np.cos(lat)
        meridian, transverse = _radii(lat)
        bulge = 3.0 * meridian * E2 * s * c / (1.0 - E2 * s * s)  # d meridian / d latitude
        north, east = meridian + alt, (transverse + alt) * c
        v_n = np.stack([lat_rate * north, lon_rate * east, -climb], -1)
        a_n = np.stack(
            [
                lat_rate2 * north + lat_rate * (bulge * lat_rate + climb),
                lon_rate2 * east + lon_rate * (c * climb - north * s * lat_rate),
                -climb_rate,
            ],
            -1,
        )
        raw, raw_rate = self.attitude(t), self.attitude(t, 1)
        sq = np.sum(raw * raw, -1, keepdims=True)
        omega = 2.0 * _vector_part(raw, raw_rate) / sq
        return Kinematics(lat, lon, alt, v_n, a_n, raw / np.sqrt(sq), omega)

    def times_ns(self, rate_hz: float) -> np.ndarray:
        """Sampling times from start to end at a constant rate, rounded to nanoseconds."""
        n = int(np.floor(self.duration_s * rate_hz * (1.0 + 1e-12)))
        return np.round(np.arange(n + 1) * (1e9 / rate_hz)).astype(np.int64)

    def trajectory(self, time_ns: np.ndarray, source: str = "") -> Trajectory:
        """The truth at given times [ns], NED/FRD."""
        k = self.at(np.asarray(time_ns) * 1e-9)
        lon = (k.lon + np.pi) % (2.0 * np.pi) - np.pi
        return Trajectory(
            np.asarray(time_ns, np.int64), k.lat, lon, k.alt, k.v_n, k.q_nb, source=source
        )


def from_waypoints(
    time_s: Values,
    lat_rad: Values,
    lon_rad: Values,
    alt_m: Values,
    q_nb: Values | None = None,
    vehicle: Vehicle = "ground",
) -> MotionProfile:
    """Motion through given points at given times.

    Args:
        time_s: (K,) increasing, at least four; the motion starts at the first.
        lat_rad: (K,).
        lon_rad: (K,); may cross 180 deg.
        alt_m: (K,) above the ellipsoid.
        q_nb: (K, 4) attitude at the points, NED/FRD. Without it the vehicle points along its
            velocity; an aircraft banks so that its turns are coordinated.
        vehicle: kind of vehicle, if `q_nb` is not given.

    Raises:
        ValueError: too few points, time that does not increase, shapes that do not match, values
            that are not finite, a pole, or, without `q_nb`, a vehicle that stands still.
    """
    columns = {"time_s": time_s, "lat_rad": lat_rad, "lon_rad": lon_rad, "alt_m": alt_m}
    t, lat, lon, alt = (_column(name, a, np.size(time_s)) for name, a in columns.items())
    if len(t) < 4 or np.any(np.diff(t) <= 0):
        raise ValueError(
            f"time_s: {len(t)} waypoints, at least 4 at increasing times are needed for a smooth "
            "path"
        )
    refuse_polar(lat)
    t = t - t[0]
    lon = np.unwrap(lon)
    degree = _DEGREE if len(t) > _DEGREE else 3
    knots = np.stack([lat - lat[0], lon - lon[0], alt], -1)
    path = make_interp_spline(t, knots, k=degree)
    start = Geodetic(lat[0], lon[0], alt[0])
    if q_nb is not None:
        q = np.asarray(q_nb, float)
        if q.shape != (len(t), 4):
            raise ValueError(f"q_nb has shape {q.shape}, the waypoints need ({len(t)}, 4)")
        return MotionProfile(t[-1], start, path, _attitude(t, q, degree))
    fine = np.interp(np.arange(16 * len(t) - 15) / 16.0, np.arange(len(t)), t)
    level = _attitude(t, np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)), degree)
    k = MotionProfile(t[-1], start, path, level).at(fine)
    speed = np.hypot(k.v_n[:, 0], k.v_n[:, 1])
    if speed.min() < _SLOWEST:
        raise ValueError(
            f"the vehicle (nearly) stands still at {fine[speed.argmin()]:.3f} s "
            f"({speed.min():.3f} m/s): where it points does not follow from where it goes; pass "
            "q_nb, or use robins.sim.commands"
        )
    heading, pitch = np.arctan2(k.v_n[:, 1], k.v_n[:, 0]), np.arctan2(-k.v_n[:, 2], speed)
    return MotionProfile(t[-1], start, path, _attitude(fine, along(k, heading, pitch, vehicle)))


def from_velocity(
    time_s: np.ndarray, v_n: np.ndarray, start: Geodetic, q_nb: np.ndarray
) -> MotionProfile:
    """Motion of velocity (K, 3) NED [m/s] and attitude (K, 4) at dense times (K,) from zero [s].

    The times increase. The path is a spline of sixth degree with the given velocities at the knots.

    Raises:
        ValueError: the start is too near a pole.
    """
    refuse_polar(start.lat)
    lat0, alt0 = float(start.lat), float(start.alt)
    alt = alt0 + make_interp_spline(time_s, -v_n[:, 2], k=_DEGREE).antiderivative()(time_s)
    lat_rate, lat = np.zeros_like(alt), np.full_like(alt, lat0)
    # Fixed point: latitude enters its own rate through the radii only; a pass gains three digits.
    for _ in range(6):
        lat_rate = v_n[:, 0] / (_radii(lat)[0] + alt)
        lat = lat0 + make_interp_spline(time_s, lat_rate, k=_DEGREE).antiderivative()(time_s)
    refuse_polar(lat)
    lon_rate = v_n[:, 1] / ((_radii(lat)[1] + alt) * np.cos(lat))
    rates = make_interp_spline(time_s, np.stack([lat_rate, lon_rate, -v_n[:, 2]], -1), k=_DEGREE)
    path = rates.antiderivative()
    path.c[:, 2] += alt0  # B-splines sum to one, so this shifts the height
    origin = Geodetic(lat0, float(start.lon), alt0)
    return MotionProfile(float(time_s[-1]), origin, path, _attitude(time_s, q_nb))


def sine_velocity(
    start: Geodetic,
    mean_mps: Values = 10.0,
    amplitude_mps: Values = 60.0,
    period_s: float = 30.0,
    duration_s: float = 600.0,
    phase_rad: Values = (0.0, np.pi / 2.0, 0.0),
) -> MotionProfile:
    """Velocity ``mean + amplitude sin(2 pi t / period + phase)`` along north, east and down.

    The body points along the velocity, with its wings level. The path is that of the generator in
    the mechanisation tests of pyins (N. Mayorov), whose pitch has the opposite sign.
    """
    mean, amplitude, phase = (
        np.broadcast_to(np.asarray(a, float), 3) for a in (mean_mps, amplitude_mps, phase_rad)
    )
    steps = max(int(np.ceil(duration_s / (period_s / 600.0))), 8)
    t = np.linspace(0.0, duration_s, steps + 1)
    v = mean + amplitude * np.sin(2.0 * np.pi * t[:, None] / period_s + phase)
    heading = np.arctan2(v[:, 1], v[:, 0])
    pitch = np.arctan2(-v[:, 2], np.hypot(v[:, 0], v[:, 1]))
    return from_velocity(t, v, start, quaternion(0.0 * heading, pitch, heading))


def along(
    k: Kinematics, heading_rad: np.ndarray, pitch_rad: np.ndarray, vehicle: Vehicle
) -> np.ndarray:
    """Attitude q_nb (N, 4) of given heading and pitch, level; or, for an aircraft, banked.

    The bank is the one without lateral specific force, as in a coordinated turn.
    """
    level = quaternion(np.zeros_like(pitch_rad), pitch_rad, heading_rad)
    if vehicle == "ground":
        return level
    _, f = k._replace(q_nb=level).rates()
    return quaternion(np.arctan2(f[:, 1], -f[:, 2]), pitch_rad, heading_rad)


def quaternion(roll_rad: np.ndarray, pitch_rad: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
    """q_nb (N, 4) of angles (N,); `robins.rotation.from_euler` in NumPy, without compilation."""
    angles = np.stack([heading_rad, pitch_rad, roll_rad], -1)
    return _Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)


def _attitude(t: np.ndarray, q: np.ndarray, degree: int = _DEGREE) -> BSpline:
    """Spline through unit quaternions, their signs chosen so that neighbours are close."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)
    return make_interp_spline(t, q * np.cumprod(np.append(1.0, flips))[:, None], k=degree)


def _vector_part(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Vector part of ``conjugate(p) q``."""
    a, b = p[:, 1:], q[:, 1:]
    return p[:, :1] * b - q[:, :1] * a - np.cross(a, b)


def knots_of(duration_s: float, knots_hz: float) -> np.ndarray:
    """Times [s] of the knots of a spline from 0 to a duration, eight intervals at least."""
    return np.linspace(0.0, duration_s, max(int(np.ceil(duration_s * knots_hz)), 8) + 1)


def smoothstep(s: np.ndarray) -> np.ndarray:
    """Rise from 0 to 1 over s in [0, 1] with two continuous derivatives."""
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def _radii(lat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    w_sq = 1.0 - E2 * np.sin(lat) ** 2
    transverse = A_M / np.sqrt(w_sq)
    return transverse * (1.0 - E2) / w_sq, transverse


def _column(name: str, values: Values, n: int) -> np.ndarray:
    a = np.asarray(values, float)
    if a.shape != (n,) or not np.isfinite(a).all():
        raise ValueError(f"{name}: {n} finite numbers are needed, got shape {a.shape}: {values!r}")
    return a


def at_lever_arm(
    motion: MotionProfile, lever_b_m: Sequence[float] | np.ndarray, knots_hz: float = 100.0
) -> MotionProfile:
    """Motion of a point fixed to the body at a lever arm, with the axes of the body.

    The point's path is that of ``r_e + C_eb lever_b``, and its velocity and acceleration are the
    path's, so all effects of Earth and body rotation are included. North, east and down
    are those at the point: they differ from the body's own by the lever arm over the radius of the
    Earth, 0.2 arcsec at 6 m.

    Args:
        motion: motion of the origin of the body axes.
        lever_b_m: (3,) lever arm from there to the point, in body axes FRD [m].
        knots_hz: knot rate of the new splines.

    Raises:
        ValueError: not three finite numbers.
    """
    lever = np.asarray(lever_b_m, float)
    if lever.shape != (3,) or not np.all(np.isfinite(lever)):
        raise ValueError(f"lever_b_m must be three finite numbers, got {lever_b_m}")
    if not np.any(lever):
        return motion
    t = knots_of(motion.duration_s, knots_hz)
    k = motion.at(t)
    lat, lon, alt, q_nb = _carried(k.lat, k.lon, k.alt, k.q_nb, lever)
    return from_waypoints(t, *(np.asarray(a) for a in (lat, lon, alt)), q_nb=np.asarray(q_nb))


@jax.jit
def _carried(lat, lon, alt, q_nb, lever_b):
    """Latitude, longitude, height and attitude at a lever arm (time on the leading axis)."""
    C_en = dcm_en(lat, lon)
    C_eb = C_en @ to_dcm(q_nb)
    r_e = ecef_from_geodetic(lat, lon, alt) + jnp.sum(C_eb * lever_b[None, None], -1)
    there = geodetic_from_ecef(r_e)
    C_en_there = dcm_en(there[0], there[1])
    return *there, from_dcm(jnp.swapaxes(C_en_there, -1, -2) @ C_eb)
