"""Drives recorded by a phone, as strapdown-rs keeps them: CSV with named columns, UTC dates.

Columns come in any order: ``time`` (``2025-06-11 20:34:27+00:00``), ``latitude longitude`` [deg],
``altitude`` [m], ``speed`` [m/s] and ``bearing`` [deg], their accuracies, ``acc_x`` .. [m/s^2],
``gyro_x`` .. [rad/s], ``mag_x`` .. [uT]. An empty cell is missing; a line is a sample only of
the sensors with numbers in it.

The axes are Android's: x to the right of the screen, y to its upper edge, z out of the screen. A
phone that lies flat with its upper edge forward is right-forward-up, as the tables are labelled; in
a holder it has another orientation, for which give a `Mounting`.

Android states the radius that contains the position with 68 % probability, so sigma along north and
east is that over 1.51. The altitude is taken as above the ellipsoid, as in Android; other phones
give it above sea level.
"""

from __future__ import annotations

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.logs.findings import AnyPath, Findings, LogError, refused
from robins.logs.fix_kinds import over_ground
from robins.logs.tables import recording
from robins.logs.text import Head, TextLayout, peek, read_columns
from robins.logs.timebase import dates_to_ns
from robins.units import to_si

_GYRO, _ACCEL, _MAG = (tuple(f"{s}_{axis}" for axis in "xyz") for s in ("gyro", "acc", "mag"))
_PLACE = ("latitude", "longitude", "altitude", "horizontalAccuracy", "verticalAccuracy")
_VELOCITY = ("speed", "bearing", "speedAccuracy", "bearingAccuracy")
_NEEDED = ("time", *_GYRO, *_ACCEL, *_MAG, *_PLACE, *_VELOCITY)
_RADIUS_68 = float(np.sqrt(-2.0 * np.log(1.0 - 0.68)))  # in sigmas of one axis
_SINGLE = 5  # Q of RTKLIB for a fix without corrections


def _header(head: Head) -> tuple[int, list[str]]:
    line, text = (head.data(1) or [(1, "")])[0]
    return line, [name.strip().strip('"') for name in text.split(",")]


def is_phone(head: Head) -> bool:
    """True if a header names the columns of such a drive."""
    names = _header(head)[1]
    return names[0] == "time" and {"acc_x", "gyro_x", "horizontalAccuracy"} <= set(names)


def read_phone(path: AnyPath, findings: Findings = None) -> Dataset:
    """Read inertial samples, magnetic field and fixes.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions; without it they are issued as `LogWarning`.

    Raises:
        LogError: a column is missing or not numeric, a stamp is no date, or a sensor has no data.
    """
    file, head = str(path), peek(path)
    line, names = _header(head)
    at = refused(file, f"line {line}")
    if lacking := [name for name in _NEEDED if name not in names]:
        raise at(f"the header lacks {', '.join(lacking)}", "is it of another format?")
    if twice := sorted({name for name in _NEEDED if names.count(name) > 1}):
        raise at(f"the header names {', '.join(twice)} twice", "keep one")
    if names[0] != "time":
        raise at("the first column is not the time", "put it first")
    columns = read_columns(path, TextLayout(tuple(names), ",", skip=line, all_named=True), findings)
    place = {name: k - 1 for k, name in enumerate(names)}

    def stack(*wanted: str) -> np.ndarray:
        return columns.values[:, [place[name] for name in wanted]]

    time_ns = dates_to_ns(file, "time", columns.texts[:, 0], columns.rows)
    have = {
        "inertial samples": np.isfinite(stack(*_GYRO, *_ACCEL)).any(axis=1),
        "magnetic field": np.isfinite(stack(*_MAG)).any(axis=1),
        "fixes": np.isfinite(stack("latitude", "longitude")).any(axis=1),
    }
    for what, lines in have.items():
        if not lines.any():
            raise LogError(file, f"no line has {what}", "record that sensor as well")
    (imu, mag, gnss), rows = have.values(), columns.rows
    gyro, accel, field = stack(*_GYRO)[imu], stack(*_ACCEL)[imu], to_si(stack(*_MAG)[mag], "uT")
    fixed, moved = stack(*_PLACE)[gnss], stack(*_VELOCITY)[gnss]
    samples = ImuTable(time_ns[imu], gyro, accel, "rate", "RFU", file, rows[imu])
    fixes = fixes_of(file, time_ns[gnss], fixed, moved, rows[gnss])
    return recording(
        file, samples, fixes, mag=MagTable(time_ns[mag], field, "RFU", file, rows[mag])
    )


def fixes_of(
    file: str, time_ns: np.ndarray, place: np.ndarray, velocity: np.ndarray, rows: np.ndarray
) -> GnssTable:
    """Fixes from the values of Android.

    Args:
        file: for messages.
        time_ns: (n,) stamps.
        place: (n, 5) latitude, longitude [deg], altitude, radius of 68 %, sigma of altitude [m].
        velocity: (n, 4) speed [m/s], bearing [deg] and their sigmas.
        rows: (n,) line numbers.
    """
    lat, lon = np.deg2rad(place[:, :2]).T.copy()
    alt_m, radius_m, sigma_alt_m = place[:, 2:].T
    speed, bearing_deg, sigma_speed, sigma_bearing_deg = velocity.T
    # A bearing of sigma 180 deg is meaningless: the error is at most twice the speed.
    across = speed * np.minimum(np.deg2rad(sigma_bearing_deg), 2.0)
    sigma = np.hypot(sigma_speed, across)
    sigma_v = np.stack([sigma, sigma, np.full(len(speed), np.nan)], axis=-1)
    sigma_m = np.stack([radius_m / _RADIUS_68, radius_m / _RADIUS_68, sigma_alt_m], axis=-1)
    alt_m, v_n = alt_m.copy(), over_ground(speed, bearing_deg)
    quality = np.full(len(speed), _SINGLE, np.int64)
    return GnssTable(
        time_ns, lat, lon, alt_m, sigma_m, v_n, sigma_v, quality, source=file, rows=rows
    )
