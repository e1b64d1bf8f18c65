"""Warnings of every packaged scenario, with why each is true: the table of docs/warnings.md.

python docs/studies/scenario_warnings.py FOLDER [--default] [--table] [SCENARIO ...]; 8 runs of
each, seed 43, with the default filter of its system and those that a scenario names. FOLDER keeps
one JSON file for each scenario; filters that are in it are not run again. At the end the table is
written of what the folder has.
"""

import argparse
import json
import re
from fnmatch import fnmatchcase
from pathlib import Path

from robins.cli import cache
from robins.systems.catalogue import SUMMARIES, listed

RUNS, SEED = 8, 43
PAGE = Path(__file__).resolve().parents[1] / "warnings.md"
MARK = "<!-- written by docs/studies/scenario_warnings.py -->\n"
SCENARIOS = [f"{system}/{name}" for system in SUMMARIES for name in listed(system)]
KINDS = {  # what a sentence has, and the words of the table
    "predictions are": "predictions not taken",
    "updates with '.*' are": "updates not taken",
    "were refused": "refused",
    "larger than the filter": "NIS high",
    "smaller than the filter": "NIS low",
    "innovations that follow": "following each other",
    "innovations on one side": "on one side",
    "in the last quarter of mean": "NIS late",
    "gave the same reading": "same reading",
    "beyond 3 sigma, before": "far off",
    "differed by more than": "local filters differ",
}
# Nothing fails, and the world is drawn from the assumptions of the best informed filter.
NOMINAL = [
    "ins-gnss/drive",
    *(f"transfer-alignment/{name}" for name in ("a", "aircraft", "ship", "vehicle", "s1")),
    *(f"airship/{name}" for name in ("matched", "s0", "s1", "s1c", "turbulence")),
    *(f"rocket/{name}" for name in ("a8", "b1n", "b4")),
    *(f"satellite/{name}" for name in ("s1", "stars")),
]
# Scenario, filter, sensor, warning: why it is true. The first row that fits is taken.
STIFF, OPEN, PAIR = (f"transfer-alignment/{name}" for name in ("s1", "a", "aircraft"))
UNIT = "R = I in {}, of records good to {}: it corrects its start slowly"
NOT_THERE = "its R counts flexure and outliers, which are not there"
REASONS = {
    (STIFF, "hinf-rad*", "*", "*"): UNIT.format("rad", "2.6 arcmin"),
    (STIFF, "hinf-deg*", "*", "*"): UNIT.format("deg", "2.6 arcmin"),
    (STIFF, "hinf-arcmin", "*", "*"): "gamma is below the least there is: hardly a step is taken",
    (STIFF, "kf", "*", "*"): "told 1 arcmin of noise, not the flutter of 2.4 arcmin",
    (STIFF, "hinf-weighted", "*", "*"): "told 1 arcmin of noise, not the flutter of 2.4 arcmin",
    (OPEN, "hinf-patent-weights", "*", "*"): "R = I in rad and m/s, far above the noise there is",
    (OPEN, "kf-told-[rb]*", "attitude_matching", "*"): NOT_THERE,
    (OPEN, "*", "velocity_matching", "*"): "open loop, its errors outgrow its linear model",
    (PAIR, "kf", "master_*", "*"): "has no states for the flexure",
    ("airship/*", "*", "*", "*"): "nine states, without the biases of gyros and accelerometers",
    ("rocket/a8", "magnetic-raw", "*", "*"): "its model stands still, and 10 rad a step cover that",
    ("rocket/a8", "federated-vector-ukf", "*", "*"): "its shares are no bound: errors of 8 sigma",
}


def named(name):
    """Names of the filters of a run, the default of the system first."""
    from robins.workbench.scenarios import (  # after `cache.enable`
        read_scenario,
        with_default_filter,
    )

    one = read_scenario(name, ())
    filters = dict.fromkeys((one.system.default, *with_default_filter(one)))
    return [n for n in filters if n in one.study.filters]


def add_runs(name, path, count):
    """Run the first filters of a scenario, so many, that its file does not have; write it."""
    from robins.workbench.run import run

    kept = json.loads(path.read_text()) if path.exists() else {"filters": [], "warnings": []}
    if missing := [n for n in named(name)[:count] if n not in kept["filters"]]:
        found = run(name, runs=RUNS, seed=SEED, filters=missing)
        kept["filters"] += list(found.metrics)
        kept["warnings"] += list(found.warnings)
        path.write_text(json.dumps(kept))
        print(f"{name}: {', '.join(missing)}; {len(found.warnings)} warnings", flush=True)


def shortened(sentence):
    """Filter, sensor and kind of a warning."""
    name, _, text = sentence.partition(": ")
    sensor = re.search("'(.*?)'", text)
    kind = next(short for words, short in KINDS.items() if re.search(words, text))
    return name, sensor[1] if sensor else "motion", kind


def reason(*of):
    """Reason why a warning is true, as far as it is known."""
    fits = (why for key, why in REASONS.items() if all(map(fnmatchcase, of, key)))
    return next(fits, "**not explained**")


def rows(name, found):
    """Rows of a scenario: what a filter is warned of by sensor, filters of which it is the same."""
    shown = f"`{name}`" + (", nominal" if name in NOMINAL else "")
    kinds, filters, silent = {}, {}, list(found["filters"])
    for one, sensor, kind in dict.fromkeys(map(shortened, found["warnings"])):
        silent = [n for n in silent if n != one]
        kinds.setdefault((one, sensor, reason(name, one, sensor, kind)), []).append(kind)
    for (one, sensor, why), of in kinds.items():
        filters.setdefault((f"{sensor}: {', '.join(of)}", why), []).append(one)
    for (warned, why), some in filters.items():
        yield f"| {shown} | {', '.join(some)} | {warned} | {why} |"
    missing = [n for n in named(name) if n not in found["filters"]]
    for some, what in ((silent, "none"), (missing, "not run yet")):
        if some:
            yield f"| {shown} | {', '.join(some)} | {what} | |"


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--default", action="store_true", help="run the default filters alone")
    parser.add_argument("--table", action="store_true", help="run nothing, write the table")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    paths = {name: given.folder / f"{name.replace('/', '+')}.json" for name in SCENARIOS}
    cache.enable()
    for name in () if given.table else given.scenarios:
        add_runs(name, paths[name], 1 if given.default else None)
    found = {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
    order = sorted(found, key=lambda name: name not in NOMINAL)
    lines = ["| scenario | filters | sensor: warning | true, because |", "|---|---|---|---|"]
    lines += [row for name in order for row in rows(name, found[name])]
    if missing := [f"`{name}`" for name in SCENARIOS if name not in found]:
        lines += ["", f"Not run yet: {', '.join(missing)}."]
    page = PAGE.read_text("utf-8").partition(MARK)[0]
    PAGE.write_text(page + MARK + "\n" + "\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    main()
