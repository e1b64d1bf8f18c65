"""Coarse alignment: attitude of a vehicle at rest, with the uncertainty that the sensors leave.

At rest the accelerometers measure the reaction to gravity, which gives roll and pitch (`level`),
and the gyros measure the rotation of the Earth, which gives the heading if they are good enough
(`gyrocompass`; Titterton & Weston 2004, chapter 10; Groves 2013, section 5.6). If they are not,
the velocity of a vehicle that drives straight ahead gives its heading (`heading_from_velocity`).
`align` chooses the method for a record at rest; `is_static` tests a record for rest.

Attitudes are q_nb, north-east-down from forward-right-down. Uncertainty is the covariance of phi in
``C_true = exp(phi x) C_estimate``, phi along north, east, down, as in `robins.rotation.Rotation`.
With errors df of the specific force and dw of the rates, measured less true, all along n,

    phi_N = df_E / g,   phi_E = -df_N / g,   phi_D = dw_E / (Omega cos L) - phi_N tan L,

the last for gyrocompassing: an east gyro error of 0.01 deg/h makes 3.2 arcmin of heading at 45 deg.

NumPy, for single use; leading axes are independent alignments.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from robins.earth import OMEGA_E, gravity
from robins.errors import require
from robins.ins.imu_errors import ImuErrorModel, mean_sigma
from robins.rotation import Rotation, from_euler, to_dcm

UNKNOWN_HEADING_RAD = np.pi / np.sqrt(3.0)
"""Sigma of an unknown angle, uniform over the circle."""

_LARGEST_HEADING_SIGMA_RAD = 0.3  # largest for which the linear error formulas hold
_DEG_H = np.pi / 180.0 / 3600.0


class Alignment(NamedTuple):
    """Attitude found at rest."""

    q_nb: Rotation  # body to north-east-down
    covariance: np.ndarray  # (..., 3, 3) rad^2 of phi, north, east, down
    method: Literal["gyrocompass", "level"]


class StaticCheck(NamedTuple):
    """Result of a test for rest, with the mean values of the record."""

    static: bool
    reasons: tuple[str, ...]  # reasons against rest, one sentence each
    omega_ib_b: np.ndarray  # (3,) rad/s, mean
    f_b: np.ndarray  # (3,) m/s^2, mean
    sigma_omega: np.ndarray  # (3,) rad/s, of a sample
    sigma_f: np.ndarray  # (3,) m/s^2, of a sample


def _record(omega_ib_b: ArrayLike, f_b: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    omega, f = np.asarray(omega_ib_b, float), np.asarray(f_b, float)
    if omega.ndim != 2 or omega.shape[1] != 3 or f.shape != omega.shape or len(omega) < 10:
        raise ValueError(
            "omega_ib_b and f_b must both have shape (n, 3) with at least 10 samples, got "
            f"{omega.shape} and {f.shape}"
        )
    for name, x in (("omega_ib_b", omega), ("f_b", f)):
        bad = np.flatnonzero(~np.all(np.isfinite(x), axis=1))
        if bad.size:
            raise ValueError(f"{name} is not finite at row {bad[0]}: {x[bad[0]]}; clean it first")
    return omega, f


def is_static(
    omega_ib_b: ArrayLike,
    f_b: ArrayLike,
    *,
    g: float = 9.80665,
    largest_sigma_omega: float = 0.01,
    largest_sigma_f: float = 0.15,
    largest_omega: float = 0.06,
    largest_g_error: float = 0.3,
) -> StaticCheck:
    """Test a record for rest: scatter of the samples, mean rate, mean specific force against g.

    The thresholds suit MEMS at some hundred Hz on a vehicle with its engine running; they must lie
    above the noise of a sample and the biases of the sensor. A steady climb, drive or turn slower
    than ``largest_omega`` cannot be distinguished from rest by inertial sensors.

    Args:
        omega_ib_b: (n, 3) gyro rates [rad/s].
        f_b: (n, 3) specific forces [m/s^2].
        g: gravity at the place [m/s^2].
        largest_sigma_omega: scatter of an axis at rest [rad/s].
        largest_sigma_f: scatter of an axis at rest [m/s^2].
        largest_omega: length of the mean rate [rad/s], bias and Earth rate included.
        largest_g_error: difference of the mean specific force from g [m/s^2].

    Raises:
        ValueError: other shapes, fewer than ten samples, values not finite.
    """
    omega, f = _record(omega_ib_b, f_b)
    mean_omega, mean_f = omega.mean(0), f.mean(0)
    sigma_omega, sigma_f = omega.std(0, ddof=1), f.std(0, ddof=1)
    size_omega, size_f = np.linalg.norm(mean_omega), np.linalg.norm(mean_f)
    reasons = []
    for what, size, most, unit in (
        ("the rates scatter by", np.max(sigma_omega), largest_sigma_omega, "rad/s"),
        ("the specific force scatters by", np.max(sigma_f), largest_sigma_f, "m/s^2"),
        ("the mean rate is", size_omega, largest_omega, "rad/s"),
    ):
        if size > most:
            reasons.append(
                f"{what} {size:.3g} {unit}, at rest at most {most:g} {unit} are expected"
            )
    if abs(size_f - g) > largest_g_error:
        reasons.append(
            f"the mean specific force is {size_f:.4g} m/s^2, {g:.4g} m/s^2 within "
            f"{largest_g_error:g} m/s^2 are expected{_hint_of_g(size_f)}"
        )
    return StaticCheck(not reasons, tuple(reasons), mean_omega, mean_f, sigma_omega, sigma_f)


def level(
    f_b: ArrayLike,
    sigma_f: ArrayLike | float,
    heading_rad: ArrayLike | float = 0.0,
    heading_sigma_rad: ArrayLike | float = UNKNOWN_HEADING_RAD,
) -> Alignment:
    """Roll and pitch from the mean specific force at rest; the heading is given.

    ``roll = atan2(-f_y, -f_z)`` and ``pitch = atan2(f_x, hypot(f_y, f_z))`` (Groves 2013, section
    5.6).

    Args:
        f_b: (..., 3) mean specific force [m/s^2].
        sigma_f: one sigma of that mean, bias included; of each body axis or of all [m/s^2].
        heading_rad: (...) heading of the nose, clockwise from north.
        heading_sigma_rad: (...) its sigma.

    Raises:
        ValueError: a vector or a sigma that is not finite, a sigma below zero; free fall; the nose
            straight up or down, where it has no heading.
    """
    f = _specific_force(f_b)
    _refuse_bad_sigmas(sigma_f=sigma_f, heading_sigma_rad=heading_sigma_rad)
    heading, heading_sigma = np.asarray(heading_rad, float), np.asarray(heading_sigma_rad, float)
    across = np.hypot(f[..., 1], f[..., 2])
    pitch = np.arctan2(f[..., 0], across)
    if np.any(np.abs(np.cos(pitch)) < 1e-3):
        raise ValueError(
            "the nose points straight up or down, where it has no heading: use gyrocompass, or "
            "mount the unit another way"
        )
    q_nb = from_euler(np.arctan2(-f[..., 1], -f[..., 2]), pitch, heading)
    C_nb = to_dcm(q_nb)
    heading, heading_sigma = (np.broadcast_to(x, pitch.shape) for x in (heading, heading_sigma))

    # phi_D due to a tilt at fixed heading: phi_D = d(heading) - tan(pitch) d, with d the tilt
    # along the nose.
    force = _tilt_of_force(f, C_nb)
    force[..., 2, :] = -np.tan(pitch)[..., None] * (
        np.cos(heading)[..., None] * force[..., 0, :]
        + np.sin(heading)[..., None] * force[..., 1, :]
    )
    covariance = _spread(force, sigma_f)
    covariance[..., 2, 2] += heading_sigma**2
    return Alignment(Rotation(jnp.asarray(q_nb)), covariance, "level")


def _refuse_poor_heading(
    lat: np.ndarray, horizontal: np.ndarray | float, sigma_omega: float
) -> None:
    predicted = sigma_omega / horizontal
    if np.any(predicted > _LARGEST_HEADING_SIGMA_RAD):
        raise ValueError(
            f"the Earth turns by {np.min(horizontal) / _DEG_H:.3g} deg/h about north at latitude "
            f"{np.rad2deg(lat)} deg and the gyros are good to {sigma_omega / _DEG_H:.3g} deg/h: "
            f"a heading sigma of {np.rad2deg(np.max(predicted)):.3g} deg is too large; take the "
            "heading from elsewhere and use level, or average for longer"
        )


def gyrocompass(
    omega_ib_b: ArrayLike,
    f_b: ArrayLike,
    lat_rad: ArrayLike | float,
    sigma_omega: ArrayLike | float,
    sigma_f: ArrayLike | float,
    alt_m: ArrayLike | float = 0.0,
) -> Alignment:
    """Attitude at rest from gravity and the rotation of the Earth.

    The two vectors are known in both frames, which fixes the attitude (TRIAD; Black 1964); gravity
    determines roll and pitch, the Earth's rotation the heading only.

    Args:
        omega_ib_b: (..., 3) mean rates [rad/s].
        f_b: (..., 3) mean specific force [m/s^2].
        lat_rad: (...) geodetic latitude.
        sigma_omega: one sigma of the mean rates, bias included; of each body axis or of all.
        sigma_f: one sigma of the mean specific force, likewise.
        alt_m: (...) height above the ellipsoid.

    Raises:
        ValueError: a vector or a sigma that is not finite, a sigma below zero; free fall; specific
            force that is not gravity; rates that are not the Earth's; a heading sigma above 0.3
            rad, due to a high latitude or poor gyros.
    """
    f, omega, lat = _specific_force(f_b), np.asarray(omega_ib_b, float), np.asarray(lat_rad, float)
    _refuse_bad_vectors("omega_ib_b", omega)
    _refuse_bad_sigmas(sigma_f=sigma_f, sigma_omega=sigma_omega)
    g = np.asarray(gravity(lat, np.asarray(alt_m, float)))
    size = np.linalg.norm(f, axis=-1)
    sigma_of_f, sigma_of_omega = (np.max(np.asarray(x, float)) for x in (sigma_f, sigma_omega))
    if np.any(np.abs(size - g) > 0.02 * g + 5.0 * sigma_of_f):
        raise ValueError(
            f"the mean specific force is {size} m/s^2 where gravity is {g} m/s^2: the vehicle "
            "accelerates, or the unit is not m/s^2"
        )
    horizontal = OMEGA_E * np.cos(lat)
    _refuse_poor_heading(lat, horizontal, sigma_of_omega)
    down = -f / size[..., None]
    vertical = np.sum(omega * down, -1)
    east = np.cross(down, omega)
    level_rate = np.linalg.norm(east, axis=-1)
    # Gyro errors, and the tilt's share of the Earth rate.
    allowed = 5.0 * np.hypot(sigma_of_omega, OMEGA_E * sigma_of_f / g) + 1e-9 * OMEGA_E
    wrong = np.maximum(np.abs(vertical + OMEGA_E * np.sin(lat)), np.abs(level_rate - horizontal))
    if np.any(wrong > allowed):
        raise ValueError(
            f"the mean rates differ from those of the Earth by {np.max(wrong) / _DEG_H:.3g} deg/h, "
            f"at most {np.max(allowed) / _DEG_H:.3g} deg/h are expected of these gyros: the "
            "vehicle turns, or the bias, the unit of the rates or the latitude is wrong"
        )

    C_nb = triad(f, omega)
    force = _tilt_of_force(f, C_nb)
    force[..., 2, :] = -np.tan(lat)[..., None] * force[..., 0, :]
    rate = np.zeros_like(force)
    rate[..., 2, :] = C_nb[..., 1, :] / horizontal[..., None]
    covariance = _spread(force, sigma_f) + _spread(rate, sigma_omega)
    return Alignment(Rotation.from_dcm(C_nb), covariance, "gyrocompass")


def triad(f_b: ArrayLike, north_b: ArrayLike) -> np.ndarray:
    """C_nb (..., 3, 3) for which specific force points up and another vector north (Black 1964).

    Gravity determines roll and pitch, the other vector the heading only: it may dip.

    Args:
        f_b: (..., 3) specific force at rest, of any length above zero.
        north_b: (..., 3) the Earth's rotation or its magnetic field, not along the vertical.
    """
    f = np.asarray(f_b, float)
    down = -f / np.linalg.norm(f, axis=-1)[..., None]
    east = np.cross(down, np.asarray(north_b, float))
    east = east / np.linalg.norm(east, axis=-1)[..., None]
    return np.stack([np.cross(east, down), east, down], axis=-2)


def heading_from_velocity(
    v_n: ArrayLike,
    sigma_v: ArrayLike | float,
    *,
    smallest_speed: float = 2.0,
    sideslip_sigma_rad: float = 0.0,
) -> tuple[float, float]:
    """Heading and its sigma [rad] from GNSS velocities of a vehicle that moves straight ahead.

    The course over ground is taken as heading: the vehicle must move forwards, without turning (so
    the lever arm of the antenna does not matter), and its sideslip, or drift in wind or current,
    has the sigma ``sideslip_sigma_rad``.

    Args:
        v_n: (3,) or (m, 3) velocities [m/s] on a straight line, NaN where missing.
        sigma_v: their sigmas, of each axis and fix, of each axis, or of all.
        smallest_speed: over ground [m/s], below which the direction is not trusted.
        sideslip_sigma_rad: sigma of the angle between nose and motion.

    Raises:
        ValueError: no velocity; too slow; the directions differ by more than their sigmas explain.
    """
    v = np.atleast_2d(np.asarray(v_n, float))
    if v.ndim != 2 or v.shape[1] != 3:
        raise ValueError(f"v_n must have shape (3,) or (m, 3), got {np.shape(v_n)}")
    sigma = np.broadcast_to(np.asarray(sigma_v, float), v.shape)
    there = np.all(np.isfinite(v[:, :2]), axis=1)
    v, sigma = v[there], sigma[there]
    require(len(v) != 0, "v_n holds no velocity, only missing values")
    speed = np.hypot(v[:, 0], v[:, 1])
    if np.min(speed) < smallest_speed:
        raise ValueError(
            f"the vehicle moves at {np.min(speed):.3g} m/s; below {smallest_speed:g} m/s the "
            "direction of motion does not tell the heading: drive faster"
        )
    # Sums of velocities, not of their directions: those are biased where the sigmas of north and
    # east differ, and the bias would not average out.
    first = np.arctan2(*v[:, 1::-1].sum(0))
    across = np.hypot(sigma[:, 0] * np.sin(first), sigma[:, 1] * np.cos(first))
    require(np.all(sigma >= 0.0) and np.all(across > 0.0), "sigma_v must be positive", sigma_v)
    weight = across**-2
    north, east = weight @ v[:, :2]
    heading = float(np.arctan2(east, north))
    off = np.arctan2(
        v[:, 1] * np.cos(heading) - v[:, 0] * np.sin(heading),
        v[:, 0] * np.cos(heading) + v[:, 1] * np.sin(heading),
    )
    if np.any(np.abs(off) > 5.0 * np.hypot(across / speed, sideslip_sigma_rad)):
        raise ValueError(
            f"the directions of motion differ by {np.rad2deg(np.ptp(off)):.3g} deg, more than "
            "their sigmas explain: the vehicle turns; use a straight piece"
        )
    sigma_of_mean = np.sqrt(np.sum(weight)) / np.hypot(north, east)
    return heading, float(np.hypot(sigma_of_mean, sideslip_sigma_rad))


def align(
    omega_ib_b: ArrayLike,
    f_b: ArrayLike,
    dt_s: float,
    lat_rad: float,
    model: ImuErrorModel,
    alt_m: float = 0.0,
    **thresholds: float,
) -> Alignment:
    """Attitude from a record at rest: gyrocompassing if the gyros allow it, else levelling.

    Args:
        omega_ib_b: (n, 3) gyro rates [rad/s].
        f_b: (n, 3) specific forces [m/s^2].
        dt_s: sampling interval [s].
        lat_rad: geodetic latitude.
        model: errors of the unit, from which the sigmas follow.
        alt_m: height above the ellipsoid.
        thresholds: of `is_static`; if not given, as there, or five sigmas of the model if more.

    Raises:
        ValueError: the vehicle moved, or what `level` and `gyrocompass` refuse.
    """
    omega, f = np.asarray(omega_ib_b, float), np.asarray(f_b, float)
    for name, rows in (("omega_ib_b", omega), ("f_b", f)):
        require(rows.ndim == 2, f"{name} must have shape (n, 3), got {rows.shape}")
    sigma_omega, sigma_f = static_sigmas(model, dt_s * len(f), f.mean(0), omega.mean(0))
    limits = {
        "g": float(gravity(lat_rad, alt_m)),
        "largest_omega": max(0.06, 5.0 * np.max(sigma_omega)),
        "largest_g_error": max(0.3, 5.0 * np.max(sigma_f)),
    }
    check = is_static(omega, f, **(limits | thresholds))
    require(check.static, f"not at rest: {'; '.join(check.reasons)}")
    if np.max(sigma_omega) <= _LARGEST_HEADING_SIGMA_RAD * OMEGA_E * np.cos(lat_rad):
        return gyrocompass(check.omega_ib_b, check.f_b, lat_rad, sigma_omega, sigma_f, alt_m)
    return level(check.f_b, sigma_f)


def static_sigmas(
    model: ImuErrorModel, duration_s: float, f_b: ArrayLike, omega_ib_b: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """One sigma (3,) of the mean rates and of the mean specific force at rest, from all errors.

    These are the `mean_sigma` of each triad, scale factors and misalignments times the measured
    vector, and the g-sensitivity of the gyros.
    """
    f, omega = np.asarray(f_b, float), np.asarray(omega_ib_b, float)
    out = []
    for errors, signal in ((model.gyro, omega), (model.accel, f)):
        variance = mean_sigma(errors, duration_s) ** 2 + (errors.size("scale_sigma") * signal) ** 2
        variance = variance + errors.size("misalignment_sigma") ** 2 @ signal**2
        out.append(np.sqrt(variance + errors.size("g_sensitivity_sigma") ** 2 @ f**2))
    return out[0], out[1]


def _specific_force(f_b: ArrayLike) -> np.ndarray:
    f = np.asarray(f_b, float)
    _refuse_bad_vectors("f_b", f)
    size = np.linalg.norm(f, axis=-1)
    if np.any(size < 0.5 * 9.80665):
        raise ValueError(
            f"the mean specific force is {size} m/s^2: without a reaction to gravity (free fall) "
            f"there is no level{_hint_of_g(size)}"
        )
    return f


def _hint_of_g(size: ArrayLike) -> str:
    near_one = np.abs(np.asarray(size, float) - 1.0) < 0.1
    return "; are the values in g?" if np.all(near_one) else ""


def _refuse_bad_vectors(name: str, x: np.ndarray) -> None:
    require(x.shape[-1:] == (3,), f"{name} must have three components, got shape {x.shape}")
    require(np.all(np.isfinite(x)), f"{name} must be finite", x)


def _refuse_bad_sigmas(**sigmas: ArrayLike | float) -> None:
    for name, given in sigmas.items():
        sigma = np.asarray(given, float)
        sound = np.all((sigma >= 0.0) & np.isfinite(sigma))
        require(sound, f"{name} must be finite, and zero or more", given)


def _tilt_of_force(f: np.ndarray, C_nb: np.ndarray) -> np.ndarray:
    """Sensitivity of phi to an error of each component of f_b (..., 3, 3); zero for phi_D."""
    g = np.linalg.norm(f, axis=-1)[..., None]
    return np.stack([C_nb[..., 1, :] / g, -C_nb[..., 0, :] / g, np.zeros_like(f)], axis=-2)


def _spread(jacobian: np.ndarray, sigma: ArrayLike | float) -> np.ndarray:
    """Covariance of phi from independent errors of the body axes."""
    scaled = jacobian * np.broadcast_to(np.asarray(sigma, float), (3,))
    return scaled @ np.swapaxes(scaled, -1, -2)
