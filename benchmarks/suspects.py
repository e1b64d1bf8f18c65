"""Suspects of the default filters, against the faults of the scenarios.

    python benchmarks/suspects.py [SYSTEM/SCENARIO ...] [--runs 20] [--seed 0] [--out table.md]

Without a name, every simulated scenario of a system whose default is a bank of hypotheses. A row
is an instrument, or the motion: the share of its faults that were detected (probability above 0.5
within the fault), the median delay of that, and the share of the time without a fault at which the
probability was above 0.5. Probabilities, scales and offsets of the banks were chosen on seed 100;
some of transfer alignment with its scenarios B to D in view (docs/defaults.md).
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path
from typing import Any

from robins.cli.cache import enable

enable()  # programs are kept between calls; before JAX is imported

import numpy as np

from robins import scenario
from robins.campaign import simulate
from robins.systems import catalogue
from robins.systems.finding import find_system

FOUND, ACCUSED = "_faults_detected_share", "_false_alarm_share"
HEAD = (
    "| scenario | suspect | faults a run | detected | delay | false alarms |",
    "|---|---|---|---|---|---|",
)


def rows(name: str, runs: int, seed: int) -> list[str]:
    """The rows of a scenario; none where its default has no suspects."""
    system, _, label = name.partition("/")
    owner = find_system(system)
    text = owner.scenarios[label].read_text(encoding="utf-8")
    study = owner.studies[tomllib.loads(text).get("study") or next(iter(owner.studies))]
    given = scenario.parse(study.parameters, text, [], source=name)
    problem = study.problem(given, (owner.default,), seed)
    if not problem.contenders[owner.default].filter.suspects:
        return []
    found = simulate(problem, runs, machine="jax").metrics[owner.default]
    faults = {k: np.asarray(true) for k, true in (problem.faults or {}).items()}
    ends = FOUND, ACCUSED
    names = [key.removesuffix(end) for key in found for end in ends if key.endswith(end)]
    return [_row(name, one, faults.get(one), found) for one in dict.fromkeys(names)]


def _row(name: str, one: str, true: np.ndarray | None, found: dict[str, Any]) -> str:
    count = 0 if true is None else int(np.sum(np.diff(np.append(False, true).astype(int)) == 1))
    share, accused = found.get(one + FOUND), found.get(one + ACCUSED)
    after = found.get(f"{one}_detection_delay_s")
    cells = [
        name,
        one.replace("_", " "),
        str(count),
        "" if share is None else "cannot name it" if accused is None else f"{100 * share:.0f} %",
        "" if after is None else f"{after:.3g} s",
        "" if accused is None or (true is not None and np.all(true)) else f"{100 * accused:.1f} %",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    systems = ("airship", "satellite", "rocket", "ins-gnss", "transfer-alignment")
    every = [f"{s}/{k}" for s in systems for k in catalogue.listed(s)]
    table = list(HEAD)
    for name in asked.names or every:
        if not name.endswith("/replay"):
            made = rows(name, asked.runs, asked.seed)
            print(*made, sep="\n", flush=True)
            table += made
    if asked.out:
        asked.out.write_text("\n".join(table) + "\n")


if __name__ == "__main__":
    main()
