"""Magnetic field and attitude made safe: what is no number goes missing, rows stay in place.

A magnetometer may miss samples for as long as it likes, and cameras lose a sensor behind a hand;
the rows remain, NaN, so that both still run beside the inertial samples. Only rows whose stamps are
out of order are refused.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from robins.dataset import AttitudeTable, MagTable
from robins.logs.arrays import checked
from robins.logs.limits import FIELD_LIMIT_T
from robins.logs.ordering import refusals, rows_where
from robins.logs.unit_length import TOLERANCE


def clean_mag(mag: MagTable) -> tuple[MagTable, dict[str, int]]:
    """Clean one table of magnetic field, component by component.

    Returns:
        The table, and counts: rows with a component that is NaN (``mag_nan``), infinite
        (``mag_inf``) or larger than `FIELD_LIMIT_T` (``mag_absurd``), which are or become NaN; and
        rows refused as ``mag_duplicate``, ``mag_backward``, ``mag_ahead``.

    Raises:
        LogError: arrays that are no table.
    """
    mag = checked(mag)
    nan, inf = np.isnan(mag.field_t), np.isinf(mag.field_t)
    absurd = (np.abs(mag.field_t) > FIELD_LIMIT_T) & ~inf
    field_t = np.where(inf | absurd, np.nan, mag.field_t)
    bad = {"nan": nan.any(axis=1), "inf": inf.any(axis=1), "absurd": absurd.any(axis=1)}
    keep, counts = refusals("mag", mag.time_ns, np.ones(len(mag), bool), bad)
    return rows_where(dataclasses.replace(mag, field_t=field_t), keep), counts


def clean_attitude(attitude: AttitudeTable) -> tuple[AttitudeTable, dict[str, int]]:
    """Clean one table of attitude; an attitude is one thing, so it is missing whole.

    Counts as `clean_mag`; ``attitude_absurd`` are quaternions that are not of unit length.

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
    keep, counts = refusals("attitude", attitude.time_ns, np.ones(len(attitude), bool), bad)
    return rows_where(dataclasses.replace(attitude, q_nb=q_nb), keep), counts
