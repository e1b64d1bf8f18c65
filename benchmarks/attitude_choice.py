"""The defaults of MARG, chosen on two public sets and judged on the third.

    python benchmarks/attitude_choice.py --broad FOLDER --euroc FOLDER --repoimu FOLDER --found FILE

The sets and their references are those of `attitude_board.py`, development trials alone. Every
candidate of `GRID` runs over every trial; a set without magnetometer runs once for candidates that
differ in numbers of the field alone. What was found is kept in the file, a line a run, so that a
run that was interrupted goes on, and another grid costs only what is new in it.

The criterion: for a set, the mean causal error over that of VQF and the mean smoothed error over
that of offline VQF (total error, of EuRoC inclination), as published in docs/systems/marg.md. The
candidate with the smallest sum over two sets is judged on the third.

`start.north` says what north is, so it is no number that errors can choose: in BROAD the reference
is the field of the place where every trial begins, in the T-stick it is fitted to the mean field of
the trial. The table has both: chosen with it, and with north as the field of the start.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from attitude_board import READERS, Row, of_robins

from robins.systems.marg import Replay

# Means of VQF 2.1.2 and offline VQF over the same trials [deg], by `attitude_board.py`.
VQF = {"BROAD": (2.50, 1.97), "T-stick": (2.48, 1.27), "EuRoC": (5.52, 1.45)}
WAYS = ("robins", "robins smoothed")
SILENT_S = 5.0  # beyond three sigmas for longer than this, a run should warn

Candidate = dict[str, Any]  # "group.name" to a value with its unit
GRID: list[Candidate] = [
    {
        "gyro.gain": gain,
        "magnetometer.declination": bend,
        "magnetometer.declination_time": lasting,
        "start.north": north,
    }
    for north, gain, (bend, lasting) in product(
        ("start", "mean"),
        ("3000 ppm", "5000 ppm"),
        (("2.5 deg", "60 s"), ("3 deg", "20 s"), ("4 deg", "20 s")),
    )
]


def parameters_of(candidate: Candidate) -> Replay:
    """The defaults with some numbers changed."""
    groups: dict[str, dict[str, Any]] = {}
    for name, value in candidate.items():
        group, _, field = name.partition(".")
        groups.setdefault(group, {})[field] = value
    return Replay(**groups)  # type: ignore[arg-type]


def told(candidate: Candidate) -> str:
    return ", ".join(f"{name.split('.')[1]} {value}" for name, value in candidate.items())


def error(row: Row) -> float:
    """Total error, of six axes the inclination [deg]."""
    return row.inclination if np.isnan(row.total) else row.total


def relative(which: str, trials: Sequence[dict[str, Row]]) -> float:
    """The criterion of a set."""
    return sum(
        float(np.mean([error(rows[way]) for rows in trials])) / peer
        for way, peer in zip(WAYS, VQF[which], strict=True)
    )


def figures(trials: Sequence[dict[str, Row]]) -> str:
    """Cells of the table: mean and largest error both ways, NEES, and runs that are off unsaid."""
    cells = []
    for way in WAYS:
        errors = [error(rows[way]) for rows in trials]
        cells.append(f"{np.mean(errors):.2f} ({np.max(errors):.1f})")
    for way in WAYS:
        nees = np.array([rows[way].nees for rows in trials])
        inside = np.sum((nees > 0.5) & (nees < 2.0))
        there = not np.isnan(nees).any()
        cells.append(f"{np.mean(nees):.2f}, {inside} of {len(nees)}" if there else "")
    rows = [rows[way] for rows in trials for way in WAYS]
    silent = sum(row.beyond_s > SILENT_S and not row.warned for row in rows)
    cells.append(f"{silent}, {sum(row.warned for row in rows)} of {len(rows)}")
    return " | ".join(cells)


def main() -> None:
    """Run what has not been run, and print what was chosen."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name in READERS:
        parser.add_argument(f"--{name}", type=Path, action="append", default=[])
    parser.add_argument("--found", type=Path, required=True, help="results, a line a run")
    given = vars(parser.parse_args())
    trials = [
        t for name, reader in READERS.items() for folder in given[name] for t in reader(folder)
        if t.development
    ]  # fmt: skip
    kept = given["found"].read_text().splitlines() if given["found"].exists() else []
    found: dict[str, dict[str, Row]] = {}
    for text in kept:
        row = json.loads(text)
        found[row["key"]] = {way: Row(*row[way]) for way in WAYS}

    def key(trial: Any, candidate: Candidate) -> str:
        seen = {
            name: value
            for name, value in candidate.items()
            if not (trial.tilt_only and name.startswith(("magnetometer.", "start.north")))
        }
        return f"{trial.set} {trial.name}: {told(seen)}"

    with given["found"].open("a") as file:
        for candidate, trial in product(GRID, trials):
            name = key(trial, candidate)
            if name not in found:
                found[name] = of_robins(trial, parameters_of(candidate))
                line = {"key": name} | {way: list(found[name][way]) for way in WAYS}
                print(json.dumps(line, default=float), file=file, flush=True)

    sets = list(dict.fromkeys(trial.set for trial in trials))
    of = {
        (which, k): [found[key(t, candidate)] for t in trials if t.set == which]
        for which in sets
        for k, candidate in enumerate(GRID)
    }
    head = "causal | smoothed | NEES causal | NEES smoothed | silent, warned"
    print(f"| candidate, set | {head} |\n|{'---|' * 6}")
    for k, candidate in enumerate(GRID):
        for which in sets:
            print(f"| {told(candidate)}; {which} | {figures(of[which, k])} |")
    rules = {"north chosen too": list(range(len(GRID)))}
    rules["north of the start"] = [k for k, c in enumerate(GRID) if c["start.north"] == "start"]
    print(f"\n| judged on | chosen on the others | {head} |\n|{'---|' * 7}")
    for name, able in rules.items():
        for judged in [*sets, "none"]:
            others = [which for which in sets if which != judged]
            best = min(able, key=lambda k: sum(relative(w, of[w, k]) for w in others))
            for which in [judged] if judged in sets else sets:
                title = f"{which}" if judged in sets else f"{which} (in-sample: all sets chose)"
                cells = figures(of[which, best])
                print(f"| {title} | {name}: {told(GRID[best])} | {cells} |")


if __name__ == "__main__":
    main()
