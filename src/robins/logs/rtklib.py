"""RTKLIB solutions (.pos): positions and velocities of a GNSS antenna.

The header states the columns and the time system; both are used. RTKLIB's third
axis is up: ``vu`` becomes ``v_D = -vu`` and ``sdu`` the sigma along D. Correlations (sdne, ...) are
not kept.
"""

from __future__ import annotations

import re

import numpy as np

from robins.dataset import GnssTable
from robins.logs.findings import (
    AnyPath,
    Findings,
    LogError,
    finding_reporter,
    refused,
    report_geoid_heights,
)
from robins.logs.text import Head, TextLayout, peek, read_columns
from robins.logs.timebase import calendar_to_ns, stamps_to_ns, week_to_ns, weeks_of

# Columns of RTKLIB, with velocities or without; used if the header was stripped.
_POSITION: list[str] = ["latitude", "longitude", "height", "Q", "ns"]
_POSITION += ["sdn", "sde", "sdu", "sdne", "sdeu", "sdun", "age", "ratio"]
_VELOCITY = ("vn", "ve", "vu", "sdvn", "sdve", "sdvu")
_WITH_VELOCITY = [*_POSITION, *_VELOCITY, "sdvne", "sdveu", "sdvun"]
_NEEDED = ("latitude", "longitude", "height", "Q", "sdn", "sde", "sdu")
_UNSUPPORTED = {
    "x-ecef": ("positions are Earth-fixed X, Y, Z", "out-solformat = llh"),
    "e-baseline": ("positions are baselines east, north, up", "out-solformat = llh"),
    "d'\"": ("latitudes are in degrees, minutes, seconds", "out-degform = deg"),
    "JST": ("times are Japan standard time", "out-timesys = gpst"),
}


def is_rtklib(head: Head) -> bool:
    """True if a header names the columns of a solution, or a line begins with a date."""
    header = any(line.startswith("%") and " ns " in line for line in head.lines)
    stamp = re.compile(r"\d{4}/\d\d/\d\d[ ,]+\d\d:\d\d:\d\d")
    return header or any(stamp.match(text) for _, text in head.data(1))


def read_rtklib(path: AnyPath, findings: Findings = None) -> GnssTable:
    """Read a .pos file of RTKLIB, latitude/longitude/height in degrees, GPST or UTC.

    Calendar stamps and week/time of week both become nanoseconds since 1970 in GPS time.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions; without it they are issued as `LogWarning`.

    Raises:
        LogError: the file is not such a solution, or in one of RTKLIB's other forms.
    """
    file, head = str(path), peek(path)
    data = head.data(1)
    if not data:
        raise LogError(file, "holds no solution: header only", "was any epoch solved?")
    comma = "," in data[0][1]
    calendar = "/" in (data[0][1].replace(",", " ").split() or [""])[0]
    names, utc = _header(head)
    # With commas, date and clock share a field; week and time of week never do.
    texts = 1 if comma and calendar else 2
    width = len(data[0][1].split("," if comma else None)) - texts
    names = names or (_WITH_VELOCITY if width >= len(_WITH_VELOCITY) else _POSITION)
    time_names = ("date", "time")[-texts:] if calendar else ("week", "time of week")
    layout = TextLayout((*time_names, *names), "," if comma else None, tuple(range(texts)))
    columns = read_columns(path, layout, findings)
    if missing := [n for n in _NEEDED if n not in names]:
        remedy = "write latitude, longitude, height, Q and the standard deviations"
        raise refused(file, "header")(f"has no column {', '.join(missing)}", remedy)

    def column(name: str) -> np.ndarray:
        return columns.values[:, names.index(name)]

    def vectors(n: str, e: str, u: str, sign: float) -> np.ndarray:
        return np.stack([column(n), column(e), sign * column(u) + 0.0], axis=-1)

    v_n = sigma_v = None
    if all(name in names for name in _VELOCITY):
        v_n, sigma_v = vectors("vn", "ve", "vu", -1.0), vectors("sdvn", "sdve", "sdvu", 1.0)
        if not (v_n.any() or sigma_v.any()):
            v_n = sigma_v = None
            finding_reporter(findings, "note", "no_velocity", file, value=0.0)(
                "all velocities and their sigmas are zero, so RTKLIB did not solve for them; "
                "they are left out. Heading will be found from the positions alone; set "
                "out-outvel = on."
            )
    if any("/geodetic" in line for line in head.lines if line.startswith("%")):
        fix = "Set out-height = ellipsoidal in RTKLIB."
        report_geoid_heights(findings, file, fix, "header", "geodetic")
    time_ns = _times(file, columns.texts, columns.rows, calendar, utc)
    lat, lon, quality = np.deg2rad(column("latitude")), np.deg2rad(column("longitude")), column("Q")
    return GnssTable(
        *(time_ns, lat, lon, column("height").copy()),
        sigma_m=vectors("sdn", "sde", "sdu", 1.0),
        v_n=v_n,
        sigma_v=sigma_v,
        quality=np.where(np.abs(quality) < 100.0, quality, 0.0).astype(np.int64),
        source=file,
        rows=columns.rows,
    )


def _header(head: Head) -> tuple[list[str], bool]:
    """Names of the number columns, if the header gives them, and True if times are UTC."""
    for number, line in enumerate(head.lines, start=1):
        if line.startswith("%"):
            fields = line[1:].replace(",", " ").split()
            for mark, (what, remedy) in _UNSUPPORTED.items():
                if any(mark in field for field in fields) and "ns" in fields:
                    remedy = f"set {remedy} in RTKLIB and solve again"
                    raise refused(head.file, f"line {number}")(what, remedy)
            if fields[:1] in (["GPST"], ["UTC"]):
                names = [field.split("(")[0] for field in fields[1:]]
                return names, fields[0] == "UTC"
    return [], False


def _times(file: str, texts: np.ndarray, rows: np.ndarray, calendar: bool, utc: bool) -> np.ndarray:
    if not calendar:
        weeks = weeks_of(file, "week", texts[:, 0], rows)
        return week_to_ns(weeks, stamps_to_ns(file, "time of week", texts[:, 1], rows))
    out = np.zeros(len(texts), np.int64)
    for i, text in enumerate(texts):
        stamp = b" ".join(text).decode("utf-8", "replace")
        try:
            out[i] = calendar_to_ns(*stamp.split(), utc=utc)
        except (ValueError, TypeError) as error:
            cause = f"is not a time stamp year/month/day hour:minute:second ({error})"
            remedy = "repair or delete the line"
            raise refused(file, f"line {rows[i]}", "time", stamp)(cause, remedy) from error
    return out
