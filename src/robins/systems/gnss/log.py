"""Recorded pseudoranges and odometry: arrangement by epoch, replay, comparison with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from robins.dataset import OdometryTable, PlaceTable, RangeLog, RangeTable
from robins.results import Outcome, Progress, ignore_progress
from robins.systems import replaying
from robins.systems.gnss.filters import SMOOTHERS, GnssWorld, contender
from robins.systems.gnss.model import (
    LENGTH,
    POSITION,
    RANGES,
    GnssState,
    LocalFrame,
    MotionStep,
    Sky,
    delay_law,
    first_fix,
    heading_rad,
    sensor_axes,
)
from robins.systems.gnss.parameters import GnssAssumptions, GnssReplay
from robins.systems.gnss.world import length_once
from robins.systems.replaying import FilterEstimates, LogPiece, PreparedLog, ReportedItems
from robins.systems.study import StateBlock
from robins.systems.tables import block_array, place_arrays, track_arrays

LEAST = 4  # satellites for the first fix
HEADING = StateBlock("heading", slice(0, 1), "rad", "deg", "NED", ("heading",))
LETTERS = {1: "G", 2: "S", 4: "R", 8: "E", 16: "J", 32: "C"}
"""Letters of the satellite systems of libRSF, as in RINEX."""

CAUSES = (
    "Likely causes: signals delayed by more than the filter believes, a jump of the receiver's "
    "clock, wheels that slip, or sigmas of the log that are too small."
)


@dataclass(frozen=True, kw_only=True)
class PreparedRangeLog(LogPiece):
    """A log by epoch, with the origin of its state; the world is a `GnssWorld`."""

    time_ns: np.ndarray  # (E,)
    place: LocalFrame
    member: np.ndarray  # (N, K)
    satellites: tuple[str, ...]
    way_m: np.ndarray  # (E,)


def arrange(log: RangeLog, believed: GnssAssumptions) -> PreparedRangeLog:
    """Arrange a log by receiver time (rows) and satellite (columns).

    The first epoch is the first with odometry and pseudoranges of four satellites; the filter
    starts there, and uses them after a first step of zero duration.

    Raises:
        ValueError: no epoch has four satellites while there is odometry.
    """
    ranges = log.ranges
    time_ns, epoch = np.unique(ranges.time_ns, return_inverse=True)
    count = np.bincount(epoch, minlength=len(time_ns))
    inside = (time_ns >= log.odometry.time_ns[0]) & (time_ns <= log.odometry.time_ns[-1])
    usable = np.flatnonzero((count >= LEAST) & inside)
    if not len(usable):
        raise ValueError(
            f"no epoch has pseudoranges of {LEAST} satellites while there is odometry; are both "
            "of the same drive?"
        )
    epochs = slice(usable[0], int(np.flatnonzero(inside)[-1]) + 1)
    numbers, column = np.unique(ranges.satellite, return_inverse=True)
    y, sky, elevation, cn0 = _columns(ranges, epoch, column, (len(time_ns), len(numbers)))
    system = np.zeros(len(numbers), dtype=int)
    system[column] = ranges.system
    kinds = np.unique(system)
    member = (system[:, None] == kinds[1:]).astype(float)

    time_ns = time_ns[epochs]
    u, way = _travel(log.odometry, time_ns)
    mean, spread = delay_law(believed.delays, *(_filled(x[epochs]) for x in (elevation, cn0)))
    sky = Sky(sky.satellite_e[epochs], sky.sigma[epochs])
    first = Sky(sky.satellite_e[0], sky.sigma[0])
    fix = first_fix(y[epochs][0], first, member, believed.clock.system_bias)
    return PreparedRangeLog(
        begin_s=0.0,
        epoch_s=(time_ns - time_ns[0]) * 1e-9,
        time_ns=time_ns,
        place=LocalFrame.at(fix[:3]),
        member=member,
        satellites=tuple(
            f"{LETTERS.get(s, 'X')}{n}" for s, n in zip(system, numbers.tolist(), strict=True)
        ),
        way_m=way,
        world=GnssWorld(
            fix=fix,
            u=u._replace(delay_mean=np.asarray(mean), delay_sigma=np.asarray(spread)),
            y={RANGES: y[epochs], LENGTH: length_once(believed, way)},
            sky=sky,
        ),
    )


def _columns(
    ranges: RangeTable, epoch: np.ndarray, column: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, Sky, np.ndarray, np.ndarray]:
    """Pseudoranges, `Sky`, elevations and C/N0 by epoch and satellite; NaN where not measured.

    Raises:
        ValueError: a satellite has two pseudoranges at one time.
    """
    if len(np.unique(epoch * shape[1] + column)) < len(epoch):
        raise ValueError("a satellite has two pseudoranges at one time; leave one signal of each")
    y, elevation, cn0 = (np.full(shape, np.nan) for _ in range(3))
    satellite, sigma = np.zeros((*shape, 3)), np.ones(shape)
    satellite[:] = ranges.satellite_e[0]  # a placeholder where nothing is measured
    y[epoch, column], sigma[epoch, column] = ranges.range_m, ranges.sigma_m
    satellite[epoch, column] = ranges.satellite_e
    elevation[epoch, column], cn0[epoch, column] = ranges.elevation_rad, ranges.cn0_dbhz
    return y, Sky(satellite, sigma), elevation, cn0


def _filled(x: np.ndarray) -> np.ndarray:
    """Fill each column forward, and backward before its first value; 0 in an empty column."""
    rows = np.arange(len(x))[:, None]
    there = np.isfinite(x)
    last = np.maximum.accumulate(np.where(there, rows, -1), axis=0)
    at = np.where(last < 0, np.argmax(there, axis=0)[None, :], last)
    return np.nan_to_num(np.take_along_axis(x, at, axis=0))


def _travel(odometry: OdometryTable, time_ns: np.ndarray) -> tuple[MotionStep, np.ndarray]:
    """Steps between epochs, without delays, and the distance travelled (E,) [m] since the first.

    Speed and yaw rate are interpolated linearly; a step has their means.
    """
    t = (odometry.time_ns - time_ns[0]) * 1e-9
    epoch_s = (time_ns - time_ns[0]) * 1e-9

    def integral(rate: np.ndarray) -> np.ndarray:
        """Integral (E,) of a rate from the first sample to each epoch, by trapezoids."""
        whole = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))])
        k = np.clip(np.searchsorted(t, epoch_s, "right") - 1, 0, len(t) - 1)
        here = np.interp(epoch_s, t, rate)
        return whole[k] + 0.5 * (rate[k] + here) * (epoch_s - t[k])

    dt = np.diff(epoch_s, prepend=0.0)
    step = np.where(dt > 0.0, dt, 1.0)
    way, turn = integral(odometry.speed_mps), integral(odometry.yaw_rate)
    speed, rate = (np.diff(x, prepend=x[:1]) / step for x in (way, turn))
    slip, sway = (np.interp(epoch_s, t, x) for x in (odometry.sigma_speed, odometry.sigma_yaw))
    none = np.zeros((len(dt), 0))
    return MotionStep(dt, np.abs(speed), rate, slip, sway, none, none), way - way[0]


# ---------------------------------------------------------------------------------------- replay


def recorded(log: RangeLog, parameters: GnssReplay) -> PreparedLog:
    """The log prepared for its filters, see `System.recorded`.

    Raises:
        ValueError: the log cannot be navigated; the message gives the reason.
    """
    given = arrange(log, parameters)
    return PreparedLog([given], partial(contender, parameters, given.place, given.member))


def replay(
    log: RangeLog,
    parameters: GnssReplay,
    filters: tuple[str, ...] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Navigate a log with the named filters, and report their quality.

    Args:
        log: pseudoranges, odometry, and true positions if known.
        parameters: assumptions that the file does not contain.
        filters: names such as "delays", "huber+rts"; by default those of the parameters.
        progress: called with the fraction done and the current task.

    Raises:
        ValueError: the log cannot be navigated; the message gives the reason.
    """
    given = arrange(log, parameters)
    make = partial(contender, parameters, given.place, given.member)
    wanted = filters or parameters.filters
    answers = replaying.run_filters([given], wanted, make, SMOOTHERS, progress)
    places = {name: given.place.geodetic(a.mean.position) for name, a in answers.items()}
    variables = track_arrays(places.values())
    true = None if log.truth is None else truth_at(log.truth, given)
    if true is not None:
        p = given.place.geodetic(true)
        variables |= place_arrays("reference", (p.lat, p.lon, p.alt), "true {}")
        error = np.stack([true - np.asarray(a.mean.position) for a in answers.values()])
        variables |= block_array("error", POSITION, error, "true minus estimated position")
    there = np.isfinite(given.world.y[RANGES])
    counts = {"pseudoranges": int(np.sum(there)), "satellites": len(given.satellites)}
    return replaying.outcome(
        given.epoch_s,
        answers,
        ReportedItems(
            blocks=(POSITION,),
            sensors=sensor_axes(given.satellites),
            estimates=_estimates,
            causes=CAUSES,
            assumed=(LENGTH,),
            euler=HEADING,
        ),
        origin_ns=int(given.time_ns[0]),
        metrics=lambda answer: {} if true is None else accuracy(answer, true),
        variables=variables,
        counts=dict(log.counts) | counts,
        notes=[
            f"{counts['pseudoranges']} pseudoranges of {counts['satellites']} satellites in "
            f"{len(there)} epochs over {given.way_m[-1]:.0f} m; the start is a fix by least "
            "squares, of unknown heading."
        ],
    )


def truth_at(truth: PlaceTable, given: PreparedRangeLog) -> np.ndarray:
    """True positions (E, 3) [m, NED] at the epochs, interpolated; NaN outside the reference."""
    local = np.asarray(given.place.local(truth.r_e))
    t, epochs = (x - given.time_ns[0] for x in (truth.time_ns, given.time_ns))
    out = np.stack([np.interp(epochs, t, x) for x in local.T], axis=1)
    return np.where(((epochs < t[0]) | (epochs > t[-1]))[:, None], np.nan, out)


def accuracy(answer: FilterEstimates, true: np.ndarray) -> dict[str, float | int]:
    """Horizontal and vertical errors, and the mean NEES of the horizontal position per axis.

    The NEES uses the two sigmas alone, without their correlation.
    """
    error = true - np.asarray(answer.mean.position)
    known = np.all(np.isfinite(error), axis=1)
    error, sigma = error[known], np.asarray(answer.sigma)[known]
    across = np.hypot(error[:, 0], error[:, 1])
    return {
        "horizontal_mean_m": float(np.mean(across)),
        "horizontal_rms_m": float(np.sqrt(np.mean(across**2))),
        "horizontal_max_m": float(np.max(across)),
        "vertical_rms_m": float(np.sqrt(np.mean(error[:, 2] ** 2))),
        "position_rms_m": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "nees": float(np.mean(0.5 * np.sum((error[:, :2] / sigma[:, :2]) ** 2, axis=1))),
        "beyond_3_sigma": float(np.mean(across > 3.0 * np.hypot(sigma[:, 0], sigma[:, 1]))),
        "epochs_compared": int(np.sum(known)),
    }


def _estimates(mean: GnssState) -> Mapping[str, np.ndarray]:
    return {"position": np.asarray(mean.position), "euler": heading_rad(mean.direction)[:, None]}
