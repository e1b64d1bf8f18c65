"""Publication of an outcome as a result folder with its report, the same for every command."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from robins import report, results
from robins.results import Outcome, Progress, Result, ignore_progress


@contextmanager
def publishing(
    out: str | os.PathLike[str],
    *,
    command: str = "",
    progress: Progress = ignore_progress,
    patience_s: float = 0.0,
) -> Iterator[Callable[[Outcome], Result]]:
    """Hold a result folder while something is computed for it.

    The folder is refused at once if it could not be written. Without an outcome, or with an error,
    what was there stays as it was. What was computed and cannot be written is kept next to it.

        with publishing("results/walk") as publish:
            result = publish(replay(["imu.csv", "gnss.pos"]))

    Args:
        out: the folder.
        command: how to make the result again, for its report.
        progress: called with the fraction done and the current activity while it is written.
        patience_s: how long to wait for another writer of the folder.

    Yields:
        A function that writes an outcome into the folder and returns the result read back.

    Raises:
        robins.results.ResultError: the folder cannot be written.
        robins.results.NotWritten: a computed outcome could not be written; its numbers are kept
            elsewhere.
    """
    with results.rescued(out):
        writer = results.ResultWriter(out, command=command, timeout_s=patience_s)
        try:
            yield partial(_write, writer, progress)
        finally:
            writer.discard()  # nothing is left to do after a commit


def publish(
    outcome: Outcome,
    out: str | os.PathLike[str],
    *,
    command: str = "",
    progress: Progress = ignore_progress,
    patience_s: float = 0.0,
) -> Result:
    """Write an outcome as a result folder with figures and a page; see `publishing`.

    Raises:
        robins.results.ResultError, robins.results.NotWritten: as for `publishing`.
    """
    with publishing(out, command=command, progress=progress, patience_s=patience_s) as write:
        return write(outcome)


def _write(writer: results.ResultWriter, progress: Progress, outcome: Outcome) -> Result:
    variables = {} if outcome.solution is None else outcome.solution.variables
    arrays = {str(name): variable.values for name, variable in variables.items()}
    with results.keep_on_error({"solution": arrays, "metrics": outcome.metrics}):
        writer.scenario_text, writer.device = outcome.parameters, outcome.device
        writer.save_summary(outcome.summary)
        if outcome.solution is not None:
            writer.save_solution(outcome.solution)
        for name, content in outcome.files.items():
            writer.save_file(name, content)

        def report_drawing(done: int, total: int, what: str) -> None:
            progress(done / max(total, 1), what)

        report.add(writer, report_drawing, outcome.notes, outcome.figures)
        return results.read(writer.commit())


def part(progress: Progress, low: float, high: float) -> Progress:
    """The progress of a part, whose 0 and 1 are `low` and `high` of the whole."""
    return lambda share, what: progress(low + (high - low) * share, what)
