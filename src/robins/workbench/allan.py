"""The command `allan`: from a log of a resting IMU to the noise parameters of its data sheet.

Examples::

    robins allan still.csv
    robins allan still.csv --terms N --json
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import xarray as xr

from robins import units
from robins.dataset import Dataset, ImuTable
from robins.ins.allan import Allan, AllanFit, deviation, fit, in_field_units, stretches
from robins.ins.increments import own_intervals
from robins.logs import formats_of, open_log
from robins.logs.clean import clean_imu
from robins.results import Outcome, Progress, array, ignore_progress, variable
from robins.workbench.errors import InputError, refusing
from robins.workbench.options import Log, Option

_NAMES = {
    "Q": "quantisation",
    "N": "random walk",
    "B": "bias instability",
    "K": "rate random walk",
    "R": "rate ramp",
}
_AXES = ("x", "y", "z")
_UNITS = {"gyro": ("rad/s", "deg/h"), "accel": ("m/s^2", "ug")}
_TURNING = np.deg2rad(2.0)  # rad/s of mean rate over a second; sensors at rest are far below


class RestingImu(NamedTuple):
    """Samples of a resting IMU."""

    rates: dict[str, np.ndarray]  # "gyro" [rad/s], "accel" [m/s^2]: (N, 3)
    time_ns: np.ndarray  # (N,)
    counts: dict[str, int]  # refused samples
    notes: list[str]
    body: str


def resting_imu(path: Path, columns: Sequence[str | os.PathLike[str]] = ()) -> RestingImu:
    """Read and clean the log of a resting IMU; increments become rates.

    Raises:
        robins.logs.LogError: the file cannot be read.
        InputError: it holds no inertial samples.
    """
    findings: list[Any] = []
    opened = open_log(path, formats_of([path], columns).get(str(path)), findings)
    table = opened.imu if isinstance(opened, Dataset) else opened
    if not isinstance(table, ImuTable):
        raise InputError("holds no inertial samples", path, "give the log of an IMU.")
    cleaned, counts, _ = clean_imu(table)
    notes = [str(finding) for finding in findings]
    time_ns = cleaned.time_ns
    bounds = stretches(time_ns)
    if len(bounds) > 2:
        rows = np.diff(bounds)
        longest = int(np.argmax(rows))
        span = (time_ns[bounds[longest + 1] - 1] - time_ns[bounds[longest]]) * 1e-9
        notes.append(
            f"The log has {len(rows) - 1} gap(s): the Allan deviation is the mean over its "
            f"{len(rows)} stretches, of which the longest has {span:.6g} s."
        )
    rates = {"gyro": cleaned.gyro, "accel": cleaned.accel}
    if cleaned.kind == "increment":
        dt_s = np.diff(time_ns) * 1e-9
        own = np.full((len(cleaned), 1), np.median(dt_s))
        # The first increment after a gap may span the whole gap.
        rows = bounds[1:-1]
        own[rows, 0] = own_intervals(dt_s, cleaned.gyro, cleaned.accel)[rows]
        rates = {sensor: values / own for sensor, values in rates.items()}
    if _moved(rates["gyro"], time_ns):
        notes.append("The sensor turned during the log: what follows is motion, not noise.")
    return RestingImu(rates, time_ns, {k: n for k, n in counts.items() if n}, notes, cleaned.body)


def _moved(gyro: np.ndarray, time_ns: np.ndarray) -> bool:
    """True if the mean rate of any second is off the median by more than `_TURNING`."""
    second = (time_ns - time_ns[0]) // 1_000_000_000
    starts = np.flatnonzero(np.diff(second, prepend=-1))
    count = np.diff(np.append(starts, len(second)))[:, None]
    means = np.add.reduceat(gyro, starts, axis=0) / count
    return bool(np.abs(means - np.median(means, axis=0)).max() > _TURNING)


def expected(fitted: AllanFit, tau_s: np.ndarray) -> dict[str, np.ndarray]:
    """Allan deviation (T, axes) of each fitted term alone, as in IEEE Std 952, Annex C."""
    tau = tau_s[:, None]
    shape = {
        "Q": np.sqrt(3.0) / tau,
        "N": 1.0 / np.sqrt(tau),
        "B": np.sqrt(2.0 * np.log(2.0) / np.pi) * np.ones_like(tau),
        "K": np.sqrt(tau / 3.0),
        "R": tau / np.sqrt(2.0),
    }
    return {term: shape[term] * getattr(fitted.value, term) for term in fitted.terms}


def _arrays(sensor: str, curve: Allan, fitted: AllanFit | None, body: str) -> dict:
    si, shown = _UNITS[sensor]
    about: dict[str, Any] = {"unit": si, "frame": body, "axes": _AXES, "display_unit": shown}
    made = array("allan", curve.deviation, sensor, confidence=curve.confidence, **about)
    made |= array("allan_low", curve.lower, sensor, **about)
    made |= array("allan_high", curve.upper, sensor, **about)
    if fitted is not None:
        parts = list(expected(fitted, curve.tau_s).values())
        made |= array("allan_fit", np.sqrt(sum(part**2 for part in parts)), sensor, **about)
        made |= array("allan_slope", np.stack(parts), sensor, **about)
    return made


def _metrics(sensor: str, fitted: AllanFit) -> dict[str, dict[str, float | list[float]]]:
    """Parameters and their intervals by axis."""
    by_axis: dict[str, dict[str, float | list[float]]] = {axis: {} for axis in _AXES}
    for name, found in in_field_units(fitted, sensor).items():  # type: ignore[arg-type]
        unit = units.as_ending(found.unit)
        for k, axis in enumerate(_AXES):
            by_axis[axis][f"{sensor}_{name}_{unit}"] = found.value[k]
            by_axis[axis][f"{sensor}_{name}_interval_{unit}"] = [found.lower[k], found.upper[k]]
    return by_axis


def _coloured(sensor: str, curve: Allan, fitted: AllanFit) -> list[str]:
    """A note where short times were left out of the fit."""
    late = [
        f"{axis} from {first:.3g} s"
        for axis, first in zip(_AXES, fitted.from_s, strict=True)
        if first > curve.tau_s[0]
    ]
    if not late:
        return []
    return [
        f"The {sensor} is coloured at short times: its noises are fitted on {', '.join(late)} on."
    ]


def allan(
    log: Log,
    *,
    terms: Annotated[str, Option("Noises to fit, of Q, N, B, K, R.", shown=True)] = "NBK",
    columns: Sequence[str | os.PathLike[str]] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Compute the Allan deviation of a resting IMU, and the noise parameters of its data sheet.

    Q quantisation, N random walk, B bias instability, K rate random walk, R rate ramp.

    Args:
        log: a file in any format of `robins.logs` with inertial samples.
        terms: noises to fit, of Q, N, B, K, R.
        columns: TOML files that declare formats of the file, see `robins.logs.columns_from`.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError: the terms are not among these letters, or the log is too short, uneven or
            constant.
        robins.logs.LogError: the file cannot be read.
    """
    if len(set(terms)) != len(terms) or not terms or not set(terms) <= set(_NAMES):
        raise InputError(f"give different letters out of {', '.join(_NAMES)}.", f"--terms {terms}")
    path = Path(log)
    given = resting_imu(path, columns)
    notes = list(given.notes)
    arrays: dict[str, Any] = {}
    by_axis: dict[str, dict[str, Any]] = {axis: {} for axis in _AXES}
    tau_s = np.zeros(0)
    for done, (sensor, rate) in enumerate(given.rates.items()):
        progress(0.1 + 0.5 * done, f"{sensor}: Allan deviation")
        with refusing(f"{path}: {sensor}"):
            curve = deviation(rate, time_ns=given.time_ns)
        fitted = None
        try:
            fitted = fit(curve, terms)
        except (ValueError, ArithmeticError) as error:
            notes.append(f"No parameters of the {sensor}: {error}.")
        else:
            for axis, found in _metrics(sensor, fitted).items():
                by_axis[axis] |= found
            notes += _coloured(sensor, curve, fitted)
        arrays |= _arrays(sensor, curve, fitted, given.body)
        tau_s = curve.tau_s
    solution = xr.Dataset(arrays | {"tau": variable("tau", tau_s, "s", "averaging time")})
    if "process" in solution.sizes:
        solution = solution.assign_coords(process=[_NAMES[term] for term in terms])
    return Outcome(
        solution,
        by_axis,
        counts=given.counts,
        notes=notes,
        scenario=f"allan/{path.name.split('.')[0]}",
        last_lines=[
            "Next:   put these numbers into the [imu] of a scenario or of a replay's configuration"
        ],
    )
