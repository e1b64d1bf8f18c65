"""Figures, tables and pages of results; knows what a result holds, not who made it.

`attach` gives a result folder its figures and its page; `add` does so while the folder is still
being written. Which figures there are follows from the arrays in the solution, whose names are
listed in `robins.results`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import xarray as xr

from robins import results
from robins.report import bounds, iron, series
from robins.report.allan_curve import allan
from robins.report.bars import comparison
from robins.report.curves import campaign, errors, estimates, height
from robins.report.document import LIMIT, Origin, page
from robins.report.embed import Drawn, draw
from robins.report.lateness import lateness
from robins.report.limits import within, worst_case
from robins.report.maps import track
from robins.report.numbers import verdict
from robins.report.style import Picture
from robins.report.terminal import plain, table
from robins.report.trade_off import trade_off
from robins.report.updates import consistency, innovations

__all__ = [
    "LIMIT",
    "Drawn",
    "Origin",
    "Picture",
    "add",
    "attach",
    "draw",
    "page",
    "pictures",
    "plain",
    "table",
    "verdict",
]

Progress = Callable[[int, int, str], None]


def pictures(solution: xr.Dataset | None, summary: Mapping[str, Any]) -> list[Picture]:
    """Every figure that the arrays of a solution and the metrics of a summary allow."""
    return [picture for make in _drawings(solution, summary) if (picture := make()) is not None]


def _drawings(
    solution: xr.Dataset | None, summary: Mapping[str, Any]
) -> list[Callable[[], Picture | None]]:
    """What to draw, in the order of the page."""
    # Columns of a summary without filters are something else, such as the axes of a sensor.
    compared = solution is None or "filter" in solution.sizes
    last: list[Callable[[], Picture | None]] = [lambda: comparison(summary)] if compared else []
    if solution is None:
        return last
    ds = solution
    drawings: list[Callable[[], Picture | None]] = [lambda: track(ds)]
    for block in bounds.blocks(ds):
        drawings.append(lambda block=block: bounds.sigmas(ds, block))
    if "information" in ds:
        drawings.append(lambda: bounds.information(ds))
    for block in series.find(ds, "error"):
        drawings.append(lambda block=block: errors(ds, block))
    for block in series.find(ds, "rms"):
        if ds[f"rms_{block}"].attrs.get("runs", 2) == 1:
            continue  # the error itself, without its sign
        drawings.append(lambda block=block: campaign(ds, block))
    for limit in series.find(ds, "within"):
        drawings.append(lambda limit=limit: within(ds, limit))
    drawings.append(lambda: worst_case(ds))
    for block in series.find(ds, "estimate"):
        # Beside its error an estimate tells something new only where it should settle on a value.
        if f"error_{block}" not in ds or "bias" in block or "scale" in block:
            drawings.append(lambda block=block: estimates(ds, block))
    for name in series.find(ds, "value"):
        drawings.append(lambda name=name: estimates(ds, name, "value"))
    if "alt_m" in ds:
        drawings.append(lambda: height(ds))
    for sensor in series.find(ds, "innovation"):
        drawings.append(lambda sensor=sensor: innovations(ds, sensor))
    for name in ("nees", "anees"):
        if name in ds:
            drawings.append(lambda name=name: consistency(ds, name))
    for sensor in series.find(ds, "allan"):
        drawings.append(lambda sensor=sensor: allan(ds, sensor))
    if "trade_off_h2" in ds:
        drawings.append(lambda: trade_off(ds))
    if "lateness_steps" in ds:
        drawings.append(lambda: lateness(ds))
    if "field_calibrated" in ds:
        drawings += [lambda: iron.planes(ds), lambda: iron.size(ds)]
    return drawings + last


def add(
    writer: results.ResultWriter, progress: Progress | None = None, notes: Sequence[str] = ()
) -> None:
    """Draw the figures and the page of a result being written, after its solution and summary.

    Args:
        writer: of the result.
        progress: called with done, total and a word on what is done.
        notes: sentences for the reader, printed below the verdict.

    Raises:
        ResultError: the writer has no summary yet, or the disk refused.
    """
    if writer.summary is None:
        raise results.ResultError(writer.path, "has no summary", "save it before its report")
    drawings = _drawings(writer.solution, writer.summary)
    drawn = []
    for done, make in enumerate(drawings):
        if progress is not None:
            progress(done, len(drawings), "drawing figures")
        picture = make()
        if picture is not None:
            drawn.append(draw(picture))
            writer.save_file(f"figures/{picture.name}.png", drawn[-1].png())
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    versions = results.versions()
    origin = Origin(
        writer.command, writer.scenario_text, writer.device, versions, now, tuple(notes)
    )
    writer.save_report(page(writer.summary, drawn, origin))
    if progress is not None:
        progress(len(drawings), len(drawings), "drawing figures")


def attach(
    path: str | os.PathLike[str], command: str = "", progress: Progress | None = None
) -> Path:
    """Give a result folder its figures and page; the folder changes at once or not at all.

    Args:
        path: of the result.
        command: how to make it again, if the result does not know yet.
        progress: called with done, total and a word on what is done.

    Raises:
        ResultError: the result is damaged or cannot be written.
    """
    with results.extend(results.read(path)) as writer:
        writer.command = writer.command or command
        add(writer, progress)
    return Path(path)
