"""Campaigns by batches of JAX on one core, and in lanes on all cores: what a run costs each.

Both are timed after they have compiled, over all that a campaign does but its report; the table
says how long compiling took, how far their RMS errors are apart, and the most memory in use.

    python benchmarks/campaigns.py [RUNS [SYSTEM ...]]
"""

import resource
import sys
import time
import tomllib

import numpy as np

from robins import scenario
from robins.campaign import Statistics
from robins.campaign.machine import ByJax, InLanes, available_cores
from robins.systems.finding import find_system

CAMPAIGNS = (
    ("transfer-alignment", "s0", "kf"),
    ("airship", "s1", "ukf"),
    ("ins-gnss", "drive", "ekf"),
)
WARM = 64  # runs that compile


def problem_of(system, name, filter_):
    found = find_system(system)
    text = found.scenarios[name].read_text()
    study = found.studies[tomllib.loads(text).get("study", next(iter(found.studies)))]
    return study.problem(scenario.parse(study.parameters, text, []), (filter_,), 0)


def timed(machine, runs):
    """Seconds to compile, seconds of all runs, and the RMS of the errors over the runs."""
    (name,) = machine.problem.contenders
    begun = time.perf_counter()
    for _, _, record in machine.chunks(WARM * available_cores()):  # chunks of the later shape
        record(name)
    compiled = time.perf_counter()
    found = Statistics(machine.problem.blocks)
    for _, _, record in machine.chunks(runs):
        found.add(record(name))
    done = time.perf_counter()
    return compiled - begun, done - compiled, found.rms


def main():
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print(f"{runs} runs; lanes on {available_cores()} cores")
    head = ("campaign", "JAX ms", "lanes ms", "ratio", "JAX s", "C++ s", "apart", "MB")
    print(f"{head[0]:34s}" + "".join(f"{h:>10s}" for h in head[1:]))
    for campaign in (c for c in CAMPAIGNS if c[0] in (sys.argv[2:] or c[0])):
        problem = problem_of(*campaign)
        slow_first, slow, want = timed(ByJax(problem), runs)
        fast_first, fast, got = timed(InLanes(problem), runs)
        size = np.max(np.abs(want), axis=0)
        apart = np.max(np.abs(got - want) / np.where(size > 0.0, size, 1.0))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
        numbers = (slow / runs * 1e3, fast / runs * 1e3, slow / fast, slow_first, fast_first)
        print(
            f"{'/'.join(campaign):34s}"
            + "".join(f"{x:10.2f}" for x in numbers)
            + f"{apart:10.1e}{memory:10.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
