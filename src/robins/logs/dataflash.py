"""Flight logs of ArduPilot (dataflash, ``.BIN``), which describe their own messages.

Messages read, from the lowest instance of each (for ``GPS`` and ``GPA``, the lowest with fixes):

- ``IMU``: rates [rad/s] and specific force [m/s^2], forward-right-down;
- ``MAG``: magnetic field [mG], less the offsets set in the autopilot;
- ``GPS``, with the accuracies and the geoid of ``GPA``: fixes at their GPS week and time of week.

Other stamps count microseconds since power-up and are converted to GPS time by the fixes. There are
no checksums: messages must follow each other without a break, but an altered number is undetected.
Source: ArduPilot, libraries/AP_Logger/README.md.
"""

from __future__ import annotations

import re
import struct

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.logs.findings import (
    AnyPath,
    Findings,
    LogError,
    damaged,
    finding_reporter,
    report_cut_end,
    report_geoid_heights,
    report_left_out,
    report_undated,
)
from robins.logs.fix_kinds import MAVLINK, fixes, over_ground
from robins.logs.merging import gps_clock
from robins.logs.opening import Bytes, map_file
from robins.logs.tables import recording
from robins.logs.timebase import GPS_EPOCH_NS, WEEK_NS
from robins.logs.ulog import UlogTopic, column, stamps, triad
from robins.units import to_si

_MARK, _FMT = b"\xa3\x95", 0x80
MAGIC = _MARK + bytes([_FMT])
_FORMAT = struct.Struct("<BB4s16s64s")
_WANTED = ("IMU", "MAG", "GPS", "GPA")
_CODES = "b=i1 B=u1 h=i2 H=u2 i=i4 I=u4 f=f4 d=f8 q=i8 Q=u8 g=f2 M=u1 a=V64 n=V4 N=V16 Z=V64 "
_CODES += "c=i2 C=u2 e=i4 E=u4 L=i4"
_TYPES = {pair[0]: pair[2:] for pair in _CODES.split()}  # types of fields, as named by NumPy
_NO_FILL = re.compile(rb"[^\x00\xff]")  # other than padding of flash blocks
_FACTORS = {**dict.fromkeys("cCeE", 0.01), "L": 1e-7}
_LAST_WEEK = 6000  # in 2095
_FIX = 2  # least status of a fix


def read_dataflash(path: AnyPath, findings: Findings = None) -> Dataset:
    """Read inertial samples, and magnetic field and fixes if logged.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions and assumptions; without it they are issued as `LogWarning`.

    Raises:
        LogError: a definition is damaged, or there are no inertial samples.
    """
    file = str(path)
    topics = _topics(file, map_file(path, findings), findings)
    imu, mag, gps, gpa = (_instance(file, topics, name, findings) for name in _WANTED)
    if imu is None:
        held = ", ".join(sorted(topics)) or "nothing that robins reads"
        raise LogError(file, f"has no samples IMU; it holds {held}", "set LOG_BITMASK to log them")
    if "TimeMS" in imu.fields:
        cause = "counts milliseconds (TimeMS), as ArduPilot did before 3.3"
        raise LogError(file, cause, "export its messages to CSV: mavlogdump.py --format csv")
    imu_ns, mag_ns, gnss = stamps(file, imu), mag and stamps(file, mag), None
    if gps is not None:
        gnss, arrived = _fixes(file, gps, gpa, findings)
        if (known := np.isfinite(gnss.lat_rad)).any():
            clock = gps_clock(file, arrived[known], gnss.time_ns[known], findings)
            imu_ns, mag_ns = clock(imu_ns), mag_ns if mag_ns is None else clock(mag_ns)
        else:
            gnss = None
    gyro, accel = triad(file, imu, "Gyr{}", "XYZ"), triad(file, imu, "Acc{}", "XYZ")
    samples, field = ImuTable(imu_ns, gyro, accel, "rate", source=file), None
    if mag is not None and mag_ns is not None:
        field = MagTable(mag_ns, to_si(triad(file, mag, "Mag{}", "XYZ"), "mG"), source=file)
    return recording(file, samples, gnss, mag=field)


def _topics(file: str, data: Bytes, findings: Findings) -> dict[str, UlogTopic]:
    """Wanted messages by topic; bytes outside any message are counted.

    Raises:
        LogError: a definition contradicts itself or an earlier one.
    """
    sizes = [0] * 256
    sizes[_FMT] = 3 + _FORMAT.size
    kinds: dict[int, list] = {}
    found: dict[int, list[bytes]] = {}
    at, stray, end = 0, 0, len(data)

    def fits(place: int) -> int:
        """Size of the message at `place`; 0 if there is none."""
        if data[place : place + 2] != _MARK or place + 3 > end:
            return 0
        size = sizes[data[place + 2]]
        return size if place + size <= end else 0

    while at < end:
        size = fits(at)
        if not size:  # resume where two messages follow each other
            begin, at = at, data.find(_MARK, at + 1)
            while at >= 0 and not ((size := fits(at)) and (at + size == end or fits(at + size))):
                at = data.find(_MARK, at + 1)
            at = end if at < 0 else at
            if at == end and end - begin < 256 and data[begin : begin + 2] == _MARK:
                report_cut_end(findings, file, begin)
            elif _NO_FILL.search(data, begin, at):
                stray += at - begin
            continue
        kind = data[at + 2]
        if kind == _FMT:
            number, size_of, *layout = _definition(file, data, at)
            if sizes[number] not in (0, size_of):
                raise damaged(file)(f"in dataflash message {number} is defined again at byte {at}")
            sizes[number] = size_of
            if layout[0] in _WANTED:
                kinds[number] = layout
                found.setdefault(number, [])
        elif kind in found:
            found[kind].append(data[at + 3 : at + size])
        at += size
    report_left_out(findings, file, stray, "bytes belong to no message")
    topics: dict[str, UlogTopic] = {}
    for number, (name, layout, factors) in kinds.items():
        if found[number]:
            rows = np.frombuffer(b"".join(found[number]), layout)
            fields = zip(layout.names or (), factors, strict=True)
            topics[name] = UlogTopic(
                name, {n: rows[n] * f if f != 1 else rows[n] for n, f in fields}
            )
    return topics


def _definition(file: str, data: Bytes, at: int) -> tuple[int, int, str, np.dtype, list[float]]:
    """Number, size, name and layout of a message, and scale factors of its fields.

    Raises:
        LogError: the definition contradicts itself.
    """
    number, size, *texts = _FORMAT.unpack_from(data, at + 3)
    name, codes, columns = (text.rstrip(b"\0").decode("ascii", "replace") for text in texts)
    names = [x.replace("TimeUS", "timestamp") for x in columns.split(",") if x]
    if number == _FMT:
        size, codes = 3 + _FORMAT.size, "BBnNZ"
    if len(names) != len(codes) or len(set(names)) != len(names) or set(codes) - _TYPES.keys():
        raise damaged(file)(f"in dataflash the definition of {name!r} at byte {at} has no layout")
    kind = np.dtype([(n, f"<{_TYPES[c]}") for n, c in zip(names, codes, strict=True)])
    if kind.itemsize + 3 != size:
        raise damaged(file)(f"in dataflash the definition of {name!r} states {size} bytes")
    return number, size, name, kind, [_FACTORS.get(c, 1.0) for c in codes]


def _instance(
    file: str, topics: dict[str, UlogTopic], name: str, findings: Findings
) -> UlogTopic | None:
    """Rows of the lowest instance; for GPS the lowest with fixes, for GPA the same one."""
    topic, gps = topics.get(name), topics.get("GPS")
    if topic is None or "I" not in topic.fields:
        return topic
    of = column(file, topic, "I")
    numbers, number = np.unique(of), of.min()
    if name in ("GPS", "GPA") and gps is not None and "I" in gps.fields:
        receivers, fixed = column(file, gps, "I"), column(file, gps, "Status") >= _FIX
        number = receivers[fixed if fixed.any() else slice(None)].min()
    if len(numbers) > 1 and name != "GPA":
        finding_reporter(findings, "note", "several_instances", file, value=len(numbers))(
            f"{name} was logged of {len(numbers)} sensors; number {number:g} is read and "
            "the others are left alone."
        )
    mine = of == number
    fields = {key: values[mine] for key, values in topic.fields.items()}
    return UlogTopic(name, fields) if mine.any() else None


def _fixes(
    file: str, gps: UlogTopic, gpa: UlogTopic | None, findings: Findings
) -> tuple[GnssTable, np.ndarray]:
    """Fixes with a GPS time, and the time at which each was logged."""
    week, ms = column(file, gps, "GWk"), column(file, gps, "GMS")
    dated = (week > 0) & (week < _LAST_WEEK) & (ms < WEEK_NS // 1_000_000)
    report_undated(findings, file, int((~dated).sum()), "messages GPS")
    gps = UlogTopic(gps.name, {name: values[dated] for name, values in gps.fields.items()})
    arrived, status = stamps(file, gps), column(file, gps, "Status")
    time_ns = week[dated].astype(np.int64) * WEEK_NS + ms[dated].astype(np.int64) * 1_000_000

    def beside(name: str) -> np.ndarray:
        """A column of GPA at the stamps of the fixes; NaN where there is none."""
        if gpa is None or name not in gpa.fields or not len(arrived):
            return np.full(len(arrived), np.nan)
        _, mine, row = np.intersect1d(arrived, stamps(file, gpa), return_indices=True)
        out = np.full(len(arrived), np.nan)
        out[mine] = column(file, gpa, name)[row]
        return out

    # the autopilot uses the opposite sign for the geoid height
    separation = beside("Und")
    if np.isnan(separation).any():
        report_geoid_heights(findings, file, "A newer version of ArduPilot logs the geoid.")
        separation = np.zeros_like(separation)
    lat, lon, alt, speed, course, down = (
        column(file, gps, name) for name in ("Lat", "Lng", "Alt", "Spd", "GCrs", "VZ")
    )
    v_n = over_ground(speed, course, np.where(beside("VV") == 0.0, np.nan, down))
    place, sigma_m = (lat, lon, alt - separation), (beside("HAcc"), beside("HAcc"), beside("VAcc"))
    kind = np.array([MAVLINK.get(int(k), 0) for k in status])
    time_ns, flat = GPS_EPOCH_NS + time_ns, status == 2
    table = fixes(file, time_ns, place, sigma_m, v_n, beside("SAcc"), kind, flat, findings)
    return table, arrived
