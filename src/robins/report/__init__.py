"""Figures, tables and pages of results; depends on the contents of a result, not on its origin.

`add` gives a result folder that is being written its figures and its page. Which figures there are
follows from the roles of the arrays in the solution: one row each in `robins.report.figures`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime

import xarray as xr

from robins import results
from robins.errors import moved
from robins.report.document import LIMIT, ReportOrigin, page
from robins.report.embed import RenderedPicture, dpi_for, draw
from robins.report.figures import FIGURES, drawings
from robins.report.numbers import Summary, verdict
from robins.report.style import Picture
from robins.report.terminal import table

__all__ = [
    "FIGURES",
    "LIMIT",
    "Picture",
    "RenderedPicture",
    "ReportOrigin",
    "add",
    "draw",
    "page",
    "pictures",
    "table",
    "verdict",
]

Progress = Callable[[int, int, str], None]


def pictures(solution: xr.Dataset | None, summary: Summary) -> list[Picture]:
    """Every figure that the arrays of a solution and the metrics of a summary allow."""
    return [picture for make in drawings(solution, summary) if (picture := make()) is not None]


def add(
    writer: results.ResultWriter,
    progress: Progress | None = None,
    notes: Sequence[str] = (),
    only: Sequence[str] = (),
) -> None:
    """Draw the figures and the page of a result being written, after its solution and summary.

    Args:
        writer: of the result.
        progress: called with done, total and a word on what is done.
        notes: sentences for the reader, printed below the verdict.
        only: names of figures, such as "track" or "error_position"; else all.

    Raises:
        ResultError: the writer has no summary yet, or the disk refused.
    """
    if writer.summary is None:
        raise results.ResultError(writer.path, "has no summary", "save it before its report")
    makers = drawings(writer.solution, writer.summary, only)
    drawn, dpi = [], dpi_for(len(makers))
    for done, make in enumerate(makers):
        if progress is not None:
            progress(done, len(makers), "drawing figures")
        picture = make()
        if picture is not None:
            drawn.append(draw(picture, dpi))
            writer.save_file(f"figures/{picture.name}.png", drawn[-1].png())
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    versions = results.versions()
    origin = ReportOrigin(
        writer.command, writer.scenario_text, writer.device, versions, now, tuple(notes)
    )
    writer.save_report(page(writer.summary, drawn, origin))
    if progress is not None:
        progress(len(makers), len(makers), "drawing figures")


__getattr__ = moved(__name__)
