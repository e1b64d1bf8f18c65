"""Do two versions of robins give the same results? All scenarios, all filters, and the real logs.

    python benchmarks/unchanged.py record OLDER/src older     # an hour and a half on one core
    python benchmarks/unchanged.py record src newer
    python benchmarks/unchanged.py compare older newer

A number of a result may differ by 1e-9 of the largest of its array, a verdict not at all. Both are
compiled alike, so that no other order of a sum hides what was changed. A result that is there
already is not computed again.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from robins import results

TOLERANCE = 1e-9
ALIKE = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
LISTED = re.compile(r"^  ((?:ins-gnss|gnss|transfer-alignment|airship|rocket|satellite)/\S+)", re.M)
EVERY = """
from robins.systems import SYSTEMS
from robins.systems.catalogue import listed
for name, system in SYSTEMS.items():
    for key, study in system.studies.items():
        first = [s for s, found in listed(name).items() if found.study in ("", key)][:1]
        print(*(f"{name}/{s} {','.join(study.filters)}" for s in first))
"""


SMOOTHED = "from robins.systems.ins_gnss.log import NAMES; print(*NAMES, sep=',')"


def commands(python: list[str], source: Path) -> dict[str, list[str]]:
    """Command lines to compare, by the name of their folder."""
    listed = subprocess.run([*python, "list"], capture_output=True, text=True, check=True).stdout
    found = {
        name.replace("/", "-"): ["run", name, "--runs", "2"] for name in LISTED.findall(listed)
    }
    every = subprocess.run([python[0], "-c", EVERY], capture_output=True, text=True, check=True)
    for line in filter(None, every.stdout.splitlines()):
        name, filters = line.split()
        filters = ",".join(f for f in filters.split(",") if not f.endswith("+rts"))
        words = ["run", name, "--runs", "2", "--filters", filters]
        found[f"every-{name.replace('/', '-')}"] = words
    walk = next(source.glob("robins/systems/ins_gnss/**/walk.toml"))
    logs = [DATA / f"gnssimu_walk_{kind}.xz" for kind in ("imu.csv", "gnss.pos")]
    # a filter that ends in +rts smooths a log; a campaign has none
    asked = subprocess.run([python[0], "-c", SMOOTHED], capture_output=True, text=True, check=True)
    found["walk"] = ["replay", *map(str, logs), str(walk), "--filters", asked.stdout.strip()]
    for log in sorted(DATA.glob("broad_*.npz")):
        found[log.stem] = ["replay", str(log), "--system", "marg"]
    return found


def record(source: Path, into: Path) -> int:
    """The results of all commands of a version, each in a folder of its name; 1 if one failed."""
    into.mkdir(parents=True, exist_ok=True)
    os.environ |= {"PYTHONPATH": str(source.resolve()), "XLA_FLAGS": ALIKE}
    python = [sys.executable, "-c", "from robins.cli import main; raise SystemExit(main())"]
    failed = 0
    for name, words in commands(python, source).items():
        out = into / name
        if not (out / "summary.json").exists():
            shutil.rmtree(out, ignore_errors=True)
            log = (into / f"{name}.log").open("w")
            done = subprocess.run([*python, *words, "--out", out], stdout=log, stderr=log)
            failed += done.returncode != 0
            print(f"{name}: status {done.returncode}", flush=True)
    return int(failed > 0)


def difference(old: np.ndarray, new: np.ndarray) -> float:
    """The largest, by the largest of the array; infinite where they are not alike."""
    if old.shape != new.shape or not np.issubdtype(old.dtype, np.number):
        return 0.0 if np.array_equal(old, new) else np.inf
    if not np.array_equal(np.isfinite(old), np.isfinite(new)):
        return np.inf
    finite = np.isfinite(old)
    scale = np.max(np.abs(old[finite]), initial=0.0) or 1.0
    return float(np.max(np.abs(old[finite] - new[finite]), initial=0.0) / scale)


def numbers(result: results.Result) -> dict[str, np.ndarray]:
    """Time series and metrics by name."""
    data = {} if result.solution is None else result.solution.data_vars
    metrics = {
        f"{name} {key}": np.array(value)
        for name, found in result.summary["filters"].items()
        for key, value in found.items()
    }
    return {str(name): array.values for name, array in data.items()} | metrics


def compare(older: Path, newer: Path) -> int:
    """Tell the largest difference of each result; 1 if one is not the same."""
    wrong, names = 0, {p.name for folder in (older, newer) for p in folder.iterdir() if p.is_dir()}
    for name in sorted(names):
        old, new = (results.read(folder / name) for folder in (older, newer))
        was, now = numbers(old), numbers(new)
        found = {k: difference(was[k], now[k]) for k in was.keys() & now.keys()}
        worst = max(found, key=lambda k: found[k])
        verdicts = [[(c["id"], c["verdict"]) for c in r.summary["claims"]] for r in (old, new)]
        only = was.keys() ^ now.keys()
        same = verdicts[0] == verdicts[1] and found[worst] <= TOLERANCE and not only
        wrong += not same
        told = f"{len(found)} arrays and numbers, at most {found[worst]:.1e} in {worst}"
        told += f", only in one: {', '.join(sorted(only))}" if only else ""
        print(f"{'same' if same else 'NOT THE SAME'}  {name}: {told}")
    print(f"{len(names) - wrong} of {len(names)} results are the same within {TOLERANCE:g}")
    return 1 if wrong else 0


if __name__ == "__main__":
    do = {"record": record, "compare": compare}[sys.argv[1]]
    raise SystemExit(do(*map(Path, sys.argv[2:4])))
