"""The table of tiers means tests that exist, and what is moved away has others to stand for it."""

import ast
import re
from pathlib import Path

import pytest
import tiers

HERE = Path(__file__).parent


def defined(name):
    """Whether a file of tests defines the function of a name, "room/test_x.py::test_y"."""
    file, *path = name.split("::")
    tree = ast.parse((HERE / file).read_text("utf-8"))
    inner = {n.name: n for n in tree.body if isinstance(n, (ast.ClassDef, ast.FunctionDef))}
    for part in path[:-1]:
        inner = {n.name: n for n in inner[part].body if hasattr(n, "name")}
    return path[-1] in inner


@pytest.mark.parametrize("entry", tiers.certified(), ids=lambda e: e["test"])
def test_what_is_moved_is_there_and_something_stands_for_it(entry):
    assert set(entry) <= {"test", "only", "promise", "stands"}
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


def test_tiers_are_not_marked_by_hand():
    for path in HERE.rglob("*.py"):
        if path.name != "tiers.py":
            found = re.search(r"mark\.(fast|certify|slow)\b", path.read_text("utf-8"))
            assert not found or path == Path(__file__), path


def test_costs_are_those_of_tests_that_are_there():
    """A name that is gone would hide that its successor was never measured."""
    for name in tiers.costs():
        assert defined(name), f"{name} is gone: run `make costs`, or delete its line"
