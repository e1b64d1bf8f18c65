"""INS/GNSS on a drive that nobody tuned it for: how far off, how sure, and which fixes were lost.

    python benchmarks/strange_drive.py --runs 50 --filters robust,ekf

A car with a MEMS unit and a receiver of centimetres, simulated run by run and replayed as a
stranger's log: mounting and lever arm are told, everything else is the default. What is hard in it:

- smooth stretches, in which the unit lies as quietly as at rest, and rough ones that shake it;
- two outages;
- velocities that are means since the last fix, half an epoch old, with the sigma of fresh ones;
- multipath: for some seconds positions are off by metres and say their usual sigma.

A fix is right where it lies within four of its sigmas of the truth. `refused` counts right fixes
that were not used, `lost` those after which the estimate is still beyond five sigmas.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from robins import logs, scenario
from robins.dataset import Dataset, GnssTable
from robins.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.rotation import rotate
from robins.systems.ins_gnss import Drive, InsGnssReplay, drive_dataset, replay

DRIVE = """
system = "ins-gnss"
imu_rate = "50 Hz"
[place]
latitude = "47 deg"
longitude = "8 deg"
height = "450 m"
heading = "-40 deg"
[imu]
gyro_noise = "0.005 deg/s/sqrt(Hz)"
accel_noise = "150 ug/sqrt(Hz)"
gyro_bias = "0.3 deg/s"
accel_bias = "10 mg"
gyro_bias_walk = "0.001 deg/s/sqrt(s)"
accel_bias_walk = "10 ug/sqrt(s)"
[gnss]
rate = "4 Hz"
sigma = ["0.012 m", "0.012 m", "0.02 m"]
velocity_sigma = ["0.03 m/s", "0.03 m/s", "0.05 m/s"]
lever_arm = ["-0.6 m", "0.3 m", "-0.9 m"]
"""
LEGS = (
    ("stop", 8),
    ("accelerate", 6, 11),
    ("straight", 12),
    ("turn", 75, 14),
    ("straight", 14),
    ("turn", -100, 18),
    ("accelerate", 5, 15),
    ("straight", 16),
    ("turn", 60, 10),
    ("accelerate", 6, 0),
    ("stop", 6),
    ("accelerate", 8, 13),
    ("straight", 14),
    ("turn", -80, 14),
    ("straight", 16),
    ("turn", 50, 12),
    ("accelerate", 8, 0),
    ("stop", 5),
)
_WORDS = {"stop": ("seconds",), "straight": ("seconds",), "turn": ("angle", "rate")}
_UNITS = {"seconds": "s", "speed": "m/s", "angle": "deg", "rate": "deg/s"}

SHAKE = np.deg2rad(0.02), 2e-3  # rad, m/s: of the increments about those of a smooth road
SMOOTH_S = 20.0  # smooth and rough road alternate
OUTAGES_S = ((52.0, 67.0), (100.0, 118.0))
MULTIPATH = 4  # episodes a run
EPISODE_S = (3.0, 8.0)
OFF_M = (0.5, 8.0)


class Told(NamedTuple):
    """Truth of the fixes of a run, known to the simulation alone."""

    error_m: np.ndarray  # (M, 3) north, east, down
    sigma_m: np.ndarray  # (3,) true
    multipath: np.ndarray  # (M,) bool

    @property
    def right(self) -> np.ndarray:
        """(M,) bool: within four sigmas of the truth."""
        return np.all(np.abs(self.error_m) <= 4.0 * self.sigma_m, axis=1)


def legs() -> str:
    """The legs as tables of a scenario."""
    out = []
    for do, *numbers in LEGS:
        names = _WORDS.get(do, ("seconds", "speed"))
        pairs = zip(names, numbers, strict=True)
        told = "\n".join(f'{name} = "{number} {_UNITS[name]}"' for name, number in pairs)
        out.append(f'[[legs]]\ndo = "{do}"\n{told}\n')
    return DRIVE + "".join(out)


def antenna_ecef(truth: Any, lever: Any) -> np.ndarray:
    """(K, 3) m."""
    C = np.asarray(dcm_en(truth.lat_rad, truth.lon_rad))
    arm = np.asarray(rotate(truth.q_nb, np.asarray(lever)))
    r = np.asarray(ecef_from_geodetic(truth.lat_rad, truth.lon_rad, truth.alt_m))
    return r + np.einsum("nij,nj->ni", C, arm)


def strange(drive: Drive, seed: int, run: int) -> tuple[Dataset, Told]:
    """One run of the drive as a stranger's log."""
    log = drive_dataset(drive, seed, run)
    truth, rng = log.truth, np.random.default_rng([seed, run])
    assert truth is not None
    assert log.gnss is not None
    # a shaken unit: increments that come back, so that nothing of it adds up
    t = log.imu.time_ns * 1e-9
    speed = np.linalg.norm(truth.v_n, axis=1)
    rough = (speed > 0.5) & (np.floor((t + rng.uniform(0.0, SMOOTH_S)) / SMOOTH_S) % 2 == 1)
    gyro, accel = log.imu.gyro.copy(), log.imu.accel.copy()
    for values, size in zip((gyro, accel), SHAKE, strict=True):
        jitter = size * rough[:, None] * rng.normal(size=values.shape)
        values[1:] += np.diff(jitter, axis=0)
    # a receiver that states mean velocities since the last fix, and is deceived for a while
    g, sigma = log.gnss, np.asarray(drive.gnss.sigma)
    place, fix_s = antenna_ecef(truth, drive.gnss.lever_arm), g.time_ns * 1e-9
    epoch = 1.0 / drive.gnss.rate
    at = [np.stack([np.interp(fix_s - a, t, x) for x in place.T], -1) for a in (0.0, epoch)]
    lat, lon, _ = (np.asarray(x) for x in geodetic_from_ecef(at[0]))
    C = np.asarray(dcm_en(lat, lon))
    mean_v = np.einsum("nji,nj->ni", C, (at[0] - at[1]) / epoch)
    mean_v += rng.normal(size=mean_v.shape) * np.asarray(drive.gnss.velocity_sigma)
    error = rng.normal(size=(len(g), 3)) * sigma
    wrong = np.zeros(len(g), bool)
    for _ in range(MULTIPATH):
        begin, way = rng.uniform(25.0, fix_s[-1] - 12.0), rng.uniform(0.0, 2.0 * np.pi)
        here = (fix_s > begin) & (fix_s < begin + rng.uniform(*EPISODE_S))
        size = np.exp(rng.uniform(*np.log(OFF_M)))
        error[here] += size * np.array([np.cos(way), np.sin(way), rng.normal()])
        wrong |= here
    lat, lon, alt = (
        np.asarray(x) for x in geodetic_from_ecef(at[0] + np.einsum("nij,nj->ni", C, error))
    )
    seen = ~np.any([(fix_s > a) & (fix_s < b) for a, b in OUTAGES_S], axis=0)
    gnss = GnssTable(
        *(x[seen] for x in (g.time_ns, lat, lon, alt, g.sigma_m, mean_v)),
        sigma_v=g.sigma_v[seen],
        source="strange drive",
    )
    imu = replace(log.imu, gyro=gyro, accel=accel)
    return replace(log, imu=imu, gnss=gnss), Told(error[seen], sigma, wrong[seen])


def judged(drive: Drive, log: Dataset, told: Told, outcome: Any, name: str) -> dict[str, float]:
    """Figures of one run and filter."""
    s, truth = outcome.solution.sel(filter=name), log.truth
    assert truth is not None
    assert log.gnss is not None
    t, time = s.time.values, truth.time_ns * 1e-9
    place = antenna_ecef(truth, drive.gnss.lever_arm)
    place = np.stack([np.interp(t, time, x) for x in place.T], -1)
    here = np.asarray(ecef_from_geodetic(s.lat_rad.values, s.lon_rad.values, s.alt_m.values))
    C = np.asarray(dcm_en(s.lat_rad.values, s.lon_rad.values))
    error = np.einsum("nji,nj->ni", C, here - place)
    across = np.hypot(error[:, 0], error[:, 1])
    scaled = error[:, :2] / s["sigma_position"].values[:, :2]
    away = np.max(np.abs(scaled), axis=1)
    out = np.any([(t > a) & (t < b) for a, b in OUTAGES_S], axis=0)
    settled, fix_s = t > 20.0, log.gnss.time_ns * 1e-9
    deceived = np.any(
        [np.abs(fix_s[told.multipath] - x) < 0.2 for x in t] if told.multipath.any() else [[False]],
        axis=1,
    ) & np.ones(len(t), bool)
    after = np.any([(t > b + 3.0) & (t < b + 8.0) for _, b in OUTAGES_S], axis=0) & ~deceived
    free = settled & ~out & ~deceived
    heading = np.interp(t, time, np.unwrap(_heading(truth.q_nb)))
    turned = np.angle(np.exp(1j * (s["estimate_euler"].values[:, 2] - heading)))
    spoke = s["gnss_position_time"].values if "gnss_position_time" in s else np.zeros(0)
    figures = {
        "rms_m": _rms(across[free]),
        "worst_m": float(np.max(across[free])),
        "multipath_m": _rms(across[settled & deceived]),
        "outage_m": float(np.max(across[out])),
        "outage_away": float(np.max(away[out])),
        "after_away": float(np.max(away[after])),
        "beyond3": float(np.mean(away[free] > 3.0)),
        "nees": float(np.mean(scaled[free] ** 2)),
        "heading_deg": float(np.rad2deg(_rms(turned[free]))),
    }
    if len(spoke):
        right = told.right[np.searchsorted(fix_s, spoke - 1e-6)]
        used = s["nis_dof_gnss_position"].values > 0
        reached = across[np.searchsorted(t, spoke - 1e-6)] <= 5.0 * np.max(told.sigma_m[:2])
        figures["refused"] = float(np.sum(right & ~used))
        figures["lost"] = float(np.sum(right & ~reached))
    return figures


def _heading(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else float("nan")


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--runs", type=int, default=50)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--filters", default="robust,ekf")
    options.add_argument("--each", action="store_true", help="print every run")
    asked = options.parse_args()
    drive = scenario.parse(Drive, legs())
    names = tuple(asked.filters.split(","))
    text = '[gnss]\nlever_arm = ["-0.6 m", "0.3 m", "-0.9 m"]\n'
    parameters = scenario.parse(InsGnssReplay, text)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    for run in range(asked.runs):
        log, told = strange(drive, asked.seed, run)
        outcome = replay(logs.clean(log), parameters, names)
        for name in names:
            found[name].append(judged(drive, log, told, outcome, name))
            if asked.each:
                shown = " ".join(f"{k} {v:.3g}" for k, v in found[name][-1].items())
                print(run, name, shown, file=sys.stderr, flush=True)
    for name, rows in found.items():
        print(f"{name}: {asked.runs} runs; median, nine tenths, worst")
        for key in rows[0]:
            values = [row[key] for row in rows]
            low, high, worst = np.nanquantile(values, [0.5, 0.9, 1.0])
            print(f"  {key:<14}{low:>10.4f}{high:>10.4f}{worst:>10.4f}")


if __name__ == "__main__":
    main()
