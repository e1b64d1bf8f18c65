"""Kinds of fixes, numbered as in RTKLIB, and usual sigmas for receivers that state none.

1 is a fixed solution, 2 float, 3 with satellite augmentation, 4 differential, 5 single, 6 precise
point positioning; 0 is none of them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from robins.dataset import GnssTable
from robins.logs.findings import Finding, Findings, report

PX4 = {6: 1, 5: 2, 4: 4, 3: 5, 2: 5}
"""Type of a fix in PX4 -> kind; 0 and 1 are no fix, 2 has no height, 8 (extrapolated) is none."""
MAVLINK = PX4 | {7: 1, 8: 6}
"""GPS_FIX_TYPE of MAVLink and ArduPilot -> kind; 7 is a static base, 8 is PPP."""

_USUAL = {1: (0.02, 0.05), 2: (0.3, 0.1), 3: (1.0, 0.2), 4: (1.0, 0.2), 5: (3.0, 0.3)}
_USUAL[6] = (0.1, 0.1)
"""Usual sigmas of horizontal position [m] and velocity [m/s] of each kind, in the open."""
_SHAPE = np.array([1.0, 1.0, 2.0])  # vertical sigmas are twice the horizontal ones
SINGLE_M = _USUAL[5][0] * _SHAPE
"""Usual sigmas (3,) of a single position, north, east, down [m]."""
_ASSUMED = {
    "place": "0.02 m for fixed, 0.3 m for float, 3 m for single ones",
    "velocity": "0.05 m/s for fixed, 0.1 m/s for float, 0.3 m/s for single ones",
}


def fixes(
    file: str,
    time_ns: np.ndarray,
    place: tuple[np.ndarray, np.ndarray, np.ndarray],
    sigma_m: tuple[np.ndarray, np.ndarray, np.ndarray],
    v_n: np.ndarray,
    sigma_v: np.ndarray,
    kind: np.ndarray,
    flat: np.ndarray,
    findings: Findings,
) -> GnssTable:
    """Fixes of a receiver, NaN without a fix, with usual sigmas where none is stated.

    Args:
        file: source of the table.
        time_ns: (n,) stamps.
        place: latitude, longitude [deg], height [m], (n,) each.
        sigma_m: north, east, down [m], (n,) each; zero or NaN if not stated.
        v_n: (n, 3) velocity [m/s].
        sigma_v: (n,) of each component of the velocity [m/s], likewise.
        kind: (n,) of the fix; 0 without a fix.
        flat: (n,) bool, fixes without height and velocity.
        findings: receives a note if sigmas are assumed.
    """
    there, solid = kind > 0, (kind > 0) & ~flat
    lat, lon = (np.deg2rad(np.where(there, value, np.nan)) for value in place[:2])
    height, v_n = np.where(solid, place[2], np.nan), np.where(solid[:, None], v_n, np.nan)
    stated = np.stack([*sigma_m, sigma_v, sigma_v, sigma_v], axis=-1)
    sigma = np.where(stated > 0.0, stated, np.nan)
    quality = kind.astype(np.int64)
    table = GnssTable(time_ns, lat, lon, height, sigma[:, :3], v_n, sigma[:, 3:], quality)
    return with_usual_sigmas(dataclasses.replace(table, source=file), findings)


def over_ground(
    speed: np.ndarray, course_deg: np.ndarray, down: np.ndarray | float = np.nan
) -> np.ndarray:
    """Velocity (n, 3), north, east, down, from speed over ground and course."""
    course = np.deg2rad(course_deg)
    with np.errstate(invalid="ignore"):  # an infinite course has no direction
        north, east = speed * np.cos(course), speed * np.sin(course)
    return np.stack([north, east, np.broadcast_to(down, north.shape)], axis=-1)


def with_usual_sigmas(table: GnssTable, findings: Findings, places: bool = True) -> GnssTable:
    """The same fixes, with the usual sigmas of their kind where none is stated, and a note.

    The table marks them (``assumed_m``, ``assumed_v``), in addition to those marked before. The
    `where` of the note names the assumed sigmas: "place", "velocity" or both.

    Vertical sigmas are twice the horizontal ones. Missing values get no sigma.
    """
    kinds = np.zeros(len(table), np.int64) if table.quality is None else table.quality
    usual = np.array([_USUAL.get(int(k), _USUAL[5]) for k in kinds]).reshape(-1, 2)
    lacking = np.isnan(table.sigma_m) & np.isfinite(table.lat_rad)[:, None] & places
    sigma_m = np.where(lacking, usual[:, :1] * _SHAPE, table.sigma_m)
    sigma_v, count, assumed_v = table.sigma_v, lacking.any(axis=1), table.assumed_v
    assumed = ["place"] if count.any() else []
    if table.v_n is not None and sigma_v is not None:
        unstated = np.isnan(sigma_v) & np.isfinite(table.v_n)
        sigma_v = np.where(unstated, usual[:, 1:] * _SHAPE, sigma_v)
        count, assumed_v = count | unstated.any(axis=1), _either(unstated, assumed_v)
        assumed += ["velocity"] if unstated.any() else []
    if count.any():
        value, usually = int(count.sum()), "; ".join(_ASSUMED[one] for one in assumed)
        sentence = (
            f"{Path(table.source).name}: {value} of {len(table)} fixes state no sigma of "
            f"{' or '.join(assumed)}; that of the kind is assumed: {usually}."
        )
        where = ", ".join(assumed)
        report(findings, Finding("note", "sigma_assumed", table.source, where, value, sentence))
    marks = {"assumed_m": _either(lacking, table.assumed_m), "assumed_v": assumed_v}
    return dataclasses.replace(table, sigma_m=sigma_m, sigma_v=sigma_v, **marks)


def _either(one: np.ndarray, other: np.ndarray | None) -> np.ndarray | None:
    marks = one if other is None else one | other
    return marks if marks.any() else None
