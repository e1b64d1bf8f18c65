"""A drive that no filter made: results to draw, with every kind of array that a result can hold."""

import numpy as np
import xarray as xr

from robins.results import variable

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

    def series(name, values, unit, axes, text, frame, shown=None):
        shown = {"display_unit": shown} if shown else {}
        dims = ("filter", "time", f"axis_{axes}")
        return {name: variable(dims, values, unit, text, frame, **shown)}

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
    for block, axes, unit, frame, shown, sigma, error in (
        ("position", "position", "m", "NED", None, sigma_p, error_p),
        ("velocity", "velocity", "m/s", "NED", None, sigma_v, about(1.0, sigma_v)),
        ("attitude", "attitude", "rad", "NED", "deg", sigma_a, about(1.0, sigma_a)),
        ("gyro_bias", "gyro_bias", "rad/s", "FRD", "deg/h", sigma_g, about(1.0, sigma_g)),
    ):
        name = block.replace("_", " ")
        if not runs:
            arrays |= series(f"error_{block}", error, unit, axes, f"{name} error", frame, shown)
            arrays |= series(f"sigma_{block}", sigma, unit, axes, f"{name} sigma", frame, shown)
        else:
            rms = sigma * np.sqrt(rng.chisquare(runs, size=sigma.shape) / runs)
            arrays |= series(f"rms_{block}", rms, unit, axes, f"{name} RMS", frame, shown)
            arrays[f"rms_{block}"].attrs["runs"] = runs
            arrays |= series(f"mean_sigma_{block}", sigma, unit, axes, name, frame, shown)
    if runs:
        anees = rng.chisquare(runs * 15, size=(f, n)) / runs
        about_it = {"degrees_of_freedom": 15, "runs": runs}
        arrays["anees"] = variable(("filter", "time"), anees, "1", "ANEES", **about_it)
    else:
        truth = np.array([8e-5, -5e-5, 2e-5])
        values = truth - arrays["error_gyro_bias"].values
        arrays |= series(
            "estimate_gyro_bias", values, "rad/s", "gyro_bias", "gyro bias", "FRD", "deg/h"
        )
        radius = 6.37e6
        lat = lat0 + (north + error_p[..., 0]) / radius
        lon = lon0 + (east + error_p[..., 1]) / radius / np.cos(lat0)
        dims = ("filter", "time")
        arrays["lat_rad"] = variable(dims, lat, "rad", "latitude")
        arrays["lon_rad"] = variable(dims, (lon + np.pi) % (2 * np.pi) - np.pi, "rad", "longitude")
        arrays["alt_m"] = variable(dims, up - error_p[..., 2], "m", "height")
        arrays |= place("reference", "time", lat0 + north / radius, lon0 + east / radius, up, lat0)
        fix = slice(None, None, 5)
        noise = rng.normal(size=(3, n))[:, fix] * 0.8
        arrays |= place(
            "gnss",
            "gnss_time",
            lat0 + (north[fix] + noise[0]) / radius,
            lon0 + (east[fix] + noise[1]) / radius,
            up[fix] + noise[2],
            lat0,
            lon0,
        )
        quality = np.where(rng.random(noise.shape[1]) < 0.8, 1, 2)
        quality[rng.random(noise.shape[1]) < 0.05] = 5
        arrays["gnss_quality"] = variable("gnss_time", quality, "1", "quality of the fix")
        arrays |= updates(rng, f, noise.shape[1], outage[fix])
        arrays["nees"] = variable(
            dims, rng.chisquare(15, size=(f, n)), "1", "NEES", degrees_of_freedom=15
        )
    arrays["outage"] = variable("time", outage, "1", "aids withheld")
    return xr.Dataset(
        arrays,
        coords={
            "filter": FILTERS[:f],
            "time": variable("time", t, "s", "time"),
            "gnss_time": variable("gnss_time", t[::5], "s", "time of fixes"),
            "axis_position": NED,
            "axis_velocity": NED,
            "axis_attitude": RPH,
            "axis_gyro_bias": XYZ,
        },
    )


def place(kind, dim, lat, lon, alt, lat0, lon0=0.19):
    lon = lon0 + (lon - lon0) / np.cos(lat0)
    lon = (lon + np.pi) % (2 * np.pi) - np.pi
    return {
        f"{kind}_lat_rad": variable(dim, lat, "rad", "latitude"),
        f"{kind}_lon_rad": variable(dim, lon, "rad", "longitude"),
        f"{kind}_alt_m": variable(dim, alt, "m", "height"),
    }


def updates(rng, filters, count, missing):
    sigma = np.broadcast_to(np.array([0.9, 0.9, 1.4]), (filters, count, 3)).copy()
    innovation = rng.normal(size=sigma.shape) * sigma
    innovation[:, missing] = np.nan
    nis = np.sum((innovation / sigma) ** 2, axis=-1)
    refused = np.zeros(nis.shape, bool)
    at = min(40, count - 1)
    refused[:, at] = True
    innovation[:, at, 0] = 6.0
    dims = ("filter", "gnss_time")
    axes = (*dims, "axis_position")
    return {
        "innovation_gnss_position": variable(axes, innovation, "m", "GNSS innovation", "NED"),
        "innovation_sigma_gnss_position": variable(axes, sigma, "m", "expected sigma", "NED"),
        "nis_gnss_position": variable(dims, nis, "1", "NIS", degrees_of_freedom=3),
        "refused_gnss_position": variable(dims, refused, "1", "refused by the gate"),
    }


def an_allan_curve():
    tau = np.geomspace(0.01, 2000.0, 45)
    n, b, k = 3e-5 * np.array([1, 1.3, 0.8]), 4e-7, 3e-8 * np.array([1, 1, 3])
    parts = np.stack(
        [
            n / np.sqrt(tau)[:, None],
            0.664 * b * np.ones((len(tau), 3)),
            k * np.sqrt(tau / 3.0)[:, None],
        ]
    )
    model = np.sqrt((parts**2).sum(axis=0))
    few = np.sqrt(tau / 2000.0)[:, None]
    rng = np.random.default_rng(5)
    value = model * (1.0 + 0.15 * few * rng.normal(size=model.shape))
    dims = ("tau", "axis_gyro")
    known = {"display_unit": "deg/h"}

    def one(values, text, dims=dims):
        return variable(dims, values, "rad/s", text, "FRD", **known)

    return xr.Dataset(
        {
            "allan_gyro": one(value, "Allan deviation"),
            "allan_low_gyro": one(value * (1.0 - 0.35 * few), "lower bound"),
            "allan_high_gyro": one(value * (1.0 + 0.6 * few), "upper bound"),
            "allan_fit_gyro": one(model, "fit"),
            "allan_slope_gyro": one(parts, "processes", ("process", *dims)),
        },
        coords={
            "tau": variable("tau", tau, "s", "averaging time"),
            "axis_gyro": XYZ,
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
