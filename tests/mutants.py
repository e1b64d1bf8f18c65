"""Plants the faults of `mutants.toml`, one at a time, and says which tests catch each.

    python tests/mutants.py --commit v0.1.0 --out before.json
    python tests/mutants.py --before before.json --out after.json
    python tests/mutants.py --only gate-patience "wire-*"
    python tests/mutants.py --random 100 --seed 42 --select fast --out random.json
    python tests/mutants.py --rows random.json --tests tests/sim/test_orbit.py --resume

They are planted in a copy of the commit, never here. A fault is caught by a test that fails with
it and passes without it. Exit status 1 if one was not caught. `--random` draws faults
(`mutations.py`) instead of the table; its outcome holds their rows, so `--rows` plants the same
ones in a later commit.
"""

import argparse
import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from queue import Queue

import mutations

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_name("mutants.toml")
FAILED = Path(".pytest_cache/v/cache/lastfailed")
OUTSIDE = {  # what the caller may set otherwise
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "jax"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    "ROBINS_DATA": str(ROOT.parent / "shared" / "data"),
    "ROBINS_CASES": str(ROOT.parent / "shared" / "cases"),
}


def table() -> list[dict]:
    """The rows of `mutants.toml`."""
    return tomllib.loads(TABLE.read_text("utf-8"))["mutant"]


def planted(mutant: dict, root: Path) -> tuple[Path, str, list[str]]:
    """File of a planted fault, its text with the fault, and the tests that should see it.

    Raises ValueError if the fault has no place there.
    """
    for row in (mutant, mutant | mutant.get("before", {})):
        file = root / "src" / "robins" / row["file"]
        tests = [f"tests/{name}" for name in row["tests"]]
        text = file.read_text("utf-8") if file.exists() else ""
        if text.count(row["old"]) == 1 and all((root / name).exists() for name in tests):
            return file, text.replace(row["old"], row["new"]), tests
    raise ValueError(f"mutant {mutant['id']}: not just one `old` in {mutant['file']}, or no tests")


def copied(commit: str, folder: Path) -> Path:
    """The files of a commit in a new folder, with the environment of this one."""
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, stdout=-1, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    (folder / ".venv").symlink_to((ROOT / ".venv").resolve())
    return folder


def failing(root: Path, tests: list[str], given: argparse.Namespace, most: int) -> list[str]:
    """The tests that fail, up to so many; raises RuntimeError if pytest does not end well."""
    (root / FAILED).unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", f"--maxfail={most}", *tests]
    command += ["-m", given.select]
    process = subprocess.Popen(
        command,
        cwd=root,
        env=OUTSIDE | os.environ | {"PYTHONPATH": str(root / "src")},
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        status = process.wait(given.timeout)
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"the tests did not end within {given.timeout:g} s") from None
    finally:
        with suppress(ProcessLookupError):  # what the tests started ends with them
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if status not in (0, 1, 2, 5):  # 2: a file of tests that cannot be imported; 5: no test
        raise RuntimeError(f"pytest ended with status {status}")
    if status in (0, 5):
        return []
    return (
        sorted(json.loads((root / FAILED).read_text("utf-8"))) if (root / FAILED).exists() else []
    )


def seen_with(mutant: dict, root: Path, stamp: int, given: argparse.Namespace) -> list[str]:
    """The tests that fail while a fault is in its file."""
    file, text, tests = planted(mutant, root)
    whole, times = file.read_bytes(), file.stat()
    try:
        file.write_text(text, "utf-8")
        os.utime(file, (stamp, stamp))  # a time of its own, so that no bytecode outlives it
        return failing(root, given.tests or tests, given, given.maxfail)
    finally:
        file.write_bytes(whole)
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))


def tried(mutant: dict, root: Path, stamp: int, given: argparse.Namespace) -> dict:
    """Outcome of one fault: status, seconds, the tests that caught it, or why it was not run."""
    began, caught, why = time.monotonic(), [], ""
    try:
        seen = seen_with(mutant, root, stamp, given)
        sick = failing(root, seen, given, len(seen)) if seen else []
        caught = [test for test in seen if test not in sick]
        status = "caught" if caught else "SURVIVED"
    except (ValueError, RuntimeError) as error:
        status, why = "NOT RUN", str(error)
    seconds = round(time.monotonic() - began)
    return {"status": status, "seconds": seconds, "caught_by": caught, "why": why}


def rows(given: argparse.Namespace, root: Path) -> list[dict]:
    """Faults to plant: of the table, of an earlier outcome, or drawn from a commit in a folder."""
    if given.rows:
        return list(json.loads(given.rows.read_text("utf-8")).values())
    if given.random:
        return mutations.drawn(root / "src" / "robins", root / "tests", given.random, given.seed)
    return table()


def listed(due: list[dict], before: dict, done: dict) -> str:
    """A table of the faults, and of the first test that caught each in two commits."""
    lines = ["| fault | before | now |", "|---|---|---|"]
    for mutant in due:
        runs = (run.get(mutant["id"], {}) for run in (before, done))
        tests = ((run.get("caught_by") or [run.get("status", "not run")])[0] for run in runs)
        short = (f"`{test.removeprefix('tests/').partition('[')[0]}`" for test in tests)
        lines.append(f"| {mutant['what']} | {' | '.join(short)} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Plant, run, write down."""
    asked = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    asked.add_argument("--commit", default="HEAD")
    asked.add_argument("--only", nargs="+", default=["*"], metavar="ID", help="may hold * and ?")
    asked.add_argument("--jobs", type=int, default=1)
    asked.add_argument("--maxfail", type=int, default=5, help="tests after which a fault is left")
    asked.add_argument("--timeout", type=float, default=1800.0, help="of the tests of a fault [s]")
    asked.add_argument("--out", type=Path, default=ROOT / ".pytest_cache" / "mutants.json")
    asked.add_argument("--resume", action="store_true", help="leave out what --out holds already")
    asked.add_argument("--before", type=Path, help="outcome of an earlier commit to compare with")
    asked.add_argument("--page", type=Path, help="where to list the tests that caught each")
    asked.add_argument("--random", type=int, metavar="N", help="draw so many faults")
    asked.add_argument("--seed", type=int, default=42, help="of the draw")
    asked.add_argument("--rows", type=Path, help="an outcome whose faults to plant")
    asked.add_argument("--select", default="not certify", metavar="MARKS", help="as -m of pytest")
    asked.add_argument("--tests", nargs="+", help="files of tests; else those of each fault")
    given = asked.parse_args()
    done = json.loads(given.out.read_text("utf-8")) if given.resume and given.out.exists() else {}
    before = json.loads(given.before.read_text("utf-8")) if given.before else {}
    copies: Queue[Path] = Queue()

    def one(job: tuple[int, dict]) -> tuple[dict, dict]:
        root = copies.get()
        try:
            return job[1], tried(job[1], root, job[0], given)
        finally:
            copies.put(root)

    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
        for k in range(given.jobs):
            copies.put(copied(given.commit, Path(scratch) / str(k) / "robins"))
        drawn = rows(given, Path(scratch) / "0" / "robins")
        due = [m for m in drawn if any(fnmatch(m["id"], p) for p in given.only)]
        jobs = [(k, m) for k, m in enumerate(due, 1) if m["id"] not in done]
        with ThreadPoolExecutor(given.jobs) as pool:
            for mutant, found in pool.map(one, jobs):
                done[mutant["id"]] = {"commit": given.commit} | mutant | found
                given.out.parent.mkdir(parents=True, exist_ok=True)
                given.out.write_text(json.dumps(done, indent=1) + "\n", "utf-8")
                told = found["why"] or " ".join(found["caught_by"][:2])
                print(
                    f"{mutant['id']:28} {found['status']:8} {found['seconds']:4} s  {told}",
                    flush=True,
                )
    left = [m["id"] for m in due if done[m["id"]]["status"] != "caught"]
    if given.page:
        given.page.write_text(listed(due, before, done), "utf-8")
    print(f"{len(due) - len(left)} of {len(due)} caught")
    for name in left:
        was = " ".join(before.get(name, {}).get("caught_by", []))
        print(f"not caught: {name}" + (f", caught before by {was}" if was else ""))
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
