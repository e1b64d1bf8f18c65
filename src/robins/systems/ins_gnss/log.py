"""Replay of recorded logs: common clock, alignment, epochs with their measurements, outcome.

Two rates: every IMU sample is mechanised, the covariance is propagated once per block. An IMU gap
too long to bridge ends a piece of the log; the next piece is aligned again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from robins.dataset import Dataset
from robins.earth import Geodetic
from robins.errors import require_known
from robins.filters import Belief
from robins.filters.values import Numbers
from robins.ins.blocks import epochs_between, gained_in_window, rate_about
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav
from robins.ins.state import InsState
from robins.program.evaluated import evaluated
from robins.results import Outcome, Progress, array, ignore_progress
from robins.rotation import Rotation
from robins.systems import replaying
from robins.systems.ins_gnss import model
from robins.systems.ins_gnss.correlated_errors import with_correlated_share
from robins.systems.ins_gnss.parameters import Aids, InsGnssReplay
from robins.systems.ins_gnss.recording import Log, in_body_axes, on_one_clock, with_lever_arm
from robins.systems.ins_gnss.reported import (
    DIVERGED,
    antenna_of,
    distances,
    fitting_sigma,
    fix_arrays,
    sigma_notes,
    verdict,
)
from robins.systems.ins_gnss.rest import UsualIntervals, at_rest, usual_of
from robins.systems.ins_gnss.robust import (
    AS_TOLD,
    HYPOTHESES,
    HindsightVerdict,
    augmented_case,
    fresh,
    hypothesis_model,
    mode_changes,
    navigation,
    robust,
    single_hypothesis,
    smoothed_probabilities,
)
from robins.systems.ins_gnss.samples import as_files
from robins.systems.ins_gnss.start import StartPoint, find_start
from robins.systems.ins_gnss.study import NAMES as STUDIED
from robins.systems.ins_gnss.study import SMOOTHERS, make_filter
from robins.systems.parts import ImuBlock
from robins.systems.replaying import (
    PROBABILITY,
    FilterEstimates,
    LogPiece,
    PreparedLog,
    ReportedItems,
)
from robins.systems.study import Case, Contender
from robins.systems.suspects import spans
from robins.systems.tables import track_arrays

CAUSES = (
    "Likely causes: the lever arm or the latency of the GNSS, the mounting of the unit, sigmas "
    "that the receiver states too small, noise of the IMU told too small, a velocity that is a "
    "mean over the receiver's interval, or a vehicle that was taken for still; `robins doctor` "
    "tells some of them."
)
WHEELS_S = 0.5  # longest interval of odometry over which the speed is interpolated
ASSUMED = (model.STANDSTILL, model.STILL_RATE, model.ROAD)  # measurements of no device
UNSURE_S = 2.0  # shortest doubt that is reported
ROBUST, WEIGHED = "robust", "weighed"
SMOOTHED = {**SMOOTHERS, f"{ROBUST}+rts": WEIGHED}
NAMES = (ROBUST, f"{ROBUST}+rts", *STUDIED)
"""Filters and smoothers of recorded logs; the first is for logs without tuned parameters."""


@dataclass(frozen=True, kw_only=True)
class LogSegment(LogPiece):
    """A piece of a log to navigate; its world is a `Case`."""

    start: StartPoint
    rate_b: np.ndarray  # (E, 3) rad/s mean raw gyro rate about each epoch
    used: np.ndarray  # (M,) bool, fixes of the log at an epoch of the piece
    withheld: np.ndarray  # (E,) bool


def prepare(whole: Log, parameters: InsGnssReplay, rows: slice) -> LogSegment:
    """Align on a piece of a log, set its epochs and assign the measurements to them.

    Raises:
        ValueError: no start can be found, or no fix lies in the piece.
    """
    increments = Increments(*(a[rows] for a in whole.increments[:3]))
    usual = usual_of(whole)
    log = whole._replace(increments=increments, time_s=whole.time_s[rows])
    start = find_start(log, parameters.start, parameters.aids, usual, parameters.gnss)
    begin_s, end_s = float(log.gnss_s[start.fix]), float(log.time_s[-1])
    used = (log.gnss_s > begin_s) & (log.gnss_s <= end_s)
    if not np.any(used):
        raise ValueError(f"no GNSS fix after the start at {begin_s:.1f} s")
    # uneven: a live filter does not know in advance when the next fix comes
    longest_s = parameters.update.longest_block
    epochs = epochs_between(begin_s, end_s, log.gnss_s[used], longest_s, even=False)
    u, y, aux, rate_b = steps_of(log, used, begin_s, epochs, parameters, usual)
    return LogSegment(
        world=Case(first_belief(log, start, parameters), u, y, aux, None),
        begin_s=begin_s,
        epoch_s=epochs,
        noise_scale=np.asarray(u.noise_scale),
        start=start,
        rate_b=rate_b,
        used=used,
        withheld=parameters.withheld(epochs, log.gnss_s),
    )


InsGnssSteps = tuple[ImuBlock, dict[str, Any], dict[str, Any], np.ndarray]
"""Inputs, measurements and aux of the steps of a filter, and the mean raw gyro rate about each
epoch (E, 3) [rad/s]; leading axis E epochs."""


def steps_of(
    log: Log,
    used: np.ndarray,
    begin_s: float,
    epochs: np.ndarray,
    parameters: InsGnssReplay,
    usual: UsualIntervals,
) -> InsGnssSteps:
    """Steps from epoch to epoch, with the measurements at their ends.

    A piece of a log that reaches back far enough gives the same bits as the whole log.

    Args:
        log: increments and fixes.
        used: (M,) bool, fixes that fall on one of the epochs.
        begin_s: epoch before the first.
        epochs: (E,) s.
        parameters: of the replay.
        usual: intervals of samples and fixes.
    """
    p, increments = parameters, log.increments
    u = replaying.imu_blocks(increments, log.time_s, begin_s, epochs, p.update, usual.sample_s)
    rate = rate_about(increments, log.time_s, epochs, usual.sample_s)
    window_s = p.gnss.velocity_window
    y, aux = measured_fixes(log, used, epochs, rate, usual.fix_s if window_s is None else window_s)
    known, about = measured_rest(log, epochs, rate, p.aids, usual)
    return u, y | known, aux | about, rate


def first_belief(log: Log, start: StartPoint, parameters: InsGnssReplay) -> Belief:
    """Initial belief at the first fix, reduced from the antenna to the IMU."""
    g, row = log.gnss, start.fix
    antenna = Geodetic(*(np.asarray(a[row]) for a in (g.lat_rad, g.lon_rad, g.alt_m)))

    def imu_at(antenna, q_nb, arm_b, moved_n):
        return antenna.retract(moved_n - q_nb.apply(arm_b))

    q_nb, arm_b = Rotation(jnp.asarray(start.q_nb)), np.asarray(parameters.gnss.lever_arm)
    moved_n = start.v_n * parameters.gnss.latency
    if start.offset_n is not None:
        arm_b, moved_n = np.zeros(3), start.offset_n
    position = evaluated(imu_at, antenna, q_nb, arm_b, moved_n)
    nav = Nav(q_nb, jnp.asarray(start.v_n), position)
    belief = model.start_belief(
        nav,
        parameters.imu,
        parameters.start,
        tilt_rad=start.tilt_sigma_rad,
        heading_rad=start.heading_sigma_rad,
        gyro_bias=start.gyro_bias,
        fix_sigma_m=np.nan_to_num(log.sigma_m[row]),
    )
    if start.spread is None:
        return belief
    factor, each = np.array(belief.factor), np.linalg.cholesky(start.spread)
    for k in range(3):  # indices of velocity and position of an axis differ by three
        factor[3 + k, 3 + k] = each[k, 0, 0]
        if not parameters.gnss.lasting_share:  # else averaging fixes does not reduce the error
            factor[6 + k, 3 + k : 9 : 3] = each[k, 1]
    return belief._replace(factor=factor)


def measured_fixes(
    log: Log, used: np.ndarray, epochs: np.ndarray, rate: np.ndarray, window_s: float
) -> tuple[dict[str, PyTree], dict[str, PyTree]]:
    """GNSS measurements and their aux by epoch; NaN where there is no fix or it is withheld."""
    given, g = used & ~log.withheld, log.gnss
    at = np.searchsorted(epochs, log.gnss_s[given] - 1e-9)

    def sorted_in(values: np.ndarray, fill: float = np.nan) -> np.ndarray:
        out = np.full((len(epochs), *values.shape[1:]), fill)
        out[at] = values
        return out

    place = (sorted_in(x[given]) for x in (g.lat_rad, g.lon_rad, g.alt_m))
    y: dict[str, Any] = {model.POSITION: Geodetic(*place)}
    aux: dict[str, Any] = {model.POSITION: model.Fix(sorted_in(log.sigma_m[given], 1.0), rate)}
    if log.v_n is not None and log.sigma_v is not None:
        gained = gained_in_window(log.increments, log.time_s, epochs[at], window_s)
        about = sorted_in(log.sigma_v[given], 1.0), rate, *(sorted_in(x, 0.0) for x in gained)
        y[model.VELOCITY] = sorted_in(log.v_n[given])
        aux[model.VELOCITY] = model.Velocity(*about)
    return y, aux


def measured_rest(
    log: Log, epochs: np.ndarray, rate: np.ndarray, aids: Aids, usual: UsualIntervals
) -> tuple[dict[str, PyTree], dict[str, PyTree]]:
    """Measurements without a receiver, with their aux: standstill, no slip, odometer."""
    still, mean_rate = at_rest(log, aids, usual, epochs)
    stands = still[:, None]
    y: dict[str, Any] = {}
    if aids.zero_velocity:
        y[model.STANDSTILL] = np.where(stands, np.zeros((len(epochs), 3)), np.nan)
        y[model.STILL_RATE] = np.where(stands, mean_rate, np.nan)
    if aids.non_holonomic:
        y[model.ROAD] = np.where(stands, np.nan, np.zeros((len(epochs), 2)))
    about: dict[str, Any] = {model.ROAD: rate} if aids.non_holonomic else {}
    if log.wheels is not None and len(log.wheels.time_s) > 1:
        t, speed, sigma = log.wheels
        near = np.clip(np.searchsorted(t, epochs), 1, len(t) - 1)
        received = (t[near] - t[near - 1] < WHEELS_S) & (epochs >= t[0]) & (epochs <= t[-1])
        y[model.ODOMETER] = np.where(received, np.interp(epochs, t, speed), np.nan)[:, None]
        about[model.ODOMETER] = model.Fix(np.interp(epochs, t, sigma)[:, None], rate)
    return y, about


def bank_step_s(parameters: InsGnssReplay, fix_step_s: float) -> float:
    """Usual duration of a step [s]."""
    return min(fix_step_s, parameters.update.longest_block)


_case = cache(partial)


def contender(parameters: InsGnssReplay, fix_step_s: float, name: str) -> Contender:
    """A filter with its model.

    Args:
        parameters: of the replay.
        fix_step_s: median interval of fixes [s].
        name: of a filter, or `WEIGHED`.
    """
    believed = model.ins_gnss_model(parameters.imu, parameters.gnss, parameters.aids)
    fits_share = parameters.gnss.velocity_window is None
    if name in (ROBUST, WEIGHED):
        share, time_s = parameters.gnss.lasting_share, parameters.gnss.lasting_time
        lasting = jnp.array([share, time_s]) if share else None
        own = ((share, time_s), parameters.start.position) if share else (None, 0.0)
        start = _case(augmented_case, fits_share, *own)
        step_s, patience_s = bank_step_s(parameters, fix_step_s), parameters.update.patience
        bank = (
            single_hypothesis()
            if name == WEIGHED
            else robust(believed, step_s, patience_s, lasting)
        )
        return Contender(bank, hypothesis_model(believed, AS_TOLD, lasting), start)
    fix_model = fresh(believed) if fits_share else believed
    return Contender(make_filter(name, parameters.update.gate), fix_model)


def _answers(
    pieces: Sequence[LogSegment],
    parameters: InsGnssReplay,
    fix_step_s: float,
    wanted: Sequence[str],
    progress: Progress,
) -> tuple[dict[str, FilterEstimates], list[str], list[str]]:
    """Estimates of each filter and smoother, and notes and warnings of the bank.

    The smoother has a single hypothesis, the likeliest by the bank's smoothed probabilities: it
    omits positions that were off, and uses the bank's process noise.
    """
    made = partial(contender, parameters, fix_step_s)
    navigated = partial(
        replaying.run_filters, contender=made, smoothers=SMOOTHED, progress=progress
    )
    smooths = [name for name in wanted if SMOOTHED.get(name) == WEIGHED]
    causal = [name for name in wanted if name not in smooths]
    wants_robust = bool(smooths) and ROBUST not in causal
    found = navigated(pieces, [*causal, ROBUST] if wants_robust else causal)
    notes, doubts = [], []
    if ROBUST in found:
        change = mode_changes(bank_step_s(parameters, fix_step_s), parameters.update.patience)
        probability = np.asarray(list(found[ROBUST].updates.values())[-1].notes[PROBABILITY])
        verdicts, first = [], 0
        for piece in pieces:
            last = first + len(piece.epoch_s)
            verdicts.append(smoothed_probabilities(probability[first:last], change))
            doubts += _doubts(piece, probability[first:last], verdicts[-1])
            first = last + 1
        notes += _share_note(found[ROBUST], parameters, fix_step_s)
        if smooths:
            seen = [_without_offsets(*of) for of in zip(pieces, verdicts, strict=True)]
            found |= navigated(seen, smooths)
    kept = {k: found[k]._replace(mean=navigation(found[k].mean)) for k in wanted}
    return kept, notes, doubts


def _without_offsets(piece: LogSegment, verdict: HindsightVerdict) -> LogSegment:
    """The piece without the positions that were off, with process noise scaled by the verdict."""
    world: Case = piece.world
    off = verdict.off > 0.5
    position = jax.tree_util.tree_map(lambda x: np.where(off, np.nan, x), world.y[model.POSITION])
    u = world.u._replace(noise_scale=world.u.noise_scale * np.sqrt(verdict.scale))
    return replace(piece, world=world._replace(u=u, y={**world.y, model.POSITION: position}))


def _doubts(piece: LogSegment, probability: np.ndarray, verdict: HindsightVerdict) -> list[str]:
    """Sentences on times at which positions were off, or at which that remained undecided."""
    seen = np.isfinite(np.asarray(piece.world.y[model.POSITION].lat))
    sentences = []
    if off := spans(piece.epoch_s[seen], verdict.off[seen] > 0.5):
        shown = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in off[:6])
        more = "" if len(off) <= 6 else f" and {len(off) - 6} more"
        sentences.append(
            f"{ROBUST}: positions were off, all to one side, against velocities and the IMU: "
            f"{shown}{more}. They were not followed."
        )
    now = probability[:, HYPOTHESES.read > 0.0].sum(axis=1)
    open_ = [(a, b) for a, b in spans(piece.epoch_s, (now > 0.05) & (now < 0.95) & seen)]
    if long := [(a, b) for a, b in open_ if b - a >= UNSURE_S]:
        shown = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in long[:6])
        sentences.append(
            f"{ROBUST}: for a while it could not be told whether positions were off or the "
            f"estimate, and its sigma says so: {shown}."
        )
    if np.any(verdict.diverged > 0.5):
        at = piece.epoch_s[np.flatnonzero(verdict.diverged > 0.5)]
        shown = ", ".join(f"{t:.1f} s" for t in at[:6])
        sentences.append(f"{ROBUST}: {DIVERGED}: {shown}. Before, its sigma did not hold.")
    return sentences


def _share_note(answer: FilterEstimates, parameters: InsGnssReplay, fix_step_s: float) -> list[str]:
    """Sentence on the window of the velocities, if it was estimated and not configured."""
    wide = answer.mean
    if wide.share is None or model.VELOCITY not in answer.updates:
        return []
    share = float(np.asarray(wide.share)[-1, 0])
    sigma = float(np.asarray(answer.sigma)[-1, -4])
    if sigma > 0.2:
        return []
    what = (
        f"means over the {fix_step_s:.3g} s since the last fix"
        if share > 0.5
        else "those of the fix"
    )
    return [
        f"The receiver's velocities are {what} (by {share:.2f} +- {sigma:.2f} of that time); "
        "gnss.velocity_window says so to the other filters."
    ]


# parameters, the log on one clock, pieces to navigate, sentences on others, interval of fixes [s],
# notes
_Opened = tuple[InsGnssReplay, Log, list[LogSegment], list[str], float, list[str]]


def _opened(dataset: Dataset, parameters: InsGnssReplay) -> _Opened:
    parameters = with_lever_arm(parameters, dataset.lever_arm_b_m)
    log = on_one_clock(in_body_axes(dataset, parameters.imu.orientation), parameters)
    parameters, notes = with_correlated_share(parameters, log)
    pieces, problems = replaying.prepare_pieces(
        log.time_s,
        log.increments.dt,
        parameters.update.longest_gap,
        partial(prepare, log, parameters),
    )
    return parameters, log, pieces, problems, usual_of(log).fix_s, notes


def recorded(dataset: Dataset, parameters: InsGnssReplay) -> PreparedLog:
    """The log prepared for its filters, see `System.recorded`.

    Raises:
        ValueError: the log cannot be navigated; the message gives the reason and a fix.
    """
    parameters, _, pieces, _, interval_s, _ = _opened(dataset, parameters)
    return PreparedLog(pieces, partial(contender, parameters, interval_s))


def replay(
    dataset: Dataset,
    parameters: InsGnssReplay,
    filters: tuple[str, ...] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Navigate an examined and cleaned log of IMU and GNSS, see `System.replay`.

    Samples loaded without a mounting are rotated by `imu.orientation`; `InsGnssReplay()` is the
    default configuration of the command.

    Raises:
        ValueError: the log cannot be navigated; the message gives the reason and a fix.
    """
    parameters, log, pieces, problems, interval_s, notes = _opened(dataset, parameters)
    wanted = filters or parameters.filters
    for name in wanted:
        require_known("filter", name, NAMES, "this system")
    answers, found, doubts = _answers(pieces, parameters, interval_s, wanted, progress)
    epoch_s, origin_ns = replaying.epochs_of(pieces), int(dataset.imu.time_ns[0])
    rate, withheld = replaying.end_to_end([(piece.rate_b, piece.withheld) for piece in pieces])
    mount = model.mount_of(parameters.gnss, parameters.aids)
    antennas = {name: antenna_of(mount, answer.mean, rate) for name, answer in answers.items()}
    variables = track_arrays(antennas.values(), "{} of the antenna") | fix_arrays(log)
    variables |= array("outage", withheld.astype(np.int8), long_name="GNSS withheld")
    used = np.any([piece.used for piece in pieces], axis=0)
    counts = replaying.gap_counts(pieces, problems) | {"pieces_not_navigated": len(problems)}
    outcome = replaying.outcome(
        epoch_s,
        answers,
        ReportedItems(
            blocks=model.state_blocks(parameters.imu.scale_states),
            sensors=model.SENSORS,
            estimates=_estimates,
            causes=CAUSES,
            assumed=ASSUMED,
        ),
        metrics=lambda answer: distances(log, used, epoch_s, antennas[answer.name]),
        variables=variables,
        counts=dict(dataset.counts) | counts,
        notes=[f"Start: {piece.start.sentence}." for piece in pieces]
        + notes * any(name.startswith(ROBUST) for name in wanted)
        + sigma_notes(dataset, parameters)
        + ["Distances are to the fixes, which err too: a better path may lie farther from them."]
        + found
        + [f"Not navigated, {problem}." for problem in problems],
        origin_ns=origin_ns,
    )
    outcome.warnings[:0] = doubts
    files = as_files(log.time_s, origin_ns, pieces, answers) if parameters.every_sample else {}
    word = verdict(answers, outcome.metrics, outcome.warnings)
    setting = fitting_sigma(dataset, parameters, outcome.metrics)
    return replace(outcome, verdict=word, files=files, setting=setting)


def _estimates(mean: InsState) -> Mapping[str, Numbers]:
    biases_and_scales = {name: getattr(mean, name) for name in InsState._fields[3:]}
    return {"velocity": mean.v_n, "q_nb": mean.q_nb.wxyz, **biases_and_scales}
