"""Navigate a recorded log: align, filter, smooth, and see how far it is from the fixes.

Two rates: every IMU sample is mechanised, the covariance moves once a block. The fixes that a
simulated outage withholds, and all others of the best quality, are the reference.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from robins.ins.state import InsState

from robins.dataset import Dataset, GnssTable
from robins.earth import Geodetic
from robins.filters import Belief, Solution, rts_smoother, run
from robins.ins.blocks import Blocks, cut, epochs_between
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, from_imu
from robins.rotation import Rotation
from robins.systems.ins_gnss import model as names
from robins.systems.ins_gnss.model import Block, Fix, Mount, antenna_velocity
from robins.systems.ins_gnss.outages import outage_mask
from robins.systems.ins_gnss.parameters import Replay
from robins.systems.ins_gnss.setup import (
    SMOOTHED,
    belief_at,
    make_filter,
    model_of,
    sigma_of,
)
from robins.systems.ins_gnss.still import StartPoint, find_start, standstill


class Prepared(NamedTuple):
    """A log made ready for the filter."""

    origin_ns: int  # time zero
    start: StartPoint
    belief: Belief
    blocks: Blocks
    u: Block
    y: dict[str, Any]
    aux: dict[str, Any]
    gnss_s: np.ndarray  # (M,) all fixes
    gnss: GnssTable
    fix_epoch: np.ndarray  # (M,) epoch of each fix, -1 outside
    withheld: np.ndarray  # (M,) bool
    withheld_epoch: np.ndarray  # (E,) bool


def fix_sigmas(gnss: GnssTable, parameters: Replay) -> tuple[np.ndarray, np.ndarray | None]:
    """Sigmas the filter believes: those stated, times the factor of their quality."""
    g = parameters.gnss
    factor = np.ones(len(gnss))
    if gnss.quality is not None:
        for quality, value in g.sigma_factor.items():
            factor[gnss.quality == int(quality)] = value
    position = np.maximum(gnss.sigma_m * factor[:, None], g.least_sigma)
    if gnss.sigma_v is None:
        return position, None
    return position, np.maximum(gnss.sigma_v * factor[:, None], g.least_velocity_sigma)


def _mean_rate(increments: Increments, time_s: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Gyro rate about a time: mean of the increments that end within 20 ms around it."""
    dt, theta = increments.dt, increments.theta
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(theta, axis=0)])
    length = np.concatenate([[0.0], np.cumsum(dt)])
    half = max(0.01, 1.5 * float(np.median(dt)))
    a = np.searchsorted(time_s, at_s - half)
    b = np.maximum(np.searchsorted(time_s, at_s + half), a + 1)
    b = np.minimum(b, len(dt))
    a = np.minimum(a, b - 1)
    return (total[b] - total[a]) / (length[b] - length[a])[:, None]


def _at_epochs(values: np.ndarray, epoch: np.ndarray, count: int, fill: float) -> np.ndarray:
    out = np.full((count, *values.shape[1:]), fill)
    out[epoch] = values
    return out


def prepare(dataset: Dataset, parameters: Replay) -> Prepared:
    """Align, place the epochs and sort the measurements to them.

    Raises:
        ValueError: there is no GNSS, the files do not overlap, or no start can be found.
    """
    if dataset.gnss is None or len(dataset.gnss) == 0:
        raise ValueError("a replay of INS/GNSS needs GNSS fixes; this log has none")
    imu = to_ned_frd(dataset.imu)
    gnss = to_ned_frd(dataset.gnss)
    increments, time_ns = from_imu(imu)
    increments = Increments(*(np.asarray(a, dtype=float) for a in increments[:3]))
    samples = increments[:3]
    origin = int(time_ns[0] - round(1e9 * float(increments.dt[0])))
    time_s = (time_ns - origin) * 1e-9
    gnss_s = (gnss.time_ns - origin) * 1e-9
    velocity = gnss.v_n if parameters.gnss.use_velocity else None

    inside = (gnss_s > time_s[0]) & (gnss_s <= time_s[-1]) & np.isfinite(gnss.lat_rad)
    if not np.any(inside):
        raise ValueError(
            f"no GNSS fix lies within the IMU log: the IMU spans 0 to {time_s[-1]:.1f} s, the "
            f"fixes {gnss_s[0]:.1f} to {gnss_s[-1]:.1f} s; do both use the same time scale?"
        )
    any_fix = np.flatnonzero(inside)[0]
    lat, alt = float(gnss.lat_rad[any_fix]), float(gnss.alt_m[any_fix])
    start = find_start(
        time_s, *samples, gnss_s, gnss.v_n, lat, alt, parameters.start, parameters.aids
    )
    # the first fix at or after the start places the filter
    begin = np.flatnonzero(inside & (gnss_s >= start.time_s - 1e-6))
    if len(begin) == 0:
        raise ValueError(f"no GNSS fix after the start at {start.time_s:.1f} s")
    first = int(begin[0])
    start = start._replace(time_s=float(gnss_s[first]))

    lever = np.asarray(parameters.gnss.lever_arm)
    q = Rotation(jnp.asarray(start.q_nb))
    v_start = np.zeros(3) if velocity is None else np.nan_to_num(velocity[first])
    antenna = Geodetic(
        jnp.asarray(gnss.lat_rad[first]),
        jnp.asarray(gnss.lon_rad[first]),
        jnp.asarray(gnss.alt_m[first]),
    )
    position = antenna.retract(-q.apply(lever) + v_start * parameters.gnss.latency)
    sigma = sigma_of(
        parameters.imu, parameters.start, start.tilt_sigma_rad, start.heading_sigma_rad
    )
    belief = belief_at(start.q_nb, v_start, position, sigma, parameters.imu, start.gyro_bias)

    used = (gnss_s > start.time_s) & (gnss_s <= time_s[-1])
    epochs = epochs_between(
        start.time_s, float(time_s[-1]), gnss_s[used], parameters.update.longest_block
    )
    blocks = cut(increments, time_s, start.time_s, epochs)
    count = len(epochs)
    fix_epoch = np.full(len(gnss), -1)
    fix_epoch[used] = np.searchsorted(epochs, gnss_s[used] - 1e-9)

    withheld = np.zeros(len(gnss), dtype=bool)
    withheld_epoch = np.zeros(count, dtype=bool)
    if parameters.outages is not None:
        span = (float(gnss_s[0]), float(gnss_s[-1]), parameters.outages)
        withheld, withheld_epoch = outage_mask(gnss_s, *span), outage_mask(epochs, *span)

    sigma_p, sigma_v = fix_sigmas(gnss, parameters)
    rate = _mean_rate(increments, time_s, epochs)
    given = used & ~withheld
    at = fix_epoch[given]
    y: dict[str, Any] = {
        names.POSITION: Geodetic(
            *(
                _at_epochs(v[given], at, count, np.nan)
                for v in (gnss.lat_rad, gnss.lon_rad, gnss.alt_m)
            )
        )
    }
    aux: dict[str, Any] = {names.POSITION: Fix(_at_epochs(sigma_p[given], at, count, 1.0), rate)}
    if velocity is not None and sigma_v is not None:
        y[names.VELOCITY] = _at_epochs(velocity[given], at, count, np.nan)
        aux[names.VELOCITY] = Fix(_at_epochs(sigma_v[given], at, count, 1.0), rate)
    still, still_rate = standstill(*samples, parameters.aids)
    last = np.minimum(np.searchsorted(time_s, epochs - 1e-9), len(time_s) - 1)
    at_rest = (still[last] & parameters.aids.zero_velocity)[:, None]
    if parameters.aids.zero_velocity:
        y[names.STANDSTILL] = np.where(at_rest, 0.0, np.full((count, 3), np.nan))
        y[names.STILL_RATE] = np.where(at_rest, still_rate[last], np.nan)
    if parameters.aids.non_holonomic:
        y[names.ROAD] = np.where(at_rest, np.nan, np.zeros((count, 2)))
        aux[names.ROAD] = rate
    bridged = np.zeros(count, dtype=bool)
    long = np.asarray(increments.dt) > 5.0 * np.median(increments.dt)
    bridged = np.any(long[blocks.parent] & (blocks.parent >= 0), axis=1)
    u = Block(blocks.increments, np.where(bridged, parameters.update.gap_noise, 1.0))
    return Prepared(
        origin, start, belief, blocks, u, y, aux, gnss_s, gnss, fix_epoch, withheld, withheld_epoch
    )


class Navigated(NamedTuple):
    """One filter's answer."""

    belief: Belief  # leading axis E
    solution: Solution  # of the filter, also for its smoother
    antenna: Geodetic  # (E,) where the filter thinks the antenna is


def navigate(
    prepared: Prepared, parameters: Replay, wanted: tuple[str, ...]
) -> dict[str, Navigated]:
    """Run the filters, each once, and their smoothers."""
    model = model_of(parameters.imu, parameters.gnss, parameters.aids)
    mount = Mount(
        jnp.asarray(parameters.gnss.lever_arm),
        jnp.asarray(parameters.gnss.latency),
        jnp.asarray(parameters.aids.axle),
    )

    @jax.jit
    def antenna(mean: InsState, rate):
        def one(x, omega):
            arm = x.q_nb.apply(mount.lever_b)
            return x.position.retract(arm - antenna_velocity(x, mount, omega) * mount.latency_s)

        return jax.vmap(one)(mean, rate)

    rate = jnp.asarray(prepared.aux[names.POSITION].omega_b)
    solutions: dict[str, Solution] = {}
    out: dict[str, Navigated] = {}
    for name in wanted:
        base = name.removesuffix(SMOOTHED)
        if base not in solutions:
            solutions[base] = run(
                make_filter(base, parameters.update.gate),
                model,
                prepared.belief,
                prepared.y,
                prepared.u,
                prepared.aux,
            )
        solution = solutions[base]
        belief = rts_smoother(solution) if name.endswith(SMOOTHED) else solution.steps.posterior
        out[name] = Navigated(belief, solution, antenna(belief.mean, rate))
    return out
