"""Recorded pseudoranges and odometry: arrangement by epoch, replay, comparison with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import jax
import numpy as np

from robins.dataset import PlaceTable, RangeLog, RangeTable
from robins.results import Outcome, Progress, ignore_progress
from robins.systems import replaying
from robins.systems.gnss.filters import SMOOTHERS, contender
from robins.systems.gnss.model import (
    LENGTH,
    POSITION,
    RANGES,
    GnssState,
    LocalFrame,
    heading_rad,
    sensor_axes,
)
from robins.systems.gnss.parameters import GnssAssumptions, GnssReplay
from robins.systems.gnss.path import LEAST, GnssPath
from robins.systems.replaying import FilterEstimates, LogPiece, PreparedLog, ReportedItems
from robins.systems.study import StateBlock
from robins.systems.tables import block_array, place_arrays, track_arrays

HEADING = StateBlock("heading", slice(0, 1), "rad", "deg", "NED", ("heading",))
LETTERS = {1: "G", 2: "S", 4: "R", 8: "E", 16: "J", 32: "C"}
"""Letters of the satellite systems of libRSF, as in RINEX."""

CAUSES = (
    "Likely causes: signals delayed by more than the filter believes, a jump of the receiver's "
    "clock, wheels that slip, or sigmas of the log that are too small."
)


def arrange(log: RangeLog, believed: GnssAssumptions) -> tuple[LogPiece, GnssPath]:
    """Arrange a log with a column for each satellite and an epoch for each receiver time.

    The first epoch is the first with odometry and pseudoranges of four satellites; the filter
    starts there, and uses them after a first step of zero duration.

    Raises:
        ValueError: no epoch has four satellites while there is odometry.
    """
    ranges, odometry = log.ranges, log.odometry
    inside = ranges.time_ns >= odometry.time_ns[0]
    inside &= ranges.time_ns <= odometry.time_ns[-1]
    times, counts = np.unique(ranges.time_ns[inside], return_counts=True)
    from_ns = min(times[counts >= LEAST], default=0)  # a satellite of before has no column
    path = GnssPath(believed, channels_of(ranges, inside & (ranges.time_ns >= from_ns)))
    names = names_of(ranges)
    rows = np.column_stack(
        [ranges.range_m, ranges.sigma_m, ranges.satellite_e, ranges.elevation_rad, ranges.cn0_dbhz]
    )
    path.push_odometry(
        odometry.time_ns,
        np.column_stack(
            [odometry.speed_mps, odometry.yaw_rate, odometry.sigma_speed, odometry.sigma_yaw]
        ),
    )
    edges, steps = np.flatnonzero(np.diff(ranges.time_ns)) + 1, []
    for at in np.split(np.arange(len(names)), edges):
        path.push_ranges(int(ranges.time_ns[at[0]]), [names[k] for k in at], rows[at])
        steps += path.steps()
    if path.without_fix and not steps:
        raise ValueError(
            f"no epoch of {LEAST} satellites or more gives a place on the Earth; are pseudoranges "
            "and satellites in metres?"
        )
    if not steps:
        raise ValueError(
            f"no epoch has pseudoranges of {LEAST} satellites while there is odometry; are both "
            "of the same drive?"
        )
    time_ns, worlds = zip(*steps, strict=True)
    world = jax.tree_util.tree_map(lambda *x: np.stack(x), *worlds)._replace(fix=path.fix)
    epoch_s = (np.array(time_ns) - time_ns[0]) * 1e-9
    return LogPiece(world=world, begin_s=0.0, epoch_s=epoch_s), path


def names_of(ranges: RangeTable) -> list[str]:
    """Name of the satellite of each row, such as "G5"."""
    pairs = zip(ranges.system.tolist(), ranges.satellite.tolist(), strict=True)
    return [f"{_letter(system)}{number}" for system, number in pairs]


def _letter(system: int) -> str:
    """Letter of a system; an unused lower-case one if it has no name."""
    return LETTERS.get(system, chr(ord("a") + system % 26))


def channels_of(ranges: RangeTable, rows: np.ndarray) -> dict[str, int]:
    """Number of satellites of each system in some rows, by its letter."""
    seen = np.unique(np.stack([ranges.system[rows], ranges.satellite[rows]]), axis=1)
    systems, counts = np.unique(seen[0], return_counts=True)
    channels: dict[str, int] = {}
    for system, count in zip(systems.tolist(), counts.tolist(), strict=True):
        letter = _letter(system)
        channels[letter] = channels.get(letter, 0) + count
    return channels


# ---------------------------------------------------------------------------------------- replay


def recorded(log: RangeLog, parameters: GnssReplay) -> PreparedLog:
    """The log prepared for its filters, see `System.recorded`.

    Raises:
        ValueError: the log cannot be navigated; the message gives the reason.
    """
    given, path = arrange(log, parameters)
    return PreparedLog([given], partial(contender, parameters, path.place, path.member))


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
    given, path = arrange(log, parameters)
    place, begin_ns = path.place, int(path.begin_ns or 0)
    make = partial(contender, parameters, place, path.member)
    wanted = filters or parameters.filters
    answers = replaying.run_filters([given], wanted, make, SMOOTHERS, progress)
    places = {name: place.geodetic(a.mean.position) for name, a in answers.items()}
    variables = track_arrays(places.values())
    true = (
        None
        if log.truth is None
        else truth_at(log.truth, place, begin_ns + np.round(1e9 * given.epoch_s).astype(np.int64))
    )
    if true is not None:
        p = place.geodetic(true)
        variables |= place_arrays("reference", (p.lat, p.lon, p.alt), "true {}")
        error = np.stack([true - np.asarray(a.mean.position) for a in answers.values()])
        variables |= block_array("error", POSITION, error, "true minus estimated position")
    there = np.isfinite(given.world.y[RANGES])
    counts = {"pseudoranges": int(np.sum(there)), "satellites": len(path.satellites)}
    return replaying.outcome(
        given.epoch_s,
        answers,
        ReportedItems(
            blocks=(POSITION,),
            sensors=sensor_axes(tuple(path.satellites)),
            estimates=_estimates,
            causes=CAUSES,
            assumed=(LENGTH,),
            euler=HEADING,
        ),
        origin_ns=begin_ns,
        metrics=lambda answer: {} if true is None else accuracy(answer, true),
        variables=variables,
        counts=dict(log.counts) | counts,
        notes=[
            f"{counts['pseudoranges']} pseudoranges of {counts['satellites']} satellites in "
            f"{len(there)} epochs over {path.way_m:.0f} m; the start is a fix by least "
            "squares, of unknown heading."
        ],
    )


def truth_at(truth: PlaceTable, place: LocalFrame, time_ns: np.ndarray) -> np.ndarray:
    """(E, 3) true positions [m, NED] at the epochs, interpolated; NaN outside the truth."""
    local = np.asarray(place.local(truth.r_e))
    t, epochs = (x - time_ns[0] for x in (truth.time_ns, time_ns))
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
