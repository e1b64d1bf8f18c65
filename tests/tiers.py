"""Which tests run when: by what they cost, and by what they prove.

    make check      `fast`: not among the costly of `costs.json`
    make test       all but `certify`
    make certify    those of `certify.toml`, and every property with a thousand examples

`costs.json` holds the seconds of processor of each test that takes 0.2 s or more, with
what it compiles, from an empty cache; `make costs` writes it. `certify.toml` names what is too long
to wait for at every push, which promise it guards, and which tests of `make test` stand for it
meanwhile.

PART=2/4 runs the second of four parts that cost alike.
"""

import json
import os
import re
import subprocess
import time
import tomllib
from datetime import date
from pathlib import Path

import pytest

HERE = Path(__file__).parent
COSTS, CERTIFY = HERE / "costs.json", HERE / "certify.toml"
LEAST_S = 0.2  # of a cost worth writing down


def plain(node: str) -> str:
    """A test without its parameters: file and name."""
    return node.partition("[")[0]


def certified() -> list[dict[str, str]]:
    """Entries of `certify.toml`: test, promise, stands."""
    return tomllib.loads(CERTIFY.read_text("utf-8"))["moved"]


def costs() -> dict[str, float]:
    """Seconds of processor of costly tests, without their parameters."""
    return json.loads(COSTS.read_text("utf-8"))


def meant(entry: dict[str, str], node: str) -> bool:
    """Whether an entry means a test: its name, alone or with parameters that match ``only``."""
    name, _, parameters = node.partition("[")
    wanted = re.compile(entry.get("only", ".*"))
    return name == entry["test"] and bool(wanted.fullmatch(parameters.removesuffix("]")))


def mark(items: list[pytest.Item]) -> None:
    """Give each test its tier."""
    costly, moved = costs(), certified()
    for item in items:
        node = item.nodeid.removeprefix("tests/")
        if any(meant(entry, node) for entry in moved):
            item.add_marker(pytest.mark.certify)
        elif plain(node) not in costly:
            item.add_marker(pytest.mark.fast)


def arrange(
    items: list[pytest.Item], part: str = "1/1"
) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """The items of a part, of "2/4" the second of four, and those of the other parts.

    Costly files come first, so that workers end together. A file stays whole; each goes to the part
    that has least to do.
    """
    costly, spent = costs(), dict[str, float]()
    for node in dict.fromkeys(plain(item.nodeid.removeprefix("tests/")) for item in items):
        file = node.partition("::")[0]
        spent[file] = spent.get(file, 0.0) + costly.get(node, LEAST_S / 4)
    mine, parts = (int(n) for n in part.split("/"))
    load, place = [0.0] * parts, dict[str, tuple[int, int]]()
    for rank, file in enumerate(sorted(spent, key=lambda f: -spent[f])):
        least = load.index(min(load))
        load[least] += spent[file]
        place[file] = least, rank
    at = {item: place[item.nodeid.removeprefix("tests/").partition("::")[0]] for item in items}
    ordered = sorted(items, key=lambda item: at[item][1])
    kept = [item for item in ordered if at[item][0] == mine - 1]
    return kept, [item for item in ordered if at[item][0] != mine - 1]


class Meter:
    """Writes what each test cost, a line a test, into a file for each worker."""

    def __init__(self, folder: str):
        self.file = Path(folder) / f"{os.getpid()}.jsonl"
        self.file.parent.mkdir(parents=True, exist_ok=True)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        """Setup, call and teardown: what the first user of a fixture pays is its cost."""
        wall, spent = time.monotonic(), _processor()
        done = yield
        cost = {"test": item.nodeid.removeprefix("tests/"), "processor_s": _processor() - spent}
        cost |= {"wall_s": time.monotonic() - wall, "mib": _mib()}
        with self.file.open("a", encoding="utf-8") as out:
            print(json.dumps(cost), file=out)
        return done


def _processor() -> float:
    """Seconds of this process and of those it started and has waited for."""
    return sum(os.times()[:4])


def _mib() -> int:
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * 4096 >> 20 if statm.exists() else 0


class Certificate:
    """Writes what came of `make certify` where the documents tell it."""

    def __init__(self, page: str):
        self.page, self.begun = Path(page), time.monotonic()

    def pytest_terminal_summary(self, terminalreporter):
        """The commit, how many tests passed and failed, and how long they took."""
        ask = ["git", "describe", "--always", "--dirty", "--abbrev=7"]
        commit = subprocess.run(ask, capture_output=True, text=True, cwd=HERE, check=True).stdout
        counts = {k: len(terminalreporter.stats.get(k, ())) for k in ("passed", "failed", "error")}
        told = ", ".join(f"{n} {k}" for k, n in counts.items())
        minutes = (time.monotonic() - self.begun) / 60.0
        self.page.write_text(
            f"Commit `{commit.strip()}`, {date.today()}: {told}, in {minutes:.0f} minutes on "
            f"{os.cpu_count()} cores.\n",
            "utf-8",
        )


def summed(folder: str) -> dict[str, float]:
    """What the meters of a run wrote, by test without its parameters."""
    sums: dict[str, float] = {}
    for file in Path(folder).glob("*.jsonl"):
        for line in file.read_text("utf-8").splitlines():
            row = json.loads(line)
            name = plain(row["test"])
            sums[name] = sums.get(name, 0.0) + row["processor_s"]
    return sums


def write_costs(*folders: str) -> None:
    """The most that each test cost in some run.

    A test may find what another one computed and compiled: the fast ones are measured alone too.
    """
    runs = [summed(folder) for folder in folders]
    most = {test: max(run.get(test, 0.0) for run in runs) for run in runs for test in run}
    costly = {k: round(v, 1) for k, v in sorted(most.items()) if v >= LEAST_S}
    COSTS.write_text(json.dumps(costly, indent=0) + "\n", "utf-8")
    print(f"{COSTS}: {len(costly)} of {len(most)} tests cost {LEAST_S:g} s or more")


if __name__ == "__main__":
    import sys

    write_costs(*sys.argv[1:])
