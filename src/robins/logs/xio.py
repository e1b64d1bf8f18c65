"""CSV of the x-io sensors and of their Fusion library: nine axes, units in the header.

    Time (s),Gyroscope X (deg/s),...,Accelerometer X (g),...,Magnetometer X (uT),...

The units in brackets are believed, any of `robins.units` of the right kind. The first column is
``Time`` or ``Timestamp``, in s, ms, us or ns. The axes are those of the sensor, which come out of
the box forward-left-up; here they bear the name "FRD" until a `Mounting` turns them.
"""

from __future__ import annotations

import os
import re
from typing import NamedTuple

import numpy as np

from robins.dataset import Dataset, ImuTable, MagTable
from robins.logs.findings import Finding, LogError
from robins.logs.text import Columns, Head, Layout, peek, read_columns
from robins.logs.timebase import stamps_to_ns
from robins.units import UnitError, to_si, unit

_TIME = re.compile(r"Time(?:stamp)? \((s|ms|us|µs|μs|ns)\)")
_DECIMALS = {"s": 9, "ms": 6, "us": 3, "µs": 3, "μs": 3, "ns": 0}
_COLUMN = re.compile(r"(Gyroscope|Accelerometer|Magnetometer) ([XYZ]) \((.+)\)")
_KINDS = {
    "Gyroscope": "angle rate",
    "Accelerometer": "acceleration",
    "Magnetometer": "magnetic field",
}


class _Column(NamedTuple):
    place: int  # among the columns after the time
    name: str
    unit: str


def _header(head: Head) -> tuple[int, list[str]]:
    line, text = (head.data(1) or [(1, "")])[0]
    return line, [name.strip().strip('"') for name in text.split(",")]


def is_xio(head: Head) -> bool:
    """Whether a header names its columns in this way."""
    first, *others = _header(head)[1]
    return bool(_TIME.fullmatch(first)) and any(_COLUMN.fullmatch(name) for name in others)


def read_xio(
    path: str | os.PathLike[str], findings: list[Finding] | None = None
) -> Dataset | ImuTable:
    """Read inertial samples, and the magnetic field where it was recorded.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Returns:
        A dataset of ``imu`` and ``mag``; the inertial table alone if there is no magnetometer.

    Raises:
        LogError: columns are missing, named twice, of an unknown unit, or not numbers.
    """
    file, head = str(path), peek(path)
    line, names = _header(head)
    time = _TIME.fullmatch(names[0])
    if time is None:
        raise LogError(
            file,
            "the first column is not the time, such as Time (s)",
            "put it first and name it with its unit",
            where=f"line {line}",
            field="header",
            value=names[0],
        )
    found = _columns(file, line, names[1:])
    columns = read_columns(path, Layout(tuple(names), ",", skip=line, all_named=True), findings)
    time_ns = stamps_to_ns(
        file, names[0], columns.texts[:, 0], columns.rows, exponent=_DECIMALS[time[1]]
    )
    imu = ImuTable(
        time_ns,
        _stack(columns, found, "Gyroscope"),
        _stack(columns, found, "Accelerometer"),
        "rate",
        source=file,
        rows=columns.rows,
    )
    if ("Magnetometer", "X") not in found:
        return imu
    field_t = _stack(columns, found, "Magnetometer")
    mag = MagTable(time_ns, field_t, source=file, rows=columns.rows)
    return Dataset(
        name=os.path.basename(file).split(".")[0],
        imu=imu,
        mag=mag,
        meta={"time_unit_known": (file,)},
    )


def _columns(file: str, line: int, names: list[str]) -> dict[tuple[str, str], _Column]:
    """By sensor and axis; whole sensors only."""
    found: dict[tuple[str, str], _Column] = {}
    for index, name in enumerate(names):
        match = _COLUMN.fullmatch(name)
        if match is None:
            continue
        sensor, axis, symbol = match.groups()
        try:
            unit(symbol, _KINDS[sensor])
        except UnitError as error:
            raise LogError(
                file, str(error), "state the unit", where=f"line {line}", field=name
            ) from error
        if (sensor, axis) in found:
            raise LogError(
                file, "is named twice", "keep one", where=f"line {line}", field=f"{sensor} {axis}"
            )
        found[sensor, axis] = _Column(index, name, symbol)
    for sensor in _KINDS:
        lacking = [f"{sensor} {axis}" for axis in "XYZ" if (sensor, axis) not in found]
        if lacking and not (sensor == "Magnetometer" and len(lacking) == 3):
            raise LogError(
                file,
                f"the header lacks {', '.join(lacking)}",
                "record the three axes together",
                where=f"line {line}",
            )
    return found


def _stack(columns: Columns, found: dict[tuple[str, str], _Column], sensor: str) -> np.ndarray:
    triad = [found[sensor, axis] for axis in "XYZ"]
    return np.stack([to_si(columns.values[:, c.place], c.unit) for c in triad], axis=-1)
