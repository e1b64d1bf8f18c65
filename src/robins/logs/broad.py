"""Trials of BROAD, the orientation benchmark of Laidig et al. (2021): NumPy archives (``.npz``).

Each holds a nine-axis IMU and the attitude that cameras saw:

- ``imu_gyr`` (n, 3) rad/s, ``imu_acc`` (n, 3) specific force in m/s^2, ``imu_mag`` (n, 3) uT;
- ``opt_quat`` (n, 4), scalar first, sensor to east-north-up, NaN where the cameras lost it;
- ``movement`` (n,), the phases that count; ``sampling_rate`` in Hz.

There are no stamps: row k is k over the rate after the start. All of it is along the axes of the
sensor, which has no front and no top. The tables say "FRD" because a body has to have a name; it
stands for the sensor's own axes, of samples and of the attitude alike, so nothing is turned.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable
from robins.foreign import archive_of, arrays_of
from robins.logs.findings import Finding, LogError, refused
from robins.logs.opening import whole
from robins.logs.tables import unit_quaternions
from robins.logs.text import Head
from robins.units import to_si

_COLUMNS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4}
_NAMES = (*_COLUMNS, "movement", "sampling_rate")
_LARGEST = 1 << 30  # bytes of a file, 18 hours at 500 Hz
_RATES_HZ = (0.1, 1e5)
_HEADER = 30  # bytes before the name of an archive's first member


def is_archive(head: Head) -> bool:
    """Whether a file begins as NumPy archives do, whole or cut."""
    length = int.from_bytes(head.start[26:28], "little")
    name = head.start[_HEADER : _HEADER + length]
    return head.start.startswith(b"PK\x03\x04") and name.endswith(b".npy")


def read_broad(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> Dataset:
    """Read a trial: inertial samples, magnetic field and true attitude, all along sensor axes.

    Args:
        path: the archive.
        findings: receives what is doubted; without it that is issued as `LogWarning`.

    Raises:
        LogError: the archive is cut or damaged, or an array is missing or is not what it should be.
            Nothing is read from a damaged one: its index comes last.
    """
    file = str(path)
    arrays = _members(file)
    rate = _rate(file, arrays["sampling_rate"])
    tables = {name: _rows_of(file, name, arrays[name], width) for name, width in _COLUMNS.items()}
    n = len(tables["imu_gyr"])
    for name, rows in (*tables.items(), ("movement", arrays["movement"])):
        if rows.shape[:1] != (n,):
            raise _misfit(file, name, rows, f"({n}, ...) as imu_gyr has")
    movement = arrays["movement"]
    if movement.ndim != 1 or movement.dtype.kind != "b":
        raise _misfit(file, "movement", movement, f"({n},) of bool")
    time_ns = np.round(np.arange(n) * (1e9 / rate)).astype(np.int64)
    return Dataset(
        name=Path(file).name.split(".")[0],
        imu=ImuTable(time_ns, tables["imu_gyr"], tables["imu_acc"], "rate", source=file),
        mag=MagTable(time_ns, to_si(tables["imu_mag"], "uT"), source=file),
        attitude=AttitudeTable(
            time_ns,
            unit_quaternions(file, "opt_quat", tables["opt_quat"], None, findings),
            nav="ENU",
            moving=movement.copy(),
            source=file,
        ),
    )


def _members(file: str) -> dict[str, np.ndarray]:
    """The arrays by name, each checked against its checksum before it is looked at."""
    data, _ = whole(file, _LARGEST)

    def damaged(why: str) -> LogError:
        mend = (
            "fetch it again, or save it as plain numbers; nothing of it was used, for no number in "
            "it can be trusted"
        )
        return LogError(file, f"is cut short or damaged after {len(data)} bytes: {why}", mend)

    arrays = arrays_of(data, damaged, _NAMES)
    if lacking := [name for name in _NAMES if name not in arrays]:
        held = sorted(name.removesuffix(".npy") for name in archive_of(data, damaged).namelist())
        what = f"has no array {', '.join(lacking)}; it has {', '.join(held)}"
        raise LogError(file, what, "name the arrays as BROAD does")
    return arrays


def _rate(file: str, value: np.ndarray) -> float:
    if value.shape not in ((), (1,)) or value.dtype.kind not in "fiu":
        raise _misfit(file, "sampling_rate", value, "() of a real number")
    rate = float(value.reshape(()))
    if not _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
        raise refused(file, field="sampling_rate", value=rate)(
            f"is not between {_RATES_HZ[0]:g} and {_RATES_HZ[1]:g} Hz, and time is made from it",
            "give samples a second",
        )
    return rate


def _rows_of(file: str, name: str, array: np.ndarray, width: int) -> np.ndarray:
    if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
        raise _misfit(file, name, array, f"(n, {width}) of real numbers")
    if not len(array):
        raise refused(file, field=name)("has no rows", "record it again")
    with np.errstate(invalid="ignore"):  # a NaN that signals stays a NaN
        return np.ascontiguousarray(array, np.float64)


def _misfit(file: str, name: str, array: np.ndarray, wanted: str) -> LogError:
    return refused(file, field=name)(
        f"is {array.dtype} of shape {array.shape} where {wanted} is needed",
        "save the arrays as BROAD does",
    )
