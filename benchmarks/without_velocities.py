"""INS/GNSS on the packaged drive with a receiver that gives no velocities.

    python benchmarks/without_velocities.py

Errors against the fixes, NIS of positions, refused fixes and epochs with a zero velocity.
"""

from dataclasses import replace

import numpy as np

from robins import scenario
from robins.systems.ins_gnss import SYSTEM, Drive, Replay, drive_dataset, replay


def main() -> None:
    """Print a line for each receiver, seed and filter."""
    text = SYSTEM.scenarios["drive"].read_text()
    print(
        "| fixes | seed | filter | error RMS [m] | NIS | refused | zero velocities |\n" + "|---" * 7
    )
    for sigma in ("0.3 m", "1 m", "3 m"):
        for seed in (1, 2):
            drive = scenario.parse(Drive, text, (f"gnss.sigma={sigma}",))
            log = drive_dataset(drive, seed=seed)
            log = replace(log, gnss=replace(log.gnss, v_n=None, sigma_v=None))
            heading = {"known_heading": float(drive.place.heading)}
            found = replay(log, Replay.model_validate({"start": heading}), ("ekf", "robust"))
            stood = found.solution.get("nis_zero_velocity")
            count = 0 if stood is None else int(np.isfinite(stood.values).any(axis=0).sum())
            for name, m in found.metrics.items():
                error, nis = m["aided_horizontal_rms_m"], m["nis_gnss_position"]
                refused = m["refused_gnss_position"]
                row = f"{name} | {error:.2f} | {nis:.2f} | {refused} | {count}"
                print(f"| {sigma} | {seed} | {row} |", flush=True)


if __name__ == "__main__":
    main()
