"""Nodes of a step in C, of every filter of the first scenario of each study; two versions compared.

    PYTHONPATH=OLDER/src python benchmarks/nodes.py older.json [SYSTEM ...]
    PYTHONPATH=src python benchmarks/nodes.py newer.json [SYSTEM ...]
    python benchmarks/nodes.py compare older.json newer.json

A node is one operation on scalars that a result needs, counted as it is written: the body of a
loop counts once, and a loop of few operations is written out. A filter that is in the file already
is not traced again.
"""

import json
import sys
import time
from pathlib import Path

from robins.export.runs import board_runs, entry_functions
from robins.program import trace_steps
from robins.systems import SYSTEMS
from robins.systems.catalogue import listed
from robins.workbench.scenarios import read_scenario


def nodes(scenario: str, name: str) -> dict[str, int]:
    """Numbers of nodes of the programs, by entry point."""
    problem = read_scenario(scenario, ("runs=1",)).problem((name,), 1)
    contender = problem.contenders[name]
    run = board_runs(problem, name, 1)[0]
    functions = entry_functions(contender.filter, contender.model, run.given)
    first = run.row(0)
    programs = trace_steps([(functions[e], first[e]) for e in functions], run.start)
    return {e: len(p.live) for e, p in zip(functions, programs, strict=True)}


def record(path: Path, systems: list[str]) -> None:
    """Count, and write the file after each filter."""
    found = json.loads(path.read_text()) if path.exists() else {}
    for system in systems or SYSTEMS:
        for key, study in SYSTEMS[system].studies.items():
            scenarios = [s for s, about in listed(system).items() if about.study in ("", key)]
            for name in study.filters if scenarios else ():
                label, begun = f"{system}/{scenarios[0]} {name}", time.process_time()
                if label in found:
                    continue
                try:
                    found[label] = nodes(label.split()[0], name)
                except Exception as error:
                    found[label] = f"{type(error).__name__}: {error}".splitlines()[0]
                path.write_text(json.dumps(found, indent=1))
                print(f"{time.process_time() - begun:6.1f} s  {label}  {found[label]}", flush=True)


def compare(older: Path, newer: Path) -> None:
    """Print the sums side by side; those that have grown are marked."""
    was, now = (json.loads(p.read_text()) for p in (older, newer))
    for label in sorted(was.keys() | now.keys()):
        sums = [sum(c.values()) if isinstance(c := f.get(label), dict) else 0 for f in (was, now)]
        print(f"{label:60s} {sums[0]:9d} {sums[1]:9d} {'more' if sums[1] > sums[0] else ''}")


if __name__ == "__main__":
    if sys.argv[1] == "compare":
        compare(*map(Path, sys.argv[2:4]))
    else:
        record(Path(sys.argv[1]), sys.argv[2:])
