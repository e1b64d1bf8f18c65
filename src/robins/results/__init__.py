"""The result folder: what every run writes and every report reads.

::

    results/walk/
        manifest.json   its origin: scenario text and hash, seed, versions, device; a
                        checksum of every file; written last, `complete`
        summary.json    for scripts: metrics by filter, claims, counts of refused samples
        solution.nc     time series with named dimensions, units and frames (netCDF-4)
        figures/*.png
        report.html     one self-contained page

`ResultWriter` fills a hidden folder and renames it into place, so a result is whole or absent: an
interrupt, a failure or a full disk leaves the earlier result as it was. `read` verifies every
checksum and refuses what is incomplete, damaged or of another version, with the reason. A folder
that robins did not write is never replaced.

Summary
-------
``scenario`` (text), ``seed``, ``runs`` (whole numbers), ``filters`` {name: {metric: value}},
``claims`` [{id, text, verdict, value, band}] with the verdicts "reproduced", "partly", "not",
``counts`` {reason: number of samples refused}, ``files`` {summary, manifest, solution, report:
path; figures, other: [paths]}, relative to the folder and filled in by the writer, ``seconds``.
Metric names end in their unit (``horizontal_rms_m``). NaN and infinity become null. A share of the
runs is a `Probability`: {share, low, high, of, level}.

Solution
--------
Every numeric array and coordinate has the attributes ``units`` and ``long_name``; an array with
components along axes also has ``frame`` ("NED", "FRD", ...), and ``display_unit`` ("deg", "deg/h",
"mg") where figures have another unit. The attribute ``role`` gives the kind of an array, ``of`` its
object: the standard deviation of the attitude, the innovation of a sensor. `ROLES` is their table,
printed on the page of the documents on the result folder. `array` builds an array, `variable` a
coordinate, `find` reads the arrays of a role. Figures are drawn from whatever is there; dimensions
are recognised by their place, so any time dimension serves whose coordinate is in seconds since the
start (``time``, ``gnss_time``, ...). Dimension coordinates ``filter`` and ``axis_...`` hold names.
Bands of consistency figures follow from ``degrees_of_freedom`` and ``runs`` at ``probability``
(0.95), or are given by ``band_low`` and ``band_high``.

Time counts in seconds since the start. Of a recorded log the attribute ``origin_ns`` of the
solution is the stamp at its zero: GPS time since 1970-01-01 (UTC and leap seconds), or, before
1980, the log's own clock. `to_dataframe` makes a table of the arrays on one clock, `Result` too.
"""

from typing import TYPE_CHECKING

from robins.errors import lazy, places

if TYPE_CHECKING:
    from robins.results.dataframe import clocks, to_dataframe
    from robins.results.errors import ResultError
    from robins.results.manifest import SCHEMA_VERSION, versions
    from robins.results.outcome import Outcome, Progress, ignore_progress
    from robins.results.probability import Probability
    from robins.results.reader import Result, read
    from robins.results.rescue import NotWritten, keep_on_error, rescued
    from robins.results.roles import ROLES, find
    from robins.results.solution import Variables, array, variable
    from robins.results.summary import VERDICTS, plain
    from robins.results.writer import ResultWriter

__all__ = [
    "ROLES",
    "SCHEMA_VERSION",
    "VERDICTS",
    "NotWritten",
    "Outcome",
    "Probability",
    "Progress",
    "Result",
    "ResultError",
    "ResultWriter",
    "Variables",
    "array",
    "clocks",
    "find",
    "ignore_progress",
    "keep_on_error",
    "plain",
    "read",
    "rescued",
    "to_dataframe",
    "variable",
    "versions",
]

_FILES = {
    "dataframe": "clocks to_dataframe",
    "errors": "ResultError",
    "manifest": "SCHEMA_VERSION versions",
    "outcome": "Outcome Progress ignore_progress",
    "probability": "Probability",
    "reader": "Result read",
    "rescue": "NotWritten keep_on_error rescued",
    "roles": "ROLES find",
    "solution": "Variables array variable",
    "summary": "VERDICTS plain",
    "writer": "ResultWriter",
}

__getattr__ = lazy(__name__, places(__name__, _FILES))
