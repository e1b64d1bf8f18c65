"""A drive of 22 s with a consumer's unit and a receiver of 2 Hz, as a scenario of INS/GNSS."""

import io
from pathlib import Path

import numpy as np

DRIVE = """
imu_rate = "50 Hz"
[place]
latitude = "46 deg"
longitude = "9 deg"
height = "300 m"
heading = "70 deg"
[imu]
gyro_noise = "0.004 deg/s/sqrt(Hz)"
accel_noise = "150 ug/sqrt(Hz)"
gyro_bias = "0.1 deg/s"
accel_bias = "5 mg"
gyro_bias_walk = "0.0005 deg/s/sqrt(s)"
accel_bias_walk = "5 ug/sqrt(s)"
[gnss]
rate = "2 Hz"
sigma = "0.5 m"
velocity_sigma = "0.05 m/s"
[[legs]]
do = "stop"
seconds = "4 s"
[[legs]]
do = "accelerate"
seconds = "4 s"
speed = "10 m/s"
[[legs]]
do = "turn"
angle = "70 deg"
rate = "14 deg/s"
[[legs]]
do = "accelerate"
seconds = "4 s"
speed = "0 m/s"
[[legs]]
do = "stop"
seconds = "4 s"
"""


GNSS_HEAD = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) "
    "sdun(m) age(s) ratio vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun\n"
)


def write_pos(path, gnss):
    """Fixes as RTKLIB writes them."""
    lines = io.StringIO()
    lines.write(GNSS_HEAD)
    for k, stamp in enumerate(gnss.time_ns):
        week, left = divmod(int(stamp) - 315_964_800_000_000_000, 604_800_000_000_000)
        n, e, d = gnss.v_n[k]
        lat, lon = np.rad2deg([gnss.lat_rad[k], gnss.lon_rad[k]])
        lines.write(
            f"{week} {left * 1e-9:.3f} {lat:.9f} {lon:.9f} {gnss.alt_m[k]:.4f} 1 12 1 1 2 0 0 0 0 "
            f"9 {n:.4f} {e:.4f} {-d:.4f} 0.05 0.05 0.1 0 0 0\n"
        )
    Path(path).write_text(lines.getvalue())
