"""Initial belief of the filter: levelling, north from the field, gyro bias from rest."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.filters import Belief
from robins.ins.alignment import triad
from robins.ins.increments import Increments
from robins.program.evaluated import evaluated
from robins.rotation import Rotation
from robins.systems.marg import model
from robins.systems.marg.parameters import MargReplay
from robins.systems.marg.rest import RestDetector

# limits for rest over the first samples
_STILL_RATE = np.radians(8.0)  # rad/s, mean magnitude of the rate
_STILL_SPREAD = np.radians(1.0)  # rad/s, mean absolute deviation of the rate
_STILL_FORCE = 0.5  # m/s^2, standard deviation on an axis
_BIASES = 3.0  # sigmas of the bias; a larger error of gravity is one of scale
_SCALE = 0.1  # largest scale error, as a share of gravity


class FilterStart(NamedTuple):
    """Initial attitude, field and gravity, with sigmas of tilt and heading [rad]."""

    q_nb: np.ndarray  # (4,)
    field_t: np.ndarray  # (2,) T, horizontal and down; zeros without a field
    tilt_rad: float
    heading_rad: float
    gravity: float  # m/s^2, as read by the accelerometers
    still: bool
    sentence: str


def attitude_of(force_b: np.ndarray, field_b: np.ndarray | None) -> np.ndarray:
    """Attitude q_nb (4,) for which specific force points up and the horizontal field north.

    Without a field, or with a vertical one, the heading is arbitrary.
    """
    level = np.eye(3)[np.argmin(np.abs(force_b))]
    north = level if field_b is None else field_b
    across = np.linalg.norm(np.cross(force_b / np.linalg.norm(force_b), north))
    C_nb = triad(force_b, north if across > 1e-3 * np.linalg.norm(north) else level)
    return np.asarray(evaluated(Rotation.from_dcm, C_nb).wxyz)


def initial_alignment(
    increments: Increments, field_b: np.ndarray, parameters: MargReplay
) -> FilterStart:
    """Align on the first samples: a short while of rest, or a longer one of motion.

    Specific force and field are rotated by the gyros into the axes of the first sample, so that
    the accelerations of motion average out.

    Args:
        increments: dt (N,) s, theta (N, 3) rad, dv (N, 3) m/s.
        field_b: (N, 3) T, NaN where missing.
        parameters: of the start and of gravity.
    """
    dt, theta, dv = increments[:3]
    start, time = parameters.start, np.cumsum(dt)
    window = max(int(np.searchsorted(time, start.still, side="right")), 1)
    rate, force = theta[:window] / dt[:window, None], dv[:window] / dt[:window, None]
    still = bool(
        np.mean(np.linalg.norm(rate, axis=1)) < _STILL_RATE
        and np.mean(np.abs(rate - rate.mean(axis=0))) < _STILL_SPREAD
        and np.max(np.std(force, axis=0)) < _STILL_FORCE
    )
    if not still:
        window = max(int(np.searchsorted(time, start.moving, side="right")), 1)
    turned = _relative_attitudes(theta[:window])
    force = np.sum(turned[:-1].apply(dv[:window]), axis=0) / time[window - 1]
    there = np.all(np.isfinite(field_b[:window]), axis=1)
    tilt = start.tilt if still else start.tilt_moving
    size, how = float(np.linalg.norm(force)), f"over {float(time[window - 1]):.2g} s"
    if not 0.5 < size / parameters.accelerometer.gravity < 1.5:
        how += f"; the mean specific force is {size:.2f} m/s^2, so the tilt is hardly known"
        tilt = np.pi / 2.0
        force = force if size > 1e-3 else np.array([0.0, 0.0, -1.0])
    how = f"{'at rest' if still else 'in motion'}, {how}"
    gravity = parameters.accelerometer.gravity
    if still and _BIASES * parameters.accelerometer.bias < abs(size - gravity) < _SCALE * gravity:
        gravity = size  # no bias is so large: the accelerometers have another scale
        how += f", with a specific force of {size:.2f} m/s^2 that is taken for gravity"
    if not np.any(there):
        q_nb = attitude_of(force, None)
        sentence = f"Levelled {how}; there is no field, so the heading is counted from the start."
        return FilterStart(q_nb, np.zeros(2), tilt, np.pi, gravity, still, sentence)
    field = np.mean(turned[1:].apply(np.where(there[:, None], field_b[:window], 0.0)), axis=0)
    field = field * window / np.sum(there)
    q_nb = attitude_of(force, field)
    north, _, down = SciRotation.from_quat(np.roll(q_nb, -1)).apply(field)
    dip = np.degrees(np.arctan2(down, north))
    sentence = (
        f"Aligned {how}: the field there, {np.linalg.norm(field) * 1e6:.1f} uT at a dip of "
        f"{dip:.1f} deg, is north."
    )
    heading = start.heading if still else start.heading_moving
    return FilterStart(q_nb, np.array([north, down]), tilt, heading, gravity, still, sentence)


def turn_across(
    before: tuple[Increments, np.ndarray],
    bridge: np.ndarray,
    after: tuple[Increments, np.ndarray],
    parameters: MargReplay,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation over a gap, from gravity and the field on both sides of it.

    If a side has no field, gravity gives the tilt, and `bridge` the heading.

    Args:
        before: increments up to the gap, and field (N, 3) [T]; as in `initial_alignment`.
        bridge: (3,) rad, rotation interpolated from the rates at the ends of the gap.
        after: the same after the gap.
        parameters: of the start.

    Returns:
        Rotation vector (3,) [rad] and up direction (3,), both in body axes at the start of the gap,
        and sigma of the rotation [rad]; infinite if the heading is unknown.
    """
    first, last = (initial_alignment(*side, parameters) for side in (before, after))
    start, end = (SciRotation.from_quat(np.roll(one.q_nb, -1)) for one in (first, last))
    start = start * _relative_attitudes(before[0].theta)[-1]
    each = [max(one.tilt_rad, one.heading_rad) for one in (first, last)]
    spread = math.hypot(*each)
    if not (np.any(first.field_t) and np.any(last.field_t)):
        _, _, z, w = (start * SciRotation.from_rotvec(bridge) * end.inv()).as_quat()
        end = SciRotation.from_rotvec([0.0, 0.0, 2.0 * np.arctan2(z, w)]) * end
        spread = math.inf
    up_b = start.inv().apply([0.0, 0.0, -1.0])
    return (start.inv() * end).as_rotvec(), up_b, spread


def _relative_attitudes(theta: np.ndarray) -> SciRotation:
    """Attitude before each interval and after the last, relative to the first."""
    out = [SciRotation.identity()]
    for step in SciRotation.from_rotvec(theta):
        out.append(out[-1] * step)
    return SciRotation.concatenate(out)


def first_belief(
    look: FilterStart, parameters: MargReplay, rest: RestDetector | None = None
) -> Belief:
    """Initial belief at the first sample.

    Only heading, declination and the azimuth of the first site are correlated: if north is the mean
    of the field over all places, the declination at the start is an error of the heading.

    Args:
        look: alignment on the first samples.
        parameters: of the start and of the other states.
        rest: detector; if the samples begin with rest, their mean rate is the bias.
    """
    p = parameters
    bias, bias_sigma = jnp.zeros(3), p.gyro.bias
    if rest is not None and rest.first is not None:
        bias, bias_sigma = jnp.asarray(rest.first), rest.first_sigma
    mean = model.MargState(
        q_nb=Rotation(jnp.asarray(look.q_nb)),
        v_n=jnp.zeros(3),
        p_n=jnp.zeros(3),
        gyro_bias=bias,
        gyro_gain=jnp.zeros((3, 3)),
        accel_bias=jnp.zeros(3),
        declination=jnp.zeros(()),
        field=jnp.asarray(look.field_t),
        azimuths=jnp.zeros(model.SITES),
        gravity=jnp.asarray(look.gravity),
    )
    known = bool(np.any(look.field_t != 0.0))
    # if north is the field at the start, its declination is zero but for a small initial error
    bend = p.magnetometer.declination
    if not known or p.start.north == "start":
        bend = bend / (20.0 if look.still else 2.0)
    sigma = [
        [look.tilt_rad, look.tilt_rad, look.heading_rad],
        [p.rest.velocity * 10.0 if look.still else 2.0 * p.travel.velocity] * 3,
        [p.travel.place] * 3,
        [bias_sigma] * 3,
        [p.gyro.gain] * 9,
        [p.accelerometer.bias] * 3,
        [bend],
        [p.magnetometer.noise if known else p.magnetometer.most] * 2,
        [np.pi] * model.SITES,
        [0.0 if look.gravity == p.accelerometer.gravity else p.accelerometer.bias],
    ]
    factor = np.diag(np.concatenate([np.asarray(s, dtype=float) for s in sigma]))
    if known and p.start.north == "mean":
        heading = float(np.hypot(look.heading_rad, bend))
        factor[model.HEADING, model.HEADING] = heading
        factor[model.DECLINATION, model.HEADING] = bend**2 / heading
        factor[model.DECLINATION, model.DECLINATION] = bend * look.heading_rad / heading
    # the azimuth of the field at the first site is the initial declination
    factor[model.AZIMUTHS.start] = factor[model.DECLINATION]
    return Belief(mean, jnp.asarray(factor))
