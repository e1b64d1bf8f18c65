"""Recorded logs: one clock, an alignment, epochs with their measurements, and what a replay found.

Two rates: every IMU sample is mechanised, the covariance moves once a block. A gap in the IMU that
is too long to bridge ends a piece of the log; the next piece is aligned anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import Dataset, GnssTable
from robins.earth import Geodetic, gravity
from robins.filters import Belief
from robins.ins.alignment import level
from robins.ins.blocks import cut, epochs_between, gained_in_window, rate_about
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav
from robins.ins.rest import moving_statistics, standstill
from robins.ins.state import InsState
from robins.results import Outcome, Progress, array, silent, variable
from robins.rotation import Rotation
from robins.systems import replaying
from robins.systems.ins_gnss import model
from robins.systems.ins_gnss.parameters import Aids, Replay, Start
from robins.systems.ins_gnss.study import SMOOTHERS, make_filter
from robins.systems.parts import Block
from robins.systems.replaying import Piece, Reported
from robins.systems.study import Case, Contender
from robins.systems.tables import place_arrays, track_arrays

CAUSES = (
    "Likely causes: the lever arm or the latency of the GNSS, the mounting of the unit, sigmas "
    "that the receiver states too small, noise of the IMU told too small, a velocity that is a "
    "mean over the receiver's interval, or a vehicle that was taken for still; `robins doctor` "
    "tells some of them."
)
RTK_QUALITY = {1: "fix", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}


class Log(NamedTuple):
    """A log or a piece of it, NED/FRD, in seconds since the first IMU sample."""

    increments: Increments  # dt (N,), theta (N, 3), dv (N, 3)
    time_s: np.ndarray  # (N,) end of each increment
    gnss: GnssTable  # M fixes, of the whole log
    gnss_s: np.ndarray  # (M,)
    sigma_m: np.ndarray  # (M, 3) believed by the filter
    v_n: np.ndarray | None  # (M, 3), None where velocities are not used
    sigma_v: np.ndarray | None
    withheld: np.ndarray  # (M,) bool


class StartPoint(NamedTuple):
    """Where and how the filter begins."""

    fix: int  # row of the whole fix that it begins at
    q_nb: np.ndarray  # (4,)
    tilt_sigma_rad: float
    gyro_bias: np.ndarray  # (3,) rad/s, mean rate of a standstill, else zero
    sentence: str  # how it was found, for the reader


@dataclass(frozen=True, kw_only=True)
class Stretch(Piece):
    """A piece of a log that is navigated; its world is a `Case`."""

    start: StartPoint
    rate_b: np.ndarray  # (E, 3) rad/s mean raw gyro rate about each epoch
    used: np.ndarray  # (M,) bool, fixes of the log that fall on an epoch of the piece
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
    return Log(
        Increments(*(np.asarray(a, dtype=float) for a in increments[:3])),
        time_s,
        gnss,
        gnss_s,
        np.maximum(gnss.sigma_m * factor[:, None], g.least_sigma),
        v_n if sigma_v is not None else None,
        sigma_v,
        parameters.withheld(gnss_s, gnss_s),
    )


def with_lever_arm(parameters: Replay, arm: tuple[float, float, float] | None) -> Replay:
    """The parameters with the lever arm that the log was loaded with, if it was with one.

    Raises:
        ValueError: the parameters have another.
    """
    other = parameters.gnss.lever_arm
    if arm is None:
        return parameters
    if any(other) and not np.allclose(arm, other, rtol=0.0, atol=1e-6):
        raise ValueError(
            f"the log was loaded with a lever arm of {arm} m, and gnss.lever_arm is {other} m; "
            "give one of the two"
        )
    gnss = parameters.gnss.model_copy(update={"lever_arm": arm})
    return parameters.model_copy(update={"gnss": gnss})


# ------------------------------------------------------------------------------------- the start


@jax.jit
def _turned(q, theta):
    def step(q, t):
        return rotation.normalise(rotation.multiply(q, rotation.from_rotvec(t))), None

    return jax.lax.scan(step, q, theta)[0]


def with_heading(q_nb: np.ndarray, heading_rad: float) -> np.ndarray:
    """The same tilt with another heading."""
    _, _, now = rotation.to_euler(jnp.asarray(q_nb))
    turn = rotation.from_rotvec(jnp.array([0.0, 0.0, 1.0]) * (heading_rad - now))
    return np.asarray(rotation.multiply(turn, jnp.asarray(q_nb)))


def find_start(log: Log, start: Start, aids: Aids) -> StartPoint:
    """Level on the quietest early window; take the heading as given or from the GNSS course.

    The gyros carry the tilt from that window to the moment the course is known (first fix faster
    than ``start.course_speed``); body forward is then taken along the course. The filter begins at
    the first whole fix from there on.

    Raises:
        ValueError: no heading is known: none was given, and no fix is fast enough; there is no
            whole fix, or none after that moment; or the mean specific force is not gravity's.
    """
    (dt, theta, dv), time_s, gnss_s = log.increments[:3], log.time_s, log.gnss_s
    g, v_n, begin_s = log.gnss, log.gnss.v_n, time_s[0] - dt[0]
    whole = np.all(np.isfinite([g.lat_rad, g.lon_rad, g.alt_m]), axis=0)
    whole &= (gnss_s > begin_s) & (gnss_s <= time_s[-1])
    if not np.any(whole):
        raise ValueError(f"no whole GNSS fix between {begin_s:.1f} and {time_s[-1]:.1f} s")
    fast = None
    if start.known_heading is None:
        if v_n is None:
            raise ValueError(
                "the heading at the start is not known: the log has no GNSS velocity to take a "
                "course from; give start.known_heading"
            )
        speed = np.hypot(v_n[:, 0], v_n[:, 1])
        usable = np.flatnonzero((speed >= start.course_speed) & (gnss_s > time_s[0]))
        if len(usable) == 0:
            raise ValueError(
                f"the heading at the start is not known: the fastest fix moves at "
                f"{np.nanmax(speed):.2f} m/s and a course is taken from "
                f"{start.course_speed:.2f} m/s on; lower start.course_speed or give "
                f"start.known_heading"
            )
        fast = usable[0]
    still, mean_rate = standstill(log.increments, *aids.quiet)
    width = max(2, round(2.0 * aids.window / float(np.median(dt))))
    mean_force, spread = moving_statistics(dv / dt[:, None], width)
    last = len(dt) - 1 if fast is None else int(np.searchsorted(time_s, gnss_s[fast]))
    quiet_enough = np.flatnonzero(still[: last + 1])
    if len(quiet_enough):
        at = int(quiet_enough[min(len(quiet_enough) - 1, width)])
        tilt, how, bias = start.tilt, "at rest", np.mean(mean_rate[quiet_enough], axis=0)
    else:
        first = min(width - 1, last)
        at = first + int(np.argmin(np.sum(spread[first : last + 1] ** 2, axis=1)))
        tilt, how, bias = 3.0 * start.tilt, "on the quietest second, moving", np.zeros(3)
    force, some = mean_force[at], np.flatnonzero(whole)[0]
    here = float(gravity(*(jnp.asarray(float(x[some])) for x in (g.lat_rad, g.alt_m))))
    if not 0.5 * here < np.linalg.norm(force) < 1.5 * here:
        raise ValueError(
            f"cannot level: the mean specific force at {time_s[at]:.2f} s is "
            f"{np.linalg.norm(force):.2f} m/s^2, gravity is {here:.2f}"
        )
    sentence = f"levelled {how} at {time_s[at]:.1f} s"
    heading = start.known_heading or 0.0
    q_nb = np.asarray(level(force, 0.0, heading).q_nb.wxyz)
    begin_s = float(time_s[at])
    if fast is None:
        sentence += f", heading given as {np.degrees(heading):.1f} deg"
    else:
        assert v_n is not None
        carried = jnp.asarray(theta[at + 1 : last + 1] - bias * dt[at + 1 : last + 1, None])
        heading = float(np.arctan2(v_n[fast, 1], v_n[fast, 0]))
        q_nb = with_heading(np.asarray(_turned(jnp.asarray(q_nb), carried)), heading)
        begin_s = float(gnss_s[fast])
        sentence += (
            f"; heading {np.degrees(heading) % 360:.1f} deg from the course at {begin_s:.1f} s, "
            f"when the speed reached {np.hypot(*v_n[fast, :2]):.2f} m/s"
        )
    later = np.flatnonzero(whole & (gnss_s >= begin_s - 1e-6))
    if len(later) == 0:
        raise ValueError(f"no whole GNSS fix after the attitude is known, at {begin_s:.1f} s")
    return StartPoint(int(later[0]), q_nb, tilt, bias, sentence)


# ------------------------------------------------------------------------------ piece to a case


def prepare(whole: Log, parameters: Replay, rows: slice) -> Stretch:
    """Align on a piece of a log, place the epochs and sort the measurements to them.

    Raises:
        ValueError: no start can be found, or no fix lies in the piece.
    """
    increments = Increments(*(a[rows] for a in whole.increments[:3]))
    log = whole._replace(increments=increments, time_s=whole.time_s[rows])
    start = find_start(log, parameters.start, parameters.aids)
    begin_s, end_s = float(log.gnss_s[start.fix]), float(log.time_s[-1])
    used = (log.gnss_s > begin_s) & (log.gnss_s <= end_s)
    if not np.any(used):
        raise ValueError(f"no GNSS fix after the start at {begin_s:.1f} s")
    epochs = epochs_between(begin_s, end_s, log.gnss_s[used], parameters.update.longest_block)
    blocks = cut(increments, log.time_s, begin_s, epochs)
    scale = replaying.noise_scale(blocks, increments.dt, parameters.update.gap_noise)
    rate = rate_about(increments, log.time_s, epochs)
    y, aux = _fixes(log, used, epochs, rate, parameters.gnss.velocity_window)
    known, about = _known(log, epochs, rate, parameters.aids)
    belief, u = _belief(log, start, parameters), Block(blocks.increments, scale)
    return Stretch(
        world=Case(belief, u, y | known, aux | about, None),
        begin_s=begin_s,
        epoch_s=epochs,
        noise_scale=scale,
        start=start,
        rate_b=rate,
        used=used,
        withheld=parameters.withheld(epochs, log.gnss_s),
    )


def _belief(log: Log, start: StartPoint, parameters: Replay) -> Belief:
    """At the first fix, moved from the antenna to the IMU."""
    g, row = log.gnss, start.fix
    v = np.zeros(3) if log.v_n is None else np.nan_to_num(log.v_n[row])
    antenna = Geodetic(*(jnp.asarray(a[row]) for a in (g.lat_rad, g.lon_rad, g.alt_m)))
    q_nb = Rotation(jnp.asarray(start.q_nb))
    arm = q_nb.apply(np.asarray(parameters.gnss.lever_arm))
    position = antenna.retract(-arm + jnp.asarray(v * parameters.gnss.latency))
    nav = Nav(q_nb, jnp.asarray(v), position)
    return model.start_belief(
        nav,
        parameters.imu,
        parameters.start,
        tilt_rad=start.tilt_sigma_rad,
        heading_rad=parameters.start.heading,
        gyro_bias=start.gyro_bias,
    )


def _fixes(
    log: Log, used: np.ndarray, epochs: np.ndarray, rate: np.ndarray, window_s: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """GNSS measurements by epoch; NaN where there is no fix or it is withheld."""
    given, g = used & ~log.withheld, log.gnss
    at = np.searchsorted(epochs, log.gnss_s[given] - 1e-9)

    def sorted_in(values: np.ndarray, fill: float = np.nan) -> np.ndarray:
        out = np.full((len(epochs), *values.shape[1:]), fill)
        out[at] = values[given]
        return out

    y: dict[str, Any] = {model.POSITION: Geodetic(*map(sorted_in, (g.lat_rad, g.lon_rad, g.alt_m)))}
    aux: dict[str, Any] = {model.POSITION: model.Fix(sorted_in(log.sigma_m, 1.0), rate)}
    if log.v_n is not None and log.sigma_v is not None:
        gained = gained_in_window(log.increments, log.time_s, epochs, window_s)
        y[model.VELOCITY] = sorted_in(log.v_n)
        aux[model.VELOCITY] = model.Velocity(sorted_in(log.sigma_v, 1.0), rate, *gained)
    return y, aux


def _known(
    log: Log, epochs: np.ndarray, rate: np.ndarray, aids: Aids
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Measurements of what is known without a receiver: standing still, or not slipping."""
    still, mean_rate = standstill(log.increments, *aids.quiet)
    last = np.minimum(np.searchsorted(log.time_s, epochs - 1e-9), len(log.time_s) - 1)
    at_rest = still[last][:, None]
    y: dict[str, Any] = {}
    if aids.zero_velocity:
        y[model.STANDSTILL] = np.where(at_rest, np.zeros((len(epochs), 3)), np.nan)
        y[model.STILL_RATE] = np.where(at_rest, mean_rate[last], np.nan)
    if aids.non_holonomic:
        y[model.ROAD] = np.where(at_rest, np.nan, np.zeros((len(epochs), 2)))
    return y, {model.ROAD: rate} if aids.non_holonomic else {}


def contender(parameters: Replay, name: str) -> Contender:
    """A filter with the model it believes in."""
    believed = model.ins_gnss_model(parameters.imu, parameters.gnss, parameters.aids)
    return Contender(make_filter(name, parameters.update.gate), believed)


def replay(
    dataset: Dataset,
    parameters: Replay,
    filters: tuple[str, ...] = (),
    progress: Progress = silent,
) -> Outcome:
    """Navigate a log of IMU and GNSS, examined and cleaned, as `System.replay` says.

    Raises:
        ValueError: the log cannot be navigated; the sentence says why and what to do.
    """
    parameters = with_lever_arm(parameters, dataset.lever_arm_b_m)
    log = on_one_clock(dataset, parameters)
    pieces, problems = replaying.prepared(
        log.time_s,
        log.increments.dt,
        parameters.update.longest_gap,
        partial(prepare, log, parameters),
    )
    wanted = filters or parameters.filters
    answers = replaying.navigated(
        pieces, wanted, partial(contender, parameters), SMOOTHERS, progress
    )
    epoch_s = replaying.epochs_of(pieces)
    rate, withheld = replaying.end_to_end([(piece.rate_b, piece.withheld) for piece in pieces])
    mount = model.mount_of(parameters.gnss, parameters.aids)
    antennas = {name: _antenna(mount, answer.mean, rate) for name, answer in answers.items()}
    variables = track_arrays(antennas.values(), "{} of the antenna") | _fix_arrays(log)
    variables |= array("outage", withheld.astype(np.int8), long_name="GNSS withheld")
    used = np.any([piece.used for piece in pieces], axis=0)
    counts = replaying.gap_counts(pieces, problems) | {"pieces_not_navigated": len(problems)}
    return replaying.outcome(
        epoch_s,
        answers,
        Reported(
            blocks=model.state_blocks(parameters.imu.scale_states),
            sensors=model.SENSORS,
            estimates=_estimates,
            causes=CAUSES,
            assumed=(model.STANDSTILL, model.STILL_RATE, model.ROAD),
        ),
        metrics=lambda answer: _distances(log, used, epoch_s, antennas[answer.name]),
        variables=variables,
        counts=dict(dataset.counts) | counts,
        notes=[f"Start: {piece.start.sentence}." for piece in pieces]
        + [f"Not navigated, {problem}." for problem in problems],
        origin_ns=int(dataset.imu.time_ns[0]),
    )


@jax.jit
def _antenna(mount: model.Mount, mean: InsState, rate_b) -> Geodetic:
    """Where a filter thinks the antenna is, at each epoch."""
    return jax.vmap(lambda x, omega: model.read_position(mount, x, omega))(mean, rate_b)


def _estimates(mean: InsState) -> Mapping[str, Any]:
    biases_and_scales = {name: getattr(mean, name) for name in InsState._fields[3:]}
    return {"velocity": mean.v_n, "q_nb": mean.q_nb.wxyz, **biases_and_scales}


def _distances(
    log: Log, used: np.ndarray, epoch_s: np.ndarray, antenna: Geodetic
) -> dict[str, Any]:
    """How far the antenna is from the best fixes, with aids and in outages.

    The best fixes are those of quality 1 where the receiver states a quality, else all.
    """
    g = log.gnss
    use = used & np.isfinite(g.lat_rad) & np.isfinite(g.alt_m)
    if g.quality is not None and np.any(use):
        use = use & (g.quality == np.min(g.quality[use]))
    epoch = np.searchsorted(epoch_s, log.gnss_s[use] - 1e-9)
    at = jax.tree_util.tree_map(lambda x: x[epoch], antenna)
    fix = Geodetic(*(jnp.asarray(v[use]) for v in (g.lat_rad, g.lon_rad, g.alt_m)))
    error, withheld = np.asarray(fix.local(at)), log.withheld[use]
    across = np.hypot(error[:, 0], error[:, 1])
    out: dict[str, Any] = {
        "aided_horizontal_rms_m": _rms(across[~withheld]),
        "aided_vertical_rms_m": _rms(error[~withheld, 2]),
        "aided_fixes": int(np.sum(~withheld)),
    }
    if np.any(withheld):
        out |= {
            "outage_horizontal_rms_m": _rms(across[withheld]),
            "outage_horizontal_max_m": float(np.max(across[withheld])),
            "outage_vertical_rms_m": _rms(error[withheld, 2]),
            "outage_fixes": int(np.sum(withheld)),
        }
    return out


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else float("nan")


def _fix_arrays(log: Log) -> dict[str, Any]:
    g = log.gnss
    out: dict[str, Any] = {
        "gnss_time": variable("gnss_time", log.gnss_s, "s", "time of the fixes"),
    }
    out |= place_arrays("gnss", (g.lat_rad, g.lon_rad, g.alt_m), "{} of the fixes")
    if g.quality is not None:
        known = [q for q in RTK_QUALITY if np.any(g.quality == q)]
        out |= array(
            "gnss_quality",
            g.quality.astype(np.int32),
            flag_values=np.asarray(known, dtype=np.int32),
            flag_meanings=" ".join(RTK_QUALITY[q] for q in known),
        )
    return out
