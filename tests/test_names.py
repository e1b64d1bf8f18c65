"""Names in the words of the field: old ones stay away, and a class's name means one thing."""

import ast
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src" / "robins"
GIVEN_UP = tomllib.loads(Path(__file__).with_name("names.toml").read_text("utf-8"))
SAME = {"Alarms"}  # a protocol, and a class that is one


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of all that is defined, imported, called or read."""
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        for field in ("id", "attr", "arg", "name", "asname", "module"):
            if isinstance(name := getattr(node, field, None), str):
                yield from ((line, part) for part in name.split("."))


def old_names(code: str, given_up: dict[str, str]) -> list[str]:
    """A sentence for each name that was given up."""
    found = identifiers(ast.parse(code))
    return [f"line {n}: {name} is now {given_up[name]}" for n, name in found if name in given_up]


def test_no_name_that_was_given_up_comes_back():
    found = {p: old_names(p.read_text("utf-8"), GIVEN_UP) for p in sorted(SOURCE.rglob("*.py"))}
    assert not {str(path): lines for path, lines in found.items() if lines}


def test_a_planted_old_name_is_found():
    old = {"Mind": "EstimatorState", "ask": "check"}
    for code in (
        "class Mind: ...",
        "from a import Mind",
        "x = gate.ask(1)",
        "def f(ask): ...",
        "f(ask=1)",
    ):
        assert old_names(code, old)
    assert not old_names("'Mind'  # ask", old)


def test_no_two_classes_share_a_name():
    classes = Counter(
        node.name
        for path in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert {name for name, times in classes.items() if times > 1} <= SAME
