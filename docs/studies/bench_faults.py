"""The faults of the specification over the wire, with and without the gate, as a table.

    python docs/studies/bench_faults.py [--runs 2] [--seconds 900] [--cases wrong,stuck]

Every run is a whole bench: seven processes, lock-step, the fault injected on the link of the star
sensor or the actuators at 600 s. Figures are those of `robins bench up`.
"""

import argparse
import math

import numpy as np

from robins.bench.rigs.satellite import RIG, judging
from robins.bench.rigs.satellite.reference import reference_q_ib
from robins.bench.run import Session
from robins.bench.run.outcome import figures, run_figures
from robins.bench.run.setup import changed, read

DEG = math.pi / 180.0
# fault, figure, band without and with the gate: the specification's, times and over 1.3 for peaks
CASES = {
    "none": (None, "attitude_peak", 20.0, 20.0),
    "sign": ({"kind": "sign"}, "attitude_peak", 20.0, 20.0),
    "lost": ({"kind": "lost"}, "attitude_end", 150.0, 150.0),
    "wrong": ({"kind": "turned", "angle": 10.0 * DEG, "end": 600.5}, "attitude_peak", 1068.0, 20.2),
    "stuck": ({"kind": "stuck", "end": 660.0}, "attitude_peak", 33974.0, 37.6),
    "wheel": ({"kind": "wheel", "wheel": 0}, "pointing_peak", 28.7, None),
}


def flown(case: str, filter_: str, seed: int, seconds: float) -> dict:
    fault = CASES[case][0]
    faults = () if fault is None else (RIG.fault(**{"begin": 600.0, **fault}),)
    flight = read("satellite/s1")
    options = {"filter": filter_, "seed": seed, "seconds": seconds, "faults": faults}
    flight = changed(flight, options)
    ran = Session(flight).run()
    assert not ran.failure, ran.failure
    told = figures(flight, ran, run_figures(flight, ran), None)
    # As in the specification: peaks and figures of the time from the fault on.
    after = slice(round(600.0 / flight.given.step), None)
    error = judging.attitude_error(ran.series)
    wanted = reference_q_ib(ran.config, ran.series, ran.steps)
    pointing = judging.turn(wanted, ran.series["motion.q_ib"])
    return told | {
        "attitude_peak": judging.peak_arcsec(error, after),
        "attitude_end": told["attitude_end_arcsec"],
        "pointing_peak": judging.peak_arcsec(pointing, after),
    }


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--runs", type=int, default=2)
    ask.add_argument("--seconds", type=float, default=900.0)
    ask.add_argument("--cases", default=",".join(CASES))
    asked = ask.parse_args()
    print("| fault | figure [arcsec] | reference | MEKF | refused | reference | gate | refused |")
    print("|---|---|---|---|---|---|---|---|")
    for case in asked.cases.split(","):
        _, figure, plain, gated = CASES[case]
        cells = []
        for filter_, reference in (("mekf", plain), ("mekf-gate", gated)):
            if reference is None:
                cells += ["-", "-", "-"]
                continue
            runs = [flown(case, filter_, seed, asked.seconds) for seed in range(asked.runs)]
            values = [run[figure] for run in runs]
            refused = np.mean([run["counts"]["refused_measurements"] for run in runs])
            cells += [f"{reference:g}", f"{np.mean(values):.4g}", f"{refused:g}"]
        print(f"| {case} | {figure.replace('_', ' ')} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
