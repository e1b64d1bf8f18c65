"""Recordings of one drive, written by other packages: rosbags, pyubx2, pynmeagps, pymavlink.

Two seconds of samples at 20 Hz, four fixes at 2 Hz; `MADE` holds the numbers that went in.
"""

import datetime
import struct
import tempfile
from functools import reduce
from operator import xor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from pymavlink.dialects.v10 import common as mavlink1
from pymavlink.dialects.v20 import common as mavlink2
from pynmeagps import NMEAMessage
from pyubx2 import GET, UBXMessage
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore

_SPREAD = [0.01, 0.04, 0.09, 0.0, 0.0, 0.0]  # of a velocity east, north, up
NS, WEEK, TOW_MS = 10**9, 2381, 408_619_000  # 2025-08-28 17:30:01 UTC, 18 s less than GPS time
UTC = datetime.datetime(2025, 8, 28, 17, 30, 1)
UTC_NS = int(UTC.replace(tzinfo=datetime.UTC).timestamp()) * NS
GPS_NS = UTC_NS + 18 * NS
_rng = np.random.default_rng(7)
MADE = SimpleNamespace(
    imu_ns=np.arange(40) * NS // 20,
    gyro=_rng.normal(size=(40, 3)),
    accel=np.array([0.0, 0.0, -9.8]) + _rng.normal(size=(40, 3)),
    mag_t=1e-5 * _rng.normal(size=(40, 3)),
    fix_ns=np.arange(4) * NS // 2,
    place=np.array([48.1, 11.2, 500.0]) + np.arange(4)[:, None] * [1e-5, -2e-5, 0.25],
    sigma=np.array([0.5, 0.5, 1.5]),
    v_n=np.array([3.0, -4.0, 0.5]) + np.arange(4)[:, None],
    geoid_m=46.5,
)


# -------------------------------------------------------------------------------------------- ROS


def _messages(store, apart, velocity):
    """(record time, topic, type, message) of the drive, along forward-left-up and east-north-up."""
    make, ros1 = (
        store.types,
        "std_msgs/msg/Header" in store.types
        and "seq" in str(store.fielddefs["std_msgs/msg/Header"]),
    )
    flu, unknown = np.array([1.0, -1.0, -1.0]), np.zeros(9)

    def vector(v):
        return make["geometry_msgs/msg/Vector3"](*map(float, v))

    def header(stamp_ns, frame):
        stamp = make["builtin_interfaces/msg/Time"](*divmod(int(stamp_ns), NS))
        seq = {"seq": 7} if ros1 else {}
        return make["std_msgs/msg/Header"](**seq, stamp=stamp, frame_id=frame)

    def imu(stamp, gyro, accel):
        q = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return make["sensor_msgs/msg/Imu"](
            header(stamp, "imu"), q, unknown, vector(gyro), unknown, vector(accel), unknown
        )

    out = []
    for k, t in enumerate(UTC_NS + MADE.imu_ns):
        gyro, accel = MADE.gyro[k] * flu, MADE.accel[k] * flu
        if apart:
            out.append((t, "/gyro/sample", "sensor_msgs/msg/Imu", imu(t, gyro, 0 * accel)))
            late = (t + NS // 40, "/accel/sample", "sensor_msgs/msg/Imu")
            out.append((*late, imu(t + NS // 40, 0 * gyro, accel)))
        else:
            out.append((t, "/imu", "sensor_msgs/msg/Imu", imu(t, gyro, accel)))
        field = make["sensor_msgs/msg/MagneticField"](
            header(t, "imu"), vector(MADE.mag_t[k] * flu), unknown
        )
        out.append((t, "/mag", "sensor_msgs/msg/MagneticField", field))
    for k, t in enumerate(UTC_NS + MADE.fix_ns):
        north, east, up = MADE.sigma**2
        status = make["sensor_msgs/msg/NavSatStatus"](0, 1)
        spread = np.diag([east, north, up]).ravel()
        fix = make["sensor_msgs/msg/NavSatFix"](
            header(t, "gps"), status, *map(float, MADE.place[k]), spread, 2
        )
        out.append((t, "/fix", "sensor_msgs/msg/NavSatFix", fix))
        n, e, d = MADE.v_n[k]
        twist = make["geometry_msgs/msg/Twist"](vector((e, n, -d)), vector((0, 0, 0)))
        spread = make["geometry_msgs/msg/TwistWithCovariance"](twist, np.diag(_SPREAD).ravel())
        kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
        out.append((t, "/vel", kind, make[kind](header(t, velocity), spread)))
        out.append((t, "/talk", "std_msgs/msg/String", make["std_msgs/msg/String"]("hello")))
    return sorted(out, key=lambda row: row[0])


def bag(path, compression=None, apart=False, velocity="gps"):
    """A recording of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = BagWriter(path)
    if compression:
        writer.set_compression(BagWriter.CompressionFormat[compression])
    with writer:
        known = {}
        for time_ns, topic, kind, message in _messages(store, apart, velocity):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], int(time_ns), store.serialize_ros1(message, kind))
    return path


def folder(path, plugin="SQLITE3", apart=False, velocity="gps", packed=False):
    """The folder of a recording of ROS 2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = FolderWriter(path, version=8, storage_plugin=StoragePlugin[plugin])
    if packed:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        known = {}
        for time_ns, topic, kind, message in _messages(store, apart, velocity):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], int(time_ns), store.serialize_cdr(message, kind))
    return path


# ------------------------------------------------------------------------------------------ u-blox


def ubx(inertial=True, **changes):
    """A stream of UBX; between the messages stand a sentence and noise."""
    out = []
    for k, t in enumerate(MADE.imu_ns):
        if inertial:
            out.append(_measured(int(t // 10**6) + 90_000, MADE.gyro[k], MADE.accel[k]))
        if k % 10 == 9:
            fix = k // 10
            lat, lon, height = MADE.place[fix].tolist()
            north, east, down = (round(x * 1e3) for x in MADE.v_n[fix])
            tow = TOW_MS + int(MADE.fix_ns[fix] // 10**6)
            now = UTC + datetime.timedelta(milliseconds=int(MADE.fix_ns[fix] // 10**6))
            fields = {
                **{"iTOW": tow, "year": now.year, "month": now.month, "day": now.day},
                **{"hour": now.hour, "min": now.minute, "second": now.second},
                **{"nano": now.microsecond * 1000, "validDate": 1, "validTime": 1},
                **{"fixType": 3, "gnssFixOk": 1, "carrSoln": 2, "lat": lat, "lon": lon},
                **{"height": round(height * 1e3), "hMSL": round((height - MADE.geoid_m) * 1e3)},
                **{"hAcc": 500, "vAcc": 1500, "sAcc": 250, "velN": north, "velE": east},
                **{"velD": down, **changes},
            }
            out += [UBXMessage("NAV", "NAV-PVT", GET, **fields).serialize(), b"$GNTXT,01*00\r\n"]
    return b"".join(out)


def _measured(tag_ms, gyro, accel):
    counts = [*np.rint(np.rad2deg(gyro) * 2**12), *np.rint(accel * 2**10)]
    words = (
        (int(n) & 0xFFFFFF) | kind << 24
        for n, kind in zip(counts, (14, 13, 5, 16, 17, 18), strict=True)
    )
    return UBXMessage(
        "ESF", "ESF-MEAS", GET, payload=struct.pack("<IHH6I", tag_ms, 6 << 11, 0, *words)
    ).serialize()


# -------------------------------------------------------------------------------------------- NMEA


def nmea(utc=UTC, gst=True, talkers=("GN",), date=True):
    """Sentences of the fixes."""
    out = []
    for k, at_ns in enumerate(MADE.fix_ns):
        now = utc + datetime.timedelta(microseconds=int(at_ns // 1000))
        (lat, lon, height), (north, east, _) = MADE.place[k], MADE.v_n[k]
        time, course = now.time(), np.rad2deg(np.arctan2(east, north)) % 360.0
        place = {"time": time, "lat": lat, "NS": "N", "lon": lon, "EW": "E"}
        for talker in talkers:
            one = {"talker": talker, "msgmode": 0, "hpnmeamode": True}
            altitude = {"alt": round(height - MADE.geoid_m, 3), "sep": MADE.geoid_m}
            rest = {"quality": 1, "altUnit": "M", "sepUnit": "M", **altitude}
            out.append(NMEAMessage(msgID="GGA", **one, **place, **rest))
            if gst:
                spread = dict(zip(("stdLat", "stdLong", "stdAlt"), MADE.sigma, strict=True))
                out.append(NMEAMessage(msgID="GST", **one, time=time, **spread))
            moved = {"spd": np.hypot(north, east) * 3600 / 1852, "cog": course}
            day = {"date": now.date()} if date else {}
            if date:
                out.append(NMEAMessage(msgID="RMC", **one, **place, status="A", **moved, **day))
            else:
                kept = {"cogt": course, "sogn": moved["spd"]}
                out.append(NMEAMessage(msgID="VTG", **one, **kept))
    return b"".join(one.serialize() for one in out)


def as_gns(gga, modes="AA"):
    """The same fix as a sentence GNS, written by its definition."""
    f = gga.decode().split("*")[0].split(",")
    return _sentence(["$GNGNS", *f[1:6], modes, f[7], f[8], f[9], f[11], "", ""])


def changed(sentence, **fields):
    """A sentence with other texts in some fields, such as f7; the last may be a new one."""
    kept = [*sentence.decode().split("*")[0].split(","), ""]
    for name, text in fields.items():
        kept[int(name[1:])] = text
    return _sentence(kept if kept[-1] else kept[:-1])


def _sentence(fields):
    body = ",".join(fields)[1:]
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


# ----------------------------------------------------------------------------------------- MAVLink


def tlog(kind="HIGHRES_IMU", version=2, boot_ms=100_000, units=1):
    """Telemetry as a ground station keeps it; the vehicle counts from power-up."""
    common, out = {1: mavlink1, 2: mavlink2}[version], []
    sender = common.MAVLink(None, srcSystem=1, srcComponent=1)

    def send(at_ns, message):
        stamp = struct.pack(">Q", (UTC_NS + int(at_ns) + 3_000_000) // 1000)
        out.append(stamp + bytes(message.pack(sender)))

    for k, t in enumerate(MADE.imu_ns):
        g, a, m = MADE.gyro[k], MADE.accel[k], MADE.mag_t[k]
        boot_us = boot_ms * 1000 + int(t // 1000)
        if kind == "HIGHRES_IMU":
            values = (*a, *g, *(m * 1e4), 0.0, 0.0, 0.0, 0.0, 63)
            for unit in range(units):
                values = [float(x) + unit for x in values[:13]]
                send(t, common.MAVLink_highres_imu_message(boot_us, *values, 63, unit))
        else:
            counts = [*np.rint(a / 9.80665e-3), *np.rint(g * 1e3), *np.rint(m * 1e7)]
            send(t, common.MAVLink_scaled_imu_message(boot_us // 1000, *map(int, counts)))
        if k % 10 == 0:
            fix = k // 10
            lat, lon, height = MADE.place[fix]
            north, east, _ = MADE.v_n[fix]
            course = round(np.rad2deg(np.arctan2(east, north)) % 360.0 * 100)
            whole = (round(lat * 1e7), round(lon * 1e7), round((height - MADE.geoid_m) * 1e3))
            rest = (100, 100, round(np.hypot(north, east) * 100), course, 12)
            ext = (round(height * 1e3), 500, 1500, 250)
            ext = ext if version == 2 else ()
            send(t, common.MAVLink_gps_raw_int_message(boot_us, 3, *whole, *rest, *ext))
    return b"".join(out)


# --------------------------------------------------------------------------------------- ArduPilot

FMT = struct.Struct("<BB4s16s64s")
LAYOUTS = {  # name -> number, codes, columns, as ArduPilot 4.5 has them
    "IMU": (10, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "MAG": (11, "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
    "GPS": (12, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HD,Lat,Lng,Alt,Spd,GCrs,VZ,Y,U"),
    "GPA": (13, "QBCCCCfBIHfHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,Und,RTCMU,RTCMD"),
}  # fmt: skip
SIZES = {"Q": "Q", "B": "B", "f": "f", "I": "I", "h": "h", "H": "H", "c": "h", "C": "H"}
SIZES |= {"L": "i", "e": "i", "E": "I"}


def dataflash(
    boot_us=50_000_000, geoid=True, late_us=(120_000, 130_000, 150_000, 125_000), receiver=0
):
    """A log on board; the second instance of each sensor is to be left alone.

    Receivers before the given one never have a fix.
    """
    out = [
        b"\xa3\x95\x80" + FMT.pack(0x80, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    ]

    def define(name):
        number, codes, columns = LAYOUTS[name]
        size = 3 + struct.calcsize("<" + "".join(SIZES[c] for c in codes))
        columns = columns if geoid else columns.replace("Und", "Any")
        texts = name.encode(), codes.encode(), columns.encode()
        out.append(b"\xa3\x95\x80" + FMT.pack(number, size, *texts))

    def log(name, *values):
        number, codes, _ = LAYOUTS[name]
        packed = struct.pack("<" + "".join(SIZES[c] for c in codes), *values)
        out.append(b"\xa3\x95" + bytes([number]) + packed)

    for name in LAYOUTS:
        define(name)
    for k, t in enumerate(MADE.imu_ns):
        now = boot_us + int(t // 1000)
        for instance in (0, 1):
            values = (*(MADE.gyro[k] + instance), *(MADE.accel[k] + instance))
            log("IMU", now, instance, *values, 0, 0, 40.0, 1, 1, 1000, 1000)
        field = [round(x * 1e7) for x in MADE.mag_t[k]]
        log("MAG", now, 0, *field, *[0] * 6, 1, now)
        if k % 10 == 5:
            fix = k // 10
            arrived = boot_us + int(MADE.fix_ns[fix] // 1000) + late_us[fix]
            lat, lon, height = MADE.place[fix]
            north, east, down = MADE.v_n[fix]
            course = np.rad2deg(np.arctan2(east, north)) % 360.0
            place = (round(lat * 1e7), round(lon * 1e7), round((height - MADE.geoid_m) * 100))
            moved = (np.hypot(north, east), course, down, 0.0)
            when = (TOW_MS + int(MADE.fix_ns[fix] // 10**6), WEEK)
            for n in range(receiver + 1):
                status, spread = (6, (100, 50, 150, 25)) if n == receiver else (1, (9999,) * 4)
                log("GPS", arrived, n, status, *when, 20, 80, *place, *moved, 1)
                log("GPA", arrived, n, *spread, 0.0, 1, arrived // 1000, 5, -MADE.geoid_m, 0, 0)
    return b"".join(out)


def content(make, name, **options):
    """Bytes of a file that a writer of `rosbags` makes."""
    with tempfile.TemporaryDirectory() as there:
        path = make(Path(there) / name, **options)
        found = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
        return found.read_bytes()
