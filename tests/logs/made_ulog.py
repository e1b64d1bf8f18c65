"""PX4 logs written byte by byte after the format's description, without the package that reads."""

import struct

import numpy as np

MAGIC = b"ULog\x01\x12\x35\x01"
SIZES = {"uint64_t": "Q", "float": "f", "double": "d", "int32_t": "i", "uint8_t": "B", "bool": "?"}
IMU = "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
MAG = "uint64_t timestamp;float[3] magnetometer_ga;"
RAW_MAG = "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;"
GPS = (
    "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
    "float s_variance_m_s;float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;"
    "uint8_t fix_type;bool vel_ned_valid;"
)
NEW_GPS = GPS.replace("int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;", "").replace(
    "float s_v",
    "double latitude_deg;double longitude_deg;double altitude_msl_m;double altitude_ellipsoid_m;"
    "float s_v",
)


def message(kind, content):
    return struct.pack("<HB", len(content), ord(kind)) + content


def layout(fields):
    out = "<"
    for field in fields.rstrip(";").split(";"):
        name, _, count = field.split()[0].rstrip("]").partition("[")
        out += f"{count}{SIZES[name]}"
    return out


def ulog(topics, records):
    """A log.

    Args:
        topics: (name, instance, fields) of each subscription.
        records: (index of its topic, values) in the order of logging.
    """
    out = MAGIC + struct.pack("<Q", 5_000_000)
    out += message("B", bytes(40))
    for name, fields in {t[0]: t[2] for t in topics}.items():
        out += message("F", f"{name}:{fields}".encode())
    for index, (name, instance, _) in enumerate(topics):
        out += message("A", struct.pack("<BH", instance, index) + name.encode())
    for index, values in records:
        data = struct.pack(layout(topics[index][2]), *values)
        out += message("D", struct.pack("<H", index) + data)
    return out


def flight(seconds=1.0, mag=("vehicle_magnetometer", MAG), gps=GPS):
    """200 Hz of inertial samples, 50 Hz of field, 5 Hz of fixes; and the numbers written."""
    rng = np.random.default_rng(4)
    topics = [
        ("sensor_combined", 0, IMU),
        ("sensor_combined", 1, IMU),
        (mag[0], 0, mag[1]),
        ("vehicle_gps_position" if gps is GPS else "sensor_gps", 0, gps),
        ("vehicle_attitude", 0, "uint64_t timestamp;float[4] q;"),
    ]
    records, written = [], {"imu": [], "mag": [], "gps": []}
    for k in range(round(200 * seconds)):
        stamp = 20_000_000 + 5_000 * k
        imu = np.float32(rng.normal([0, 0, 0, 0, 0, -9.8]))
        records.append((0, (stamp, *imu)))
        records.append((1, (stamp, *(imu + 1))))
        records.append((4, (stamp, 1.0, 0.0, 0.0, 0.0)))
        written["imu"].append((stamp, *imu))
        if k % 4 == 0:
            field = np.float32(rng.normal(size=3))
            stamps = (stamp,) if mag[0] == "vehicle_magnetometer" else (stamp + 900, stamp)
            records.append((2, (*stamps, *field)))
            written["mag"].append((stamp, *field))
        if k % 40 == 0:
            lat, lon, alt = 63.4170622 + 1e-7 * k, -10.4082151, 106.766
            place = (lat, lon, alt - 40.0, alt)
            if gps is GPS:
                place = [round(lat * 1e7), round(lon * 1e7), round(alt * 1e3) - 40_000, 106_766]
            rest = (0.25, 1.5, 2.5, 3.0, -4.0, 0.5, 3 + (k == 40) * 3, k != 80)
            records.append((3, (stamp, *place, *rest)))
            written["gps"].append((stamp, lat, lon, alt))
    return ulog(topics, records), {name: np.array(rows) for name, rows in written.items()}
