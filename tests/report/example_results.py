"""A drive that no filter made: results to draw, with every kind of array that a result can hold."""

import numpy as np
import xarray as xr

from robins.results import array, variable
from robins.systems.tables import place_arrays

FILTERS = ["kalman", "robust", "dead reckoning"]
NED = ["north", "east", "down"]
XYZ = ["x", "y", "z"]
RPH = ["roll", "pitch", "heading"]


def a_drive(filters=2, runs=0, seconds=600.0, lat0=0.85, lon0=0.19):
    """Time series of a drive in a town with an outage; a campaign's statistics where runs > 0."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 0.2)
    n, f = len(t), filters
    heading = 0.6 * np.sin(t / 47.0) + 1.2 * np.sin(t / 130.0) + t / 90.0
    speed = 9.0 + 4.0 * np.sin(t / 23.0)
    north = np.cumsum(speed * np.cos(heading)) * 0.2
    east = np.cumsum(speed * np.sin(heading)) * 0.2
    up = 210.0 + 8.0 * np.sin(t / 80.0)
    outage = (t > 0.5 * seconds) & (t < 0.6 * seconds)
    since = np.where(outage, t - 0.5 * seconds, 0.0)

    def about(scale, sigma):
        noise = np.cumsum(rng.normal(size=(f, n, 3)), axis=1)
        noise -= np.linspace(0.0, 1.0, n)[None, :, None] * noise[:, -1:, :]
        noise /= noise.std(axis=1, keepdims=True)
        return noise * sigma * 0.9 * scale

    worse = (1.0 + 0.7 * np.arange(f))[:, None, None]
    start = np.exp(-t / 25.0)[None, :, None]
    sigma_p = worse * (0.4 + 0.002 * since[None, :, None] ** 1.7 + 3.0 * start)
    sigma_p = sigma_p * np.array([1.0, 1.0, 1.6])
    sigma_v = worse * (0.03 + 0.002 * since[None, :, None] + 0.3 * start)
    sigma_v = np.broadcast_to(sigma_v, (f, n, 3))
    sigma_a = worse * (np.array([1.0, 1.0, 5.0]) * 4e-4 * (1.0 + 30.0 * start))
    sigma_g = worse * (2e-5 * (0.1 + start)) * np.ones(3)
    error_p = about(1.0, sigma_p)
    arrays = {}
    angles = {"unit": "rad", "frame": "NED", "axes": RPH, "display_unit": "deg"}
    bias = {"unit": "rad/s", "frame": "FRD", "axes": XYZ, "display_unit": "deg/h"}
    for block, shown, sigma, error in (
        ("position", {"unit": "m", "frame": "NED", "axes": NED}, sigma_p, error_p),
        ("velocity", {"unit": "m/s", "frame": "NED", "axes": NED}, sigma_v, about(1.0, sigma_v)),
        ("attitude", angles, sigma_a, about(1.0, sigma_a)),
        ("gyro_bias", bias, sigma_g, about(1.0, sigma_g)),
    ):
        if not runs:
            arrays |= array("error", error, block, **shown)
            arrays |= array("sigma", sigma, block, **shown)
        else:
            rms = sigma * np.sqrt(rng.chisquare(runs, size=sigma.shape) / runs)
            arrays |= array("rms", rms, block, runs=runs, **shown)
            arrays |= array("mean_sigma", sigma, block, **shown)
    if runs:
        anees = rng.chisquare(runs * 15, size=(f, n)) / runs
        arrays |= array("consistency", anees, "anees", degrees_of_freedom=15, runs=runs)
    else:
        truth = np.array([8e-5, -5e-5, 2e-5])
        values = truth - arrays["error_gyro_bias"].values
        arrays |= array("estimate", values, "gyro_bias", **bias)
        radius = 6.37e6
        lat = lat0 + (north + error_p[..., 0]) / radius
        lon = lon0 + (east + error_p[..., 1]) / radius / np.cos(lat0)
        there = lat, (lon + np.pi) % (2 * np.pi) - np.pi, up - error_p[..., 2]
        arrays |= place_arrays("track", there)
        arrays |= place("reference", lat0 + north / radius, lon0 + east / radius, up, lat0)
        fix = slice(None, None, 5)
        noise = rng.normal(size=(3, n))[:, fix] * 0.8
        arrays |= place(
            "gnss",
            lat0 + (north[fix] + noise[0]) / radius,
            lon0 + (east[fix] + noise[1]) / radius,
            up[fix] + noise[2],
            lat0,
            lon0,
        )
        quality = np.where(rng.random(noise.shape[1]) < 0.8, 1, 2)
        quality[rng.random(noise.shape[1]) < 0.05] = 5
        arrays |= array("gnss_quality", quality)
        arrays |= updates(rng, f, noise.shape[1], outage[fix])
        nees = rng.chisquare(15, size=(f, n))
        arrays |= array("consistency", nees, "nees", degrees_of_freedom=15)
    return xr.Dataset(
        arrays | array("outage", outage),
        coords={
            "filter": FILTERS[:f],
            "time": variable("time", t, "s", "time"),
            "gnss_time": variable("gnss_time", t[::5], "s", "time of fixes"),
        },
    )


def place(role, lat, lon, alt, lat0, lon0=0.19):
    lon = lon0 + (lon - lon0) / np.cos(lat0)
    return place_arrays(role, (lat, (lon + np.pi) % (2 * np.pi) - np.pi, alt))


def updates(rng, filters, count, missing):
    sigma = np.broadcast_to(np.array([0.9, 0.9, 1.4]), (filters, count, 3)).copy()
    innovation = rng.normal(size=sigma.shape) * sigma
    innovation[:, missing] = np.nan
    nis = np.sum((innovation / sigma) ** 2, axis=-1)
    refused = np.zeros(nis.shape, bool)
    at = min(40, count - 1)
    refused[:, at] = True
    innovation[:, at, 0] = 6.0
    of, dims = "gnss_position", "filter gnss_time"
    axes = {"unit": "m", "frame": "NED", "axes": NED, "dims": f"{dims} axis_position"}
    return (
        array("innovation", innovation, of, **axes)
        | array("innovation_sigma", sigma, of, **axes)
        | array("nis", nis, of, degrees_of_freedom=3, dims=dims)
        | array("refused", refused, of, dims=dims)
    )


def an_allan_curve():
    tau = np.geomspace(0.01, 2000.0, 45)
    n, b, k = 3e-5 * np.array([1, 1.3, 0.8]), 4e-7, 3e-8 * np.array([1, 1, 3])
    bias = 0.664 * b * np.ones((len(tau), 3))
    parts = np.stack([n / np.sqrt(tau)[:, None], bias, k * np.sqrt(tau / 3.0)[:, None]])
    model = np.sqrt((parts**2).sum(axis=0))
    few = np.sqrt(tau / 2000.0)[:, None]
    rng = np.random.default_rng(5)
    value = model * (1.0 + 0.15 * few * rng.normal(size=model.shape))
    arrays = {}
    for role, values in (
        ("allan", value),
        ("allan_low", value * (1.0 - 0.35 * few)),
        ("allan_high", value * (1.0 + 0.6 * few)),
        ("allan_fit", model),
        ("allan_slope", parts),
    ):
        about = {"unit": "rad/s", "frame": "FRD", "axes": XYZ, "display_unit": "deg/h"}
        arrays |= array(role, values, "gyro", **about)
    return xr.Dataset(
        arrays,
        coords={
            "tau": variable("tau", tau, "s", "averaging time"),
            "process": ["angle random walk", "bias instability", "rate random walk"],
        },
    )


def a_summary(filters=2, **changes):
    metrics = {
        "horizontal_rms_m": 0.0213,
        "vertical_rms_m": 0.0174,
        "attitude_rms_arcmin": 3.21,
        "heading_rms_deg": 0.31,
        "nis_inside_percent": 94.6,
        "horizontal_rms_outage_m": 1.9,
        "velocity_rms_m_per_s": [0.021, 0.019, 0.03],
        "worst_step_us": None,
    }
    scaled = {
        name: {
            key: value * (1.0 + 0.7 * i) if isinstance(value, float) else value
            for key, value in metrics.items()
        }
        for i, name in enumerate(FILTERS[:filters])
    }
    claim = {"id": "smoothed-outage", "text": "Smoothed error in 15 s outages is at most 0.29 m"}
    return {
        "scenario": "ins_gnss/town",
        "seed": 7,
        "runs": 1,
        "filters": scaled,
        "claims": [
            claim | {"verdict": "reproduced", "value": 0.18, "band": [None, 0.29]},
            {
                "id": "sigma",
                "text": "Stated sigma equals Monte Carlo RMS within 5 %",
                "verdict": "partly",
                "value": 1.061,
                "band": [0.95, 1.05],
            },
        ],
        "counts": {"imu_duplicate_time": 2, "gnss_not_finite": 14},
        "seconds": 12.34,
    } | changes
