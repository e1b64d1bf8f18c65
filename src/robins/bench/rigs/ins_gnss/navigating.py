"""Config of a drive, its three parts, and its evaluation."""

from __future__ import annotations

import json
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins import logs, manifold
from robins.bench.evaluation import (
    MessageSeries,
    PageView,
    RunFigures,
    RunResult,
    figures_of,
    latest,
    rms,
)
from robins.bench.live.feed import Signal
from robins.bench.parts.station import Inputs, Part
from robins.bench.recording.topics import JSON, Topic, as_json, nav_sat_fix
from robins.bench.recording.topics import imu as imu_of_ros
from robins.bench.rig import ExportSources, LoadedRun, RigError, Timing
from robins.bench.rigs.ins_gnss import FLAGS, SUSPECTS
from robins.bench.run.setup import Setup
from robins.bench.wire.fields import Values
from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.earth import Geodetic
from robins.ins.blocks import rate_about
from robins.ins.mechanise import Nav
from robins.ins.state import InsState
from robins.logs.ordering import rows_where
from robins.ros import Message
from robins.rotation import Rotation
from robins.scenario import Quantity, default
from robins.systems.ins_gnss import aboard as program
from robins.systems.ins_gnss import model
from robins.systems.ins_gnss.live import LiveInsGnss, Navigation
from robins.systems.ins_gnss.parameters import Drive, Gnss, InsGnssReplay
from robins.systems.ins_gnss.recording import (
    Log,
    as_rates,
    in_body_axes,
    on_one_clock,
    with_lever_arm,
)
from robins.systems.ins_gnss.reported import antenna_of, distances, fix_arrays
from robins.systems.ins_gnss.world import drive_dataset
from robins.systems.parts import motion_of
from robins.systems.suspects import probability_array, sentences, words
from robins.systems.tables import attitude_array, block_array, track_arrays

_SHARED = ("system", "title", "imu", "start", "aids", "update", "outages", "log")


class NavigationParameters(InsGnssReplay):
    """Filter parameters of the navigation computer, and the source of the samples.

    A configuration of a replay, with the files of a ``log``; or a scenario of a simulated drive,
    whose sensor errors the filter assumes as simulated. With neither, boards at ``imu`` and
    ``gnss`` send at ``imu_rate`` and ``fix_rate``, for the ``duration``.
    """

    log: tuple[str, ...] = ()
    drive: Drive | None = None
    duration: Annotated[float, Quantity("time", above="0 s", most="1 d")] = default("10 min")
    imu_rate: Annotated[float, Quantity("frequency", above="0 Hz", most="1 kHz")] = default(
        "100 Hz"
    )
    fix_rate: Annotated[float, Quantity("frequency", above="0 Hz", most="1 kHz")] = default("1 Hz")

    @classmethod
    def model_validate_json(
        cls, json_data: str | bytes | bytearray, **options: Any
    ) -> NavigationParameters:
        """Parse a scenario; that of a drive is split into truth and filter parameters."""
        said = json.loads(json_data)
        if "legs" in said:
            gnss = {k: v for k, v in said.get("gnss", {}).items() if k in Gnss.model_fields}
            drive = {k: v for k, v in said.items() if k != "log"}
            said = {k: said[k] for k in _SHARED if k in said} | {"gnss": gnss, "drive": drive}
        return super().model_validate_json(json.dumps(said), **options)


class InsGnssConfig(NamedTuple):
    """Complete input of a run."""

    step_ns: int
    given: InsGnssReplay
    filter: str
    machine: str | None  # that steps the filter; None: as `LiveInsGnss` chooses
    rates_hz: tuple[float, float]  # of samples and fixes
    dataset: Dataset | None  # rates along the unit's axes and fixes in NED; None: boards send
    frames: tuple[int, ...] = (0,)  # all steps are computed alike


@lru_cache(maxsize=4)
def _read_log(files: tuple[str, ...]) -> Dataset:
    dataset = logs.clean(logs.load_dataset(files))
    if dataset.gnss is None or len(dataset.gnss) == 0:
        raise RigError("the log has no GNSS fixes", ", ".join(files), "give the receiver's file")
    return as_rates(dataset)


def _rate_hz(table: ImuTable | GnssTable | None) -> float:
    # rounded as in a replay: the detection of a missing sample may depend on the last digit
    if table is None or len(table) < 2:
        return 1.0
    return 1.0 / float(np.median(np.diff(table.time_ns) * 1e-9))


def timing(given: NavigationParameters) -> Timing:
    """Steps of a run, one per sample; those of a log in the order of its rows, gaps ignored."""
    if given.log:
        samples = _read_log(given.log).imu
        return Timing(1.0 / _rate_hz(samples), len(samples), 0)
    lasts_s, rate_hz = given.duration, given.imu_rate
    if given.drive is not None:
        drive = given.drive
        lasts_s, rate_hz = motion_of(drive.place, drive.legs).duration_s, drive.imu_rate
    return Timing(1.0 / rate_hz, round(lasts_s * rate_hz), 0)


def prepare(setup: Setup, given: NavigationParameters) -> InsGnssConfig:
    """The config of a run.

    Raises:
        RigError: nothing sends as imu or gnss.
        robins.logs.LogError: a file of the log cannot be read.
    """
    believed = InsGnssReplay(**{k: getattr(given, k) for k in InsGnssReplay.model_fields})
    dataset = None
    if given.log:
        dataset = _read_log(given.log)
        believed = with_lever_arm(believed, dataset.lever_arm_b_m)
    elif given.drive is not None:
        dataset = as_rates(drive_dataset(given.drive, setup.seed))
    elif silent := sorted({"imu", "gnss"} - set(setup.ports)):
        what = "this configuration has no log and no drive"
        fix = 'give a log, --set \'log=["imu.csv", "gnss.pos"]\', or boards, --node imu=PORT'
        raise RigError(f"nobody speaks as {' and '.join(silent)}: {what}", fix=fix)
    rates_hz = given.imu_rate, given.fix_rate
    if dataset is not None:
        rates_hz = _rate_hz(dataset.imu), _rate_hz(dataset.gnss)
    step_ns = round(1e9 * timing(given).step_s)
    return InsGnssConfig(step_ns, believed, setup.filter, setup.machine, rates_hz, dataset)


def imu(config: InsGnssConfig) -> Part:
    """The inertial unit: one sample per step."""
    samples = None if config.dataset is None else config.dataset.imu

    def act(state: None, k: int, inputs: Inputs):
        if samples is None or k >= len(samples):
            return None, []
        said = {"omega_s": samples.gyro[k], "f_s": samples.accel[k]}
        return None, [("sample", {"time": int(samples.time_ns[k]), **said})]

    return Part("imu", {}, lambda: None, act)


def gnss(config: InsGnssConfig) -> Part:
    """The receiver: a fix with the first sample that is not older; in an outage, a fix of NaN.

    Its state is the number of the next fix.
    """
    if config.dataset is None or config.dataset.gnss is None:
        return Part("gnss", {}, lambda: 0, lambda sent, k, inputs: (sent, []))
    fixes, sample_ns = config.dataset.gnss, config.dataset.imu.time_ns
    since_s = (fixes.time_ns - sample_ns[0]) * 1e-9
    place = np.stack([fixes.lat_rad, fixes.lon_rad, fixes.alt_m], axis=1)
    nothing = np.full(place.shape, np.nan)
    v_n, sigma_v = (nothing if x is None else np.array(x) for x in (fixes.v_n, fixes.sigma_v))
    withheld = config.given.withheld(since_s, since_s)
    place[withheld] = v_n[withheld] = np.nan

    def act(sent: int, k: int, inputs: Inputs):
        if sent == len(fixes) or fixes.time_ns[sent] > sample_ns[min(k, len(sample_ns) - 1)]:
            return sent, []
        lat, lon, alt = place[sent]
        said = {"lat": lat, "lon": lon, "alt": alt, "v_n": v_n[sent], "sigma_v": sigma_v[sent]}
        said |= {"time": int(fixes.time_ns[sent]), "sigma": fixes.sigma_m[sent]}
        said |= {"quality": 0 if fixes.quality is None else int(fixes.quality[sent])}
        return sent + 1, [("fix", said)]

    return Part("gnss", {}, lambda: int(np.searchsorted(since_s, 0.0, side="right")), act)


InsGnssNavigationState = tuple[LiveInsGnss, tuple[Navigation, ...]]
"""State of the navigation computer: one mutable object, and the epochs still to be sent, one per
step."""


def navigation(config: InsGnssConfig) -> Part:
    """The navigation computer: sends what `LiveInsGnss` reports."""

    @cache
    def made() -> LiveInsGnss:  # compiles; not needed to query the inputs
        return LiveInsGnss(config.given, *config.rates_hz, config.filter, machine=config.machine)

    def begin() -> InsGnssNavigationState:
        made().start_over()
        return made(), ()

    def act(state: InsGnssNavigationState, k: int, inputs: Inputs):
        live, waiting = state
        answer, flags = None, 0
        if (sample := inputs["sample"]) is not None:
            answer = live.push_imu(sample["time"], sample["omega_s"], sample["f_s"])
            flags, waiting = answer.flags, (*waiting, *live.passed)
        if (fix := inputs["fix"]) is not None:
            place = fix["lat"], fix["lon"], fix["alt"]
            moves = (fix["v_n"], fix["sigma_v"]) if np.any(np.isfinite(fix["v_n"])) else ()
            answer = live.push_fix(
                fix["time"], *place, fix["sigma"], *moves, quality=fix["quality"]
            )
            flags, waiting = flags | answer.flags, (*waiting, *live.passed)
        said: list[tuple[str, Values]] = []
        if answer is not None:
            said.append(("state", {**_answer_fields(answer), "flags": int(flags)}))
        if waiting:
            said.append(("epoch", _answer_fields(waiting[0])))
        return (live, waiting[1:]), said

    nothing = {"sample": None, "fix": None}
    return Part("navigation", {"sample": 0, "fix": 0}, begin, act, nothing)


def _answer_fields(n: Navigation) -> Values:
    place = {"lat": n.lat_rad, "lon": n.lon_rad, "alt": n.alt_m}
    wrong = np.array([n.wrong.get(name, np.nan) for name in SUSPECTS])
    state = {"time": n.time_ns, "q_nb": n.q_nb, "v_n": n.v_n, "sigma": n.sigma}
    return {**state, **place, "wrong": wrong}


def aboard(flight: LoadedRun) -> ExportSources:
    """Filter and loop of the navigation computer as a program, for the drive or log of a flight.

    Raises:
        RobinsError: nothing sends as imu or gnss, the log cannot be read or navigated, or the part
            needs what the loop does not do.
    """
    config = prepare(flight.setup, flight.given)
    if config.dataset is None or config.dataset.gnss is None:
        raise RigError("the filter is tried on a drive or a log, and there is none", "--board")
    problem, constants = program.export_sources(
        config.given, config.dataset, config.rates_hz, flight.setup.filter, SUSPECTS, flight.name
    )
    here = sorted(Path(__file__).parent.glob("navigation_*.[ch]"))
    files = {path.name: path.read_text("utf-8") for path in here}
    return ExportSources(problem, "filter", {**files, "navigation_given.h": constants})


def topics(config: InsGnssConfig) -> tuple[Topic, ...]:
    """Conversions to ROS 2 of samples and fixes, for `robins replay` of a record, and of states."""

    def fix(v: Values) -> Message:
        covariance = np.diag(np.square(v["sigma"]))
        return nav_sat_fix(v["lat"], v["lon"], v["alt"], covariance=covariance)

    def sample(v: Values) -> Message:
        return imu_of_ros(v["omega_s"], v["f_s"], body="FRD")

    return (
        Topic("sample", "/imu/data_raw", "sensor_msgs/msg/Imu", sample, "imu", "time"),
        Topic("fix", "/gnss/fix", "sensor_msgs/msg/NavSatFix", fix, "gnss", "time"),
        Topic("state", "/navigation/state", JSON, as_json, "imu", "time"),
    )


def judge(flight: LoadedRun, result: RunResult) -> RunFigures:
    """Figures of a replay of the log, and errors where the truth is known."""
    series, config, blocks = result.series, result.config, model.state_blocks(False)[:3]
    arrays = track_arrays([_nav(series, "state").position], "{} of the unit")
    arrays |= attitude_array(series["state.q_nb"][None], "FRD to NED")
    for block in blocks:
        arrays |= block_array("sigma", block, series["state.sigma"][None, :, block.where])
    metrics: dict[str, Any] = {}
    if config.dataset is not None:
        log = on_one_clock(in_body_axes(config.dataset, config.given.imu.orientation), config.given)
        metrics, flew = against_fixes(config, log, series), log.gnss_s <= series.time_s[-1]
        flown_by = log._replace(gnss=rows_where(log.gnss, flew), gnss_s=log.gnss_s[flew])
        arrays |= fix_arrays(flown_by)
    if config.dataset is not None and config.dataset.truth is not None:
        error = against_truth(config.dataset.truth, series)
        for block in blocks:
            arrays |= block_array("error", block, error[None, :, block.where])
        metrics["heading_rms_deg"] = rms(np.degrees(error[:, 2]))
        metrics["velocity_rms_m_s"] = rms(np.linalg.norm(error[:, 3:6], axis=1))
        metrics["horizontal_rms_m"] = rms(np.linalg.norm(error[:, 6:8], axis=1))
    flags = series["state.flags"]
    counts = {f"steps_{of}": int(np.sum(flags >> k & 1)) for k, of in enumerate(FLAGS[:2])}
    each = zip(SUSPECTS, series["state.wrong"].T, strict=True)
    wrong = {name: x for name, x in each if np.any(np.isfinite(x))}
    arrays |= probability_array("wrong", [wrong])
    said = sentences("navigation", series.time_s, wrong)
    return RunFigures(metrics, counts, arrays=arrays, lines=[*figures_of(metrics), *said])


def _nav(series: MessageSeries, message: str, rows: np.ndarray | slice = slice(None)) -> Nav:
    q, v, *place = (series[f"{message}.{f}"][rows] for f in ("q_nb", "v_n", "lat", "lon", "alt"))
    return Nav(Rotation(q), jnp.asarray(v), Geodetic(*place))


def epochs_of(series: MessageSeries) -> np.ndarray:
    """Steps in which the final estimate of each epoch was sent, in the order of epochs."""
    heard = np.flatnonzero(series["epoch.time"] > 0)[::-1]
    return heard[np.unique(series["epoch.time"][heard], return_index=True)[1]]


def against_fixes(config: InsGnssConfig, log: Log, series: MessageSeries) -> dict[str, Any]:
    """Distances of the antenna from the fixes, as in `robins replay`.

    The gyro bias is not on the wire: with a latency it would move the antenna by the lever arm
    times both.
    """
    assert config.dataset is not None
    if not len(rows := epochs_of(series)):
        return {}
    epoch_s = (series["epoch.time"][rows] - int(config.dataset.imu.time_ns[0])) * 1e-9
    nothing = jnp.zeros((len(rows), 3))
    mean = InsState(*_nav(series, "epoch", rows), nothing, nothing)
    rate_b = rate_about(log.increments, log.time_s, epoch_s)
    antenna = antenna_of(model.mount_of(config.given.gnss, config.given.aids), mean, rate_b)
    near = np.minimum(np.searchsorted(epoch_s, log.gnss_s - 1e-6), len(epoch_s) - 1)
    return distances(log, np.abs(epoch_s[near] - log.gnss_s) < 1e-6, epoch_s, antenna)


def against_truth(t: Trajectory, series: MessageSeries) -> np.ndarray:
    """(E, 9) true less estimated attitude [rad], velocity [m/s], position [m], each NED."""
    at = np.clip(np.searchsorted(t.time_ns, series["state.time"]), 0, len(t) - 1)
    place = Geodetic(*(np.asarray(x)[at] for x in (t.lat_rad, t.lon_rad, t.alt_m)))
    truth = Nav(Rotation(np.asarray(t.q_nb)[at]), jnp.asarray(t.v_n)[at], place)
    return np.asarray(jax.jit(jax.vmap(manifold.local))(_nav(series, "state"), truth))


_OFFERED = (
    {"label": "gnss: 30 m to the north", "fault": {"kind": "shifted"}},
    {"label": "gnss: no satellites", "fault": {"kind": "blind"}},
    {"label": "gnss: link silent", "fault": {"kind": "silent", "link": "gnss"}},
    {"label": "imu: 2 % of samples lost", "fault": {"kind": "loss", "link": "imu", "share": 0.02}},
)
"""Faults that the page offers."""


def view() -> PageView:
    """Page with attitude, velocity, and position relative to the start."""
    plots = (("velocity", "m/s"), ("position from the start", "m"), ("sigma of the position", "m"))
    axes = ("north", "east", "down")
    three = [Signal(f"{plot} {axis}", unit, plot) for plot, unit in plots for axis in axes]
    drawn = [*(Signal(f"q {c}", "1", "attitude", "attitude", "navigated") for c in "wxyz"), *three]
    drawn += [Signal(words(name), "1", "probability of being wrong") for name in SUSPECTS]

    def sample(series: MessageSeries, config: InsGnssConfig, since: int, step: int) -> list[float]:
        names = ("q_nb", "v_n", "sigma", "wrong", "lat", "lon", "alt")
        q, v, sigma, wrong, *place = (
            latest(series[f"state.{name}"], since, step) for name in names
        )
        known = np.flatnonzero(np.isfinite(series["state.lat"][: step + 1]))
        first = known[0] if len(known) else step
        begin = [series[f"state.{name}"][first] for name in names[4:]]
        to_m = np.array([1.0, np.cos(begin[0]), 0.0]) * 6.378137e6 - np.array([0.0, 0.0, 1.0])
        return [*q, *v, *((np.array(place) - begin) * to_m), *sigma[6:], *wrong]

    return PageView(lambda given: drawn, sample, offered=_OFFERED)
