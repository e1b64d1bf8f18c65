"""Evaluation of a run of the satellite, its page and topics, and the run inside one program."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from robins.bench.evaluation import (
    Alert,
    MessageSeries,
    OperatorEvent,
    PageView,
    RunFigures,
    RunResult,
    latest,
    rms,
)
from robins.bench.live.feed import Signal
from robins.bench.recording.topics import JSON, Topic, as_json, imu
from robins.bench.rig import LoadedRun
from robins.bench.rigs.satellite import OFFERED
from robins.bench.rigs.satellite.config import SatelliteConfig
from robins.bench.rigs.satellite.messages import (
    AS_IT_IS,
    FLAGS,
    HELD,
    KEPT,
    REFUSED,
    RUN,
    SAFE,
    SHORT,
    SILENT,
    STAND_BY,
    USED,
)
from robins.bench.rigs.satellite.reference import (
    CommandedAttitude,
    reference_q_ib,
    target_after,
    target_attitudes,
)
from robins.bench.rigs.satellite.vehicle import per_wheel
from robins.bench.run.setup import counted_from
from robins.bench.wire.fields import Values
from robins.filters import Belief, Loop, run_closed
from robins.filters.run import Step
from robins.results import array, variable
from robins.rotation import conjugate, from_rotvec, multiply, to_rotvec
from robins.systems.satellite.model import AttitudeState, QuaternionState
from robins.systems.satellite.nodes import STAR, StateForm, StepInputs, react
from robins.systems.satellite.parameters import AttitudeLoop

ARCSEC = np.pi / 648000.0
Arrays = Mapping[str, np.ndarray]


def turn(q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """(E, 3) rotation vectors [rad] of conj(q_from) q_to, in the axes of q_from."""
    return np.asarray(to_rotvec(multiply(conjugate(q_from), q_to)))


def attitude_error(series: Arrays) -> np.ndarray:
    """(E, 3) true less estimated attitude [rad], body axes."""
    return turn(series["estimate.q_ib"], series["motion.q_ib"])


def flag(series: Arrays, text: str) -> np.ndarray:
    """(E,) bool: flag of the estimate, named by its text in `FLAGS`."""
    return (series["estimate.flags"] >> FLAGS.index(text)) & 1 == 1


def rms_arcsec(error: np.ndarray, counted: slice) -> float:
    """RMS over the counted steps of the root sum square of three axes [arcsec]."""
    found = rms(error[counted])
    return float("nan") if found is None else found / ARCSEC


def peak_arcsec(error: np.ndarray, counted: slice) -> float:
    """Greatest norm over the counted steps [arcsec]."""
    size = np.linalg.norm(error[counted], axis=-1)
    return float(np.nanmax(size)) / ARCSEC if np.any(np.isfinite(size)) else float("nan")


# ------------------------------------------------------------------------------------------ figures

UNFIT = "safe: do not steer by this"
_AXES = ("x", "y", "z (boresight)")


def judge(flight: LoadedRun, result: RunResult) -> RunFigures:
    """Errors of attitude determination and of pointing, over the counted steps.

    Those of the determination exclude estimates that it flags as unfit for use.
    """
    series, counted = result.series, slice(counted_from(flight, result.steps), None)
    attitude, unfit = attitude_error(series), flag(series, UNFIT)
    stated = np.where(unfit[:, None], np.nan, attitude)
    wanted = reference_q_ib(result.config, series, len(series.time_s))
    pointing = turn(wanted, series["motion.q_ib"])
    metrics = {
        "attitude_rms_arcsec": rms_arcsec(stated, counted),
        "attitude_peak_arcsec": peak_arcsec(stated, counted),
        "pointing_rms_arcsec": rms_arcsec(pointing, counted),
        "pointing_peak_arcsec": peak_arcsec(pointing, counted),
        "attitude_end_arcsec": float(np.linalg.norm(stated[-1])) / ARCSEC,
    }
    return RunFigures(
        metrics,
        {
            "refused_measurements": int(np.sum(flag(series, "star refused"))),
            "quaternions_of_wrong_length": int(
                np.sum(flag(series, "star of a length other than one"))
            ),
            "designs_not_passed": int(np.sum(flag(series, "last gain kept: no new one passed"))),
            "steps_without_gyro": int(np.sum(flag(series, "gyro held"))),
            "steps_in_safe_mode": int(np.sum(unfit)),
        },
        warnings(attitude[counted], unfit[counted]),
        arrays(result, attitude, pointing),
        [
            f"{name.removesuffix('_arcsec').replace('_', ' '):<16}{value:10.2f} arcsec"
            for name, value in list(metrics.items())[:4]
        ],
    )


def warnings(error: np.ndarray, unfit: np.ndarray) -> list[str]:
    """Reasons to doubt the figures.

    Args:
        error: (E, 3) of the attitude, over the counted steps; NaN where it is not known.
        unfit: (E,) true where the estimate was flagged as unfit for control.
    """
    known = np.all(np.isfinite(error), axis=-1)
    unusable = (
        ("The error of the attitude is not known", np.sum(~known)),
        ("The estimate was marked as not to be steered by", np.sum(known & unfit)),
    )
    rest = f"of the {len(error)} steps that count, and the figures are those of the others"
    return [f"{what} in {steps} {rest}" for what, steps in unusable if steps]


def arrays(result: RunResult, attitude: np.ndarray, pointing: np.ndarray) -> dict[str, xr.Variable]:
    """Time series of the run, as `robins.results` names them."""
    f = result.series
    sigma, bias, innovation = (
        f["estimate.sigma"],
        f["estimate.gyro_bias"],
        f["innovation.innovation"],
    )
    heard = np.flatnonzero(np.isfinite(innovation[:, 0]))
    true_bias = np.asarray(result.config.rows.gyro_bias)[: result.steps]
    wheels = f["wheels.momentum"][:, : len(result.config.vehicle.craft.wheel_h)]
    body: dict[str, Any] = {"unit": "rad", "frame": "body", "axes": _AXES, "display_unit": "arcsec"}
    rate = body | {"unit": "rad/s", "display_unit": "arcsec/s"}
    out: dict[str, xr.Variable] = {}

    def add(role: str, values: np.ndarray, of: str, **about: Any) -> None:
        out.update(array(role, values[None], of, **about))

    add("error", attitude, "attitude", **body)
    add("sigma", sigma[:, :3], "attitude", **body)
    add("estimate", bias, "gyro_bias", **rate)
    add("error", true_bias - bias, "gyro_bias", **rate)
    add("sigma", sigma[:, 3:], "gyro_bias", **rate)
    add(
        "value",
        pointing,
        "pointing",
        long_name="pointing error",
        comment="Where the craft points against where it should.",
        **body | {"frame": "reference", "axes": ("x", "y", "z")},
    )
    add(
        "value",
        wheels,
        "wheel_momentum",
        unit="N m s",
        long_name="momentum of the wheels",
        frame="wheel axes",
        axes=[f"wheel {k}" for k in range(wheels.shape[1])],
        dims="filter time axis_wheel",
    )
    if len(heard):
        out["star_time"] = variable("star_time", f.time_s[heard], "s", "time since the start")
        add("innovation", innovation[heard], "star", **body)
        add("innovation_sigma", f["innovation.sigma"][heard], "star", **body)
        add("refused", flag(f, "star refused")[heard].astype(np.int8), "star")
    return out


# -------------------------------------------------------------------------------------- one program


@lru_cache
def _loop_step(react: Callable, form: StateForm) -> Callable:
    """Loop of one step for a form of the state; cached, so that each is compiled once."""
    return partial(react, form)


def _posterior(step: Step) -> Belief:
    return step.posterior


@partial(jax.jit, static_argnames="form")
def _attitudes(form: StateForm, mean: AttitudeState | QuaternionState) -> Array:
    return jax.vmap(form.attitude)(mean)


def inside(
    config: SatelliteConfig,
    steps: int | None = None,
    said: Sequence[OperatorEvent] = (),
    react: Callable = react,
) -> dict[str, np.ndarray] | None:
    """The same run inside one program, by `run_closed`, as `robins run --runs 1` does it.

    Args:
        config: of the run.
        steps: number of steps to run; None: all.
        said: messages of the operator. One program cannot put computers on standby or reset them:
            then the result is None.
        react: one step of the loop, as in `robins.systems.satellite.nodes`.
    """
    if any(one.message != "reference" for one in said):
        return None
    heard = [(one.step, one.values["q_ib"], one.values["rate"]) for one in said]
    loop = Loop(
        jax.tree_util.Partial(_loop_step(react, config.form), config.given),
        config.vehicle,
        jax.tree_util.tree_map(lambda x: x[:steps], _rows(config, heard)),
        {STAR: config.due[:steps]},
    )
    done = run_closed(config.filter, config.model, config.start, loop, keep=_posterior)
    mean, seen = done.steps.mean, done.readings
    momenta = np.asarray(seen.outputs["wheel_momentum"])
    return {
        # the first leaf of the state of each kind
        "motion.q_ib": np.asarray(jax.tree_util.tree_leaves(seen.truth)[0]),
        "estimate.q_ib": np.asarray(_attitudes(config.form, mean)),
        "estimate.gyro_bias": np.asarray(config.form.bias(mean)),
        "wheels.momentum": np.stack([per_wheel(h) for h in momenta]),
    }


def _rows(config: SatelliteConfig, said: list[CommandedAttitude]) -> StepInputs:
    """Inputs of each step, with the target attitudes that the operator sent."""
    if not said:
        return config.rows
    q, omega, alpha = (np.stack(x) for x in zip(*target_attitudes(config, said), strict=True))
    course = config.rows.course._replace(
        ref_q_ib=q[:-1], ref_omega_b=omega[:-1], ref_alpha_b=alpha[:-1], ref_end_q_ib=q[1:]
    )
    return config.rows._replace(course=course)


# --------------------------------------------------------------------------------------------- page

_XYZ = ("x", "y", "z")
_OF_FRAMES = USED | REFUSED | SHORT  # flags of a star frame, so none between two frames


def signals(given: AttitudeLoop) -> list[Signal]:
    """Signals on the page, by the parameters of an attitude loop."""

    def three(plot: str, unit: str, sigma: bool = False) -> list[Signal]:
        found = []
        for axis in _XYZ:
            found.append(Signal(f"{plot} {axis}", unit, plot))
            if sigma:
                found.append(Signal(f"{plot} sigma {axis}", unit, plot, "sigma", f"{plot} {axis}"))
        return found

    def attitude(of: str) -> list[Signal]:
        return [Signal(f"q {of} {c}", "1", "attitude", "attitude", of) for c in "wxyz"]

    momentum = "wheel momentum"
    return [
        *attitude("true"),
        *attitude("estimated"),
        *three("attitude error", "arcsec", sigma=True),
        *three("pointing error", "arcsec"),
        *three("innovation of the star sensor", "arcsec", sigma=True),
        Signal("test ratio", "1", "test ratio of the star sensor"),
        Signal("test ratio limit", "1", "test ratio of the star sensor", "limit"),
        *three("rate", "deg/s"),
        *(Signal(f"{momentum} {k}", "mN m s", momentum) for k in range(len(given.wheels.axes))),
        Signal(f"{momentum} limit", "mN m s", momentum, "limit"),
        Signal(f"{momentum} lower limit", "mN m s", momentum, "limit"),
    ]


def sample(series: MessageSeries, config: SatelliteConfig, since: int, step: int) -> list[float]:
    """Values of the signals in a step; those of star frames are the latest since step `since`."""
    now = slice(step, step + 1)
    q_ib = series["motion.q_ib"][now]
    error = turn(series["estimate.q_ib"][now], q_ib)[0] / ARCSEC
    sigma = series["estimate.sigma"][step, :3] / ARCSEC
    pointing = turn(target_after(config, series, step + 1).q_ib[None], q_ib)[0] / ARCSEC
    innovation, its_sigma, ratio = (
        latest(series[f"innovation.{name}"], since, step)
        for name in ("innovation", "sigma", "ratio")
    )
    wheels = len(config.vehicle.craft.wheel_h)
    limit = 1e3 * float(np.asarray(config.given.craft.wheel_momentum_limit)[0])
    return [
        *series["motion.q_ib"][step],
        *series["estimate.q_ib"][step],
        *np.ravel([error, sigma], order="F"),
        *pointing,
        *np.ravel([innovation / ARCSEC, its_sigma / ARCSEC], order="F"),
        float(ratio),
        1.0,
        *np.degrees(series["motion.omega_b"][step]),
        *(1e3 * series["wheels.momentum"][step, :wheels]),
        limit,
        -limit,
    ]


def counts(series: MessageSeries, done: int) -> dict[str, int]:
    """Counts on the page."""
    return {"refused_measurements": int(np.sum(flag(series, "star refused")[:done]))}


class Alarms:
    """Watches the flags of the estimates and raises notices."""

    def __init__(self) -> None:
        self._stands = 0  # flags whose start was reported, but not yet their end
        self._frames = 0  # frames refused in a row

    def observe(self, series: MessageSeries, step: int) -> list[Alert]:
        """Notices of the estimate of a step."""
        flags = int(series["estimate.flags"][step])
        return [one._replace(text=f"adm: {one.text}") for one in self.alerts_of(flags)]

    def alerts_of(self, flags: int) -> list[Alert]:
        """Notices of the next estimate.

        Frames that are refused one after another are reported once, and their number when one
        is used again.
        """
        now, begun = flags, self._stands
        if not flags & _OF_FRAMES:  # no frame: the flags of the last one remain
            now |= begun & (REFUSED | SHORT | KEPT)
        new, over = now & ~begun, begun & ~now
        if flags & REFUSED:
            self._frames = 1 if new & REFUSED else self._frames + 1
        self._stands = now & ~USED
        said = []
        if new & REFUSED:
            said.append(Alert("alarm", "star refused"))
        if over & REFUSED:
            frames = "one frame was" if self._frames == 1 else f"{self._frames} frames were"
            said.append(Alert("info", f"star used again, {frames} refused"))
        for flag_ in (HELD, SILENT, SHORT, KEPT):
            if new & flag_:
                said.append(Alert("warning", FLAGS[flag_.bit_length() - 1]))
        if new & SAFE:
            said.append(Alert("alarm", FLAGS[SAFE.bit_length() - 1]))
        if over & SAFE:
            said.append(Alert("info", "the estimate can be steered by again"))
        return said


def _slew_command(
    series: MessageSeries, config: SatelliteConfig, step: int, turn_rad: np.ndarray
) -> tuple[str, Values]:
    """Command to an inertially fixed attitude, turned from the present target."""
    now = target_after(config, series, step + 1).q_ib
    return "reference", {"q_ib": np.asarray(multiply(now, from_rotvec(jnp.asarray(turn_rad))))}


_SLEW_DEG = 10.0
SAYS = {
    **{
        f"slew {_SLEW_DEG:g} deg about {axis}": partial(_slew_command, turn_rad=turn_rad)
        for axis, turn_rad in zip(_XYZ, np.radians(_SLEW_DEG) * np.eye(3), strict=True)
    },
    "hold this attitude": partial(_slew_command, turn_rad=np.zeros(3)),
    "back to the course": lambda series, config, step: ("reference", {}),
    "control: stand by": lambda series, config, step: ("mode", {"mode": STAND_BY}),
    "control: run": lambda series, config, step: ("mode", {"mode": RUN}),
    "determination: reset": lambda series, config, step: ("mode", {"mode": AS_IT_IS, "reset": 1}),
}
"""Operator messages that the page offers."""


def view() -> PageView:
    """Layout of the live page of the satellite."""
    return PageView(signals, sample, Alarms, counts, OFFERED, SAYS)


# ------------------------------------------------------------------------------------------ viewers

_IMU = "sensor_msgs/msg/Imu"


def topics(config: SatelliteConfig) -> Sequence[Topic]:
    """Conversions of rates and attitudes with covariance; body and inertial axes stay."""
    step_s = config.step_ns * 1e-9
    return (
        Topic("gyro", "/gyro/imu", _IMU, lambda v: imu(v["theta_b"] / step_s), "body"),
        Topic("motion", "/plant/imu", _IMU, lambda v: imu(v["omega_b"], q_nb=v["q_ib"]), "body"),
        Topic(
            "estimate",
            "/adm/imu",
            _IMU,
            lambda v: imu(q_nb=v["q_ib"], q_covariance=np.diag(v["sigma"][:3] ** 2)),
            "body",
        ),
        Topic("star", "/star/frame", JSON, as_json, "body"),
        Topic("wheels", "/actuators/wheels", JSON, as_json, "body"),
    )
