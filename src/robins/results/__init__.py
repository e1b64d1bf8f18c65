"""The result folder: what every run writes and every report reads.

::

    results/walk/
        manifest.json   where it came from: scenario text and hash, seed, versions, device; a
                        checksum of every file; written last, `complete`
        summary.json    what scripts read: metrics by filter, claims, counts of refused samples
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
Metric names end in their unit (``horizontal_rms_m``). NaN and infinity become null.

Solution
--------
Every numeric array and coordinate has the attributes ``units`` and ``long_name``; an array with
components along axes also has ``frame`` ("NED", "FRD", ...). `variable` builds one. Figures are
drawn from whatever of the following is there; dimensions are recognised by their place, so any
time dimension serves whose coordinate is in seconds since the start (``time``, ``update_time``,
``gnss_time``, ...).

======================================= =========================================================
``lat_rad, lon_rad, alt_m``             (filter, time) position of each filter
``track_north_m, track_east_m``         (filter, time) the same on a map about any origin; made
                                        from latitude and longitude where absent
``reference_lat_rad, ...``              (any time) the truth or the best known path; also
                                        ``..._lon_rad``, ``..._alt_m``, and ``..._north_m``,
                                        ``..._east_m`` where ``track_north_m`` is given
``gnss_lat_rad, ..., gnss_east_m``      (any time) fixes, as for the reference
``gnss_quality``                        (as the fixes) whole numbers; attributes ``flag_values``
                                        and ``flag_meanings`` as in the CF conventions, else as
                                        RTKLIB numbers them
``outage``                              (time) nonzero where aids were withheld
``estimate_BLOCK``                      (filter, time, axis_BLOCK)
``error_BLOCK``                         the same; true minus estimated, where a truth exists
``value_NAME``                          (filter, time, axis_NAME) what the vehicle does beside what
                                        is estimated of it; attribute ``comment``, a caption, as of
                                        ``error_NAME`` where it is an error of the vehicle
``sigma_BLOCK``                         the same; one standard deviation the filter states
``innovation_SENSOR``                   (filter, update time, axis_SENSOR); NaN where missing
``innovation_sigma_SENSOR``             the same; one standard deviation the filter expects
``nis_SENSOR``                          (filter, update time); attribute ``degrees_of_freedom``, or
                                        an array ``nis_dof_SENSOR`` (filter, update time)
``refused_SENSOR``                      (filter, update time) nonzero where a gate refused
``nees``                                (filter, time) of one run; ``degrees_of_freedom``
``rms_BLOCK``                           (filter, time, axis_BLOCK) over the runs of a campaign;
                                        attribute ``runs``
``mean_sigma_BLOCK``                    the same; root of the mean variance the filter states
``bound_BLOCK``                         (time, axis_BLOCK) covariance bound, one standard deviation
``bound_prior_BLOCK, bound_left_BLOCK`` (axis_BLOCK) and, as the bound, ``bound_unaided_BLOCK``,
                                        ``bound_without_BLOCK`` (sensor, time, axis_BLOCK); of
                                        `robins.campaign.bound`, as the next row
``information``                         (state, time) bits; also ``gramian`` (direction) and
                                        ``gramian_rank``
``anees``                               (filter, time); ``runs``, ``degrees_of_freedom`` or an
                                        array ``anees_dof`` of its shape, and ``normalised=1`` if
                                        it is divided by these
``bounds``                              (filter) nonzero where what the filter states are bounds,
                                        not standard deviations
``field_measured, field_calibrated``    (time, axis) of a magnetometer; the second with the
                                        attribute ``strength``, the size it should have [T]
``within_LIMIT``                        (filter, time) share of the runs within a limit; ``runs``
``note_RULE_NOTE``                      (filter, time) what a rule noted in the first run
``allan_SENSOR``                        (tau, axis_SENSOR) Allan deviation over averaging time
``allan_low_SENSOR, allan_high_SENSOR`` the same; confidence bounds
``allan_fit_SENSOR``                    the same; the fitted model
``allan_slope_SENSOR``                  (process, tau, axis_SENSOR) its parts, by name
``lateness_steps``                      (bin) steps of a bench that began so late, one more than
                                        ``lateness_edge`` (edge), microseconds
``trade_off_h2, trade_off_hinf``        (design, gamma) true norms of designs, NaN where there is
                                        none; the second with the attributes ``least``, the least
                                        norm, and ``least_of``, of what designs; also ``kalman_h2``
                                        and ``kalman_hinf``
======================================= =========================================================

BLOCK is a part of the state (``attitude``, ``velocity``, ``position``, ``gyro_bias``, ...). The
attribute ``display_unit`` ("deg", "deg/h", "mg") is the unit of figures. Bands of consistency
figures follow from ``degrees_of_freedom`` and ``runs`` at ``probability`` (0.95), or are given by
``band_low`` and ``band_high``. Dimension coordinates ``filter`` and ``axis_...`` hold names.
"""

from robins.results.errors import ResultError
from robins.results.manifest import SCHEMA_VERSION, versions
from robins.results.reader import Result, read
from robins.results.rescue import NotWritten, rescued
from robins.results.solution import variable
from robins.results.summary import VERDICTS
from robins.results.writer import ResultWriter, extend, write

__all__ = [
    "SCHEMA_VERSION",
    "VERDICTS",
    "NotWritten",
    "Result",
    "ResultError",
    "ResultWriter",
    "extend",
    "read",
    "rescued",
    "variable",
    "versions",
    "write",
]
