"""A simulated drive with fixes of a centimetre and outages of 15 s: errors once fixes come back.

    python benchmarks/outages.py --runs 50 --seed 100

The packaged drive with an RTK receiver at 4 Hz, fixes withheld for 15 s of every 45. A run of the
filter, and its smoother, against the fixes that it was given and those that were withheld:

- within: share of outages after which the position is within three sigmas of the fixes, 1 s later;
- held wrong: the longest time for which right fixes are more likely wrong to `robust` [s];
- aided and outage RMS, horizontal [m], causal and smoothed.
"""

from __future__ import annotations

import argparse

import numpy as np

from robins import scenario
from robins.systems.ins_gnss import SYSTEM, Drive, InsGnssReplay, drive_dataset, replay

SETTINGS = (
    'gnss.sigma=["0.01 m","0.01 m","0.02 m"]',
    'gnss.velocity_sigma=["0.03 m/s","0.03 m/s","0.05 m/s"]',
    "gnss.rate=4 Hz",
)
OUTAGES = {"length": "15 s", "first": "60 s", "gap": "45 s", "last": "20 s"}
FILTERS = "robust", "robust+rts"
LATER_S, SIGMAS = 1.0, 3.0
RADIUS_M = 6.37e6


def drive() -> Drive:
    """The packaged drive with another receiver."""
    return scenario.parse(Drive, SYSTEM.scenarios["drive"].read_text(), SETTINGS)


def longest(which: np.ndarray) -> int:
    """Length of the longest run of true in (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(int)))
    return int(np.max(np.diff(edges.reshape(-1, 2), axis=1), initial=0))


def one(given: Drive, seed: int) -> dict[str, float]:
    """Figures of one run."""
    log = drive_dataset(given, seed=seed)
    parameters = InsGnssReplay.model_validate({"outages": OUTAGES})
    found = replay(log, parameters, FILTERS)
    s = found.solution.sel(filter=FILTERS[0])
    fix_s = (log.gnss.time_ns - log.imu.time_ns[0]) * 1e-9
    time = s["time"].values
    at = np.minimum(np.searchsorted(time, fix_s - 1e-9), len(time) - 1)
    same = np.abs(time[at] - fix_s) < 1e-6
    lat, lon = s["lat_rad"].values[at], s["lon_rad"].values[at]
    error = RADIUS_M * np.stack(
        [log.gnss.lat_rad - lat, (log.gnss.lon_rad - lon) * np.cos(lat)], axis=1
    )
    spread = np.hypot(s["sigma_position"].values[at, :2], log.gnss.sigma_m[:, :2])
    right = np.all(np.abs(error) < SIGMAS * spread, axis=1)
    out = s["outage"].values[at].astype(bool) & same
    ends = np.flatnonzero(out[:-1] & ~out[1:] & same[1:])
    later = [int(np.searchsorted(fix_s, fix_s[k + 1] + LATER_S - 1e-6)) for k in ends]
    wrong = s["wrong"].sel(suspect="gnss_position").values
    held = (np.nan_to_num(wrong[at]) > 0.5) & ~out
    return {
        "outages": len(ends),
        "within": float(np.mean(right[later])) if later else float("nan"),
        "held wrong": longest(held) * float(np.median(np.diff(fix_s))),
        "aided": found.metrics[FILTERS[0]]["aided_horizontal_rms_m"],
        "outage": found.metrics[FILTERS[0]]["outage_horizontal_rms_m"],
        "aided smoothed": found.metrics[FILTERS[1]]["aided_horizontal_rms_m"],
        "outage smoothed": found.metrics[FILTERS[1]]["outage_horizontal_rms_m"],
    }


def main() -> None:
    """Print a line a run, and the whole."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=100)
    asked = parser.parse_args()
    given, rows = drive(), []
    for seed in range(asked.seed, asked.seed + asked.runs):
        rows.append(one(given, seed))
        if len(rows) == 1:
            print("| seed | " + " | ".join(rows[0]) + " |\n|" + "---|" * (len(rows[0]) + 1))
        print(f"| {seed} | " + " | ".join(f"{x:.3f}" for x in rows[-1].values()) + " |", flush=True)
    weight = np.array([row["outages"] for row in rows])
    within = float(np.average([row["within"] for row in rows], weights=weight))
    count, share = int(weight.sum()), 100.0 * within
    print(f"\n{count} outages: {share:.1f} % within three sigmas {LATER_S:g} s later;")
    print(f"right fixes held for wrong for {max(row['held wrong'] for row in rows):.1f} s at most;")
    for name in ("aided", "outage", "aided smoothed", "outage smoothed"):
        print(f"{name} {np.sqrt(np.mean([row[name] ** 2 for row in rows])):.3f} m RMS")


if __name__ == "__main__":
    main()
