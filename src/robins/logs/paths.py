"""Trajectories in files without a table of columns: KITTI odometry, Applanix SBET, NovAtel INSPVA.

- KITTI odometry: a line holds the 3 x 4 matrix [R t] of a camera in the axes of the first, x right,
  y down, z forward (development kit of the benchmark). Times are in ``times.txt`` next to it, or in
  ``../sequences/NAME/times.txt``. The first camera's z is taken as north, its x as east.
- SBET, of POSPac: records of 17 doubles, little-endian: second of the week, latitude, longitude,
  altitude, velocity, roll, pitch, platform heading, wander angle, acceleration, rates. The heading
  is the platform heading minus the wander angle. Velocities are in wander axes whose signs differ
  by source, and are not read.
- NovAtel INSPVAA and INSPVASA (OEM7 manual, "INSPVA"): week, second, latitude, longitude, height,
  velocity north, east, up, roll (right side down), pitch (nose up), azimuth, status.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from robins import rotation
from robins.dataset import Trajectory
from robins.logs.findings import AnyPath, Findings, LogError, finding_reporter, refused
from robins.logs.mounting import LocalPath, from_local
from robins.logs.opening import read_whole
from robins.logs.read_text import NOWHERE
from robins.logs.text import Head, TextLayout, read_columns
from robins.logs.timebase import WEEK_NS, stamps_to_ns, unrolled, week_to_ns

_LARGEST = 1 << 30  # bytes, largest file
_KITTI = TextLayout(tuple(f"{row}{k}" for row in "123" for k in range(1, 5)), None, texts=())
_TO_ENU = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x right, y down, z ahead
_CAMERA = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # of forward, right, down
_SBET = np.dtype("<f8")
_RECORD = 17 * _SBET.itemsize
_INSPVA = ("#INSPVAA,", "%INSPVASA,")
_UNUSABLE = ("INS_INACTIVE", "INS_ALIGNING", "WAITING", "DETERMINING")


def is_kitti(head: Head) -> bool:
    """True if rows of numbers are poses with a rotation and nothing else."""
    rows = [text.split() for _, text in head.data(20)]
    try:
        poses = np.array(rows, np.float64).reshape(-1, 3, 4)[:, :, :3]
    except ValueError:
        return False
    with np.errstate(all="ignore"):
        off = np.abs(poses @ poses.transpose(0, 2, 1) - np.eye(3))
    return len(rows) > 0 and len(rows[0]) == 12 and bool(np.all(off < 1e-3))


def read_kitti(path: AnyPath, findings: Findings = None) -> Trajectory:
    """Read poses of KITTI odometry.

    Raises:
        LogError: times are missing or of another number; a line is no pose.
    """
    file, poses = Path(path), read_columns(path, _KITTI, findings)
    beside = (file.parent / "times.txt", file.parents[1] / "sequences" / file.stem / "times.txt")
    times = next((one for one in beside if one.exists()), None)
    if times is None:
        raise LogError(str(path), "has no times beside it", f"put times.txt into {file.parent}")
    clock = read_columns(times, TextLayout(("time",), None), findings)
    if len(clock.rows) != len(poses.rows):
        cause = f"has {len(poses.rows)} poses, and {times} {len(clock.rows)} times"
        raise LogError(str(path), cause, "give the times of this sequence")
    time_ns = stamps_to_ns(str(times), "time", clock.texts[:, 0], clock.rows)
    matrix = poses.values.reshape(-1, 3, 4)
    try:
        q_lb = rotation.from_dcm(_TO_ENU @ matrix[:, :, :3] @ _CAMERA)
    except ValueError as error:
        raise LogError(str(path), f"holds no rotation: {error}", "copy it again") from error
    r_l = matrix[:, :, 3] @ _TO_ENU.T
    finding_reporter(findings, "note", "no_place", str(path), value="0 0 0")(
        "positions are metres from the first camera, whose axes are taken as east, down, north; "
        "they are put at latitude 0, longitude 0, height 0."
    )
    local = LocalPath(time_ns, r_l, np.full_like(r_l, np.nan), q_lb)
    return from_local(local, NOWHERE, source=str(path))


def is_sbet(head: Head) -> bool:
    """True if the first two records have places on Earth and are less than 10 s apart."""
    if len(head.start) < _RECORD + 32:
        return False
    first, then = (np.frombuffer(head.start, _SBET, 4, at) for at in (0, _RECORD))
    with np.errstate(all="ignore"):
        step = then[0] - first[0]
    limits = (1e-6 < abs(x) < limit for x, limit in zip(first[:2], (7e5, np.pi / 2), strict=True))
    near = abs(first[2]) <= 7.0 and abs(first[3]) < 1e5 and 1e-4 < step < 10.0
    return all(limits) and bool(near)


def read_sbet(path: AnyPath, findings: Findings = None) -> Trajectory:
    """Read a smoothed best estimate of trajectory.

    Raises:
        LogError: the file cannot be read, or has no complete record of finite numbers.
    """
    data, _ = read_whole(path, _LARGEST)
    file, count = str(path), len(data) // _RECORD
    if rest := len(data) % _RECORD:
        sentence = f"ends early: the last {rest} bytes are no whole record and are left out."
        finding_reporter(findings, "warning", "ends_early", file, value=rest)(sentence)
    v = np.frombuffer(data, _SBET, 17 * count).reshape(count, 17)
    bad = ~(np.abs(v[:, 0]) < 1e8)
    if bad.any() or not count:
        where = f"record {int(np.argmax(bad)) + 1}" if count else ""
        raise refused(file, where, "time")("is no time of the week", "fetch it again")
    with np.errstate(invalid="ignore"):
        euler = v[:, 7], v[:, 8], v[:, 9] - v[:, 10]
        q_nb = rotation.from_euler(*euler)
    time_ns = unrolled(np.round(v[:, 0] * 1e9).astype(np.int64))
    missing = np.full((count, 3), np.nan)
    lat, lon, alt = (v[:, k].astype(np.float64) for k in (1, 2, 3))
    rows = np.arange(1, count + 1)
    return Trajectory(time_ns, lat, lon, alt, missing, q_nb, source=file, rows=rows)


def is_inspva(head: Head) -> bool:
    """True if a line is an INSPVA log in ASCII."""
    return any(line.startswith(_INSPVA) for line in head.lines)


def read_inspva(path: AnyPath, findings: Findings = None) -> Trajectory:
    """Read the INSPVA logs with valid checksums among the lines of a file.

    Raises:
        LogError: there is none, or a field of one is no number.
    """
    file, rows, numbers, clocks = str(path), list[int](), list[list[float]](), list[list[bytes]]()
    damaged = idle = 0
    data = read_whole(path, _LARGEST)[0].removeprefix(b"\xef\xbb\xbf")
    for k, raw in enumerate(data.split(b"\n"), start=1):
        if not raw.startswith(tuple(one.encode() for one in _INSPVA)):
            continue
        body, _, check = raw.strip()[1:].partition(b"*")
        fields = body.partition(b";")[2].split(b",")
        if f"{_crc(body):08x}".encode() != check.lower() or len(fields) != 12:
            damaged += 1
            continue
        if fields[11].decode("ascii", "replace").startswith(_UNUSABLE):
            idle += 1
            continue
        try:
            numbers.append([float(x) for x in fields[2:11]])
        except ValueError as error:
            raise refused(file, f"line {k}")(f"{error}", "delete the line") from error
        rows.append(k)
        clocks.append(fields[:2])
    for count, what in ((damaged, "are cut or fail their checksum"), (idle, "are not aligned")):
        if count:
            finding_reporter(findings, "warning", "lines_left_out", file, value=count)(
                f"{count} INSPVA lines {what} and are left out."
            )
    if not rows:
        raise LogError(file, "holds no whole INSPVA line of an aligned unit", "record it again")
    v, at, clock = np.array(numbers), np.array(rows), np.array(clocks, "S40")
    weeks = stamps_to_ns(file, "week", clock[:, 0], at, 0)
    time_ns = week_to_ns(weeks, stamps_to_ns(file, "second", clock[:, 1], at))
    if (np.abs(weeks) > 7000).any() or (time_ns % WEEK_NS < 0).any():
        raise LogError(file, "has a week that is none of GPS", "record it again")
    q_nb = rotation.from_euler(*np.deg2rad(v[:, 6:9]).T)
    lat, lon = np.deg2rad(v[:, :2]).T.copy()
    v_n = v[:, 3:6] * [1.0, 1.0, -1.0]
    return Trajectory(time_ns, lat, lon, v[:, 2].copy(), v_n, q_nb, source=file, rows=at)


def _crc(body: bytes) -> int:
    """NovAtel's checksum: CRC-32 from zero and without a final inversion."""
    return zlib.crc32(body, 0xFFFFFFFF) ^ 0xFFFFFFFF
