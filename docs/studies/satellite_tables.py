"""Every filter of the satellite in every scenario: the tables of its page.

    python docs/studies/satellite_tables.py [--runs 24] [--filters all] [SCENARIO ...]

Errors over the epochs that count, pooled over runs, in arcsec. All of it takes about a quarter of
an hour on two cores.
"""

from __future__ import annotations

import argparse
import time

from robins import scenario
from robins.campaign import simulate
from robins.systems.satellite import SYSTEM

KEYS = (
    *("attitude_rms_arcsec", "attitude_rms_spread_arcsec", "pointing_rms_arcsec"),
    *("x_rms_arcsec", "y_rms_arcsec", "z_rms_arcsec", "attitude_peak_arcsec"),
    *("pointing_peak_arcsec", "nees_attitude", "predicted_rms_arcsec", "worst_case_share"),
)


def table(name: str, filters: tuple[str, ...], runs: int | None, settings: tuple[str, ...]) -> None:
    """Print a scenario."""
    begun = time.perf_counter()
    study = SYSTEM.studies["attitude-loop"]
    given = scenario.parse(
        study.parameters, SYSTEM.scenarios[name].read_text(), settings, source=name
    )
    chosen = study.filters if filters == ("all",) else filters or given.filters
    count = runs or given.runs
    outcome = simulate(study.problem(given, chosen, 0), count)
    print(f"\n{name}: {given.title}, {count} runs{''.join(f', {s}' for s in settings)}")
    print("| filter | " + " | ".join(key.removesuffix("_arcsec") for key in KEYS) + " |")
    print("|---" * (len(KEYS) + 1) + "|")
    for filter_, m in outcome.metrics.items():
        cells = (f"{m.get(key, float('nan')):.4g}" for key in KEYS)
        print(f"| `{filter_}` | " + " | ".join(cells) + " |")
    for claim in outcome.claims:
        print(f"  {claim['id']:26s} {claim['verdict']:11s} {claim['value']:.3g}")
    refused = {k: v for k, v in outcome.counts.items() if k.endswith("refused")}
    print(f"  refused {refused}   {time.perf_counter() - begun:.0f} s", flush=True)


def main() -> None:
    """Print a table for each scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="*", default=list(SYSTEM.scenarios))
    parser.add_argument("--runs", type=int, help="as the scenario says")
    parser.add_argument("--filters", default="", help="names, or all; as the scenario says")
    parser.add_argument("--set", action="append", default=[], metavar="key=value")
    given = parser.parse_args()
    names = tuple(filter(None, given.filters.split(",")))
    for name in given.scenarios:
        table(name, names, given.runs, tuple(given.set))


if __name__ == "__main__":
    main()
