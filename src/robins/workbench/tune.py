"""The command `tune`: parameters of a filter, by simulated runs or by a recorded log.

Examples::

    robins tune ins-gnss/drive --filter ekf --vary believed.r_factor=4
    robins tune imu.csv gnss.pos unit.toml --filter ekf --vary imu.gyro_noise --vary imu.accel_noise
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import xarray as xr
from scipy.special import ndtri

from robins import _float64, scenario, units
from robins.campaign.tuning import Tuned, choose
from robins.report.numbers import csv_of
from robins.results import Outcome, Progress, array, ignore_progress
from robins.workbench.errors import refusing
from robins.workbench.options import Filter, Option
from robins.workbench.publication import part
from robins.workbench.replay import Findings, ignore_findings, open_log
from robins.workbench.scenarios import request_fields
from robins.workbench.tune_objectives import (
    COMPONENTS,
    DENSITY,
    FIRST_BLOCK,
    INNOVATIONS,
    TuningRequest,
    objective_in_words,
    on_log,
    on_runs,
    overridden,
    settings_at,
    total_of,
)

_COLUMNS = ("parameter", "as written", "factor", "low", "high", "now")  # of tuning.csv


def tune(
    names: Annotated[Sequence[str], Option(metavar="SCENARIO|LOG...")],
    *,
    vary: Annotated[
        Sequence[str],
        Option("A parameter to tune, and where to begin; may be repeated.", metavar="key[=value]"),
    ],
    filter_name: Filter = "",
    runs: Annotated[int, Option("Simulated runs of either half.", least=6)] = 16,
    by: Annotated[
        str, Option("error, the name of a block of the state, innovations.", metavar="WHAT")
    ] = "",
    system: Annotated[str, Option("The system that navigates a log.")] = "ins-gnss",
    columns: Sequence[str | os.PathLike[str]] = (),
    settings: Sequence[str] = (),
    seed: int = 0,
    progress: Progress = ignore_progress,
    findings: Findings = ignore_findings,
) -> Outcome:
    """Find factors on parameters of a filter with which it is best.

    With a SCENARIO it is best where the true errors of simulated runs are least; the simulated
    world stays as it is written. With the files of a LOG it is best where it predicts the
    measurements best. Every third segment of a log, and as many runs as were used, are held out:
    the values found are kept only if they are better there, beyond chance.

    It refuses where the data do not determine a parameter. The folder has tuned.toml.

    Args:
        names: a scenario, "system/name", a TOML file or "file.py:study"; or the files of a log.
        vary: texts ``key``, or ``key=value`` to begin elsewhere, one per parameter.
        filter_name: of the filter; by default the first of the scenario or system.
        runs: simulated runs to choose on; as many others to judge on.
        seed: of the random streams.
        by: "error", the geometric mean of the RMS errors of all blocks, or the name of one block;
            "innovations", the log density of the measurements. By default the error of simulated
            runs; a log has no truth.
        system: of a log.
        settings: "path=value" texts that change scenario and filter beforehand.
        columns: TOML files that declare formats of the log's files.
        progress: called with the fraction done and the current activity.
        findings: called with the doctor's findings on a log.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be fulfilled.
        robins.campaign.tuning.UndeterminedError: the data do not determine a parameter.
    """
    _float64.require()
    if _is_log(names):
        opened = open_log(names, system=system, settings=settings, columns=columns)
        progress(0.0, "reading")
        of = on_log(opened, filter_name, vary, by, settings, findings)
    else:
        of = on_runs(os.fspath(names[0]), filter_name, vary, runs, seed, by, settings, progress)
    keys = [v.key for v in of.vary]
    tuning = part(progress, 0.1, 1.0)
    with refusing(of.label):
        found = choose(of.objective, keys, of.chosen_on, of.judged_on, tuning)
    return _outcome(of, found, seed)


def _is_log(names: Sequence[str | os.PathLike[str]]) -> bool:
    """True if these are files of a log, and no scenario."""
    if len(names) > 1:
        return True
    name = os.fspath(names[0])
    return os.path.isfile(name) and not name.endswith(".toml")


def _outcome(of: TuningRequest, found: Tuned, seed: int) -> Outcome:
    stays = not found.better
    x = np.zeros(len(found.x)) if stays else found.x
    now = settings_at(of.vary, x)
    with refusing(of.label):
        of.checked(now)
    text = scenario.text_of(overridden(of.text, (*of.settings, *now)))
    z = float(ndtri(0.975))
    bands = [
        (math.exp(a), math.exp(a - z * s), math.exp(a + z * s))
        for a, s in zip(found.x, found.sigma, strict=True)
    ]
    change = _change(of, found)
    warnings = []
    if stays:
        warnings.append(
            f"{of.filter}: what was found is not better on the data held out, beyond chance "
            f"({change}): the values as written stay"
        )
    rows = {
        f"{of.filter} as written": _metrics(of, found.before),
        f"{of.filter} tuned": _metrics(of, found.before if stays else found.after)
        | {f"{v.key} times": band[0] for v, band in zip(of.vary, bands, strict=True) if not stays},
    }
    was = [scenario.setting(v.key, v.start).partition("=")[2] for v in of.vary]
    lines = [
        f"{v.key}: {old} times {band[0]:.3g} ({band[1]:.3g} to {band[2]:.3g} at 95 %)"
        for v, old, band in zip(of.vary, was, bands, strict=True)
    ]
    table: list[Sequence[str | float]] = [
        (v.key, old, *band, line.partition("=")[2])
        for v, old, band, line in zip(of.vary, was, bands, now, strict=True)
    ]
    how = "gradient" if found.gradient else "search"
    return Outcome(
        solution=_solution(of, found, np.array(bands)),
        metrics=rows,
        files={"tuned.toml": text.encode(), "tuning.csv": csv_of([_COLUMNS, *table])},
        notes=[
            *lines,
            f"Held out: {change}.",
            of.data_note,
            f"Small is made: {of.by}; by {how}, {found.evaluations} evaluations.",
            *found.notes,
        ],
        warnings=warnings,
        scenario=of.label,
        seed=seed,
        runs=len(found.before),
        title=f"{of.filter} tuned",
        last_lines=["Tuned:  {out}/tuned.toml   with these values"],
        **request_fields(of.text, of.settings),
    )


def _change(of: TuningRequest, found: Tuned) -> str:
    """Change of the objective on the data held out, in words."""
    if of.by == objective_in_words(INNOVATIONS):
        total = total_of(INNOVATIONS, ())
        was, now = (-total(m.mean(axis=0)) for m in (found.before, found.after))
        return (
            f"{of.by} {was:.4f} -> {now:.4f}, {found.gain:+.4f} (at least {found.gain_low:+.4f} at "
            f"95 %), over {len(found.before)} {of.parts}"
        )
    less, least = (100.0 * math.expm1(-one) for one in (found.gain, found.gain_low))
    over = f"over {len(found.before)} {of.parts}"
    return f"{of.by} {less:+.2f} % (at most {least:+.2f} % at 95 %), {over}"


def _metrics(of: TuningRequest, parts: np.ndarray) -> dict[str, float]:
    """Figures of the data held out: log density, and by block RMS error and stated over it."""
    mean = np.mean(parts, axis=0)
    out: dict[str, float] = {"log_density": float(mean[DENSITY] / mean[COMPONENTS])}
    n = len(of.blocks)
    for b, square, variance in zip(
        of.blocks, mean[FIRST_BLOCK:][:n], mean[FIRST_BLOCK:][n:], strict=True
    ):
        rms = float(units.convert(math.sqrt(square), b.units, b.display_unit))
        out[f"{b.name}_rms_{units.as_ending(b.display_unit)}"] = rms
        if square > 0.0:
            out[f"{b.name}_stated_over_rms"] = math.sqrt(variance / square)
    return out


def _solution(of: TuningRequest, found: Tuned, bands: np.ndarray) -> xr.Dataset:
    """Factors with their intervals, and the objective of each part that was held out."""
    total = of.objective.total
    label = (
        "minus log density" if of.by == objective_in_words(INNOVATIONS) else "ln of the RMS error"
    )
    data: dict[str, Any] = {"parameter": ("parameter", [v.key for v in of.vary])}
    for name, values in zip(("factor", "low", "high"), bands.T, strict=True):
        data |= array(f"tuned_{name}", values)
    with np.errstate(divide="ignore", invalid="ignore"):
        for name, parts in (("before", found.before), ("after", found.after)):
            values = np.array([total(one) for one in parts])
            about = {"comment": of.by, "parts": of.parts, "label": label}
            data |= array(f"judged_{name}", values, **about)
    return xr.Dataset(data)
