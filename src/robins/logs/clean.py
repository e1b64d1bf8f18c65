"""The boundary behind which a run is safe: bad samples are refused, counted, and then absent.

What is refused here leaves the tables exactly as if its rows had never been recorded; nothing is
repaired, interpolated or smoothed. Time is put in order by refusing the fewest samples, see
`robins.logs.ordering`. Gaps are declared, not filled: the system decides whether to bridge them.
Denormal numbers and huge but possible ones pass; outliers are the business of filters.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.logs.arrays import checked_gnss, checked_imu, checked_truth
from robins.logs.clean_mag import clean_attitude, clean_mag
from robins.logs.findings import LogError
from robins.logs.limits import (
    ACCEL_LIMIT,
    ALT_LIMIT_M,
    GYRO_LIMIT,
    LAT_LIMIT,
    LON_LIMIT,
    SIGMA_LIMIT,
    SPEED_LIMIT,
)
from robins.logs.ordering import increasing, reasons, rows_where

_PLACEHOLDER_SIGMA = 1.0
_COMPONENTS = ("north", "east", "vertical")


def clean(dataset: Dataset) -> Dataset:
    """Refuse what cannot be used and count it by reason.

    Counts, in samples, begin with the table's name: ``imu_nan``, ``imu_inf``, ``imu_absurd`` (a
    magnitude no vehicle has), ``imu_duplicate``, ``imu_backward`` and ``imu_ahead`` (time stamps
    out of order); ``gnss_...`` likewise and ``gnss_sigma`` (zero or negative); ``truth_...``,
    ``master_...``, ``mag_...``, ``attitude_...``.
    Counts already in the dataset are added to.

    A fix that lacks a component keeps the others: the component becomes NaN, its sigma, if that was
    not a positive number, a 1 that nobody uses. A fix with no component left is refused whole.
    Magnetic field and attitude keep their rows, NaN where something is missing.

    ``imu_gaps`` lists the times between which IMU samples are missing.

    Raises:
        LogError: arrays that are no tables (F04), fewer than two IMU samples left, or a GNSS
            component whose sigma is never positive.
    """
    imu, counts, gaps = clean_imu(dataset.imu)
    tables: dict[str, Any] = {"imu": imu}
    for kind, cleaner in _CLEANERS.items():
        if (table := getattr(dataset, kind)) is not None:
            tables[kind], more = cleaner(table)
            counts |= more
    total = {k: dataset.counts.get(k, 0) + counts.get(k, 0) for k in dataset.counts | counts}
    return dataclasses.replace(dataset, **tables, counts=total, imu_gaps=gaps)


def clean_imu(imu: ImuTable) -> tuple[ImuTable, dict[str, int], list[tuple[int, int]]]:
    """Clean one IMU table: the table, counts by reason, gaps (start_ns, end_ns). See `clean`."""
    imu = checked_imu(imu)
    values = np.hstack([imu.gyro, imu.accel])
    limit = np.repeat([GYRO_LIMIT, ACCEL_LIMIT], 3)
    keep, counts = _whole_rows(imu.time_ns, values, limit)
    if np.count_nonzero(keep) < 2:
        refused = ", ".join(f"{n} {reason}" for reason, n in counts.items() if n) or "none"
        raise LogError(
            imu.source or "ImuTable",
            f"fewer than two of {len(imu)} samples can be used (refused: {refused})",
            "the doctor tells what is wrong with them",
        )
    gaps = _gaps(imu, keep)
    return rows_where(imu, keep), {f"imu_{k}": n for k, n in counts.items()}, gaps


def clean_truth(truth: Trajectory) -> tuple[Trajectory, dict[str, int]]:
    """Clean a trajectory: whole rows only."""
    truth = checked_truth(truth)
    position = np.stack([truth.lat_rad, truth.lon_rad, truth.alt_m], -1)
    values = np.hstack([position, truth.v_n, truth.q_nb])
    limit = np.array([LAT_LIMIT, LON_LIMIT, ALT_LIMIT_M, *[SPEED_LIMIT] * 3, *[1.001] * 4])
    keep, counts = _whole_rows(truth.time_ns, values, limit)
    return rows_where(truth, keep), {f"truth_{k}": n for k, n in counts.items()}


def clean_master(master: Trajectory) -> tuple[Trajectory, dict[str, int]]:
    """Clean the report of a master INS: what is missing in a row stays missing, the rest is kept.

    An attitude is one thing, so it is missing whole.
    """
    master = checked_truth(master)
    parts = {
        "position": (
            np.stack([master.lat_rad, master.lon_rad, master.alt_m], -1),
            np.array([LAT_LIMIT, LON_LIMIT, ALT_LIMIT_M]),
        ),
        "v_n": (master.v_n, np.full(3, SPEED_LIMIT)),
        "q_nb": (master.q_nb, np.full(4, 1.001)),
    }
    if master.omega_ib_b is not None:
        parts["omega_ib_b"] = (master.omega_ib_b, np.full(3, GYRO_LIMIT))
    kept: dict[str, np.ndarray] = {}
    refused = {reason: np.zeros(len(master), bool) for reason in ("nan", "inf", "absurd")}
    for name, (values, limit) in parts.items():
        nan, inf = np.isnan(values), np.isinf(values)
        with np.errstate(invalid="ignore"):
            absurd = (np.abs(values) > limit) & ~inf
        missing = nan | inf | absurd
        if name == "q_nb":
            missing = np.broadcast_to(missing.any(axis=1)[:, None], missing.shape)
        kept[name] = np.where(missing, np.nan, values)
        for reason, mask in zip(refused, (nan, inf, absurd), strict=True):
            refused[reason] |= mask.any(axis=1)
    have = np.any([np.isfinite(values).any(axis=1) for values in kept.values()], axis=0)
    in_order = np.zeros(len(master), bool)
    in_order[have] = increasing(master.time_ns[have])
    counts = {reason: int(rows.sum()) for reason, rows in refused.items()}
    counts |= reasons(master.time_ns[have], in_order[have])
    lat, lon, alt = kept.pop("position").T
    table = dataclasses.replace(master, lat_rad=lat, lon_rad=lon, alt_m=alt, **kept)
    return rows_where(table, in_order), {f"master_{k}": n for k, n in counts.items()}


def clean_gnss(gnss: GnssTable) -> tuple[GnssTable, dict[str, int]]:
    """Clean one GNSS table: the table and counts by reason. See `clean`."""
    gnss = checked_gnss(gnss)
    position = np.stack([gnss.lat_rad, gnss.lon_rad, gnss.alt_m], -1)
    limit = np.array([LAT_LIMIT, LON_LIMIT, ALT_LIMIT_M])
    values, sigma, refused = _components(gnss, "position", position, gnss.sigma_m, limit)
    v_n = sigma_v = None
    if gnss.v_n is not None and gnss.sigma_v is not None:
        limit = np.full(3, SPEED_LIMIT)
        v_n, sigma_v, more = _components(gnss, "velocity", gnss.v_n, gnss.sigma_v, limit)
        refused = {reason: refused[reason] | more[reason] for reason in refused}
    have = np.isfinite(values).any(axis=1)
    if v_n is not None:
        have |= np.isfinite(v_n).any(axis=1)
    in_order = np.zeros(len(gnss), bool)
    in_order[have] = increasing(gnss.time_ns[have])
    counts = {reason: int(rows.sum()) for reason, rows in refused.items()}
    counts |= reasons(gnss.time_ns[have], in_order[have])
    table = dataclasses.replace(
        gnss,
        lat_rad=values[:, 0],
        lon_rad=values[:, 1],
        alt_m=values[:, 2],
        sigma_m=sigma,
        v_n=v_n,
        sigma_v=sigma_v,
    )
    return rows_where(table, in_order), {f"gnss_{k}": n for k, n in counts.items()}


def _whole_rows(
    time_ns: np.ndarray, values: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, dict[str, int]]:
    """Rows to keep, and counts, where one bad number spoils its row."""
    nan = np.isnan(values).any(axis=1)
    inf = np.isinf(values).any(axis=1) & ~nan
    with np.errstate(invalid="ignore"):
        absurd = (np.abs(values) > limit).any(axis=1) & ~nan & ~inf
    good = ~(nan | inf | absurd)
    keep = np.zeros(len(time_ns), bool)
    keep[good] = increasing(time_ns[good])
    counts = {"nan": int(nan.sum()), "inf": int(inf.sum()), "absurd": int(absurd.sum())}
    return keep, counts | reasons(time_ns[good], keep[good])


def _components(
    gnss: GnssTable, what: str, values: np.ndarray, sigma: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Values with NaN where a component is missing, sigmas, rows touched by each reason."""
    with np.errstate(invalid="ignore"):
        absurd = (np.abs(values) > limit) | (sigma > SIGMA_LIMIT)
        unsure = sigma <= 0.0
    for k, name in enumerate(_COMPONENTS):
        known = np.isfinite(values[:, k])
        if known.any() and not (sigma[known, k] > 0.0).any():
            raise LogError(
                gnss.source or "GnssTable",
                f"the {name} {what} has {np.count_nonzero(known)} fixes and no positive sigma",
                "zero means unknown, not exact: give real sigmas"
                + (", or leave the velocities out" if what == "velocity" else ""),
                field=f"sigma of {name} {what}",
                value=float(sigma[known, k][0]),
            )
    nan = np.isnan(values) | np.isnan(sigma)
    inf = (np.isinf(values) | np.isinf(sigma)) & ~nan
    absurd &= ~nan & ~inf
    unsure &= ~nan & ~inf
    refused = {"nan": nan, "inf": inf, "absurd": absurd, "sigma": unsure}
    missing = nan | inf | absurd | unsure
    usable = (sigma > 0.0) & (sigma <= SIGMA_LIMIT)
    return (
        np.where(missing, np.nan, values),
        np.where(usable, sigma, _PLACEHOLDER_SIGMA),
        {reason: np.asarray(mask.any(axis=1)) for reason, mask in refused.items()},
    )


def _gaps(imu: ImuTable, keep: np.ndarray) -> list[tuple[int, int]]:
    """Where samples are missing between two kept ones.

    A step longer than usual: for increments 1.5 times, for each one lost takes its motion with it;
    for rates 2.5 times, since one lost sample is bridged by its neighbours. Also where more than
    two samples in a row were refused as backward: a clock set back hides time that has passed.
    """
    kept, refused = np.flatnonzero(keep), np.flatnonzero(~keep)
    time_ns = imu.time_ns[kept]
    step = np.diff(time_ns)
    long = step > (1.5 if imu.kind == "increment" else 2.5) * np.median(step)
    after = np.searchsorted(kept, refused) - 1  # the last sample kept before each refused one
    backward = (after >= 0) & (imu.time_ns[refused] < time_ns[np.maximum(after, 0)])
    long |= np.bincount(after[backward], minlength=len(kept))[:-1] > 2
    return [(int(time_ns[k]), int(time_ns[k + 1])) for k in np.flatnonzero(long)]


_CLEANERS: dict[str, Callable[[Any], tuple[Any, dict[str, int]]]] = {
    "gnss": clean_gnss,
    "truth": clean_truth,
    "master": clean_master,
    "mag": clean_mag,
    "attitude": clean_attitude,
}
