"""Folders that are one recording: ROS, EuRoC, KITTI, phones, gnss-ins-sim.

- EuRoC and ASL: ``mav0`` or the folder above it, with ``imu0`` and ``state_groundtruth_estimate0``.
- KITTI raw: ``oxts`` with ``data/*.txt`` and ``timestamps.txt``; the columns are described in the
  development kit. x, y, z are forward, left, up; yaw is counterclockwise from east.
- Sensor Logger: a file per sensor (tszheichoi/awesome-sensor-logger: UNITS.md, COORDINATES.md).
  Android's ``TotalAcceleration`` is the specific force; of an iPhone it is the sum of
  ``Accelerometer`` and ``Gravity``, reversed unless the axes were standardised.
- phyphox: a file per sensor, with columns named with their units.
- gnss-ins-sim: ``time.csv``, ``gyro-0.csv``, ``accel-0.csv`` and the files of the reference.

Axes of phones are those of Android: right, forward, up if it lies flat.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.gps_time import gps_of
from robins.logs.findings import AnyPath, Findings, LogError, finding_reporter, os_errors, refused
from robins.logs.fix_kinds import with_usual_sigmas
from robins.logs.merging import interpolated
from robins.logs.mounting import Origin
from robins.logs.opening import RECORDING, read_whole
from robins.logs.phone import fixes_of
from robins.logs.read_text import read_text
from robins.logs.rosbag import read_rosbag
from robins.logs.tables import Table
from robins.logs.text import Columns, TextLayout, peek, read_columns
from robins.logs.text_formats import TEXT_FORMATS
from robins.logs.timebase import dates_to_ns, stamps_to_ns
from robins.rotation import from_euler
from robins.units import to_si

_XYZ = ("x", "y", "z")
_TRUTH = "state_groundtruth_estimate0/data.csv"
_ROWS = {row.name: row for row in TEXT_FORMATS}
_OXTS = 30  # numbers in a record
_LARGEST = 1 << 26  # bytes, largest OXTS file
_FLU = np.array([1.0, -1.0, -1.0])
_SEPARATORS = (",", ";", "\t")


def read_folder(
    path: AnyPath, findings: Findings = None, origin: Origin | None = None
) -> Table | Dataset:
    """Read a folder that is a recording.

    Args:
        path: the folder.
        findings: receives omissions and doubts; without it they are issued as `LogWarning`.
        origin: position on the Earth of a path in local metres, as of EuRoC.

    Raises:
        LogError: the folder is of no known kind; a file is missing or cannot be read; an origin is
            given, but nothing is in local metres.
    """
    folder = Path(path)
    with os_errors(str(path), fix="check its permissions"):
        for mark, read in _FOLDERS.items():
            for place in (folder, folder / "mav0", folder / "oxts"):
                if (place / mark).exists():
                    if read is _euroc and (place / _TRUTH).exists():
                        return _euroc(place, findings, origin)
                    return _without(origin, folder, read(place, findings))
        names = sorted(p.name for p in folder.iterdir())
        if "metadata.yaml" in names or any(map(RECORDING.fullmatch, names)):
            return _without(origin, folder, read_rosbag(folder, findings))
    held = ", ".join(names[:5]) or "nothing"
    remedy = "give files, or the folder of a recording (ROS, EuRoC, KITTI, phones)"
    raise LogError(str(path), f"is a folder with {held}", remedy)


def _without(origin: Origin | None, folder: Path, read: Table | Dataset) -> Table | Dataset:
    if origin is not None:
        cause = "this folder has no local metres to put at an origin"
        raise LogError(str(folder), cause, "give no origin")
    return read


def _table(
    path: Path, clock: str, names: Sequence[str], findings: Findings, needed: int | None = None
) -> Columns:
    """Columns by patterns of their names: the stamps, if any, and numbers.

    The first `needed` names, by default all, are required; other missing columns are NaN.

    Raises:
        LogError: a required column is missing, or the file cannot be read.
    """
    line, text = (peek(path).data(1) or [(1, "")])[0]
    separator = max(_SEPARATORS, key=text.count)
    held = [name.strip().strip('"').strip() for name in text.split(separator)]

    def place(name: str) -> int:
        found = (k for k, one in enumerate(held) if re.fullmatch(name, one, re.IGNORECASE))
        return next(found, -1)

    places = [place(name) for name in names]
    wanted = [*names[:needed], *([clock] if clock else ())]
    if lacking := [name for name in wanted if place(name) < 0]:
        cause = f"no column fits {lacking[0]}; there are {', '.join(held)}"
        raise refused(str(path), f"line {line}")(cause, "export it again")
    numbers = tuple(sorted({at for at in places if at >= 0}))
    texts = (place(clock),) if clock else ()
    comma = separator != "," and re.search(r"\d,\d", "".join(t for _, t in peek(path).data(3)[1:]))
    layout = TextLayout(
        tuple(held), separator, texts, numbers, skip=line, decimal="," if comma else "."
    )
    read = read_columns(path, layout, findings)
    missing = np.full(len(read.rows), np.nan)
    values = [read.values[:, layout.number(at)] if at >= 0 else missing for at in places]
    return read._replace(values=np.stack(values, axis=-1) if values else read.values)


# ----------------------------------------------------------------------------- EuRoC and KITTI


def _euroc(folder: Path, findings: Findings, origin: Origin | None = None) -> Dataset:
    imu = read_text(_ROWS["euroc-imu"], folder / "imu0" / "data.csv", findings)
    truth, path = None, folder / _TRUTH
    if path.exists():
        truth = read_text(_ROWS["euroc-truth"], path, findings, origin)
    assert isinstance(imu, ImuTable)
    assert isinstance(truth, Trajectory | None)
    name = folder.resolve().parent.name if folder.name == "mav0" else folder.resolve().name
    return Dataset(name, imu, truth=truth, time_unit_known=(imu.source,))


def _oxts(folder: Path, findings: Findings) -> Dataset:
    file, clock = str(folder), folder / "timestamps.txt"
    records = sorted((folder / "data").glob("*.txt"))
    lines = read_whole(clock, _LARGEST)[0].split(b"\n")
    stamps = [stamp.strip()[:39] for stamp in lines if stamp.strip()]
    if len(stamps) != len(records) or not records:
        cause = f"{clock.name} has {len(stamps)} stamps for {len(records)} files in data"
        raise LogError(file, cause, "copy the folder again")
    rows = np.arange(1, len(stamps) + 1)
    time_ns = dates_to_ns(str(clock), "time", np.array(stamps, "S40"), rows, "UTC")
    v = np.concatenate([_record(record) for record in records])
    lat, lon, roll, pitch = np.deg2rad(v[:, 0]), np.deg2rad(v[:, 1]), v[:, 3], -v[:, 4]
    place, v_n = (lat, lon, v[:, 2].copy()), np.stack([v[:, 6], v[:, 7], -v[:, 10]], axis=-1)
    q_nb = _turning(roll, pitch, np.pi / 2.0 - v[:, 5])
    sigma, sigma_v = (np.repeat(v[:, k, None], 3, axis=1) for k in (23, 24))
    finding_reporter(findings, "note", "fixes_of_truth", file)(
        "fixes and path are both the solution of the OXTS unit, so errors against the path are "
        "smaller than those of a receiver of its own."
    )
    return Dataset(
        folder.resolve().parent.name,
        ImuTable(time_ns, v[:, 17:20] * _FLU, v[:, 11:14] * _FLU, "rate", "FRD", file, rows),
        gnss=GnssTable(time_ns, *place, sigma, v_n, sigma_v, source=file, rows=rows),
        truth=Trajectory(time_ns, *place, v_n, q_nb, source=file, rows=rows),
        time_unit_known=(file,),
    )


def _turning(roll: np.ndarray, pitch: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4), scalar first, body to navigation, of Euler angles [rad]."""
    q = from_euler(roll, pitch, heading)
    return np.where(q[:, :1] < 0.0, -q, q)


def _record(path: Path) -> np.ndarray:
    try:
        numbers = np.array([read_whole(path, _LARGEST)[0].split()], np.float64)
    except ValueError as error:
        raise LogError(str(path), f"is no record: {error}", "copy it again") from error
    if numbers.shape != (1, _OXTS):
        raise LogError(str(path), f"has {numbers.size} numbers, not {_OXTS}", "copy it again")
    return numbers


# ------------------------------------------------------------------------------------- phones


def _phone(folder: Path, findings: Findings) -> Dataset:
    """Folder of Sensor Logger or phyphox, by the name of the column of time."""
    gyro_file = folder / "Gyroscope.csv"
    logger = "seconds_elapsed" in peek(gyro_file).lines[0]
    clock = "time" if logger else r"Time \(s\)"
    xyz = _XYZ if logger else [rf"(.* )?{axis} \(.*\)" for axis in _XYZ]

    def samples(
        name: str, names: Sequence[str] = xyz, needed: int | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        path = folder / f"{name}.csv"
        if not path.exists():
            raise LogError(str(folder), f"has no {path.name}", "record that sensor as well")
        read = _table(path, clock, names, findings, needed)
        exponent = 0 if logger else 9
        time_ns = stamps_to_ns(str(path), "time", read.texts[:, 0], read.rows, exponent)
        return gps_of(time_ns) if logger else time_ns, read.values, read.rows

    gyro_ns, gyro, rows = samples("Gyroscope")
    if logger and not (folder / "TotalAcceleration.csv").exists():
        accel_ns, accel, _ = samples("Accelerometer")
        gravity = interpolated(accel_ns, *samples("Gravity")[:2])
        accel = (accel + gravity) * _apple(folder)
    else:
        accel_ns, accel, _ = samples("TotalAcceleration" if logger else "Accelerometer")
    force = interpolated(gyro_ns, accel_ns, accel)
    imu = ImuTable(gyro_ns, gyro, force, "rate", "RFU", str(gyro_file), rows)
    mag = gnss = None
    if (path := folder / "Magnetometer.csv").exists():
        mag_ns, field, mag_rows = samples("Magnetometer")
        mag = MagTable(mag_ns, to_si(field, "uT"), "RFU", str(path), mag_rows)
    if (path := folder / "Location.csv").exists():
        fix_ns, v, fix_rows = samples("Location", _LOCATION, 2)
        for k in range(3, 9):
            v[v[:, k] < 0.0, k] = np.nan  # unknown
        fixes = fixes_of(str(path), fix_ns, v[:, :5], v[:, 5:], fix_rows)
        gnss = with_usual_sigmas(fixes, findings)
        if gnss.v_n is None or np.isnan(gnss.v_n).all():
            gnss = replace(gnss, v_n=None, sigma_v=None)
    name = folder.resolve().name
    return Dataset(name, imu, gnss, mag=mag, time_unit_known=(str(gyro_file),))


_LOCATION = (
    r"latitude( \(.*\))?",
    r"longitude( \(.*\))?",
    r"altitude|Height \(m\)|Altitude WGS84 \(m\)",
    r"horizontal ?Accuracy( \(.*\))?",
    r"vertical ?Accuracy( \(.*\))?",
    r"(speed|velocity)( \(.*\))?",
    r"bearing|Direction \(.*\)",
    "speedAccuracy",
    "bearingAccuracy",
)


def _apple(folder: Path) -> float:
    """Sign that converts the acceleration of Sensor Logger to specific force.

    Raises:
        LogError: the file that states the make of the phone is missing.
    """
    path = folder / "Metadata.csv"
    lines = peek(path).lines[:2] if path.exists() else []
    cells = [[cell.strip('" ') for cell in text.split(",")] for text in lines]
    stated = dict(zip(*cells, strict=False)) if len(cells) == 2 else {}
    make, standard = (stated.get(n, "").lower() for n in ("platform", "standardisation"))
    if make not in ("ios", "android") or standard not in ("true", "false", ""):
        cause = f"{path.name} does not state the make of the phone, so the sign is not known"
        raise LogError(str(folder), cause, "export the recording with its metadata")
    return -1.0 if make == "ios" and standard != "true" else 1.0


# ------------------------------------------------------------------------------- gnss-ins-sim


def _simulated(folder: Path, findings: Findings) -> Dataset:
    def of(name: str, *names: str) -> np.ndarray:
        return _table(folder / f"{name}.csv", "", names, findings).values

    def stamps(name: str) -> np.ndarray:
        read = _table(folder / f"{name}.csv", r"(gps_)?time \(sec\)", (), findings)
        return stamps_to_ns(str(folder / f"{name}.csv"), "time", read.texts[:, 0], read.rows)

    time_ns, file = stamps("time"), str(folder / "gyro-0.csv")
    unit = "deg/s" if "(deg/s)" in peek(file).lines[0] else "rad/s"
    gyro = to_si(of("gyro-0", *(rf"gyro_{axis} \(.*\)" for axis in _XYZ)), unit)
    accel = of("accel-0", *(rf"accel_{axis} \(.*\)" for axis in _XYZ))
    imu, gnss, truth = ImuTable(time_ns, gyro, accel, "rate", source=file), None, None
    if (folder / "gps-0.csv").exists() and (folder / "gps_time.csv").exists():
        v = of("gps-0", *(rf"gps_{n} \(.*\)" for n in ("lat", "lon", "alt", "vN", "vE", "vD")))
        sigma = np.full((len(v), 3), np.nan)
        place = np.deg2rad(v[:, 0]), np.deg2rad(v[:, 1]), v[:, 2].copy()
        gnss = GnssTable(stamps("gps_time"), *place, sigma, v[:, 3:], sigma, source=str(folder))
    if (folder / "ref_pos.csv").exists():
        place = of("ref_pos", *(rf"ref_pos_{n} \(.*\)" for n in ("lat", "lon", "alt"))).T.copy()
        v_n = of("ref_vel", *(rf"ref_vel_{n} \(.*\)" for n in _XYZ))
        euler = of("ref_att_euler", *(rf"ref_{n} \(.*\)" for n in ("Roll", "Pitch", "Yaw")))
        q_nb = _turning(*np.deg2rad(euler).T)
        place[:2] = np.deg2rad(place[:2])
        lat, lon, alt = place
        truth = Trajectory(time_ns, lat, lon, alt, v_n, q_nb, source=str(folder / "ref_pos.csv"))
    return Dataset(folder.resolve().name, imu, gnss, truth, time_unit_known=(file,))


_FOLDERS: dict[str, Callable[[Path, Findings], Dataset]] = {
    "imu0/data.csv": _euroc,
    "timestamps.txt": _oxts,
    "Gyroscope.csv": _phone,
    "gyro-0.csv": _simulated,
}
"""Characteristic file of each kind of folder -> its reader."""
