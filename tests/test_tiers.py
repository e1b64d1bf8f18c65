"""The table of tiers means tests that exist, and what is moved away has others to stand for it."""

import ast
import random
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
import tiers

HERE = Path(__file__).parent


@cache
def parsed(file):
    return ast.parse(file.read_text("utf-8"))


def defined(name):
    """Test for a file that defines the function of a name, "room/test_x.py::test_y"."""
    file, *path = name.split("::")
    tree = parsed(HERE / file)
    inner = {n.name: n for n in tree.body if isinstance(n, (ast.ClassDef, ast.FunctionDef))}
    for part in path[:-1]:
        inner = {n.name: n for n in inner[part].body if hasattr(n, "name")}
    return path[-1] in inner


@pytest.mark.parametrize("entry", tiers.certified(), ids=lambda e: e["test"])
def test_what_is_moved_is_there_and_something_stands_for_it(entry):
    assert set(entry) <= {"test", "only", "promise", "stands", "first"}
    assert defined(entry["test"])
    assert entry["promise"].endswith(".")
    assert entry["stands"]
    moved = {e["test"] for e in tiers.certified() if "only" not in e}
    for name in entry["stands"]:
        assert defined(name)
        assert name not in moved
    re.compile(entry.get("only", ""))


def test_a_test_is_meant_by_its_name_and_parameters():
    every, some = {"test": "a.py::test_b"}, {"test": "a.py::test_b", "only": "x|y-.*"}
    for node, of_every, of_some in (
        ("a.py::test_b", True, False),
        ("a.py::test_b[x]", True, True),
        ("a.py::test_b[y-1[2]]", True, True),
        ("a.py::test_b[xx]", True, False),
        ("a.py::test_bb", False, False),
        ("b.py::test_b[x]", False, False),
    ):
        assert tiers.meant(every, node) == of_every
        assert tiers.meant(some, node) == of_some


def test_parameters_that_no_test_has_are_found():
    entries = [{"test": "a.py::test_b", "only": only} for only in ("x", "x|z", "z")]
    nodes = ["a.py::test_b[x]", "a.py::test_b[y]"]
    assert tiers.meaningless(entries, nodes) == ["a.py::test_b"]
    assert tiers.meaningless(entries, nodes[1:]) == []  # one of them, by its name


class Item(NamedTuple):
    nodeid: str


class Marked:
    def __init__(self, nodeid):
        self.nodeid, self.marks = f"tests/{nodeid}", []

    def add_marker(self, mark):
        self.marks.append(mark.name)


def test_a_fast_test_is_cheap_in_a_cheap_file():
    large = tiers.heavy()
    rows = tiers.budget.costs()["files"].items()
    costly = {f: next(iter(row["tests"])) for f, row in rows if row["tests"] and f not in large}
    for file, test in list(costly.items())[:3]:
        dear, cheap = Marked(f"{file}::{test}[x]"), Marked(f"{file}::test_of_nothing")
        tiers.mark([dear, cheap])
        assert "fast" not in dear.marks
        assert cheap.marks == ["fast"]
    others = [Marked(f"{file}::test_of_nothing") for file in large]
    tiers.mark(others)
    assert others
    assert not any(item.marks for item in others)


def by_file(items):
    costs, load = tiers.costs(), {}
    for item in items:
        file = item.nodeid.partition("::")[0]
        load[file] = load.get(file, 0.0) + costs[item.nodeid.removeprefix("tests/")]
    return load


def test_parts_hold_every_test_once_in_whole_files_and_cost_alike():
    items = [Item(f"tests/{node}") for node in tiers.costs()]
    random.Random(1).shuffle(items)
    split = [tiers.arrange(items, f"{k}/3") for k in (1, 2, 3)]
    assert all(sorted(part + others) == sorted(items) for part, others in split)
    parts = [part for part, _ in split]
    assert sorted(item for part in parts for item in part) == sorted(items)
    files = [by_file(part) for part in parts]
    assert sum(map(len, files)) == len({name for names in files for name in names})
    spent = [sum(file.values()) for file in files]
    largest = max(cost for file in files for cost in file.values())
    assert max(spent) <= max(1.1 * min(spent), largest)
    last = tiers.arrange(items)[0][-1]
    file = last.nodeid.partition("::")[0]
    ordered, _ = tiers.arrange(items, first={file.removeprefix("tests/")})
    assert ordered[0].nodeid.startswith(file)


def test_tiers_are_not_marked_by_hand():
    for path in HERE.rglob("*.py"):
        if path.name != "tiers.py":
            found = re.search(r"mark\.(fast|certify|slow)\b", path.read_text("utf-8"))
            assert not found or path == Path(__file__), path
