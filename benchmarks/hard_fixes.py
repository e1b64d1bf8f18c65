"""INS/GNSS on the packaged drive with fixes that are hard to use.

    python benchmarks/hard_fixes.py --seeds 3,4

First a receiver that gives no velocities: errors against its fixes, NIS of positions, refused fixes
and epochs with a zero velocity. Then one position that is far away: how far the track moves from
that of the same log without it, at most and at the end.
"""

import argparse
from dataclasses import replace

import numpy as np

from robins import scenario
from robins.dataset import Dataset
from robins.systems.ins_gnss import SYSTEM, Drive, InsGnssReplay, drive_dataset, replay

FILTERS = "ekf", "robust"
RADIUS_M = 6.37e6
FAR_FIX, LAST = 120, 60  # number of the fix, epochs at the end


def drive(*settings: str) -> Drive:
    """The packaged drive, changed."""
    return scenario.parse(Drive, SYSTEM.scenarios["drive"].read_text(), settings)


def head(*columns: str) -> None:
    """Print the head of a table."""
    print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")


def without_velocities(seeds: list[int]) -> None:
    """Print a line for each receiver, seed and filter."""
    head("fixes", "seed", "filter", "error RMS [m]", "NIS", "refused", "zero velocities")
    for sigma in ("0.3 m", "1 m", "3 m"):
        given = drive(f"gnss.sigma={sigma}")
        parameters = InsGnssReplay.model_validate({"start": {"known_heading": given.place.heading}})
        for seed in seeds:
            log = drive_dataset(given, seed=seed)
            log = replace(log, gnss=replace(log.gnss, v_n=None, sigma_v=None))
            found = replay(log, parameters, FILTERS)
            stood = found.solution.get("nis_zero_velocity")
            count = 0 if stood is None else int(np.isfinite(stood.values).any(axis=0).sum())
            for name, m in found.metrics.items():
                error, nis = m["aided_horizontal_rms_m"], m["nis_gnss_position"]
                row = f"{name} | {error:.2f} | {nis:.2f} | {m['refused_gnss_position']} | {count}"
                print(f"| {sigma} | {seed} | {row} |", flush=True)


def track(log: Dataset) -> np.ndarray:
    """(filters, E, 2) latitude and longitude [rad] of the antenna."""
    found = replay(log, InsGnssReplay(), FILTERS).solution
    return np.stack([found["lat_rad"].values, found["lon_rad"].values], axis=-1)


def far_away(seeds: list[int]) -> None:
    """Print a line for each distance, seed and filter."""
    head("off by [km]", "seed", "filter", "track moves by at most [m]", "at the end [m]")
    for seed in seeds:
        log = drive_dataset(drive(), seed=seed)
        usual = track(log)
        for off_km in (0.1, 1.0, 10.0, 111.0, 1000.0):
            lat = log.gnss.lat_rad.copy()
            lat[FAR_FIX] -= 1e3 * off_km / RADIUS_M
            moved = track(replace(log, gnss=replace(log.gnss, lat_rad=lat))) - usual
            away = RADIUS_M * np.linalg.norm(moved, axis=-1)
            for name, one in zip(FILTERS, away, strict=True):
                row = f"{name} | {one.max():.2f} | {one[-LAST:].mean():.2f}"
                print(f"| {off_km:g} | {seed} | {row} |", flush=True)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="3,4")
    seeds = list(map(int, parser.parse_args().seeds.split(",")))
    without_velocities(seeds)
    far_away(seeds)


if __name__ == "__main__":
    main()
