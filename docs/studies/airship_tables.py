"""Every filter of the airship study in every scenario: the tables of its page.

    python docs/studies/airship_tables.py [--runs 20] [--rate 100] [SCENARIO ...]

Mean and standard deviation over 200 to 800 s of the horizontal error, averaged over the runs. Takes
about half an hour on two cores, most of it compilation.
"""

from __future__ import annotations

import argparse
import time
import warnings

from robins import scenario
from robins.campaign import simulate
from robins.systems.airship import SYSTEM

STUDY = SYSTEM.studies["navigation"]


def main() -> None:
    """Print a table for each scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="*", default=list(SYSTEM.scenarios))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--rate", default="100", help="of the inertial unit [Hz]")
    parser.add_argument("--filters", default=",".join(STUDY.filters))
    given = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # what some filters warn of is shown here
    for name in given.scenarios:
        begun = time.perf_counter()
        text = SYSTEM.scenarios[name].read_text()
        parameters = scenario.parse(
            STUDY.parameters, text, (f'imu.rate="{given.rate} Hz"',), source=name
        )
        problem = STUDY.problem(parameters, tuple(given.filters.split(",")), seed=0)
        outcome = simulate(problem, given.runs)
        print(f"\n{name}: {parameters.title}, {given.runs} runs", flush=True)
        print(
            "filter                  position [m]   velocity [m/s]   NEES/n att/vel/pos, diverged"
        )
        for filter_, m in outcome.metrics.items():
            nees = " ".join(
                f"{m[key]:8.3g}"
                for key in ("nees_all_states", *(f"nees_{b.name}" for b in problem.blocks))
            )
            print(
                f"{filter_:22s} {m['horizontal_mean_m']:8.2f} / {m['horizontal_std_m']:6.2f}"
                f" {m['velocity_mean_m_s']:8.4f} / {m['velocity_std_m_s']:6.4f}"
                f"  {nees}  {m['diverged_runs']}",
                *(f"{m[k]:.1f}" for k in m if k.startswith("horizontal_rms_at")),
                flush=True,
            )
        for claim in outcome.claims:
            print(f"  {claim['id']:16s} {claim['verdict']:11s} {claim['value']:.4g}")
        print(f"  {time.perf_counter() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
