"""A replay of two filters by hand: places, attitudes, velocities, fixes, and a gap in the log."""

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from robins.results import array, variable

NAMES = ["ekf", "ekf+rts"]
GAP = 4  # row that is NaN
TIME_S = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75])
ORIGIN_NS = 1_756_402_237_123_456_789  # 2025-08-28 17:30:19.123456789 UTC, in GPS time
LAT_RAD = np.stack([0.7 + 1e-6 * TIME_S, 0.7 + 1.1e-6 * TIME_S])
LON_RAD = np.stack([-1.8 + 5e-3 * TIME_S, -1.8 + 5.1e-3 * TIME_S])  # tens of kilometres to the east
ALT_M = np.stack([100.0 + TIME_S, 99.0 + 2.0 * TIME_S])
FIX_S = np.array([0.5, 1.5])


def attitudes(seed=4):
    """q_nb of both filters, as scipy has them."""
    rng = np.random.default_rng(seed)
    return [Rotation.random(len(TIME_S), rng=rng) for _ in NAMES]


def scalar_first(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def places(role, values, name):
    made = {}
    for of, one in zip(("lat_rad", "lon_rad", "alt_m"), values, strict=True):
        unit, words = (
            of.rpartition("_")[2],
            {"lat": "latitude", "lon": "longitude", "alt": "height"},
        )
        shown = {"display_unit": "deg"} if unit == "rad" else {}
        text = f"{words[of[:3]]} of the {name}"
        made |= array(role, np.array(one), of, unit=unit, long_name=text, **shown)
    return made


def a_replay(*, dated=True, placed=True, clock="time"):
    q_nb = np.stack([scalar_first(q) for q in attitudes()])
    velocity = np.arange(2.0 * len(TIME_S) * 3).reshape(2, -1, 3)
    axes = ["north", "east", "down"]
    bias = np.full((2, len(TIME_S), 3), np.radians(1.0) / 3600.0)
    shown = {"unit": "rad/s", "display_unit": "deg/h", "frame": "FRD", "axes": ["x", "y", "z"]}
    about = {"frame": "FRD to NED", "axes": ["w", "x", "y", "z"]}
    ways = [np.array(x) for x in (LAT_RAD, LON_RAD, ALT_M)]
    for one in (q_nb, *ways):
        one[:, GAP] = np.nan
    data = array("estimate", velocity, "velocity", unit="m/s", frame="NED", axes=axes)
    data |= array("estimate", bias, "gyro_bias", **shown)
    data |= array("attitude", q_nb, dims=f"filter {clock} axis_q_nb", **about)
    mixed = ["azimuth [rad]", "horizontal part [T]"]
    innovation = np.arange(8.0).reshape(2, 2, 2)
    data |= array("innovation", innovation, "mag", unit="rad, T", frame="NED", axes=mixed)
    if placed:
        data |= places("track", ways, "antenna")
        data |= places("gnss", [x[0, [1, 5]] for x in ways], "fixes")
    for name, time in (("time", TIME_S), ("gnss_time", FIX_S), ("mag_time", FIX_S)):
        data[name] = variable(name, time, "s", "time")
    if clock != "time":
        data[clock] = variable(clock, TIME_S, "s", "time of the samples")
    origin = np.int64(ORIGIN_NS if dated else 86_400_000_000_000)
    return xr.Dataset(data, {"filter": NAMES}, {"origin_ns": origin})
