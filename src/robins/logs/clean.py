"""Cleaning of a log for a run: bad samples are refused, counted and removed.

Refusing leaves the tables exactly as if the rows had never been recorded; no value is repaired,
interpolated or smoothed. Samples that were stamped in batches are spread evenly, see
`robins.logs.batches`; then time is put in order by refusing the fewest samples, see
`robins.logs.ordering`. Gaps are declared, not filled: the system decides whether to bridge them.
Denormal numbers and huge but possible ones pass; outliers are left to filters.

A magnetometer may miss samples for any time, and motion capture loses occluded sensors: their rows
are kept as NaN, so that they stay parallel to the inertial samples. Only rows whose stamps are out
of order are refused.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from robins.dataset import (
    AttitudeTable,
    Dataset,
    GnssTable,
    ImuTable,
    MagTable,
    OdometryTable,
    Trajectory,
)
from robins.errors import require_kind
from robins.ins.plausible import ACCEL_LIMIT, GYRO_LIMIT
from robins.logs.batches import spread, spread_counts, spread_like
from robins.logs.findings import Finding, LogError
from robins.logs.fix_kinds import with_usual_sigmas
from robins.logs.limits import (
    ALT_LIMIT_M,
    FIELD_LIMIT_T,
    LAT_LIMIT,
    LON_LIMIT,
    QUATERNION_LIMIT,
    SIGMA_LIMIT,
    SPEED_LIMIT,
)
from robins.logs.ordering import Rows, refusals, rows_where
from robins.logs.tables import TOLERANCE, AnyTable, checked, place_of

_PLACEHOLDER_SIGMA = 1.0
_PLACE_LIMIT = np.array([LAT_LIMIT, LON_LIMIT, ALT_LIMIT_M])


def clean(dataset: Dataset) -> Dataset:
    """Refuse unusable samples, and count them by reason.

    Counts, in samples, begin with the table's name: ``imu_nan``, ``imu_inf``, ``imu_absurd`` (a
    magnitude no vehicle has), ``imu_duplicate``, ``imu_backward`` and ``imu_ahead`` (time stamps
    out of order); ``gnss_...`` likewise and ``gnss_sigma`` (zero or negative); ``truth_...``,
    ``master_...``, ``mag_...``, ``attitude_...``, ``odometry_...``. Rows of batches
    that got a time of their own are kept and counted, as ``imu_spread``. Counts already in the
    dataset are added to.

    A fix that lacks a component keeps the others: the component becomes NaN, its sigma, if not
    positive, 1 (unused). A fix without any component is refused. Magnetic field and attitude keep
    their rows, NaN where a component is missing.

    ``imu_gaps`` lists the times between which IMU samples are missing. A component of fixes whose
    sigma is never positive gets the usual one of the kind of each fix, which is a finding.

    Raises:
        TypeError: the argument is no dataset, or a table is of the wrong kind.
        LogError: arrays that are no tables (F04), or fewer than two IMU samples left.
    """
    require_kind(dataset, Dataset, "clean", "make one of the table: Dataset(name, imu=table)")
    imu, counts, gaps = clean_imu(dataset.imu)
    tables: dict[str, Any] = {"imu": imu}
    read, findings = checked(dataset.imu), list(dataset.findings)
    even = spread(read)
    for kind, cleaner in _CLEANERS.items():
        if (table := getattr(dataset, kind)) is not None:
            table = checked(table)
            like = spread_like(table, read, even)
            even_table = _with_sigmas(like, findings) if isinstance(like, GnssTable) else like
            tables[kind], more = cleaner(even_table)
            counts |= more | spread_counts(kind, table, like)
    total = {k: dataset.counts.get(k, 0) + counts.get(k, 0) for k in dataset.counts | counts}
    return dataclasses.replace(dataset, **tables, counts=total, imu_gaps=gaps, findings=findings)


def clean_imu(imu: ImuTable) -> tuple[ImuTable, dict[str, int], list[tuple[int, int]]]:
    """Clean one IMU table: the table, counts by reason, gaps (start_ns, end_ns). See `clean`."""
    read = checked(imu)
    imu = spread(read)
    limit = np.repeat([GYRO_LIMIT, ACCEL_LIMIT], 3)
    have, bad = _whole_rows(np.hstack([imu.gyro, imu.accel]), limit)
    keep, counts = refusals("imu", imu.time_ns, have, bad)
    counts |= spread_counts("imu", read, imu)
    if np.count_nonzero(keep) < 2:
        reasons = {k.removeprefix("imu_"): n for k, n in counts.items() if n and k != "imu_spread"}
        counted = ", ".join(f"{n} {reason}" for reason, n in reasons.items()) or "none"
        cause = f"fewer than two of {len(imu)} samples can be used (refused: {counted})"
        raise LogError(imu.source or "ImuTable", cause, "the doctor tells what is wrong with them")
    return rows_where(imu, keep), counts, _gaps(imu, keep)


def clean_truth(truth: Trajectory) -> tuple[Trajectory, dict[str, int]]:
    """Clean a trajectory: keep rows with place and attitude; a velocity may be missing (NaN)."""
    truth = checked(truth)
    v_n = np.where(np.isnan(truth.v_n), 0.0, truth.v_n)
    values = np.hstack([place_of(truth), v_n, truth.q_nb])
    limit = np.array([*_PLACE_LIMIT, *[SPEED_LIMIT] * 3, *[QUATERNION_LIMIT] * 4])
    return _kept("truth", truth, *_whole_rows(values, limit))


def clean_master(master: Trajectory) -> tuple[Trajectory, dict[str, int]]:
    """Clean the records of a master INS: missing components stay NaN, the others are kept.

    An attitude without one component is missing as a whole.
    """
    master = checked(master)
    parts: dict[str, tuple[np.ndarray, np.ndarray | float]] = {
        "place": (place_of(master), _PLACE_LIMIT),
        "v_n": (master.v_n, SPEED_LIMIT),
        "q_nb": (master.q_nb, QUATERNION_LIMIT),
    }
    if master.omega_ib_b is not None:
        parts["omega_ib_b"] = (master.omega_ib_b, GYRO_LIMIT)
    kept: dict[str, np.ndarray] = {}
    bad: dict[str, Rows] = {}
    for name, (values, limit) in parts.items():
        kept[name], more = _numbers(values, limit)
        bad = {reason: rows | bad.get(reason, rows) for reason, rows in more.items()}
    kept["q_nb"][np.isnan(kept["q_nb"]).any(axis=1)] = np.nan
    have = np.any([np.isfinite(values).any(axis=1) for values in kept.values()], axis=0)
    lat, lon, alt = kept.pop("place").T
    return _kept("master", master, have, bad, lat_rad=lat, lon_rad=lon, alt_m=alt, **kept)


def _with_sigmas(gnss: GnssTable, findings: list[Finding]) -> GnssTable:
    """Fixes with usual sigmas for components whose sigma is never positive; adds a note."""
    blank: dict[str, np.ndarray] = {}
    for name, values in (("sigma_m", place_of(gnss)), ("sigma_v", gnss.v_n)):
        sigma = getattr(gnss, name)
        if values is not None and sigma is not None:
            with np.errstate(invalid="ignore"):
                never = ~np.any(np.isfinite(values) & (sigma > 0.0), axis=0)
            blank[name] = np.where(never, np.nan, np.where(np.isnan(sigma), 0.0, sigma))
    filled = with_usual_sigmas(dataclasses.replace(gnss, **blank), findings)
    kept = {
        name: np.where(np.isnan(one), getattr(filled, name), getattr(gnss, name))
        for name, one in blank.items()
    }
    return dataclasses.replace(filled, **kept)


def clean_gnss(gnss: GnssTable) -> tuple[GnssTable, dict[str, int]]:
    """Clean one GNSS table: the table and counts by reason. See `clean`."""
    gnss = checked(gnss)
    place, sigma_m, bad = _components(place_of(gnss), gnss.sigma_m, _PLACE_LIMIT)
    have = np.isfinite(place).any(axis=1)
    kept = dict(zip(("lat_rad", "lon_rad", "alt_m"), place.T, strict=True)) | {"sigma_m": sigma_m}
    if gnss.v_n is not None and gnss.sigma_v is not None:
        limit = np.full(3, SPEED_LIMIT)
        v_n, sigma_v, more = _components(gnss.v_n, gnss.sigma_v, limit)
        bad = {reason: bad[reason] | more[reason] for reason in bad}
        have |= np.isfinite(v_n).any(axis=1)
        kept |= {"v_n": v_n, "sigma_v": sigma_v}
    return _kept("gnss", gnss, have, bad, **kept)


def _kept(
    name: str, table: AnyTable, have: Rows, bad: Mapping[str, Rows], **columns: np.ndarray
) -> tuple[AnyTable, dict[str, int]]:
    """Rows of a table that are not refused, with other columns, and the counts by reason."""
    keep, counts = refusals(name, table.time_ns, have, bad)
    return rows_where(dataclasses.replace(table, **columns), keep), counts


def _whole_rows(values: np.ndarray, limit: np.ndarray) -> tuple[Rows, dict[str, Rows]]:
    """Good rows, and bad ones by their first reason, if one bad number refuses a row."""
    _, bad = _numbers(values, limit)
    bad["inf"] &= ~bad["nan"]
    bad["absurd"] &= ~bad["nan"] & ~bad["inf"]
    return ~(bad["nan"] | bad["inf"] | bad["absurd"]), bad


def _numbers(values: np.ndarray, limit: np.ndarray | float) -> tuple[np.ndarray, dict[str, Rows]]:
    """Values, NaN where not finite or beyond the limit, and affected rows by reason."""
    nan, inf = np.isnan(values), np.isinf(values)
    with np.errstate(invalid="ignore"):
        absurd = (np.abs(values) > limit) & ~inf
    bad = {"nan": nan, "inf": inf, "absurd": absurd}
    kept = np.where(nan | inf | absurd, np.nan, values)
    return kept, {reason: mask.any(axis=1) for reason, mask in bad.items()}


def _components(
    values: np.ndarray, sigma: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Values with NaN where a component is missing, sigmas, and affected rows by reason."""
    nan = np.isnan(values) | np.isnan(sigma)
    inf = (np.isinf(values) | np.isinf(sigma)) & ~nan
    with np.errstate(invalid="ignore"):
        absurd = ((np.abs(values) > limit) | (sigma > SIGMA_LIMIT)) & ~nan & ~inf
        unsure = (sigma <= 0.0) & ~nan & ~inf
    usable = (sigma > 0.0) & (sigma <= SIGMA_LIMIT)
    bad = {"nan": nan, "inf": inf, "absurd": absurd, "sigma": unsure}
    return (
        np.where(nan | inf | absurd | unsure, np.nan, values),
        np.where(usable, sigma, _PLACEHOLDER_SIGMA),
        {reason: np.asarray(mask.any(axis=1)) for reason, mask in bad.items()},
    )


def _gaps(imu: ImuTable, keep: np.ndarray) -> list[tuple[int, int]]:
    """Spans between kept samples in which others are missing.

    A step longer than usual: for increments 1.5 times, since the motion of a lost one is lost; for
    rates 2.5 times, since one lost sample is interpolated. Also where more than two successive
    samples were refused as backward: a clock set back hides elapsed time.
    """
    kept, refused = np.flatnonzero(keep), np.flatnonzero(~keep)
    time_ns = imu.time_ns[kept]
    step = np.diff(time_ns)
    long = step > (1.5 if imu.kind == "increment" else 2.5) * np.median(step)
    after = np.searchsorted(kept, refused) - 1  # the last sample kept before each refused one
    backward = (after >= 0) & (imu.time_ns[refused] < time_ns[np.maximum(after, 0)])
    long |= np.bincount(after[backward], minlength=len(kept))[:-1] > 2
    return [(int(time_ns[k]), int(time_ns[k + 1])) for k in np.flatnonzero(long)]


def clean_mag(mag: MagTable) -> tuple[MagTable, dict[str, int]]:
    """Clean one table of magnetic field, component by component.

    Returns:
        The table, and counts: rows with a component that is NaN (``mag_nan``), infinite
        (``mag_inf``) or larger than `FIELD_LIMIT_T` (``mag_absurd``), which are or become NaN; and
        rows refused as ``mag_duplicate``, ``mag_backward``, ``mag_ahead``.

    Raises:
        LogError: arrays that are no table.
    """
    read = checked(mag)
    mag = spread(read)
    field_t, bad = _numbers(mag.field_t, FIELD_LIMIT_T)
    table, counts = _kept("mag", mag, np.ones(len(mag), bool), bad, field_t=field_t)
    return table, counts | spread_counts("mag", read, mag)


def clean_attitude(attitude: AttitudeTable) -> tuple[AttitudeTable, dict[str, int]]:
    """Clean one table of attitude; an attitude without one component is missing as a whole.

    Counts as in `clean_mag`; ``attitude_absurd`` are quaternions that are not of unit length.

    Raises:
        LogError: arrays that are no table.
    """
    attitude = checked(attitude)
    q_nb = attitude.q_nb
    nan, inf = np.isnan(q_nb).any(axis=1), np.isinf(q_nb).any(axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        wrong = ~(np.abs(np.linalg.norm(q_nb, axis=1) - 1.0) < TOLERANCE) & ~nan & ~inf
    q_nb = np.where((nan | inf | wrong)[:, None], np.nan, q_nb)
    bad = {"nan": nan & ~inf, "inf": inf, "absurd": wrong}
    return _kept("attitude", attitude, np.ones(len(attitude), bool), bad, q_nb=q_nb)


def clean_odometry(odometry: OdometryTable) -> tuple[OdometryTable, dict[str, int]]:
    """Clean one table of wheel speeds: keep rows with a speed and a positive sigma.

    Raises:
        LogError: arrays that are no table.
    """
    odometry = checked(odometry)
    sigma = odometry.sigma_speed
    limit = np.array([SPEED_LIMIT, SIGMA_LIMIT])
    have, bad = _whole_rows(np.stack([odometry.speed_mps, sigma], axis=-1), limit)
    bad["sigma"] = have & (sigma <= 0.0)
    return _kept("odometry", odometry, have & (sigma > 0.0), bad)


_CLEANERS: dict[str, Callable[[Any], tuple[Any, dict[str, int]]]] = {
    "gnss": clean_gnss,
    "truth": clean_truth,
    "master": clean_master,
    "mag": clean_mag,
    "attitude": clean_attitude,
    "odometry": clean_odometry,
}
