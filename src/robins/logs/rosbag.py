"""Recordings of ROS 1 and 2: the messages of `robins.ros` and velocities of receivers, as tables.

The first topic with messages of each type is read:

- ``sensor_msgs/Imu``: rates [rad/s] and specific force [m/s^2]; if one topic has only rates and
  another only specific forces, both. The orientation is an estimate, not truth, and is ignored.
- ``sensor_msgs/MagneticField``: magnetic field [T].
- ``sensor_msgs/NavSatFix``: fixes; sigmas are missing if the covariance is unknown.
- ``geometry_msgs/TwistStamped``, ``TwistWithCovarianceStamped``: east-north-up velocity of a fix of
  the same frame_id and stamp, as written by receiver drivers; any other is ignored.

Axes of sensors are forward-left-up (REP-103) and are converted to those of a table. The stamp is
that of the header: UTC since 1970, converted to GPS time, or a count from another start, unchanged
(a leap second of UTC has no stamp of its own).
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from typing import NamedTuple, TypeAlias

import numpy as np

from robins import ros
from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.gps_time import GPS_EPOCH_S, gps_of
from robins.logs.findings import AnyPath, Findings, LogError, damaged, finding_reporter
from robins.logs.fix_kinds import with_usual_sigmas
from robins.logs.merging import are_halves, merged
from robins.logs.opening import parts_of
from robins.logs.ros_files import raw_messages
from robins.logs.tables import Table, recording

_FLU = np.array([1.0, -1.0, -1.0])  # forward-left-up <-> forward-right-down
_NED = [1, 0, 2]  # of east, north, up: variances have no sign
_ENU = np.array([1.0, 1.0, -1.0])  # signs of a velocity in the order of `_NED`
_QUALITY = {0: 5, 1: 3, 2: 4}  # status of a NavSatFix -> RTKLIB's Q
_IMU, _MAG, _FIX = (ros.name_of(kind) for kind in (ros.Imu, ros.MagneticField, ros.NavSatFix))
_TWISTS = tuple(f"geometry_msgs/msg/Twist{kind}Stamped" for kind in ("", "WithCovariance"))
# positions of quantities among the numbers of a message
_TURN, _TURN_KNOWN, _FORCE, _FORCE_KNOWN = slice(13, 16), 16, slice(25, 28), 28
_STATUS, _PLACE, _VARIANCE, _KIND = 0, slice(2, 5), [5, 9, 13], 14
_TWIST_VARIANCE = [6, 13, 20]


class _TopicMessages(NamedTuple):
    """The messages of a topic."""

    topic: str
    frame_id: str  # of the first message
    time_ns: np.ndarray
    values: np.ndarray  # (n, numbers of a message)


Topics: TypeAlias = dict[tuple[str, str], _TopicMessages]
"""Messages by type and topic."""


def read_rosbag(path: AnyPath, findings: Findings = None) -> Table | Dataset:
    """Read inertial samples, magnetic field and fixes.

    Args:
        path: a file (.mcap, .db3, .bag), plain or compressed, or the folder of a recording.
        findings: receives omissions; without it they are issued as `LogWarning`.

    Returns:
        A dataset; a table if there are no inertial samples but magnetic field or fixes.

    Raises:
        LogError: a package of the extra `logs` is not installed; a file is damaged or missing, or
            has no samples.
    """
    file = str(path)
    topics, kinds = _topics(path, findings)
    imu = _inertial(file, topics, findings)
    mag, fixes = (_first(file, topics, kind, findings) for kind in (_MAG, _FIX))
    field = mag and MagTable(mag.time_ns, mag.values[:, :3] * _FLU, source=file)
    gnss = fixes and _fixes(file, fixes, topics, findings)
    if imu is not None:
        return recording(file, imu, gnss, mag=field)
    alone = field if gnss is None else gnss
    if alone is None or (field is not None and gnss is not None):
        held = ", ".join(sorted(kinds)) or "no messages"
        cause = f"has no messages {_IMU}; it holds {held}"
        raise LogError(file, cause, "record that topic as well")
    return alone


def _topics(path: AnyPath, findings: Findings) -> tuple[Topics, set[str]]:
    """All messages that are read, by type and topic, and all types in the recording.

    Raises:
        LogError: as `read_rosbag`.
    """
    stamps: dict[tuple[str, str], array[int]] = defaultdict(lambda: array("q"))
    values: dict[tuple[str, str], array[float]] = defaultdict(lambda: array("d"))
    frames: dict[tuple[str, str], str] = {}
    kinds, wanted = set[str](), (_IMU, _MAG, _FIX, *_TWISTS)
    for part in parts_of(path):
        for name, topic, data, ros1 in raw_messages(part, wanted, findings):
            kinds.add(name)
            if not data:
                continue
            try:
                time_ns, frame_id, numbers = ros.numbers(name, data, ros1)
            except ros.RosError as error:
                raise damaged(str(part))(f"RosError: {error}") from error
            key = name, topic
            frames.setdefault(key, frame_id)
            stamps[key].append(time_ns)
            values[key].extend(numbers)
    found: Topics = {}
    for key, frame_id in frames.items():
        time_ns = np.array(stamps.pop(key), np.int64)
        dated = time_ns >= GPS_EPOCH_S * 1_000_000_000
        rows = np.array(values.pop(key)).reshape(len(time_ns), -1)
        found[key] = _TopicMessages(
            key[1], frame_id, np.where(dated, gps_of(time_ns), time_ns), rows
        )
    return found, kinds


def _first(
    file: str, topics: Topics, name: str, findings: Findings, beside: str = ""
) -> _TopicMessages | None:
    """First topic of a type; a note lists the others, except `beside`."""
    found = [one for (of, _), one in topics.items() if of == name]
    left = [one.topic for one in found[1:] if one.topic != beside]
    if left:
        finding_reporter(findings, "note", "several_instances", file, value=len(found))(
            f"{name} was recorded on {len(found)} topics; the first, {found[0].topic}, is read and "
            f"the others are left alone: {', '.join(left)}."
        )
    return found[0] if found else None


def _inertial(file: str, topics: Topics, findings: Findings) -> ImuTable | None:
    """Samples of the first topic, merged with another if it has only rates or specific forces."""

    def known(one: _TopicMessages, place: slice, at: int) -> np.ndarray:
        """A quantity, forward-right-down; NaN if its covariance marks it as unknown."""
        return np.where(one.values[:, at : at + 1] == -1.0, np.nan, one.values[:, place] * _FLU)

    tables = [
        (one.topic, ImuTable(one.time_ns, known(one, _TURN, _TURN_KNOWN),
                             known(one, _FORCE, _FORCE_KNOWN), "rate", source=file))
        for (name, _), one in topics.items()
        if name == _IMU
    ]  # fmt: skip
    if not tables:
        return None
    first = tables[0][1]
    other = next(((k, t) for k, t in tables[1:] if are_halves(first, t)), None)
    _first(file, topics, _IMU, findings, other[0] if other else "")
    return merged(first, other[1], findings) if other else first


def _fixes(file: str, gnss: _TopicMessages, topics: Topics, findings: Findings) -> GnssTable:
    status = gnss.values[:, _STATUS]
    lost = status < 0
    variance = gnss.values[:, _VARIANCE][:, _NED]
    unknown = gnss.values[:, _KIND] == 0
    with np.errstate(invalid="ignore"):  # a negative variance means unknown
        sigma_m = np.where(unknown[:, None], np.nan, np.sqrt(variance))
    place = np.where(lost[:, None], np.nan, gnss.values[:, _PLACE]).T.copy()
    lat, lon, alt = np.deg2rad(place[0]), np.deg2rad(place[1]), place[2]
    v_n, sigma_v = _velocities(file, gnss, topics, findings)
    quality = np.array([_QUALITY.get(int(k), 0) for k in status], np.int64)
    table = GnssTable(gnss.time_ns, lat, lon, alt, sigma_m, v_n, sigma_v, quality, source=file)
    return with_usual_sigmas(table, findings, places=False)


def _velocities(
    file: str, gnss: _TopicMessages, topics: Topics, findings: Findings
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Velocities of the fixes and their sigmas, if written by the receiver's driver."""
    for (name, topic), one in topics.items():
        if name not in _TWISTS or one.frame_id != gnss.frame_id:
            continue
        order = np.argsort(one.time_ns, kind="stable")
        at = np.minimum(np.searchsorted(one.time_ns, gnss.time_ns, sorter=order), len(order) - 1)
        row = order[at]
        same = (one.time_ns[row] == gnss.time_ns)[:, None]
        if 2 * same.sum() <= len(same):
            continue
        v_n = np.where(same, one.values[row, :3][:, _NED] * _ENU, np.nan)
        sigma_v = np.full_like(v_n, np.nan)
        if name == _TWISTS[1]:
            variance = one.values[row][:, _TWIST_VARIANCE][:, _NED]
            with np.errstate(invalid="ignore"):
                sigma_v = np.where(same & (variance > 0.0), np.sqrt(variance), np.nan)
        finding_reporter(findings, "note", "velocity_taken", file, value=topic)(
            f"velocities of {int(same.sum())} of {len(same)} fixes are those of {topic}, taken as "
            f"east, north, up: it has the frame_id and the stamps of {gnss.topic}."
        )
        return v_n, sigma_v
    return None, None
