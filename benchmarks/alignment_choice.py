"""Choice of the numbers of the default filter of transfer alignment.

    python benchmarks/alignment_choice.py [--runs 8] [--seed 100]

The RMS length of the attitude error ['] of `adaptive` on A to D and on an aircraft whose structure
is another than any filter believes, for some factors of the gyros and structures; the choice is
the least mean of the logarithms among those that no scenario has. Figures of the filter are quoted
on other random numbers (`benchmarks/defaults.py`). A row takes one to three minutes.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

from robins.cli.cache import enable

enable()  # programs are kept between calls; before JAX is imported

import numpy as np
from defaults import STRUCTURES, problem_of, score

from robins.campaign.monte_carlo import worlds
from robins.systems.transfer_alignment.product import filters
from robins.systems.transfer_alignment.product.filters import KICKED, QUIET, NoiseHypothesis
from robins.systems.transfer_alignment.product.parameters import Structure

WHERE = (
    *((f"transfer-alignment/{name}", ()) for name in "abcd"),
    *(("transfer-alignment/aircraft", changes) for changes in STRUCTURES.values()),
)


class Candidate(NamedTuple):
    """Numbers of the bank."""

    gyro: float  # times the stated noise of the gyros
    sigma_arcmin: float  # of the structure
    time_s: float

    def take(self) -> None:
        """The package has these numbers from here on."""
        noisy = NoiseHypothesis(gyro=self.gyro)
        modes = QUIET, noisy, noisy._replace(walk=self.gyro)
        filters._STIFF_MODES, filters._FLEXING_MODES = modes, (QUIET, KICKED, *modes[1:])
        sigma, time = math.radians(self.sigma_arcmin / 60.0), self.time_s
        filters.UNKNOWN = Structure(sigma=(sigma,) * 3, time=(time,) * 3)


CANDIDATES = (
    *(Candidate(20.0, 10.0, 3.0), Candidate(20.0, 10.0, 5.0), Candidate(15.0, 10.0, 5.0)),
    *(Candidate(30.0, 10.0, 5.0), Candidate(10.0, 10.0, 3.0)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description="How the numbers of the default were chosen.")
    parser.add_argument("--runs", type=int, default=8, help="of each scenario")
    parser.add_argument("--seed", type=int, default=100, help="of the random numbers")
    parser.add_argument("--candidates", type=int, default=len(CANDIDATES), help="the first ones")
    asked = parser.parse_args()
    print("| gyros, structure | A | B | C | D | 20' in 6 s | 3' in 0.4 s | mean log |")
    print("|---" * (len(WHERE) + 2) + "|")
    for one in CANDIDATES[: asked.candidates]:
        one.take()
        errors = []
        for where, changes in WHERE:
            problem = problem_of(where, asked.seed, changes, scales=())
            runs = list(worlds(problem, asked.runs, asked.runs))
            errors.append(score(problem, "adaptive", "attitude", runs).error)
        cells = [f"{one.gyro:g} times, {one.sigma_arcmin:g}' in {one.time_s:g} s"]
        cells += [f"{error:.2f}" for error in (*errors, np.mean(np.log(errors)))]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
