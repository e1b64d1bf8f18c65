"""Orientation on BROAD beside VQF, trial by trial, as they are and changed on purpose.

    python docs/studies/marg_broad.py [FOLDER] [--made]

FOLDER holds ``broad_*.npz``; by default ROBINS_DATA, else ../shared/data. VQF's columns need the
package ``vqf``. With --made the trials are also changed: a magnet fastened to the sensor in the
middle of the motion, samples averaged to 57 Hz, gyros with 0.5 % of gain error, 1 deg/s of bias and
more noise, a start in the midst of the motion.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robins.dataset import Dataset
from robins.ins.frames import to_ned_frd
from robins.logs.broad import read_broad
from robins.rotation import multiply
from robins.systems.marg import MargReplay, replay
from robins.systems.marg.replay import orientation_errors, rms_deg, truth_at

# Without the package its columns stay empty.
vqf: Any = importlib.import_module("vqf") if importlib.util.find_spec("vqf") else None

ENU_TO_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])


def peer(log: Dataset) -> tuple[float, float]:
    """Total RMSE [deg] of VQF, in real time and offline; NaN without the package."""
    if vqf is None or log.mag is None or log.attitude is None:
        return float("nan"), float("nan")
    step = float(np.median(np.diff(log.imu.time_ns))) * 1e-9
    gyro, accel, field = (
        np.ascontiguousarray(a) for a in (log.imu.gyro, log.imu.accel, log.mag.field_t * 1e6)
    )
    true, counts = truth_at(to_ned_frd(log.attitude), log.imu.time_ns)
    out = []
    causal = vqf.VQF(step).updateBatch(gyro, accel, field)
    for q in (causal, vqf.offlineVQF(gyro, accel, field, step)):
        ned = multiply(ENU_TO_NED, q["quat9D"])
        out.append(rms_deg(orientation_errors(ned[counts], true[counts]).total))
    return out[0], out[1]


def rows_of(log: Dataset, rows: slice) -> Dataset:
    """A part of a log."""
    assert log.mag is not None
    assert log.attitude is not None
    assert log.attitude.moving is not None
    imu, mag, true = log.imu, log.mag, log.attitude
    moving = true.moving[rows] if true.moving is not None else None
    return replace(
        log,
        imu=replace(imu, time_ns=imu.time_ns[rows], gyro=imu.gyro[rows], accel=imu.accel[rows]),
        mag=replace(mag, time_ns=mag.time_ns[rows], field_t=mag.field_t[rows]),
        attitude=replace(true, time_ns=true.time_ns[rows], q_nb=true.q_nb[rows], moving=moving),
    )


def averaged(log: Dataset, number: int) -> Dataset:
    """Means of so many samples, at the time of the last."""
    assert log.mag is not None
    ends = rows_of(log, slice(number - 1, len(log.imu) // number * number, number))

    def mean(rows: np.ndarray) -> np.ndarray:
        return rows[: len(ends.imu) * number].reshape(-1, number, 3).mean(axis=1)

    assert ends.mag is not None
    imu = replace(ends.imu, gyro=mean(log.imu.gyro), accel=mean(log.imu.accel))
    return replace(ends, imu=imu, mag=replace(ends.mag, field_t=mean(log.mag.field_t)))


def with_magnet(log: Dataset, size_t: float, seed: int) -> Dataset:
    """A magnet on the sensor from a fifth to seven tenths of the motion, in some direction."""
    assert log.mag is not None
    assert log.attitude is not None
    assert log.attitude.moving is not None
    direction = np.random.default_rng(seed).standard_normal(3)
    moving = np.flatnonzero(log.attitude.moving)
    there = np.zeros(len(log.mag))
    there[moving[len(moving) // 5] : moving[7 * len(moving) // 10]] = 1.0
    there = np.convolve(there, np.ones(285) / 285.0, "same")
    added = np.outer(there, size_t * direction / np.linalg.norm(direction))
    return replace(log, mag=replace(log.mag, field_t=log.mag.field_t + added))


def with_poor_gyros(log: Dataset, seed: int) -> Dataset:
    """Gyros with gain errors of 0.5 %, a bias of 1 deg/s an axis and 0.2 deg/s of noise."""
    rng = np.random.default_rng(seed)
    gain = np.eye(3) + 0.005 * rng.standard_normal((3, 3))
    noise = np.radians(0.2) * rng.standard_normal(log.imu.gyro.shape)
    bias = np.radians(1.0) * rng.standard_normal(3)
    return replace(log, imu=replace(log.imu, gyro=log.imu.gyro @ gain.T + noise + bias))


def from_the_midst(log: Dataset) -> Dataset:
    """Begun 15 s into the motion, or 60 s where a magnet is on the sensor by then."""
    assert log.attitude is not None
    assert log.attitude.moving is not None
    first = int(np.flatnonzero(log.attitude.moving)[0])
    wait_s = 60.0 if "attached" in log.name else 15.0
    return rows_of(log, slice(first + int(wait_s * 285.7), None))


def changes() -> Iterator[tuple[str, Callable[[Dataset, int], Dataset]]]:
    """Changes of the trials, by name."""
    for size in (4.0, 8.0, 20.0, 100.0):
        yield (
            f"magnet of {size:g} uT",
            lambda log, k, size=size: with_magnet(log, size * 1e-6, 40 + k),
        )
    yield "57 Hz", lambda log, k: averaged(log, 5)
    yield "poor gyros", with_poor_gyros
    yield "start in motion", lambda log, k: from_the_midst(log)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    parser.add_argument("folder", nargs="?", default=os.environ.get("ROBINS_DATA", str(beside)))
    parser.add_argument("--made", action="store_true")
    given = parser.parse_args()
    trials = [read_broad(path) for path in sorted(Path(given.folder).glob("broad_*.npz"))]
    kinds = [("", lambda log, k: log), *(changes() if given.made else ())]
    words = ("total", "heading", "inclination")
    heads = ["", "marg", *words[1:], "VQF", "smoothed", *words[1:], "offline VQF"]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for kind, change in kinds:
        table = []
        for number, trial in enumerate(trials):
            log = change(trial, number)
            found = replay(log, MargReplay()).metrics
            own = [
                [found[name][f"{which}_rmse_deg"] for which in words]
                for name in ("marg", "marg-smoothed")
            ]
            peers = peer(log)
            table.append([*own[0], peers[0], *own[1], peers[1]])
            if not kind:
                label = trial.name.removeprefix("broad_").replace("_", " ")
                print(f"| {label} | " + " | ".join(f"{x:.2f}" for x in table[-1]) + " |")
        worst = f" (worst {max(r[0] for r in table):.1f}, VQF {max(r[3] for r in table):.1f})"
        mean = " | ".join(f"{x:.2f}" for x in np.mean(table, axis=0))
        print(f"| mean{', ' + kind if kind else ''}{worst} | {mean} |", flush=True)


if __name__ == "__main__":
    main()
