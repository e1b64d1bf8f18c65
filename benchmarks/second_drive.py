"""INS/GNSS on a minute of comma2k19, replayed by the defaults; nothing here was tuned on it.

    python benchmarks/second_drive.py FOLDER [--cases all,outages,wheels] [--raw]

FOLDER is a segment of comma2k19 (Schafer et al. 2018), with `processed_log` and `global_pose`. A
phone behind the windscreen, a u-blox receiver without correction data at 10 Hz, 100 Hz of MEMS; the
pose of the camera, computed afterwards from all sensors with carrier phases, serves as truth.

Told are the sigmas of the receiver's data sheet, as the log has none. Fixes are placed on the clock
of the IMU by their own time, which the frames have in both. Vertical velocities are not recorded.
Axes are forward, right, down, as published. `outages` withholds all fixes for two times ten
seconds, `wheels` gives the speed of the CAN bus besides. `--raw` takes the gyro without the
correction of its bias by the phone, which is 4 deg/s.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from robins import logs, rotation, scenario
from robins.dataset import Dataset, GnssTable, ImuTable, OdometryTable, Trajectory
from robins.earth import dcm_en, geodetic_from_ecef
from robins.systems.ins_gnss import InsGnssReplay, replay

SIGMA_M = 2.1, 2.1, 4.0  # 2.5 m circular error probable
SIGMA_V = 0.05  # m/s
SIGMA_WHEEL = 0.05  # m/s
SIGMA_COURSE = np.deg2rad(0.3)
LEAP_S, WEEK_S, GPS_EPOCH_S = 18.0, 604800.0, 315964800.0  # in 2018; 1980-01-06
OUTAGES = '[outages]\nlength = "10 s"\nfirst = "15 s"\ngap = "10 s"\nlast = "15 s"\n'


def loaded(folder: Path, raw: bool = False) -> Dataset:
    """The segment as a log whose clock is that of the device."""

    def array(name: str) -> np.ndarray:
        return np.load(folder / name)

    frame_s, week = array("global_pose/frame_times"), array("global_pose/frame_gps_times")
    boot = np.median(frame_s - (week[:, 0] * WEEK_S + week[:, 1]))
    fixes = array("processed_log/GNSS/live_gnss_ublox/value")
    lat, lon, speed, utc_s, alt, course = fixes.T
    utc_s = np.where(utc_s > 1e11, 1e-3 * utc_s, utc_s)
    fix_s = utc_s - GPS_EPOCH_S + LEAP_S + boot
    turn = np.deg2rad(course)
    v_n = np.stack([speed * np.cos(turn), speed * np.sin(turn), np.full(len(speed), np.nan)], -1)
    across = np.hypot(SIGMA_V, speed * SIGMA_COURSE)
    gnss = GnssTable(
        _ns(fix_s),
        np.deg2rad(lat),
        np.deg2rad(lon),
        alt,
        np.tile(SIGMA_M, (len(lat), 1)),
        v_n,
        np.stack([across, across, np.ones(len(across))], -1),
        source="u-blox",
    )
    imu = ImuTable(
        _ns(array("processed_log/IMU/gyro/t")),
        array(
            "processed_log/IMU/gyro_uncalibrated/value" if raw else "processed_log/IMU/gyro/value"
        ),
        array("processed_log/IMU/accelerometer/value"),
        kind="rate",
        source="phone",
    )
    r_e, v_e = array("global_pose/frame_positions"), array("global_pose/frame_velocities")
    place = tuple(np.asarray(x) for x in geodetic_from_ecef(r_e))
    C_en = np.asarray(dcm_en(*place[:2]))
    q_eb = jnp.asarray(array("global_pose/frame_orientations"))
    C_nb = np.swapaxes(C_en, 1, 2) @ np.asarray(rotation.to_dcm(q_eb))
    truth = Trajectory(
        _ns(frame_s),
        *place,
        np.einsum("nji,nj->ni", C_en, v_e),
        np.asarray(rotation.from_dcm(jnp.asarray(C_nb))),
        source="global pose",
    )
    wheel_s = array("processed_log/CAN/speed/t")
    none = np.full(len(wheel_s), np.nan)
    wheels = OdometryTable(
        _ns(wheel_s),
        array("processed_log/CAN/speed/value")[:, 0],
        none,
        np.full(len(wheel_s), SIGMA_WHEEL),
        none,
        source="CAN",
    )
    return Dataset("comma2k19", imu, gnss, truth, odometry=wheels)


def _ns(seconds: np.ndarray) -> np.ndarray:
    return np.round(seconds * 1e9).astype(np.int64)


def against(truth: Trajectory, time_ns: np.ndarray, lat: Any, lon: Any, alt: Any) -> np.ndarray:
    """(E, 3) m, north, east, down from the true place to the estimated."""
    at = [np.interp(time_ns, truth.time_ns, x) for x in (truth.lat_rad, truth.lon_rad, truth.alt_m)]
    north, east = 6.36e6 * (lat - at[0]), 6.38e6 * np.cos(at[0]) * (lon - at[1])
    return np.stack([north, east, at[2] - alt], -1)


def told(dataset: Dataset, case: str, names: tuple[str, ...]) -> None:
    """Replay and print."""
    outages = case != "all"
    parameters = scenario.parse(InsGnssReplay, OUTAGES if outages else "")
    heard = dataset if case == "wheels" else replace(dataset, odometry=None)
    outcome = replay(heard, parameters, names)
    assert dataset.truth is not None
    print(case)
    for name in names:
        s = outcome.solution.sel(filter=name)
        time_ns = s.time.values * 1e9 + float(outcome.solution.attrs["origin_ns"])
        error = against(dataset.truth, time_ns, s.lat_rad.values, s.lon_rad.values, s.alt_m.values)
        inside = (time_ns >= dataset.truth.time_ns[0]) & (time_ns <= dataset.truth.time_ns[-1])
        out = s.outage.values.astype(bool) & inside
        across = np.hypot(error[:, 0], error[:, 1])
        scaled = error[:, :2] / s["sigma_position"].values[:, :2]
        shares = [("aided", inside & ~out)] + ([("outage", out)] if outages else [])
        for word, of in shares:
            print(
                f"  {name:<12}{word:<8} horizontal RMS {_rms(across[of]):6.2f} m, max "
                f"{np.max(across[of]):6.2f} m, vertical RMS {_rms(error[of, 2]):6.2f} m, scatter "
                f"{_rms(across[of] - np.mean(across[of])):5.2f} m, NEES "
                f"{np.mean(scaled[of] ** 2):7.2f}, worst {np.max(np.abs(scaled[of])):5.1f} sigma"
            )
        figures = outcome.metrics[name]
        kept = {k: v for k, v in figures.items() if k.startswith(("nis", "refused"))}
        print("   ", ", ".join(f"{k} {v}" for k, v in kept.items() if "band" not in k))
    for sentence in [*outcome.notes, *outcome.warnings]:
        print("   ", sentence)


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def main() -> None:
    """Print how far off the fixes and each filter are."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path)
    options.add_argument("--filters", default="robust,robust+rts,ekf")
    options.add_argument("--cases", default="all,outages,wheels")
    options.add_argument("--raw", action="store_true")
    asked = options.parse_args()
    raw = loaded(asked.folder, asked.raw)
    for finding in logs.examine(raw):
        print(finding)
    dataset = logs.clean(raw)
    g, truth = dataset.gnss, dataset.truth
    assert g is not None
    assert truth is not None
    error = against(truth, g.time_ns, g.lat_rad, g.lon_rad, g.alt_m)
    print(
        f"fixes: {len(g)}, horizontal RMS {_rms(np.hypot(error[:, 0], error[:, 1])):.2f} m, mean "
        f"{np.mean(error, axis=0).round(2)} m"
    )
    for case in asked.cases.split(","):
        told(dataset, case, tuple(asked.filters.split(",")))


if __name__ == "__main__":
    main()
