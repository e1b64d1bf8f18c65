"""Kinds of fixes as RTKLIB counts them, and sigmas where a receiver states none.

1 is a fixed solution, 2 float, 3 with augmentation by satellite, 4 differential, 5 single, 6 a
precise point position; 0 is none of them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from robins.dataset import GnssTable
from robins.logs.findings import Finding, telling

MAVLINK = {6: 1, 5: 2, 4: 4, 3: 5, 2: 5}
"""GPS_FIX_TYPE of MAVLink, PX4 and ArduPilot -> kind; less is no fix."""

_USUAL = {
    1: (0.02, 0.05),
    2: (0.3, 0.1),
    3: (1.0, 0.2),
    4: (1.0, 0.2),
    5: (3.0, 0.3),
    6: (0.1, 0.1),
}
"""Usual sigma of a horizontal place [m] and of a velocity [m/s] of each kind, in the open."""


def with_usual_sigmas(table: GnssTable, findings: list[Finding] | None) -> GnssTable:
    """The same fixes, with the usual sigmas of their kind where none is stated, and a note.

    Vertical sigmas are twice the horizontal ones. What is missing itself gets no sigma.
    """
    kinds = np.zeros(len(table), np.int64) if table.quality is None else table.quality
    usual = np.array([_USUAL.get(int(k), _USUAL[5]) for k in kinds]).reshape(-1, 2)
    shape = np.array([1.0, 1.0, 2.0])
    lacking = np.isnan(table.sigma_m) & np.isfinite(table.lat_rad)[:, None]
    sigma_m = np.where(lacking, usual[:, :1] * shape, table.sigma_m)
    sigma_v, count = table.sigma_v, lacking.any(axis=1)
    if table.v_n is not None and sigma_v is not None:
        unstated = np.isnan(sigma_v) & np.isfinite(table.v_n)
        sigma_v = np.where(unstated, usual[:, 1:] * shape, sigma_v)
        count = count | unstated.any(axis=1)
    if count.any():
        telling(findings, "note", "sigma_assumed", table.source, value=int(count.sum()))(
            f"{count.sum()} of {len(table)} fixes state no sigma of place or velocity; the usual "
            "one of their kind is assumed, 0.02 m for fixed, 0.3 m for float, 3 m for single ones."
        )
    return dataclasses.replace(table, sigma_m=sigma_m, sigma_v=sigma_v)
