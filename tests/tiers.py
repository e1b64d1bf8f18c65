"""Which tests run when: by what they cost, and by what they prove.

    make check      `fast`: neither the test nor its file is among the costly of `costs.json`
    make test       all but `certify`
    make certify    those of `certify.toml`, and every property with a thousand examples

`costs.json` holds, by file, the seconds of processor of each test that takes 0.2 s or more, from an
empty cache; `make costs` writes it (`budget.py`). In a costly file a cheap test is cheap only after
the others, which made the worlds and the programs that it uses. `certify.toml` names what is too
long to wait for at every push, which promise it guards, and which tests of `make test` stand for it
meanwhile.

PART=2/4 runs the second of four parts that cost alike.
"""

import contextlib
import os
import re
import subprocess
import time
import tomllib
from collections.abc import Collection
from datetime import date
from pathlib import Path

import budget
import pytest

HERE = Path(__file__).parent
CERTIFY = HERE / "certify.toml"
HEAVY_S = 20.0  # of a file none of whose tests is fast


def plain(node: str) -> str:
    """A test without its parameters: file and name."""
    return node.partition("[")[0]


def certified() -> list[dict[str, str]]:
    """Entries of `certify.toml`: test, promise, stands, and ``first`` of what takes minutes."""
    return tomllib.loads(CERTIFY.read_text("utf-8"))["moved"]


def first_files() -> set[str]:
    """Files with which the workers of `make certify` begin, so that they end together."""
    return {entry["test"].partition("::")[0] for entry in certified() if "first" in entry}


def costs() -> dict[str, float]:
    """Seconds of processor of costly tests, without their parameters."""
    files = budget.costs()["files"]
    return {f"{f}::{test}": s for f, row in files.items() for test, s in row["tests"].items()}


def heavy() -> set[str]:
    """Files that take `HEAVY_S` or more."""
    return {f for f, row in budget.costs()["files"].items() if row["seconds"] >= HEAVY_S}


def meant(entry: dict[str, str], node: str) -> bool:
    """Test for an entry that names a test, alone or with parameters that match ``only``."""
    name, _, parameters = node.partition("[")
    wanted = re.compile(entry.get("only", ".*"))
    return name == entry["test"] and bool(wanted.fullmatch(parameters.removesuffix("]")))


def meaningless(entries: list[dict[str, str]], nodes: list[str]) -> list[str]:
    """Tests with several parameters here, of which ``only`` of an entry fits none."""
    by_name: dict[str, list[str]] = {}
    for node in nodes:
        by_name.setdefault(plain(node), []).append(node)
    return [
        entry["test"]
        for entry in entries
        if len(here := by_name.get(entry["test"], [])) > 1
        and not any(meant(entry, n) for n in here)
    ]


def mark(items: list[pytest.Item], whole: bool = True) -> None:
    """Give each test its tier; ``whole``: all parameters of each are there, none was named."""
    costly, large, moved = costs(), heavy(), dict[str, list[dict[str, str]]]()
    nodes = [item.nodeid.removeprefix("tests/") for item in items]
    if idle := meaningless(certified(), nodes) if whole else []:
        raise pytest.UsageError(f"certify.toml: 'only' fits no parameters of {', '.join(idle)}")
    for entry in certified():
        moved.setdefault(entry["test"], []).append(entry)
    for item in items:
        node = item.nodeid.removeprefix("tests/")
        if any(meant(entry, node) for entry in moved.get(plain(node), ())):
            item.add_marker(pytest.mark.certify)
        elif plain(node) not in costly and node.partition("::")[0] not in large:
            item.add_marker(pytest.mark.fast)


def arrange(
    items: list[pytest.Item], part: str = "1/1", first: Collection[str] = ()
) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """The items of a part, of "2/4" the second of four, and those of the other parts.

    Costly files come first, before them those of ``first``, so that workers end together. A file
    stays whole; each goes to the part that has least to do.
    """
    costly, spent = costs(), dict[str, float]()
    for node in dict.fromkeys(plain(item.nodeid.removeprefix("tests/")) for item in items):
        file = node.partition("::")[0]
        spent[file] = spent.get(file, 0.0) + costly.get(node, budget.LEAST_S / 4)
    mine, parts = (int(n) for n in part.split("/"))
    load, place = [0.0] * parts, dict[str, tuple[int, int]]()
    for rank, file in enumerate(sorted(spent, key=lambda f: (f not in first, -spent[f]))):
        least = load.index(min(load))
        load[least] += spent[file]
        place[file] = least, rank
    at = {item: place[item.nodeid.removeprefix("tests/").partition("::")[0]] for item in items}
    ordered = sorted(items, key=lambda item: at[item][1])
    kept = [item for item in ordered if at[item][0] == mine - 1]
    return kept, [item for item in ordered if at[item][0] != mine - 1]


class Certificate:
    """Writes what came of `make certify` where the documents tell it."""

    def __init__(self, page: str):
        self.page, self.begun = Path(page), time.monotonic()

    def pytest_terminal_summary(self, terminalreporter):
        """The commit, how many tests passed and failed, and how long they took."""
        ask = ["git", "describe", "--always", "--dirty", "--abbrev=7"]
        commit = "unknown"
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            done = subprocess.run(ask, capture_output=True, text=True, cwd=HERE, check=True)
            commit = done.stdout.strip()
        counts = {k: len(terminalreporter.stats.get(k, ())) for k in ("passed", "failed", "error")}
        told = ", ".join(f"{n} {k}" for k, n in counts.items())
        minutes = (time.monotonic() - self.begun) / 60.0
        self.page.write_text(
            f"Commit `{commit}`, {date.today()}: {told}, in {minutes:.0f} minutes on "
            f"{os.cpu_count()} cores.\n",
            "utf-8",
        )
