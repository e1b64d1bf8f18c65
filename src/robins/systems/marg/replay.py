"""Replay of a nine-axis log, and its errors if the truth is known.

Orientation errors are defined as in BROAD (Laidig, Caruso, Cereatti & Seel 2021).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import AttitudeTable, Dataset
from robins.earth.magnetic import MagneticModelError, decimal_year, elements, field_n, wmm_for
from robins.errors import require_known
from robins.filters import Code
from robins.filters.consistency_limits import FEWEST, REFUSED_SHARE
from robins.filters.values import Numbers
from robins.ins.frames import to_ned_frd
from robins.results import Outcome, Progress, Variables, array, ignore_progress, variable
from robins.systems import replaying
from robins.systems.marg import model, monitor
from robins.systems.marg.filters import BARE, filter_of, one_prior
from robins.systems.marg.log import PreparedMargLog, prepare
from robins.systems.marg.parameters import MargReplay
from robins.systems.replaying import FilterEstimates, PreparedLog, ReportedItems
from robins.systems.study import Contender, StateBlock
from robins.systems.tables import EULER, SensorUpdates, attitude_array, block_array

CAUSAL, SMOOTHED = FILTERS = ("marg", "marg-smoothed")
# site azimuths are not reported: unvisited ones are unknown, the others show in the heading
_BLOCKS = tuple(block for block in model.BLOCKS if block.name != "azimuths")
_ESTIMATED = {block.name: {"velocity": "v_n"}.get(block.name, block.name) for block in _BLOCKS[1:]}
_HEADING = StateBlock("heading", slice(2, 3), "rad", "deg", "NED", ("heading",))
_INCLINATION = StateBlock("inclination", slice(0, 2), "rad", "deg", "NED", ("north", "east"))


class OrientationErrors(NamedTuple):
    """Angles [rad] of q_e = q_estimated conj(q_true), both from body to an earth frame.

    ENU and NED give the same values, except for the sign of the heading error, which here is
    clockwise as headings are.
    """

    total: np.ndarray  # (N,) 0 to pi
    heading: np.ndarray  # (N,) -pi to pi, estimated minus true
    inclination: np.ndarray  # (N,) 0 to pi


def orientation_errors(q_estimated: np.ndarray, q_true: np.ndarray) -> OrientationErrors:
    """Total, heading and inclination error between q_nb (N, 4), NED; NaN where one is missing.

    With q_e = (w, x, y, z): total 2 acos |w|, heading 2 atan(z / w), inclination
    2 acos sqrt(w^2 + z^2); written with the arc tangent, which is exact for small angles too.
    """
    e = rotation.multiply(q_estimated, rotation.conjugate(q_true))
    w, z = e[:, 0], e[:, 3]
    across = np.hypot(e[:, 1], e[:, 2])
    sign = np.where(w < 0.0, -1.0, 1.0)
    return OrientationErrors(
        total=2.0 * np.arctan2(np.linalg.norm(e[:, 1:], axis=1), np.abs(w)),
        heading=2.0 * np.arctan2(sign * z, sign * w),
        inclination=2.0 * np.arctan2(across, np.hypot(w, z)),
    )


def truth_at(attitude: AttitudeTable, time_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True q_nb (N, 4), NED, at given times, NaN if none is near; and mask (N,) of counted ones.

    The nearest true attitude within half a sampling interval is taken, without interpolation. Only
    the phases marked by the author of the log count, or all if none is marked.
    """
    table = to_ned_frd(attitude)
    times = table.time_ns
    later = np.clip(np.searchsorted(times, time_ns), 0, len(times) - 1)
    sooner = np.maximum(later - 1, 0)
    after, before = np.abs(times[later] - time_ns), np.abs(times[sooner] - time_ns)
    nearest = np.where(after <= before, later, sooner)
    reach = 0.51 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    near = np.abs(times[nearest] - time_ns) <= reach
    q = np.where(near[:, None], table.q_nb[nearest], np.nan)
    moving = np.ones(len(times), dtype=bool) if table.moving is None else table.moving
    return q, moving[nearest] & np.all(np.isfinite(q), axis=1)


def rms_deg(angle_rad: np.ndarray) -> float:
    """Root mean square [deg] of angles [rad]; NaN if there are none."""
    return float(np.degrees(np.sqrt(np.mean(angle_rad**2)))) if angle_rad.size else float("nan")


def contender(parameters: MargReplay, name: str) -> Contender:
    """The filter "marg" with its model.

    Raises:
        ValueError: another filter is requested.
    """
    require_known("filter", name, (CAUSAL,), "this system, which smooths replays only")
    return Contender(filter_of(parameters), model.model_of(parameters))


def recorded(dataset: Dataset, parameters: MargReplay) -> PreparedLog:
    """The log prepared for its filter, see `System.recorded`.

    Raises:
        ValueError: the log cannot be used; the message gives the reason.
    """
    return PreparedLog([prepare(dataset, parameters)], partial(contender, parameters))


def replay(
    dataset: Dataset,
    parameters: MargReplay,
    filters: tuple[str, ...] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Estimate the orientation over a log, with errors if its truth is known; see `System.replay`.

    Raises:
        ValueError: the log cannot be used; the message gives the reason.
    """
    progress(0.0, "integrating blocks")
    log = prepare(dataset, parameters)
    wanted = filters or parameters.filters
    answers, seen = _answers(log, parameters, wanted, progress)
    q_nb = {name: _by_sample(log, answer) for name, answer in answers.items()}
    answers = {name: _as_stated(log, a, parameters) for name, a in answers.items()}
    north = None if parameters.use_magnetometer == "never" else true_north(dataset)
    if north is not None:
        q_nb = {name: _to_true_north(q, north) for name, q in q_nb.items()}
        answers = {name: _answer_to_true_north(answer, north) for name, answer in answers.items()}
    doubt = {name: _doubt(answer, seen[name], parameters) for name, answer in answers.items()}
    variables, errors = _variables(log, answers, doubt) | _attitudes(log, q_nb), {}
    truth = None if dataset.attitude is None else truth_at(dataset.attitude, log.time_ns)
    if truth is not None:
        errors = {name: _errors(q[log.rows], truth[0][log.rows]) for name, q in q_nb.items()}
        variables |= _error_arrays(answers, errors)

    def metrics(answer: FilterEstimates) -> dict[str, float | int]:
        share = {"rest_share": float(np.mean(log.still))}
        if truth is None:
            return share
        moving = truth[1][log.rows]
        ratio = (errors[answer.name][:, 2] / answer.sigma[:, 2])[moving]
        # one if the stated sigma of the heading is right
        nees = float(np.mean(ratio**2)) if ratio.size else float("nan")
        return _accuracy(q_nb[answer.name], *truth) | {"heading_nees": nees} | share

    lasted = np.asarray(log.world.u.samples.dt_s)
    looks, disturbed = _field_sentences(log, answers)
    warned = disturbed + monitor.of_samples(log.counts, len(log.time_ns))
    for name, answer in answers.items():
        warned += monitor.sentences(name, doubt[name], answer.mean, lasted)
    predictions = next(iter(answers.values())).tally.counts()
    lost = sum(number for code, number in predictions.items() if code != Code.DONE)
    outcome = replaying.outcome(
        log.epoch_s,
        answers,
        REPORTED,
        metrics=metrics,
        variables=variables,
        counts=dict(dataset.counts) | log.counts | {"steps_not_taken": lost},
        notes=[*_sentences(log, answers), *looks, *_about_north(dataset, north)],
        origin_ns=int(log.time_ns[0]),
    )
    return replace(outcome, warnings=[*warned, *outcome.warnings])


def _about_north(dataset: Dataset, north: float | None) -> list[str]:
    notes = []
    if dataset.mag is None:
        notes.append("There is no magnetometer in this log: the heading is that of the gyros.")
    if north is not None:
        notes.append(
            f"North is true north: the field of the Earth is turned by {math.degrees(north):.1f} "
            "deg at the first fix (World Magnetic Model)."
        )
    return notes


def _answers(
    log: PreparedMargLog, parameters: MargReplay, wanted: Sequence[str], progress: Progress
) -> tuple[dict[str, FilterEstimates], dict[str, Mapping[str, SensorUpdates]]]:
    """Estimates of filters and smoother, and the updates by which to monitor each, by name."""
    # the smoother needs the causal run: it decides whether the gyros are uncalibrated
    causal = dict.fromkeys([*wanted, CAUSAL])
    causal.pop(SMOOTHED, None)
    make = partial(contender, parameters)
    answers = replaying.run_filters([log], tuple(causal), make, None, progress)
    seen = {CAUSAL: answers[CAUSAL].updates}
    if SMOOTHED in wanted:
        smoothed = _smoothed(log, answers[CAUSAL], parameters, progress)
        answers[SMOOTHED], seen[SMOOTHED] = smoothed
    return {name: answers[name] for name in wanted}, seen


def _doubt(
    answer: FilterEstimates, seen: Mapping[str, SensorUpdates], parameters: MargReplay
) -> monitor.Contradictions:
    """Contradictions of estimates with the parameters."""
    return monitor.doubts_of(
        np.asarray(answer.mean.declination),
        np.asarray(answer.mean.gyro_gain),
        monitor.as_stated(seen, parameters),
        parameters,
        np.asarray(answer.wrong[BARE]) > 0.5,
    )


def _smoothed(
    log: PreparedMargLog, causal: FilterEstimates, parameters: MargReplay, progress: Progress
) -> tuple[FilterEstimates, Mapping[str, SensorUpdates]]:
    """Smoother with the gyro prior that the causal run ended with, and updates of its filter."""
    start, bare = log.world.start, bool(np.asarray(causal.wrong[BARE])[-1] > 0.5)
    if bare:
        factor, gains = np.array(start.factor), np.arange(model.DIM)[model.GAINS]
        factor[gains, gains] = np.hypot(parameters.gyro.gain, parameters.gyro.bare_gain)
        start = start._replace(factor=jnp.asarray(factor))
    piece = replace(log, world=log.world._replace(start=start))
    one = Contender(one_prior(parameters), model.model_of(parameters))
    names, smoothers = (SMOOTHED, CAUSAL), {SMOOTHED: CAUSAL}
    found = replaying.run_filters([piece], names, lambda _: one, smoothers, progress)
    wrong = {BARE: np.full(len(log.epoch_s), float(bare))}
    return found[SMOOTHED]._replace(wrong=wrong), found[CAUSAL].updates


def true_north(dataset: Dataset) -> float | None:
    """Declination [rad] of the Earth's field by the WMM at the first fix.

    None without a fix, a magnetometer or a date: stamps that count from the start of a recording
    are outside the validity of every model.
    """
    gnss = dataset.gnss
    if gnss is None or dataset.mag is None:
        return None
    place = np.stack([gnss.lat_rad, gnss.lon_rad, gnss.alt_m], axis=1)
    known = np.flatnonzero(np.all(np.isfinite(place), axis=1))
    if not known.size:
        return None
    lat, lon, height = place[known[0]]
    try:
        year = decimal_year(np.datetime64(int(gnss.time_ns[known[0]]), "ns"))
        field = field_n(wmm_for(year), lat, lon, height, year)
    except MagneticModelError:
        return None
    return float(elements(field).declination_rad)


def _to_true_north(q_nb: np.ndarray, declination: float) -> np.ndarray:
    """Convert attitudes (..., 4) from magnetic to true north."""
    turn = np.array([math.cos(declination / 2.0), 0.0, 0.0, math.sin(declination / 2.0)])
    return np.asarray(rotation.multiply(turn, q_nb))


def _answer_to_true_north(answer: FilterEstimates, declination: float) -> FilterEstimates:
    turn = rotation.from_rotvec(jnp.array([0.0, 0.0, declination]))
    mean = answer.mean
    q_nb = mean.q_nb.__class__(jnp.asarray(_to_true_north(mean.q_nb.wxyz, declination)))
    turned = [np.asarray(rotation.rotate(turn, jnp.asarray(v))) for v in (mean.v_n, mean.p_n)]
    return answer._replace(mean=mean._replace(q_nb=q_nb, v_n=turned[0], p_n=turned[1]))


def _by_sample(log: PreparedMargLog, answer: FilterEstimates) -> np.ndarray:
    """(N, 4) attitude at every sample."""
    if answer.name == SMOOTHED:
        q, first = model.smoothed_attitudes(answer.mean, log.samples)
    else:
        q, first = (
            model.causal_attitudes(answer.start.mean, answer.mean, log.samples),
            log.look.q_nb,
        )
    rows = np.asarray(q).reshape(-1, 4)[: len(log.time_ns) - 1]
    return np.concatenate([np.asarray(first)[None], rows])


def _as_stated(
    log: PreparedMargLog, answer: FilterEstimates, parameters: MargReplay
) -> FilterEstimates:
    """Estimates as NumPy arrays, with `stated_sigma`."""
    kept = answer.mean, answer.sigma, answer.updates
    mean, sigma, seen = jax.tree_util.tree_map(np.asarray, kept)
    samples = log.world.u.samples
    sigma = stated_sigma(sigma, samples.angle, samples.dt_s, parameters)
    return answer._replace(mean=mean, sigma=sigma, updates=seen)


def stated_sigma(
    sigma: np.ndarray, turned: np.ndarray, lasted: np.ndarray, parameters: MargReplay
) -> np.ndarray:
    """Standard deviations (B, n), with `StatedErrors` added to those of attitude.

    Args:
        sigma: (B, n) of the filter, attitude first.
        turned: (B,) rad, angle turned in each block.
        lasted: (B,) s, duration of each block.
        parameters: have the stated errors.
    """
    stated = parameters.stated
    late = stated.delay * turned / lasted
    floor = np.stack([np.hypot(x, late) for x in [stated.tilt] * 2 + [stated.heading]], axis=1)
    return np.concatenate([np.hypot(sigma[:, :3], floor), sigma[:, 3:]], axis=1)


def _estimates(mean: model.MargState) -> Mapping[str, Numbers]:
    values = {name: np.asarray(getattr(mean, of)) for name, of in _ESTIMATED.items()}
    return {name: x.reshape(len(x), -1) for name, x in values.items()} | {"q_nb": mean.q_nb.wxyz}


REPORTED = ReportedItems(
    blocks=_BLOCKS,
    sensors=model.SENSORS,
    estimates=_estimates,
    causes="Likely causes: a magnetometer without calibration (`robins calibrate`) or near iron, "
    "axes or units of a sensor that differ from those stated, or noise of the gyro stated too "
    "small.",
    assumed=tuple(model.SENSORS),
    euler=EULER._replace(frame="body to NED"),
)


def _accuracy(q_nb: np.ndarray, q_true: np.ndarray, counts: np.ndarray) -> dict[str, float | int]:
    e = orientation_errors(q_nb[counts], q_true[counts])
    return {
        "total_rmse_deg": rms_deg(e.total),
        "heading_rmse_deg": rms_deg(e.heading),
        "inclination_rmse_deg": rms_deg(e.inclination),
        "total_max_deg": float(np.degrees(np.max(e.total, initial=0.0))),
        "samples_compared": int(np.sum(counts)),
    }


def _errors(q: np.ndarray, q_true: np.ndarray) -> np.ndarray:
    """Errors (B, 3) [rad], true minus estimated: tilt about north and east, and heading."""
    # tilt of the true vertical relative to the estimated one, about estimated north and east
    true_down = rotation.to_dcm(q_true)[:, 2]
    north, east, _ = np.moveaxis(rotation.to_dcm(q), 1, 0)
    tilt = np.sum(east * true_down, axis=1), -np.sum(north * true_down, axis=1)
    return np.stack([*tilt, -orientation_errors(q, q_true).heading], axis=1)


def _error_arrays(
    answers: Mapping[str, FilterEstimates], errors: Mapping[str, np.ndarray]
) -> Variables:
    out: dict[str, Any] = {}
    every = np.stack(list(errors.values()))
    sigma = np.stack([answer.sigma[:, :3] for answer in answers.values()])
    for block, words in (
        (_HEADING, "true minus estimated heading"),
        (_INCLINATION, "tilt of true against estimated"),
    ):
        out |= block_array("error", block, every[..., block.where], words)
        out |= block_array("sigma", block, sigma[..., block.where])
    return out


def _refused(log: PreparedMargLog, answer: FilterEstimates) -> np.ndarray:
    """Mask (B,) of blocks whose magnetometer measurement was refused."""
    update = answer.updates.get(model.MAGNETOMETER)
    none = np.zeros(len(log.rows), dtype=bool)
    return none if update is None else update.code == int(Code.REFUSED)


def _variables(
    log: PreparedMargLog,
    answers: Mapping[str, FilterEstimates],
    doubt: Mapping[str, monitor.Contradictions],
) -> Variables:
    still = log.still.astype(np.int8)
    data = array("context", still, "rest", unit="1", long_name="unit lies still")
    doubtful = [doubt[name].any for name in answers]
    refused = [_refused(log, answer) for answer in answers.values()]
    for name, rows, words in (
        ("doubtful", doubtful, "states or innovations beyond what was assumed"),
        ("magnetic_disturbance", refused, "magnetometer refused"),
    ):
        values = np.stack(rows).astype(np.int8)
        data |= array("context", values, name, unit="1", long_name=words, dims="filter time")
    return data


def _attitudes(log: PreparedMargLog, q_nb: Mapping[str, np.ndarray]) -> Variables:
    """Attitude at every sample, with its own time axis."""
    since_s = (log.time_ns - log.time_ns[0]) * 1e-9
    clock = variable("sample_time", since_s, "s", "time of the inertial samples")
    words = "estimated attitude at every sample"
    q = np.stack(list(q_nb.values()))
    return {"sample_time": clock} | attitude_array(q, "body to NED", "sample_time", words)


def _sentences(log: PreparedMargLog, answers: Mapping[str, FilterEstimates]) -> list[str]:
    """Remarks for the reader of the report."""
    c = log.counts
    out = [
        log.look.sentence,
        f"At rest for {100.0 * float(np.mean(log.still)):.0f} % of the log. Of the inertial "
        f"samples {c['imu_missing']} are missing, {c['imu_saturated']} are at the end of their "
        f"range ({c['imu_bridged']} put back from their flanks) and {c['imu_frozen']} repeat the "
        f"same rate of hanging gyros; there are {c['imu_gaps']} gaps. Of the field readings "
        f"{c['field_missing']} are missing and {c['field_implausible']} cannot be of the Earth's "
        f"field. {c['blocks_in_free_fall']} blocks are in free fall.",
    ]
    return out + [_turned_from_to(log, answer) for answer in answers.values()]


def _turned_from_to(log: PreparedMargLog, answer: FilterEstimates) -> str:
    """Sentence on the attitude at the first and at the last epoch, with its sigma."""
    said = []
    for at in (0, -1):
        euler = np.degrees(rotation.to_euler(jnp.asarray(answer.mean.q_nb.wxyz)[at]))
        north, east, heading = np.degrees(answer.sigma[at, :3])
        said.append(
            f"at {log.epoch_s[at]:.1f} s roll {euler[0]:.1f}, pitch {euler[1]:.1f}, heading "
            f"{euler[2] % 360.0:.1f} deg (sigma of the tilt {max(north, east):.1f}, of the heading "
            f"{heading:.1f} deg)"
        )
    return f"{answer.name}: {', '.join(said)}."


def _field_sentences(
    log: PreparedMargLog, answers: Mapping[str, FilterEstimates]
) -> tuple[list[str], list[str]]:
    """Sentences on refused magnetometer readings: notes, or warnings from a share of a third.

    Where there are `FEWEST` readings or more, `replaying.outcome` warns of the share.
    """
    notes, warned = [], []
    for name, answer in answers.items():
        refused = _refused(log, answer)
        update, count = answer.updates.get(model.MAGNETOMETER), int(np.sum(refused))
        looked = 0 if update is None else int(np.sum((update.dof > 0) | refused))
        if looked and not count:
            notes.append(f"{name}: the field was undisturbed at all {looked} looks.")
        elif looked:
            unjudged = looked < FEWEST and count >= REFUSED_SHARE * looked
            (warned if unjudged else notes).append(
                f"{name}: the field was disturbed at {count} of {looked} looks; heading "
                "then came from the gyros."
            )
    return notes, warned
