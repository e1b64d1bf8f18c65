"""Campaigns by batches of JAX on one core, and in lanes on all cores: what a run costs each.

Both are timed after they have compiled, over all that a campaign does but its report; the table
says how long compiling took, how far their RMS errors are apart, and the most memory in use.

    python benchmarks/campaigns.py [RUNS [SYSTEM ...]]
    python benchmarks/campaigns.py --memory
    python benchmarks/campaigns.py --linear
    python benchmarks/campaigns.py --compile

The second measures the most memory in use by a campaign of an alignment, over truth steps and
runs, and of the drive, each in a process of its own: of its set-up, and of all. The third times an
alignment over truth steps and over runs, after it has compiled. The fourth compiles each loop of
some campaigns, in seconds of the compiler by node, for `robins.campaign.compilation`.
"""

import resource
import subprocess
import sys
import time
import tomllib
from functools import partial

import numpy as np

from robins import scenario
from robins.campaign import Statistics, simulate
from robins.campaign.compilation import LOOP_S
from robins.campaign.machine import JaxMachine, LaneMachine, available_cores
from robins.systems.finding import find_system

CAMPAIGNS = (
    ("transfer-alignment", "s0", "kf"),
    ("airship", "s1", "ukf"),
    ("ins-gnss", "drive", "ekf"),
)
WARM = 64  # runs that compile
in_c = partial(LaneMachine, name="c")


ALIGNMENT, DRIVE = CAMPAIGNS[0], CAMPAIGNS[2]
MEMORY = (  # machine, truth steps, runs
    ("c", 1_000, 100), ("c", 1_000, 1_000), ("c", 10_000, 100), ("c", 100_000, 32),
    ("jax", 1_000, 100), ("jax", 10_000, 100), ("c", "drive", 128),
)  # fmt: skip


def problem_of(system, name, filter_, *settings):
    found = find_system(system)
    text = found.scenarios[name].read_text()
    study = found.studies[tomllib.loads(text).get("study", next(iter(found.studies)))]
    return study.problem(scenario.parse(study.parameters, text, settings), (filter_,), 0)


def added(blank, name, record):
    """The statistics of a chunk."""
    found = blank()
    found.add(record)
    return found


def timed(machine, runs):
    """Seconds to compile, seconds of all runs, and the RMS of the errors over the runs."""
    (name,) = machine.problem.contenders
    begun = time.perf_counter()
    for _, _, record in machine.chunks(WARM * available_cores()):  # chunks of the later shape
        record(name)
    compiled = time.perf_counter()
    found = Statistics(machine.problem.blocks)
    for _, _, statistics in machine.chunks(runs, taken=partial(added, found.blank)):
        found.merge(statistics(name))
    done = time.perf_counter()
    return compiled - begun, done - compiled, found.rms


def used():
    """The most memory that this process had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def one_campaign(machine, steps, runs):
    """Megabytes of the set-up, and of a whole campaign, of so many truth steps of 0.01 s."""
    if steps == "drive":
        problem = problem_of(*DRIVE)
    else:
        duration = f"manoeuvre.duration={0.01 * int(steps)} s"
        problem = problem_of(*ALIGNMENT, duration, "settle=5 s")
    before = used()
    simulate(problem, int(runs), machine=machine)
    print(f"{machine:>8s}{steps:>10s}{runs:>8s}{before:>10.0f}{used():>10.0f}")


def memory():
    print(f"{'machine':>8s}{'steps':>10s}{'runs':>8s}{'set-up':>10s}{'all':>10s}  [MB]", flush=True)
    for row in MEMORY:
        subprocess.run([sys.executable, __file__, "--one", *map(str, row)], check=True)


LINEAR = (  # truth steps, runs
    (1_000, 100), (1_000, 1_000), (1_000, 10_000), (1_000, 100_000),
    (10_000, 1_000), (100_000, 1_000),
)  # fmt: skip
LINEAR_BY_JAX = ((1_000, 128), (1_000, 1_024), (10_000, 128), (100_000, 128))


def linear():
    """Microseconds a truth step of one run, which are the same where the time is linear."""
    print(
        f"{'machine':>8s}{'steps':>8s}{'runs':>8s}{'time [s]':>12s}{'a step [us]':>14s}{'MB':>8s}"
    )
    for made, sizes in ((in_c, LINEAR), (JaxMachine, LINEAR_BY_JAX)):
        for steps, runs in sizes:
            duration = f"manoeuvre.duration={0.01 * steps} s"
            problem = problem_of(*ALIGNMENT, duration, "settle=5 s")
            machine = made(problem)
            _, spent, _ = timed(machine, runs)
            each = spent / (steps * runs) * 1e6
            row = f"{machine.name:>8s}{steps:8d}{runs:8d}{spent:12.2f}{each:14.3f}{used():8.0f}"
            print(row, flush=True)


def compile_loops():
    """Seconds of the compiler for each loop, and milliseconds for a node beside `LOOP_S`."""
    print(f"{'campaign':34s}{'nodes':>8s}{'compiler [s]':>14s}{'a node [ms]':>14s}")
    for campaign in (*CAMPAIGNS, ("rocket", "a1", "ukf")):
        machine = LaneMachine(problem_of(*campaign))
        simulate(machine.problem, 8, machine=machine)
        for loop in machine._hand_over._loops:
            before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
            loop.hand_over()
            took = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
            node = (took - LOOP_S) / loop.nodes * 1e3
            row = f"{'/'.join(campaign):34s}{loop.nodes:8d}{took:14.2f}{node:14.2f}"
            print(row if took else f"{row}  from the cache", flush=True)


def main():
    if sys.argv[1:] == ["--compile"]:
        return compile_loops()
    if sys.argv[1:] == ["--linear"]:
        return linear()
    if sys.argv[1:2] == ["--one"]:
        return one_campaign(*sys.argv[2:])
    if sys.argv[1:] == ["--memory"]:
        return memory()
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print(f"{runs} runs; lanes on {available_cores()} cores")
    head = ("campaign", "JAX ms", "lanes ms", "ratio", "JAX s", "C++ s", "apart", "MB")
    print(f"{head[0]:34s}" + "".join(f"{h:>10s}" for h in head[1:]))
    for campaign in (c for c in CAMPAIGNS if c[0] in (sys.argv[2:] or c[0])):
        problem = problem_of(*campaign)
        slow_first, slow, want = timed(JaxMachine(problem), runs)
        fast_first, fast, got = timed(in_c(problem), runs)
        size = np.max(np.abs(want), axis=0)
        apart = np.max(np.abs(got - want) / np.where(size > 0.0, size, 1.0))
        numbers = (slow / runs * 1e3, fast / runs * 1e3, slow / fast, slow_first, fast_first)
        print(
            f"{'/'.join(campaign):34s}"
            + "".join(f"{x:10.2f}" for x in numbers)
            + f"{apart:10.1e}{used():10.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
