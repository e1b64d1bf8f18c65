"""Orientation after a gap: samples are taken out of trials where the unit turns fastest.

    python benchmarks/gaps.py --broad FOLDER --broad FOLDER

For each length of gap: of all trials the median and the worst error of attitude one second after
the gap and half a minute after it, in degrees, and the share of heading errors within three stated
sigmas in the minute after the gap.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from attitude_board import READERS

from robins.dataset import Dataset
from robins.filters import run
from robins.systems.marg import MargReplay, model_of, one_prior, prepare
from robins.systems.marg.model import HEADING
from robins.systems.marg.replay import orientation_errors, stated_sigma, truth_at

GAPS_S = (0.7, 1.0, 2.0, 5.0, 20.0)


def with_gap(log: Dataset, gap_s: float) -> tuple[Dataset, float]:
    """The log without inertial samples over a time in which it turns most, and the end of it [s].

    Half a minute before it and a minute after it are left.
    """
    time = (log.imu.time_ns - log.imu.time_ns[0]) * 1e-9
    turned = np.cumsum(np.linalg.norm(log.imu.gyro, axis=1))
    first = np.flatnonzero((time > 30.0) & (time < time[-1] - 60.0 - gap_s))
    last = np.searchsorted(time, time[first] + gap_s)
    k = int(np.argmax(turned[last] - turned[first]))
    keep = np.r_[0 : first[k] + 1, last[k] : len(time)]
    columns = {name: getattr(log.imu, name)[keep] for name in ("time_ns", "gyro", "accel")}
    return replace(log, imu=replace(log.imu, **columns, rows=None)), float(time[last[k]])


def main() -> None:
    """Print a row a length."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--broad", type=Path, action="append", required=True)
    trials = [t for folder in parser.parse_args().broad for t in READERS["broad"](folder)]
    p = MargReplay()
    print(f"| gap | 1 s after | 30 s after | within 3 sigmas |\n|{'---|' * 4}")
    for gap_s in GAPS_S:
        soon, later, within = [], [], []
        for trial in (t for t in trials if t.development):
            log, end_s = with_gap(trial.log, gap_s)
            made = prepare(log, p)
            w, u = made.world, made.world.u
            answer = run(one_prior(p), model_of(p), w.start, w.y, w.u, w.aux, machine="vm")
            belief = answer.steps.posterior
            assert log.attitude is not None
            true, _ = truth_at(log.attitude, made.time_ns[made.rows])
            errors = orientation_errors(np.asarray(belief.mean.q_nb.wxyz), true)
            turned, lasted = np.asarray(u.samples.angle), np.asarray(u.samples.dt_s)
            sigma = stated_sigma(np.asarray(belief.sigma), turned, lasted, p)[:, HEADING]
            after = made.epoch_s - end_s
            total = np.degrees(errors.total)
            soon.append(np.nanmedian(total[(after > 0.5) & (after < 1.5)]))
            later.append(np.nanmedian(total[(after > 25.0) & (after < 35.0)]))
            ratio = np.abs(errors.heading / sigma)[(after > 0.0) & (after < 60.0)]
            within.append(np.mean(ratio[np.isfinite(ratio)] < 3.0))
        cells = [f"{np.median(x):.1f}, worst {np.max(x):.1f} deg" for x in (soon, later)]
        print(
            f"| {gap_s:g} s | {' | '.join(cells)} | {100.0 * np.mean(within):.1f} % |", flush=True
        )


if __name__ == "__main__":
    main()
