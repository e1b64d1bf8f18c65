"""CSV whose header names each column with its unit: inertial samples, and paths such as a master's.

    # frames: NED FRD
    time_s,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,roll_deg,pitch_deg,heading_deg

The first column is the time (``time_s``, ``time_ms``, ``time_us`` or ``time_ns``); the others come
in any order, and columns of other names are left alone. An empty cell or ``nan`` is missing.

- samples, rates at a time: gyro_x gyro_y gyro_z (_rad_s, _deg_s), accel_x .. (_m_s2, _g);
- samples, increments since the line before: dtheta_x .. (_rad, _deg), dv_x .. (_m_s);
- a path: lat lon (_deg, _rad), height (_m), v_north v_east v_down (_m_s), and roll pitch heading
  (_deg, _rad) or q_w q_x q_y q_z, body to navigation; optionally the turn rate against inertial
  space omega_x omega_y omega_z (_rad_s, _deg_s) along the body axes.

Frames are NED and FRD unless a comment before the header says ``frames: ENU RFU``, which concerns
quaternions and components x, y, z.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import BodyFrame, ImuTable, NavFrame, Trajectory
from robins.ins.frames import swap, swap_q
from robins.logs.findings import Finding, LogError, report
from robins.logs.text import COMMENTS, Columns, Head, Layout, peek, read_columns
from robins.logs.timebase import stamps_to_ns
from robins.logs.unit_length import unit_quaternions
from robins.logs.writing import rows_of_numbers, write_lines

_DEG = np.pi / 180.0
_G = 9.80665
_TIMES = {"time_s": 9, "time_ms": 6, "time_us": 3, "time_ns": 0}
_ANGLE = {"deg": _DEG, "rad": 1.0}
_RATE = {"rad_s": 1.0, "deg_s": _DEG}
_SPEED = {"m_s": 1.0}

Units = dict[str, float]  # ending of a column's name -> what to multiply by


def _axes(stem: str, units: Units) -> dict[str, Units]:
    return {f"{stem}_{axis}": units for axis in "xyz"}


_PLACE = {"lat": _ANGLE, "lon": _ANGLE, "height": {"m": 1.0}}
_VELOCITY = {"v_north": _SPEED, "v_east": _SPEED, "v_down": _SPEED}
_EULER = {"roll": _ANGLE, "pitch": _ANGLE, "heading": _ANGLE}
_QUATERNION = {f"q_{axis}": {"": 1.0} for axis in "wxyz"}
_OMEGA = _axes("omega", _RATE)
_GYRO, _ACCEL = _axes("gyro", _RATE), _axes("accel", {"m_s2": 1.0, "g": _G})
_DTHETA, _DV = _axes("dtheta", _ANGLE), _axes("dv", _SPEED)
_KINDS = {
    "imu": (_GYRO | _ACCEL, _DTHETA | _DV),
    "trajectory": (_PLACE | _VELOCITY | _EULER, _PLACE | _VELOCITY | _QUATERNION),
}
_STEMS: dict[str, Units] = (
    _PLACE | _VELOCITY | _EULER | _QUATERNION | _OMEGA | _GYRO | _ACCEL | _DTHETA | _DV
)
_COLUMNS = {
    f"{stem}_{unit}" if unit else stem: (stem, factor)
    for stem, units in _STEMS.items()
    for unit, factor in units.items()
}
# Beyond these an angle is in another unit or another column; a heading may be unwrapped a little.
_LIMIT_DEG = {"lat": 90.0, "lon": 400.0, "roll": 400.0, "pitch": 90.0, "heading": 400.0}
_FRAMES: dict[str, tuple[NavFrame, BodyFrame]] = {"NED": ("NED", "FRD"), "ENU": ("ENU", "RFU")}


class _Header(NamedTuple):
    line: int
    names: list[str]


def _header(head: Head) -> _Header:
    line, text = (head.data(1) or [(1, "")])[0]
    return _Header(line, [name.strip() for name in text.split(",")])


def holds(head: Head, kind: str) -> bool:
    """Whether a file's header names columns of this kind, "imu" or "trajectory", in this way."""
    first, *others = _header(head).names
    known = set().union(*_KINDS[kind])
    return first in _TIMES and any(_COLUMNS.get(name, ("",))[0] in known for name in others)


def read_named_imu(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> ImuTable:
    """Read inertial samples.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Raises:
        LogError: columns are missing, named twice or not numbers.
    """
    table = _read(path, "imu", findings)
    rates = "gyro_x" in table.values
    return ImuTable(
        time_ns=table.time_ns,
        gyro=table.stack(_GYRO if rates else _DTHETA),
        accel=table.stack(_ACCEL if rates else _DV),
        kind="rate" if rates else "increment",
        body=table.frames[1],
        source=str(path),
        rows=table.rows,
    )


def read_named_path(
    path: str | os.PathLike[str], findings: list[Finding] | None = None
) -> Trajectory:
    """Read a path; NaN where something is missing. Arguments and errors as `read_named_imu`."""
    table = _read(path, "trajectory", findings)
    nav, body = table.frames
    v_n = table.stack(_VELOCITY)
    for stem in (*_PLACE, *_EULER):
        _within_limits(table, stem, findings)
    attitude = _recorded(table, findings) if "q_w" in table.values else _from_euler(table)
    if nav == "ENU":
        v_n = swap(v_n)
    return Trajectory(
        time_ns=table.time_ns,
        lat_rad=table.values["lat"],
        lon_rad=table.values["lon"],
        alt_m=table.values["height"],
        v_n=v_n,
        q_nb=attitude,
        nav=nav,
        body=body,
        source=str(path),
        omega_ib_b=table.stack(_OMEGA) if "omega_x" in table.values else None,
        rows=table.rows,
    )


class _Table(NamedTuple):
    file: str
    frames: tuple[NavFrame, BodyFrame]
    time_ns: np.ndarray
    values: dict[str, np.ndarray]  # by stem, SI
    names: dict[str, str]  # stem -> name of its column
    rows: np.ndarray

    def stack(self, stems: Sequence[str] | dict[str, Any]) -> np.ndarray:
        return np.stack([self.values[stem] for stem in stems], axis=-1)


def _read(path: str | os.PathLike[str], kind: str, findings: list[Finding] | None) -> _Table:
    file, head = str(path), peek(path)
    header = _header(head)
    names = _names(file, header, kind)
    layout = Layout(tuple(header.names), ",", skip=header.line, all_named=True)
    columns: Columns = read_columns(path, layout, findings)
    time = header.names[0]
    time_ns = stamps_to_ns(file, time, columns.texts[:, 0], columns.rows, _TIMES[time])
    values = {
        stem: columns.values[:, header.names.index(name) - 1] * _COLUMNS[name][1]
        for stem, name in names.items()
    }
    return _Table(file, _frames(head, header), time_ns, values, names, columns.rows)


def _names(file: str, header: _Header, kind: str) -> dict[str, str]:
    """Which column holds what: stem -> its name; whole sets of columns only.

    Raises:
        LogError: the time is not first, columns are missing, or two hold the same.
    """
    where = f"line {header.line}"
    first, *others = header.names
    if first not in _TIMES:
        raise LogError(
            file,
            f"the first column is not the time (one of {', '.join(_TIMES)})",
            "put it first and name it with its unit",
            where=where,
            field="header",
            value=first,
        )
    found: dict[str, str] = {}
    for name in others:
        stem = _COLUMNS.get(name, ("",))[0]
        if stem in found:
            raise LogError(
                file, f"{found[stem]} and {name} are the same thing", "keep one", where=where
            )
        if stem:
            found[stem] = name
    sets = [set(wanted) for wanted in _KINDS[kind]]
    best = min(sets, key=lambda wanted: len(wanted - set(found)))
    if lacking := [stem for stem in _STEMS if stem in best - set(found)]:
        wanted = ", ".join(_spellings(stem) for stem in lacking)
        raise LogError(
            file,
            f"the header lacks {wanted}; it has {', '.join(header.names)}",
            "name the columns so, with their units",
            where=where,
        )
    omega = [stem for stem in _OMEGA if stem in found] if kind == "trajectory" else []
    if 0 < len(omega) < 3:
        raise LogError(
            file,
            f"of the turn rate there is only {', '.join(found[stem] for stem in omega)}",
            "give omega_x, omega_y and omega_z, or none of them",
            where=where,
        )
    keep = best | set(omega)
    return {stem: name for stem, name in found.items() if stem in keep}


def _spellings(stem: str) -> str:
    return " or ".join(f"{stem}_{unit}" if unit else stem for unit in _STEMS[stem])


def _frames(head: Head, header: _Header) -> tuple[NavFrame, BodyFrame]:
    """What a comment above the header says of the frames.

    Raises:
        LogError: it says something else than NED FRD or ENU RFU.
    """
    for number, line in enumerate(head.lines[: header.line - 1], start=1):
        said = re.search(r"\bframes?:\s*(.+)", line) if line.lstrip().startswith(COMMENTS) else None
        if said is None:
            continue
        words = re.findall(r"[A-Z]{3}", said[1])
        fitting = [pair for pair in _FRAMES.values() if words and set(words) <= set(pair)]
        if len(fitting) != 1:
            raise LogError(
                head.file,
                "is neither NED FRD nor ENU RFU",
                "convert the columns to one of the two and say which",
                where=f"line {number}",
                field="frames",
                value=said[1].strip(),
            )
        return fitting[0]
    return _FRAMES["NED"]


def _within_limits(table: _Table, stem: str, findings: list[Finding] | None) -> None:
    """Take out angles that cannot be; refuse the column if they are many.

    Raises:
        LogError: more than half of the angles are beyond the limit.
    """
    if stem not in table.values or stem not in _LIMIT_DEG:
        return
    values, limit = table.values[stem], _LIMIT_DEG[stem]
    beyond = np.abs(values) > limit * _DEG * (1.0 + 1e-9)
    if not beyond.any():
        return
    k, name = int(np.argmax(beyond)), table.names[stem]
    shown = float(values[k] / _COLUMNS[name][1])
    unit = name.removeprefix(f"{stem}_")
    allowed = f"+-{limit * _DEG / _ANGLE[unit]:.4g} {unit}"
    count = f"{beyond.sum()} of {np.isfinite(values).sum()} rows"
    if 2 * beyond.sum() > np.isfinite(values).sum():
        other = "degrees under a name that says radians" if unit == "rad" else "another unit"
        raise LogError(
            table.file,
            f"beyond {allowed}, as in {count}: probably {other}, or another column",
            "name the column with the unit it is in",
            where=f"line {table.rows[k]}",
            field=name,
            value=shown,
        )
    values[beyond] = np.nan
    report(
        findings,
        Finding(
            "warning",
            "angle_range",
            table.file,
            f"line {table.rows[k]}",
            shown,
            f"{Path(table.file).name} line {table.rows[k]}: {name} is {shown:g}, beyond {allowed} "
            f"({count}). What cannot be is taken as missing.",
        ),
    )


def _from_euler(table: _Table) -> np.ndarray:
    """Roll, pitch and heading are of the vehicle, the same in both pairs of frames."""
    q = np.asarray(rotation.from_euler(*(jnp.asarray(table.values[stem]) for stem in _EULER)))
    if table.frames[0] == "NED":
        return q
    return np.asarray(swap_q(q))


def _recorded(table: _Table, findings: list[Finding] | None) -> np.ndarray:
    q = table.stack(_QUATERNION)
    return unit_quaternions(table.file, "q_w .. q_z", q, table.rows, findings)


def write_named(path: str | os.PathLike[str], table: ImuTable | Trajectory) -> None:
    """Write a table so that it is read back as it was, angles and positions in degrees.

    Numbers come back bit by bit but for the conversions of angles; quaternions are written where
    the frames are ENU and RFU or an attitude is near the vertical, else roll, pitch, heading.

    Raises:
        LogError: the frames are a mixture of the two conventions; the file cannot be written.
    """
    if isinstance(table, ImuTable):
        frames = table.body
        stems = [(_GYRO, "rad_s"), (_ACCEL, "m_s2")]
        if table.kind == "increment":
            stems = [(_DTHETA, "rad"), (_DV, "m_s")]
        names = [f"{stem}_{unit}" for axes, unit in stems for stem in axes]
        values = np.hstack([table.gyro, table.accel])
    else:
        if (table.nav, table.body) not in _FRAMES.values():
            raise LogError(
                str(path),
                f"frames {table.nav} and {table.body} do not belong together",
                "convert the table first",
            )
        frames = f"{table.nav} {table.body}"
        names, values = _path_columns(table)

    def blocks():
        yield f"# frames: {frames}\n"
        yield ",".join(("time_s", *names)) + "\n"
        yield from rows_of_numbers(table.time_ns, values, ",")

    write_lines(path, blocks())


def _path_columns(table: Trajectory) -> tuple[list[str], np.ndarray]:
    v_n = np.asarray(table.v_n)
    if table.nav == "ENU":
        v_n = swap(v_n)
    columns = [np.rad2deg(table.lat_rad), np.rad2deg(table.lon_rad), table.alt_m, v_n]
    names = ["lat_deg", "lon_deg", "height_m", *(f"{stem}_m_s" for stem in _VELOCITY)]
    euler = np.stack(rotation.to_euler(jnp.asarray(table.q_nb)), axis=-1)
    if table.nav == "ENU" or np.nanmax(np.abs(euler[:, 1]), initial=0.0) > 1.5:
        names += list(_QUATERNION)
        columns.append(np.asarray(table.q_nb))
    else:
        names += [f"{stem}_deg" for stem in _EULER]
        columns.append(np.rad2deg(euler))
    if table.omega_ib_b is not None:
        names += [f"{stem}_rad_s" for stem in _OMEGA]
        columns.append(table.omega_ib_b)
    return names, np.column_stack(columns)
