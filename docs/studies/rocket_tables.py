"""Every filter of the rocket in every scenario: the tables of its page, and the held-out check.

    python docs/studies/rocket_tables.py [--runs 50] [--filters all] [SCENARIO ...] [--held-out]

RMS errors over t > 30 s, pooled over runs. With --held-out the discriminator, whose numbers were
chosen on A1, A2 and A4, meets a slower spin, and bursts longer and larger than those. All of it
takes about an hour on two cores, most of it compilation.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from robins import scenario
from robins.campaign import simulate
from robins.systems.rocket import SYSTEM

ANGLES = ("attitude_rms_deg", "quiet_rms_deg", "burst_peak_deg", "nees_attitude", "settled_s")
FIELD = ("total_rms_deg", "about_field_rms_deg", "across_field_rms_deg", "about_field_end_deg")
BY_AXIS = ("roll_rms_deg", "pitch_rms_deg", "yaw_rms_deg")

SLOW = ('body.spin="25 deg/s"', 'body.cone="5 deg"')
LONGER = ('magnetometer.disturbance.angle="8 deg"', 'magnetometer.disturbance.length="2 s"')
LONGEST = ('magnetometer.disturbance.length="5 s"',)
HELD_OUT: dict[str, tuple[str, ...]] = {
    "new seed": (),
    "spin 25 deg/s, cone 5 deg": SLOW,
    "bursts 2 s, 8 deg": LONGER,
    "bursts 5 s, longer than patience": LONGEST,
}
CHECKED = (
    *("ukf", "huber", "gate", "stukf", "federated-vector-stukf"),
    *("discriminator", "federated-root-discriminator"),
)


def campaign(name: str, filters: tuple[str, ...], runs: int, seed: int, settings=()) -> Any:
    """Outcome of a packaged scenario."""
    text = SYSTEM.scenarios[name].read_text()
    study = SYSTEM.studies[scenario.mapping_of(text)["study"]]
    given = scenario.parse(study.parameters, text, settings, source=name)
    chosen = study.filters if filters == ("all",) else filters or given.filters
    return given, simulate(study.problem(given, chosen, seed), runs)


def table(name: str, filters: tuple[str, ...], runs: int) -> None:
    """Print a scenario."""
    begun = time.perf_counter()
    given, outcome = campaign(name, filters, runs, seed=0)
    angles = given.study == "magnetic-attitude"
    keys = (*ANGLES, *BY_AXIS) if angles else (*FIELD, "attitude_rms_deg", "nees_attitude")
    print(f"\n{name}: {given.title}, {runs} runs")
    print("| filter | " + " | ".join(key.removesuffix("_deg") for key in keys) + " |")
    print("|---" * (len(keys) + 1) + "|")
    for filter_, m in outcome.metrics.items():
        print(
            f"| `{filter_}` | " + " | ".join(f"{m.get(k, float('nan')):.3g}" for k in keys) + " |"
        )
    for claim in outcome.claims:
        print(f"  {claim['id']:26s} {claim['verdict']:11s} {claim['value']:.3g}")
    print(*outcome.notes, f"{time.perf_counter() - begun:.0f} s", sep="\n", flush=True)


def held_out(runs: int) -> None:
    """Print the check: no model error / 2 % in all coefficients."""
    print("\n| case | " + " | ".join(f"`{name}`" for name in CHECKED) + " |")
    print("|---" * (len(CHECKED) + 1) + "|")
    for label, settings in HELD_OUT.items():
        both = [
            campaign(name, CHECKED, runs, 1000, (*settings, 'duration="120 s"'))[1].metrics
            for name in ("a1", "a2")
        ]
        cells = [
            " / ".join(f"{metrics[name]['attitude_rms_deg']:.3f}" for metrics in both)
            for name in CHECKED
        ]
        print(f"| {label} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print a table for each scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="*", default=list(SYSTEM.scenarios))
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--filters", default="all", help="names, or all, or empty: as the scenario")
    parser.add_argument("--held-out", action="store_true", help="only the held-out check")
    given = parser.parse_args()
    if given.held_out:
        held_out(min(given.runs, 20))
        return
    for name in given.scenarios:
        table(name, tuple(filter(None, given.filters.split(","))), given.runs)


if __name__ == "__main__":
    main()
