"""Settings of XLA: the time to compile a campaign against the time that it then takes.

For each system a batch of runs of one filter, in a process of its own for each setting; processor
time, so that other work on the machine counts little. Ratios are to XLA's own settings; below one
is faster.

    python benchmarks/compile.py [SETTING ...]
"""

import json
import os
import subprocess
import sys
import time
from statistics import geometric_mean

SETTINGS = {
    "xla": "",
    "emitters": "--xla_cpu_use_fusion_emitters=false",
    "split": "--xla_cpu_parallel_codegen_split_count=1",
    "level 1": "--xla_backend_optimization_level=1",
    "level 2": "--xla_backend_optimization_level=2",
    "emitters, split": "--xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1",
    "all, level 0": "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_optimization_level=0",
    "all, level 1": "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_optimization_level=1",
    "all, level 2": "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_optimization_level=2",
}
JOBS = {
    "transfer-alignment/aircraft": "product",
    "transfer-alignment/a": "kf",
    "airship/s0": "cukf-soft",
    "rocket/a1": "federated-vector-stukf",
    "satellite/s1": "mekf",
    "ins-gnss/drive": "ukf",
}
RUNS, REPEATS = 16, 3


def measure(job: str) -> dict[str, float]:
    """Seconds of processor to compile and to run once more, for the world and the filter."""
    from robins import scenario
    from robins.campaign.monte_carlo import record, worlds
    from robins.workbench.scenarios import find_scenario, study_of

    system, _, text = find_scenario(job)
    study = study_of(system, text, job)
    parameters = scenario.parse(study.parameters, text, [f"runs={RUNS}"], source=job)
    problem = study.problem(parameters, (JOBS[job],), 0)

    def spent(work) -> tuple[float, object]:
        begin = time.process_time()
        made = work()
        return time.process_time() - begin, made

    simulate, (world, count) = spent(lambda: next(worlds(problem, RUNS)))
    first, _ = spent(lambda: record(problem, JOBS[job], world, count))
    again = min(spent(lambda: record(problem, JOBS[job], world, count))[0] for _ in range(REPEATS))
    return {"world": simulate, "compile": first - again, "run": again}


def of(setting: str, job: str) -> dict[str, float]:
    """`measure` in a process of its own."""
    told = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    done = subprocess.run(
        [sys.executable, __file__, "--one", job],
        env=os.environ | told | {"XLA_FLAGS": SETTINGS[setting]},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    wanted = sys.argv[1:] or list(SETTINGS)
    base = {}
    print(f"{'setting':16} {'job':28} {'world':>12} {'compile':>12} {'run':>12}")
    for setting in dict.fromkeys(["xla", *wanted]):
        ratios = {"world": [], "compile": [], "run": []}
        for job in JOBS:
            found = of(setting, job)
            base.setdefault(job, found)
            row = ""
            for name, seconds in found.items():
                ratios[name].append(seconds / base[job][name])
                row += f" {seconds:6.2f} ({ratios[name][-1]:.2f})"
            print(f"{setting:16} {job:28}{row}", flush=True)
        means = "".join(f"        {geometric_mean(r):.2f}" for r in ratios.values())
        print(f"{setting:16} {'geometric mean':28}{means}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(measure(sys.argv[2])))
    else:
        main()
