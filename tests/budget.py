"""Budget of the tests and of the promised commands: counts and seconds against their ceilings.

    python tests/budget.py            print the tables; exit status 1 if a ceiling is passed
    python tests/budget.py --lower    write lower ceilings into `budget.toml`

`costs.json` holds what each file of tests cost when `make costs` measured it (`meter.py` says how),
`budget.toml` the ceilings by room. Ceilings go down and never up: who adds cost to a room removes
as much there or moves it to `make certify`.
"""

import json
import math
import re
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

HERE = Path(__file__).parent
COSTS, CEILINGS = HERE / "costs.json", HERE / "budget.toml"
COUNTS = ("programs", "processes", "builds", "runs")
LEAST_S = 0.2  # of a test that is worth a line of its own
# Which of two rooms compiles a shared function first depends on the order of files.
ROOM = 1.08

Found = dict[str, Counter[str]]
Ceilings = dict[str, dict[str, int]]


def costs() -> dict:
    """Measurements: "files", and of the whole run "modules", "peak_mib" and "seconds".

    Seconds are the sum of all files, so that they are as new as each of them.
    """
    measured = json.loads(COSTS.read_text("utf-8"))
    return measured | {"seconds": sum(row["seconds"] for row in measured["files"].values())}


def ceilings() -> dict:
    """Ceilings: "whole", "rooms" and "commands"."""
    return tomllib.loads(CEILINGS.read_text("utf-8"))


def room_of(file: str) -> str:
    """Room of a file of tests: its folder, "tests" for those without one."""
    return file.split("/")[0] if "/" in file else "tests"


def by_room(files: dict[str, Iterable[dict[str, float]]]) -> Found:
    """Sums of counts and seconds by room."""
    rooms: Found = {}
    for file, rows in files.items():
        for row in rows:
            rooms.setdefault(room_of(file), Counter()).update(row)
    return rooms


def recorded() -> Found:
    """Sums of the records by room."""
    files = costs()["files"]
    return by_room({f: [{k: row[k] for k in (*COUNTS, "seconds")}] for f, row in files.items()})


def passed(found: Found, most: Ceilings, kinds: Iterable[str]) -> list[str]:
    """A sentence for each ceiling that is passed."""
    return [
        f"{name}: {counts[kind]:.0f} {kind}, over the ceiling of {most.get(name, {}).get(kind, 0)}"
        for name, counts in sorted(found.items())
        for kind in kinds
        if counts[kind] > most.get(name, {}).get(kind, 0)
    ]


def of_the_whole(measured: dict, most: dict[str, int]) -> list[str]:
    """A sentence for each ceiling of the whole run that is passed."""
    return [
        f"whole run: {measured[kind]:.0f} {kind}, over the ceiling of {limit}"
        for kind, limit in most.items()
        if measured[kind] > limit
    ]


def verdict() -> list[str]:
    """Ceilings that the records pass."""
    most = ceilings()
    kinds = (*COUNTS, "seconds")
    return of_the_whole(costs(), most["whole"]) + passed(recorded(), most["rooms"], kinds)


def rows(found: Found, most: Ceilings, kinds: tuple[str, ...]) -> list[str]:
    """A table in Markdown, each cell a figure and its ceiling."""
    lines = ["| | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for name, counts in sorted(found.items()):
        cells = (f"{counts[k]:.0f} of {most.get(name, {}).get(k, 0)}" for k in kinds)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def table() -> str:
    """Rooms with their figures and ceilings, and the whole run, in Markdown."""
    measured, most = costs(), ceilings()
    whole = {k: f"{measured[k]:.0f} of {limit}" for k, limit in most["whole"].items()}
    lines = rows(recorded(), most["rooms"], (*COUNTS, "seconds"))
    lines += ["", "The whole run: " + ", ".join(f"{k} {v}" for k, v in whole.items()) + "."]
    return "\n".join(lines) + "\n"


def commands() -> str:
    """Promised commands and their ceilings, in Markdown."""
    kinds = ("programs", "processes", "builds", "runs", "modules")
    lines = ["| command | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for name, most in ceilings()["commands"].items():
        lines.append(f"| `{name}` | {' | '.join(str(most[k]) for k in kinds)} |")
    return "\n".join(lines) + "\n"


def written(most: dict) -> str:
    """`budget.toml`."""
    head = """\
# Ceilings of `make test` and of the promised commands; tests/budget.py prints them beside what was
# measured. They go down and never up: tests/test_budget.py compares them with earlier commits.
# Seconds are of processor, from an empty cache, as on the machine of tests/meter.py.
"""
    parts = [head, "[whole]\n" + "".join(f"{k} = {v}\n" for k, v in most["whole"].items())]
    for part in ("rooms", "commands"):
        lines = (
            f'"{name}" = {{ {", ".join(f"{k} = {v}" for k, v in row.items())} }}\n'
            for name, row in most[part].items()
        )
        parts.append(f"[{part}]\n" + "".join(lines))
    return "\n".join(parts)


def lowered(most: dict) -> dict:
    """The lesser of each ceiling and of what was measured with its margin."""
    rooms = {}
    for room, counts in sorted(recorded().items()):
        was = most["rooms"].get(room, {})
        found = {k: math.ceil(counts[k] * ROOM) for k in COUNTS}
        found["seconds"] = math.ceil(counts["seconds"] * 1.25)  # machines differ in what is dear
        rooms[room] = {k: min(n, was.get(k, n)) for k, n in found.items()}
    return most | {"rooms": rooms}


def earlier(*names: str) -> list[list[dict]]:
    """Tables of this folder in earlier commits; none where git or its history is missing."""

    def git(*words: str, told: str = "") -> str:
        done = subprocess.run(["git", *words], cwd=HERE, input=told, capture_output=True, text=True)
        return "" if done.returncode else done.stdout

    if shutil.which("git") is None:
        return [[] for _ in names]
    commits = git("log", "--format=%H", "-20", "--", *names).split()
    asked = "".join(f"{commit}:tests/{name}\n" for name in names for commit in commits)
    told = git("cat-file", "--batch", told=asked)
    tables = [tomllib.loads(t) for t in re.split(r"(?m)^.*(?: blob \d+| missing)\n", told)[1:]]
    return [tables[k * len(commits) : (k + 1) * len(commits)] for k in range(len(names))]


def flat(most: dict) -> Counter[str]:
    """Ceilings by part, name and kind, and of each kind the sum of all rooms, in one table."""
    found = Counter({f"whole {kind}": limit for kind, limit in most["whole"].items()})
    for row in most["rooms"].values():
        found.update({f"all rooms {kind}": limit for kind, limit in row.items()})
    for part in ("rooms", "commands"):
        for name, row in most[part].items():
            found.update({f"{part} {name} {kind}": limit for kind, limit in row.items()})
    return found


def raised(now: dict, before: dict) -> list[str]:
    """Ceilings that are above those of an earlier commit."""
    here = flat(now)
    return [
        f"{name}: {here[name]} now, {limit} before"
        for name, limit in flat(before).items()
        if here[name] > limit
    ]


def main() -> int:
    """Print the tables and what is passed."""
    if "--lower" in sys.argv:
        CEILINGS.write_text(written(lowered(ceilings())), "utf-8")
    print(re.sub(r"(?m)^\|[-|]+\n", "", table()).replace("|", " "))
    print(re.sub(r"(?m)^\|[-|]+\n", "", commands()).replace("|", " "))
    over = verdict()
    print("\n".join(over) if over else "Every figure is within its ceiling.")
    return bool(over)


if __name__ == "__main__":
    sys.exit(main())
