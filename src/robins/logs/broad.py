"""Trials of BROAD, the orientation benchmark of Laidig et al. (2021): .mat, .hdf5 and .npz.

Each archive, of the repository github.com/dlaidig/broad or converted by NumPy, holds a nine-axis
IMU and the attitude from optical motion capture:

- ``imu_gyr`` (n, 3) rad/s, ``imu_acc`` (n, 3) specific force in m/s^2, ``imu_mag`` (n, 3) uT;
- ``opt_quat`` (n, 4), scalar first, sensor to east-north-up, NaN where the cameras lost it;
- ``movement`` (n,), the phases that count; ``sampling_rate`` in Hz.

There are no stamps: row k is at k / rate after the start. All data are in sensor axes, which have
no front and no top. The tables are labelled "FRD", which here stands for the sensor's own axes, of
samples and attitude alike, so nothing is rotated.
"""

from __future__ import annotations

import os

import numpy as np

from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable
from robins.logs.archives import arrays_in, kind_of_archive, names_in
from robins.logs.findings import AnyPath, Findings, LogError, refused
from robins.logs.tables import stem_of, unit_quaternions
from robins.logs.text import Head
from robins.logs.text_format import RATES_HZ
from robins.units import to_si

_COLUMNS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4}
_NAMES = (*_COLUMNS, "movement", "sampling_rate")


def is_broad(head: Head) -> bool:
    """True if a file is an archive with some of these arrays.

    Raises:
        LogError: it is a damaged archive.
    """
    if not kind_of_archive(head.start):
        return False
    return bool(names_in(head.file, os.stat(head.file).st_mtime_ns) & set(_COLUMNS))


def read_broad(path: AnyPath, findings: Findings = None) -> Dataset:
    """Read a trial: inertial samples, magnetic field and true attitude, all in sensor axes.

    Args:
        path: the archive.
        findings: receives doubts; without it they are issued as `LogWarning`.

    Raises:
        LogError: the archive is cut or damaged, or an array is missing or invalid. Nothing is read
            from a damaged one, whose index comes last.
    """
    file = str(path)
    arrays = arrays_in(path, _NAMES)
    if lacking := [name for name in _NAMES if name not in arrays]:
        held = sorted(names_in(file, os.stat(file).st_mtime_ns))
        what = f"has no array {', '.join(lacking)}; it has {', '.join(held)}"
        raise LogError(file, what, "name the arrays as BROAD does")
    rate = _rate(file, arrays["sampling_rate"])
    tables = {name: _rows_of(file, name, arrays[name], width) for name, width in _COLUMNS.items()}
    n = len(tables["imu_gyr"])
    movement = arrays["movement"]
    if movement.shape in ((n, 1), (1, n)):  # from MATLAB, which has no vectors and here no bool
        movement = movement.reshape(n)
        movement = movement.astype(bool) if np.isin(movement, (0, 1)).all() else movement
    for name, rows in (*tables.items(), ("movement", movement)):
        if rows.shape[:1] != (n,):
            raise _misfit(file, name, rows, f"({n}, ...) as imu_gyr has")
    if movement.ndim != 1 or movement.dtype.kind != "b":
        raise _misfit(file, "movement", movement, f"({n},) of bool")
    time_ns = np.round(np.arange(n) * (1e9 / rate)).astype(np.int64)
    gyro, accel, field, q = tables.values()
    q_nb = unit_quaternions(file, "opt_quat", q, None, findings)
    return Dataset(
        stem_of(file),
        ImuTable(time_ns, gyro, accel, "rate", source=file),
        mag=MagTable(time_ns, to_si(field, "uT"), source=file),
        attitude=AttitudeTable(time_ns, q_nb, "ENU", moving=movement.copy(), source=file),
    )


def _rate(file: str, value: np.ndarray) -> float:
    if value.size != 1 or value.dtype.kind not in "fiu":
        raise _misfit(file, "sampling_rate", value, "() of a real number")
    rate = float(value.reshape(()))
    if not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        cause = f"is not between {RATES_HZ[0]:g} and {RATES_HZ[1]:g} Hz, and time is made from it"
        raise refused(file, field="sampling_rate", value=rate)(cause, "give samples a second")
    return rate


def _rows_of(file: str, name: str, array: np.ndarray, width: int) -> np.ndarray:
    if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
        raise _misfit(file, name, array, f"(n, {width}) of real numbers")
    if not len(array):
        raise refused(file, field=name)("has no rows", "record it again")
    with np.errstate(invalid="ignore"):  # a signalling NaN stays NaN
        return np.ascontiguousarray(array, np.float64)


def _misfit(file: str, name: str, array: np.ndarray, wanted: str) -> LogError:
    return refused(file, field=name)(
        f"is {array.dtype} of shape {array.shape} where {wanted} is needed",
        "save the arrays as BROAD does",
    )
