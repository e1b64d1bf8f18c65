"""INS/GNSS where most of the error of positions lasts: NEES with what a replay finds, and without.

    python benchmarks/lasting_errors.py --runs 10 --seed 100

The drive of `strange_drive.py` on a smooth road without outages, with fixes of a single receiver
(2 m, 2 m, 4 m) and velocities of the fix. The error of a position is, with its sigma s,
s (sqrt(share) z + sqrt(1 - share) w), with white w and z first-order Gauss-Markov. `found` is the
replay as it comes, `white` the one with gnss.lasting_share = 0. NEES is that of the horizontal
position over its two components, from 20 s on, over all runs.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from strange_drive import antenna_ecef, legs

from robins import logs, scenario
from robins.dataset import Dataset
from robins.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.systems.ins_gnss import Drive, InsGnssReplay, drive_dataset
from robins.systems.ins_gnss import replay as replayed

SIGMA_M = np.array([2.0, 2.0, 4.0])
RECEIVER = """
rate = "{rate} Hz"
sigma = ["2 m", "2 m", "4 m"]
velocity_sigma = ["0.1 m/s", "0.1 m/s", "0.2 m/s"]
lever_arm = ["-0.6 m", "0.3 m", "-0.9 m"]
"""
CASES = ((0.0, 1.0), (0.5, 100.0), (0.95, 30.0), (0.95, 100.0), (0.95, 300.0), (0.999, 1000.0))
"""Share of the variance that lasts, and its time constant [s]."""
FILTERS = "robust", "robust+rts"


def lasting(drive: Drive, seed: int, run: int, share: float, time_s: float) -> Dataset:
    """One run with such errors of its positions."""
    log = drive_dataset(drive, seed, run)
    assert log.truth is not None
    assert log.gnss is not None
    rng, g = np.random.default_rng([seed, run, round(1e3 * share), round(time_s)]), log.gnss
    t, fix_s = log.truth.time_ns * 1e-9, g.time_ns * 1e-9
    place = antenna_ecef(log.truth, drive.gnss.lever_arm)
    place = np.stack([np.interp(fix_s, t, x) for x in place.T], -1)
    z, white = rng.normal(size=(2, len(g), 3))
    for k, left in enumerate(np.exp(-np.diff(fix_s) / time_s), start=1):
        z[k] = left * z[k - 1] + np.sqrt(1.0 - left**2) * z[k]
    error = SIGMA_M * (np.sqrt(share) * z + np.sqrt(1.0 - share) * white)
    C = np.asarray(dcm_en(g.lat_rad, g.lon_rad))
    off = geodetic_from_ecef(place + np.einsum("nij,nj->ni", C, error))
    lat, lon, alt = (np.asarray(x) for x in off)
    return replace(log, gnss=replace(g, lat_rad=lat, lon_rad=lon, alt_m=alt))


def nees(
    drive: Drive, log: Dataset, parameters: InsGnssReplay
) -> tuple[list[float], list[float], bool]:
    """NEES and error [m] of each filter after 20 s, and whether a lasting part was found."""
    outcome = replayed(logs.clean(log), parameters, FILTERS)
    assert log.truth is not None
    t = outcome.solution.time.values
    place = antenna_ecef(log.truth, drive.gnss.lever_arm)
    place = np.stack([np.interp(t, log.truth.time_ns * 1e-9, x) for x in place.T], -1)
    values, errors = [], []
    for name in FILTERS:
        s = outcome.solution.sel(filter=name)
        lat, lon, alt = (s[k].values for k in ("lat_rad", "lon_rad", "alt_m"))
        here = np.asarray(ecef_from_geodetic(lat, lon, alt))
        off = np.einsum("nji,nj->ni", np.asarray(dcm_en(lat, lon)), here - place)[t > 20.0, :2]
        sigma = s["sigma_position"].values[t > 20.0, :2]
        values.append(float(np.mean((off / sigma) ** 2)))
        errors.append(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))))
    return values, errors, any("is taken to last" in note for note in outcome.notes)


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--runs", type=int, default=10)
    options.add_argument("--seed", type=int, default=0)
    asked = options.parse_args()
    arm = 'lever_arm = ["-0.6 m", "0.3 m", "-0.9 m"]'
    told = {
        "found": scenario.parse(InsGnssReplay, f"[gnss]\n{arm}\n"),
        "white": scenario.parse(InsGnssReplay, f"[gnss]\n{arm}\nlasting_share = 0.0\n"),
    }
    print("share  time [s]  rate [Hz]  replay  found in   NEES (smoothed)   error [m] (smoothed)")
    for rate in (1, 4):
        begin, _, rest = legs().partition("[gnss]")
        text = begin + "[gnss]" + RECEIVER.format(rate=rate) + rest[rest.index("[[legs]]") :]
        drive = scenario.parse(Drive, text)
        for share, time_s in CASES:
            runs = [lasting(drive, asked.seed, run, share, time_s) for run in range(asked.runs)]
            for name, parameters in told.items():
                found = [nees(drive, log, parameters) for log in runs]
                value, error = np.mean([f[0] for f in found], 0), np.mean([f[1] for f in found], 0)
                counted = f"{sum(f[2] for f in found):3} of {len(found):3}"
                print(
                    f"{share:5.3f}  {time_s:8.0f}  {rate:9}  {name:6}  "
                    f"{counted}  {value[0]:7.2f} ({value[1]:.2f})"
                    f"  {error[0]:9.2f} ({error[1]:.2f})",
                    flush=True,
                )


if __name__ == "__main__":
    main()
