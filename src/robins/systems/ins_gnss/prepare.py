"""A log made ready for the filter: one clock, an alignment, epochs, measurements sorted to them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.dataset import Dataset, GnssTable
from robins.earth import Geodetic
from robins.filters import Belief
from robins.ins.blocks import Blocks, cut, epochs_between
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, after_gap, from_imu
from robins.rotation import Rotation
from robins.systems.ins_gnss import model as names
from robins.systems.ins_gnss.model import Block, Fix, Velocity
from robins.systems.ins_gnss.outages import outage_mask
from robins.systems.ins_gnss.parameters import Replay
from robins.systems.ins_gnss.setup import belief_at, sigma_of
from robins.systems.ins_gnss.still import StartPoint, find_start, standstill


class Log(NamedTuple):
    """A whole log, NED/FRD, in seconds since its first IMU sample."""

    increments: Increments  # dt (N,), theta (N, 3), dv (N, 3)
    time_s: np.ndarray  # (N,) end of each increment
    gnss: GnssTable
    gnss_s: np.ndarray  # (M,)
    sigma_m: np.ndarray  # (M, 3) believed by the filter
    v_n: np.ndarray | None  # (M, 3), None where velocities are not used
    sigma_v: np.ndarray | None
    withheld: np.ndarray  # (M,) bool


class Prepared(NamedTuple):
    """A piece of a log, ready to be navigated; E epochs."""

    start: StartPoint
    belief: Belief
    blocks: Blocks
    u: Block
    y: dict[str, Any]
    aux: dict[str, Any]
    rate_b: np.ndarray  # (E, 3) rad/s mean raw gyro rate about each epoch
    fix_epoch: np.ndarray  # (M,) epoch of each fix of the log, -1 outside the piece
    withheld: np.ndarray  # (E,) bool


def on_one_clock(dataset: Dataset, parameters: Replay) -> Log:
    """Both tables on the IMU's clock, sigmas as the filter shall believe them.

    Raises:
        ValueError: there is no GNSS, or no fix lies within the IMU's time.
    """
    if dataset.gnss is None or len(dataset.gnss) == 0:
        raise ValueError("a replay of INS/GNSS needs GNSS fixes; this log has none")
    gnss, g = to_ned_frd(dataset.gnss), parameters.gnss
    increments, end_ns = from_imu(dataset.imu)
    origin = int(dataset.imu.time_ns[0])
    time_s, gnss_s = (end_ns - origin) * 1e-9, (gnss.time_ns - origin) * 1e-9
    if not np.any((gnss_s > 0.0) & (gnss_s <= time_s[-1])):
        raise ValueError(
            f"no GNSS fix lies within the IMU log: the IMU spans 0 to {time_s[-1]:.1f} s, the "
            f"fixes {gnss_s[0]:.1f} to {gnss_s[-1]:.1f} s; do both use the same time scale?"
        )
    factor = np.ones(len(gnss))
    if gnss.quality is not None:
        for quality, value in g.sigma_factor.items():
            factor[gnss.quality == int(quality)] = value
    v_n, sigma_v = (gnss.v_n, gnss.sigma_v) if g.use_velocity else (None, None)
    if sigma_v is not None:
        sigma_v = np.maximum(sigma_v * factor[:, None], g.least_velocity_sigma)
    withheld = np.zeros(len(gnss), dtype=bool)
    if parameters.outages is not None:
        withheld = outage_mask(gnss_s, gnss_s[0], gnss_s[-1], parameters.outages)
    return Log(
        Increments(*(np.asarray(a, dtype=float) for a in increments[:3])),
        time_s,
        gnss,
        gnss_s,
        np.maximum(gnss.sigma_m * factor[:, None], g.least_sigma),
        v_n if sigma_v is not None else None,
        sigma_v,
        withheld,
    )


def pieces(log: Log, longest_gap_s: float) -> list[slice]:
    """Runs of increments without a gap too long to bridge; the increment across it is in none."""
    broken = np.flatnonzero(log.increments.dt > longest_gap_s)
    edges = [-1, *broken.tolist(), len(log.time_s)]
    found = [slice(a + 1, b) for a, b in pairwise(edges)]
    return [s for s in found if s.stop > s.start]


def prepare(log: Log, piece: slice, parameters: Replay) -> Prepared:
    """Align on a piece of a log, place the epochs and sort the measurements to them.

    Raises:
        ValueError: no start can be found, or no fix lies in the piece.
    """
    increments = Increments(*(a[piece] for a in log.increments[:3]))
    time_s = log.time_s[piece]
    begin_s, end_s = float(time_s[0] - increments.dt[0]), float(time_s[-1])
    whole = np.isfinite(log.gnss.lat_rad) & np.isfinite(log.gnss.lon_rad)
    whole &= np.isfinite(log.gnss.alt_m) & (log.gnss_s > begin_s) & (log.gnss_s <= end_s)
    if not np.any(whole):
        raise ValueError(f"no whole GNSS fix between {begin_s:.1f} and {end_s:.1f} s")
    start, first = _start(log, increments, time_s, whole, parameters)
    used = (log.gnss_s > start.time_s) & (log.gnss_s <= end_s)
    if not np.any(used):
        raise ValueError(f"no GNSS fix after the start at {start.time_s:.1f} s")

    epochs = epochs_between(start.time_s, end_s, log.gnss_s[used], parameters.update.longest_block)
    blocks = cut(increments, time_s, start.time_s, epochs)
    fix_epoch = np.full(len(log.gnss), -1)
    fix_epoch[used] = np.searchsorted(epochs, log.gnss_s[used] - 1e-9)
    rate = _mean_rate(increments, time_s, epochs)
    y, aux = _fixes(log, fix_epoch, rate)
    if names.VELOCITY in y:
        gained = gained_in_window(increments, time_s, epochs, parameters.gnss.velocity_window)
        aux[names.VELOCITY] = Velocity(aux[names.VELOCITY].sigma, rate, *gained)
    _knowledge(y, aux, increments, time_s, epochs, rate, parameters)

    gap = after_gap(increments.dt)
    bridged = np.any(gap[blocks.parent] & (blocks.parent >= 0), axis=1)
    withheld = np.zeros(len(epochs), dtype=bool)
    if parameters.outages is not None:
        withheld = outage_mask(epochs, log.gnss_s[0], log.gnss_s[-1], parameters.outages)
    return Prepared(
        start=start,
        belief=_belief(log, first, start, parameters),
        blocks=blocks,
        u=Block(blocks.increments, np.where(bridged, parameters.update.gap_noise, 1.0)),
        y=y,
        aux=aux,
        rate_b=rate,
        fix_epoch=fix_epoch,
        withheld=withheld,
    )


def _start(
    log: Log, increments: Increments, time_s: np.ndarray, whole: np.ndarray, parameters: Replay
) -> tuple[StartPoint, int]:
    """Where the filter begins: at the first whole fix once the attitude is known."""
    some = int(np.flatnonzero(whole)[0])
    lat, alt = float(log.gnss.lat_rad[some]), float(log.gnss.alt_m[some])
    start = find_start(
        time_s,
        *increments[:3],
        log.gnss_s,
        log.gnss.v_n,
        lat,
        alt,
        parameters.start,
        parameters.aids,
    )
    later = np.flatnonzero(whole & (log.gnss_s >= start.time_s - 1e-6))
    if len(later) == 0:
        raise ValueError(f"no whole GNSS fix after the attitude is known, at {start.time_s:.1f} s")
    first = int(later[0])
    return start._replace(time_s=float(log.gnss_s[first])), first


def _belief(log: Log, first: int, start: StartPoint, parameters: Replay) -> Belief:
    """At the first fix, moved from the antenna to the IMU."""
    v = np.zeros(3) if log.v_n is None else np.nan_to_num(log.v_n[first])
    g = log.gnss
    antenna = Geodetic(*map(jnp.asarray, (g.lat_rad[first], g.lon_rad[first], g.alt_m[first])))
    arm = Rotation(jnp.asarray(start.q_nb)).apply(np.asarray(parameters.gnss.lever_arm))
    position = antenna.retract(-arm + jnp.asarray(v * parameters.gnss.latency))
    sigma = sigma_of(
        parameters.imu, parameters.start, start.tilt_sigma_rad, start.heading_sigma_rad
    )
    return belief_at(start.q_nb, v, position, sigma, parameters.imu, start.gyro_bias)


def _mean_rate(increments: Increments, time_s: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Gyro rate about a time: mean over the increments that end within 10 ms of it."""
    dt, theta = increments.dt, increments.theta
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(theta, axis=0)])
    length = np.concatenate([[0.0], np.cumsum(dt)])
    half = max(0.01, 1.5 * float(np.median(dt)))
    a = np.searchsorted(time_s, at_s - half)
    b = np.minimum(np.maximum(np.searchsorted(time_s, at_s + half), a + 1), len(dt))
    a = np.minimum(a, b - 1)
    return (total[b] - total[a]) / (length[b] - length[a])[:, None]


def gained_in_window(
    increments: Increments, time_s: np.ndarray, at_s: np.ndarray, window_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """How much velocity was gained from the average instant of a window to its end.

    The mean over the window (t - T, t] of v(t) - v(s) is the integral of the specific force with a
    weight that grows from 0 at t - T to 1 at t, seen in the body axes at t.

    Args:
        increments: dt (N,), theta (N, 3), dv (N, 3).
        time_s: (N,) end of each.
        at_s: (E,) ends of the windows.
        window_s: length T; 0 for none.

    Returns:
        (E, 3) m/s, gravity not taken out, and (E,) the integral of the weight, T/2 where the
        samples cover the window.
    """
    gained, age = np.zeros((len(at_s), 3)), np.zeros(len(at_s))
    if window_s <= 0.0:
        return gained, age
    sample = np.searchsorted(time_s, at_s - 1e-9)
    turned = SciRotation.identity(len(at_s))  # from the axes of the sample to those at t
    while True:
        inside = sample >= 0
        k = np.clip(sample, 0, len(time_s) - 1)
        end = np.minimum(time_s[k], at_s)
        begin = np.maximum(time_s[k] - increments.dt[k], at_s - window_s)
        length = np.where(inside, np.maximum(end - begin, 0.0), 0.0)
        if not np.any(length > 0.0):
            return gained, age
        share = length / increments.dt[k]
        weight = 1.0 - (at_s - 0.5 * (begin + end)) / window_s
        # dv is in the axes at the start of its interval, so the turn over the interval comes first
        turned = turned * SciRotation.from_rotvec(-share[:, None] * increments.theta[k])
        gained += (weight * share)[:, None] * turned.apply(increments.dv[k])
        age += weight * length
        sample = sample - 1


def _at_epochs(values: np.ndarray, epoch: np.ndarray, count: int, fill: float) -> np.ndarray:
    out = np.full((count, *values.shape[1:]), fill)
    out[epoch] = values
    return out


def _fixes(log: Log, fix_epoch: np.ndarray, rate: np.ndarray) -> tuple[dict, dict]:
    """GNSS measurements by epoch; NaN where there is no fix or it is withheld."""
    given = (fix_epoch >= 0) & ~log.withheld
    at, count, g = fix_epoch[given], len(rate), log.gnss

    def sorted_in(values, fill=np.nan):
        return _at_epochs(values[given], at, count, fill)

    y: dict[str, Any] = {
        names.POSITION: Geodetic(sorted_in(g.lat_rad), sorted_in(g.lon_rad), sorted_in(g.alt_m))
    }
    aux: dict[str, Any] = {names.POSITION: Fix(sorted_in(log.sigma_m, 1.0), rate)}
    if log.v_n is not None and log.sigma_v is not None:
        y[names.VELOCITY] = sorted_in(log.v_n)
        aux[names.VELOCITY] = Fix(sorted_in(log.sigma_v, 1.0), rate)
    return y, aux


def _knowledge(y, aux, increments, time_s, epochs, rate, parameters: Replay) -> None:
    """What is known without a receiver: standing still, or not slipping sideways."""
    aids = parameters.aids
    if not (aids.zero_velocity or aids.non_holonomic):
        return
    still, mean_rate = standstill(increments.dt, increments.theta, increments.dv, aids)
    last = np.minimum(np.searchsorted(time_s, epochs - 1e-9), len(time_s) - 1)
    at_rest = still[last][:, None]
    if aids.zero_velocity:
        y[names.STANDSTILL] = np.where(at_rest, 0.0, np.full((len(epochs), 3), np.nan))
        y[names.STILL_RATE] = np.where(at_rest, mean_rate[last], np.nan)
    if aids.non_holonomic:
        y[names.ROAD] = np.where(at_rest, np.nan, np.zeros((len(epochs), 2)))
        aux[names.ROAD] = rate
