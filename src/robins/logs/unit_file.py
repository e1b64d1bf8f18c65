"""Configuration of a replay from properties of a unit and its receiver found by the doctor.

The clock offset and the window of the velocities are found together: mean velocities over the last
epoch and late stamps have the same effect relative to the IMU, and only the positions separate
them. If they cannot, only the window is assumed, which is more common.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from robins import rotation
from robins.dataset import GnssTable, ImuTable
from robins.logs.checks_motion import in_body, small_offset
from robins.logs.gnss_motion import track_of, velocity_delay
from robins.logs.motion_fit import MotionFit
from robins.logs.motion_models import ModelChoice, judge
from robins.logs.quiet import ImuSignal, signal_of, windows_of

_STRAIGHT = 0.85  # least length of the mean direction of travel that defines forward
_LEAST = 20  # fewest directions of travel
_RIGHT_DEG = 10.0  # from right angles; smaller angles may be due to slopes, trim and biases
_RESTS = 5  # fewest pairs of seconds at rest to estimate noise
_LATE_S = 0.03
_MEDIAN = 0.4549  # median of the square of a unit normal variable


class UnitProperties(NamedTuple):
    """Properties found in a log; None if undetermined."""

    orientation_deg: tuple[float, float, float] | None = None  # roll, pitch, yaw of the mounting
    latency_s: float | None = None  # a fix stamped t is valid at t - latency
    velocity_window_s: float | None = None
    gyro_noise: tuple[float, float, float] | None = None  # rad/sqrt(s), vehicle's axes
    accel_noise: tuple[float, float, float] | None = None  # m/s/sqrt(s)
    left: tuple[float, float] | None = None  # unexplained shares, without and with the clock found
    lasting_share: float | None = None  # correlated share of position variance, as in a replay
    rounded_deg: float | None = None  # angle from the estimate to the right angles used instead


def find_unit(imu: ImuTable, gnss: GnssTable | None) -> UnitProperties:
    """Mounting, latency, velocity window and noise, as far as a log determines them.

    Args:
        imu: in sensor axes, labelled forward-right-down.
        gnss: of the same log.
    """
    signal, track = signal_of(imu), None if gnss is None else track_of(gnss)
    if signal is None:
        return UnitProperties()
    if gnss is None or track is None or track.v_n is None:
        return UnitProperties(**_noise(imu, None, None))
    epoch = float(np.median(np.diff(track.time_s)))
    verdict = judge(imu, gnss, signal, track)
    if verdict is None:
        return UnitProperties(**_noise(imu, gnss, None))
    late, lag = velocity_delay(track), small_offset(verdict)
    window = 2.0 * late if late is not None and late > _LATE_S else None
    if window is not None and abs(window - epoch) < 0.4 * epoch:
        window = epoch
    # If positions do not show the age of velocities, half an epoch is no clock offset.
    if late is None and lag is not None and 0.3 * epoch < -lag < 0.7 * epoch:
        window, lag = epoch, None
    orientation, rounded_deg, C_bs = _orientation(signal, verdict)
    left = None
    if window is not None or lag is not None:
        plain = verdict if late is None else judge(imu, gnss, signal, track, late_s=0.0)
        found = verdict.clocked if late is None or lag is not None else verdict.nothing
        left = None if plain is None else _lowered(plain, verdict, found)
        window, lag = (window, lag) if left else (None, None)
    return UnitProperties(
        orientation_deg=orientation,
        rounded_deg=rounded_deg,
        latency_s=None if lag is None else -lag,
        velocity_window_s=window,
        left=left,
        **_noise(imu, gnss, C_bs),
    )


def _lowered(
    plain: ModelChoice, verdict: ModelChoice, found: MotionFit
) -> tuple[float, float] | None:
    """Unexplained shares of the motion without and with the clock found.

    None if the share does not fall by more than its uncertainty, from the scatter of the stretches:
    only significant improvements are written.
    """
    before, after = plain.nothing.by_stretch(plain.views), found.by_stretch(verdict.views)
    if len(before) == len(after):
        gain = before - after
        sigma = np.std(gain) / np.sqrt(max(len(gain) - 1, 1))
    else:  # the shift moved a stretch beyond an end
        sigma = np.hypot(*(np.std(x) / np.sqrt(max(len(x) - 1, 1)) for x in (before, after)))
    if not np.mean(before) - np.mean(after) > sigma:
        return None
    return plain.nothing.left(plain.views), found.left(verdict.views)


def _orientation(
    signal: ImuSignal, verdict: ModelChoice
) -> tuple[tuple[float, float, float] | None, float | None, np.ndarray | None]:
    """Roll, pitch, yaw [deg] of the vehicle relative to the sensor, angle of rounding, and C_bs."""
    v_b = in_body(verdict)
    if len(v_b) < _LEAST:
        return None, None, None
    windows = windows_of(signal)
    down = -np.mean(windows.accel[windows.calm], axis=0)
    down /= np.linalg.norm(down)
    ahead = v_b / np.linalg.norm(v_b, axis=1, keepdims=True)
    if np.linalg.norm(np.mean(ahead, axis=0)) < _STRAIGHT:
        return None, None, None
    forward = np.mean(ahead, axis=0)
    forward -= down * (down @ forward)
    forward /= np.linalg.norm(forward)
    C_bs = np.stack([forward, np.cross(down, forward), down])
    whole = np.round(C_bs)
    turned = np.rad2deg(np.arccos(np.clip((np.trace(C_bs @ whole.T) - 1.0) / 2.0, -1.0, 1.0)))
    right = abs(np.linalg.det(whole) - 1.0) < 1e-9 and turned < _RIGHT_DEG
    C_bs = whole if right else C_bs
    angles = rotation.to_euler(rotation.from_dcm(C_bs.T))
    roll, pitch, yaw = (float(np.round(np.rad2deg(float(a)), 1)) + 0.0 for a in angles)
    return (roll, pitch, yaw), float(turned) if right else None, C_bs


def _noise(imu: ImuTable, gnss: GnssTable | None, C_bs: np.ndarray | None) -> dict:
    """Random walks from means over a second at rest: half the mean square of their differences.

    Estimated by the median, which is insensitive to the seconds in which the vehicle starts.
    """
    signal = signal_of(imu)
    if signal is None:
        return {}
    windows = windows_of(signal)
    begin_s = signal.time_s[windows.first]
    rest = windows.at_rest.copy()
    if gnss is not None and gnss.v_n is not None:
        fix_s = (gnss.time_ns - imu.time_ns[signal.rows[0]]) * 1e-9
        size = np.hypot(gnss.v_n[:, 0], gnss.v_n[:, 1])
        good = np.isfinite(size)
        rest &= np.interp(begin_s + 0.5, fix_s[good], size[good], left=np.inf, right=np.inf) < 0.2
    both = rest[1:] & rest[:-1]
    if np.sum(both) < _RESTS:
        return {}
    length = float(np.median(np.diff(begin_s)))
    out = {}
    for name, means in (("gyro_noise", windows.gyro), ("accel_noise", windows.accel)):
        means = means if C_bs is None else means @ C_bs.T
        squares = np.median(np.diff(means, axis=0)[both] ** 2, axis=0) / _MEDIAN
        spread = np.sqrt(0.5 * squares * length)
        out[name] = tuple(float(x) for x in spread)
    return out


def toml_of(
    found: UnitProperties, log: str, usual: Mapping[str, tuple[float, ...]] | None = None
) -> str:
    """Configuration of `robins replay` with the properties found; the rest is default.

    Args:
        found: by `find_unit`.
        log: name of the log, for the first line.
        usual: default noise of a replay, by name; a smaller value at rest becomes a comment, since
            in motion errors of scale and axes add to it.
    """
    lines = [f"# Found by `robins doctor` in {log}; what is not here is the default.", ""]
    if found.left is not None:
        before, after = found.left
        lines[1:1] = [f"# Motion left unexplained: {before:.1%} without it, {after:.1%} with it."]
    lines += ['system = "ins-gnss"', ""]
    unit, receiver = [], []
    if found.orientation_deg is not None:
        unit.append(f"orientation = {_list(found.orientation_deg, 'deg', '.1f')}")
    if found.rounded_deg is not None:
        unit.insert(0, f"# found {found.rounded_deg:.1f} deg from these, as slopes or trim explain")
    for name, symbol, factor in (
        ("gyro_noise", "deg/s/sqrt(Hz)", 180.0 / np.pi),
        ("accel_noise", "m/s^2/sqrt(Hz)", 1.0),
    ):
        noise = getattr(found, name)
        if noise is not None:
            small = np.max(noise) <= np.min((usual or {}).get(name, 0.0))
            values = _list(factor * np.array(noise), symbol, ".3g")
            unit.append(f"# {name} = {values} at rest" if small else f"{name} = {values}")
    if found.latency_s is not None:
        receiver.append(f'latency = "{found.latency_s:.3f} s"')
    if found.velocity_window_s is not None:
        receiver.append(f'velocity_window = "{found.velocity_window_s:.3g} s"')
    if found.lasting_share is not None:
        receiver.append(
            f"lasting_share = {found.lasting_share:.3g}  # of the variance of positions"
        )
    receiver.append('# lever_arm = ["0 m", "0 m", "0 m"]  # IMU to antenna; measure it')
    for name, rows in (("imu", unit), ("gnss", receiver)):
        lines += [f"[{name}]", *rows, ""] if rows else []
    return "\n".join(lines)


def _list(values, unit: str, form: str) -> str:
    return "[" + ", ".join(f'"{value:{form}} {unit}"' for value in values) + "]"
