"""Campaigns by batches of JAX on one core, and in lanes on all cores: what a run costs each.

Both are timed after they have compiled, over all that a campaign does but its report; the table
says how long compiling took, how far the errors of the two are apart, and the most memory in use.

    python benchmarks/campaigns.py [RUNS]
"""

import resource
import sys
import time
import tomllib

import numpy as np

from robins import scenario
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
    """Seconds to compile, seconds of all runs, and the errors of all runs at the end."""
    begun = time.perf_counter()
    for _, _, record in machine.chunks(WARM):
        for name in machine.problem.contenders:
            record(name)
    compiled = time.perf_counter()
    errors = []
    for _, _, record in machine.chunks(runs):
        for name in machine.problem.contenders:
            errors.append(record(name)["error"][:, -1])
    done = time.perf_counter()
    return compiled - begun, done - compiled, np.concatenate(errors)


def main():
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print(f"{runs} runs; lanes on {available_cores()} cores")
    head = ("campaign", "JAX ms", "lanes ms", "ratio", "JAX s", "C++ s", "apart", "MB")
    print(f"{head[0]:34s}" + "".join(f"{h:>10s}" for h in head[1:]))
    for campaign in CAMPAIGNS:
        problem = problem_of(*campaign)
        slow_first, slow, want = timed(ByJax(problem), runs)
        fast_first, fast, got = timed(InLanes(problem), runs)
        size = np.max(np.abs(want), axis=0)
        apart = np.max(np.abs(got - want) / size)
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
