"""Every error says what is wrong, where and how to fix it, and has the one base."""

import ast
import builtins
from collections.abc import Iterator
from pathlib import Path

import pytest

import robins
from robins.bench.broker import LinkLost
from robins.errors import RobinsError
from robins.logs import LogError
from robins.results import ResultError
from robins.results.errors import result_error
from robins.scenario import ScenarioError
from robins.workbench import InputError

SOURCE = Path(robins.__file__).parent
OF_THE_SYSTEM = {"TargetBusyError"}  # an OSError that becomes a ResultError


def strays(tree: ast.AST) -> Iterator[str]:
    """Public classes that derive from a built-in exception and not from `RobinsError`."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
            continue
        bases = [ast.unparse(base) for base in node.bases]
        built_in = [getattr(builtins, base, None) for base in bases]
        raised = any(isinstance(b, type) and issubclass(b, Exception) for b in built_in)
        if raised and not any("RobinsError" in base or "Warning" in base for base in bases):
            yield node.name


def test_every_error_has_the_one_base():
    found = {name for path in SOURCE.rglob("*.py") for name in strays(ast.parse(path.read_text()))}
    assert found - {"RobinsError"} == OF_THE_SYSTEM


def test_a_planted_error_of_another_base_is_found():
    code = "class A(OSError): ...\nclass B(RobinsError, OSError): ...\nclass _C(OSError): ..."
    assert list(strays(ast.parse(code))) == ["A"]


@pytest.mark.parametrize(
    ("error", "where", "what", "fix", "sentence"),
    [
        (RobinsError("is wrong"), "", "is wrong", "", "is wrong"),
        (RobinsError("is wrong", "a"), "a", "is wrong", "", "a: is wrong"),
        (RobinsError("is wrong", fix="mend it"), "", "is wrong", "mend it", "is wrong; mend it"),
        (InputError("is wrong", Path("a"), "mend it"), "a", "is wrong", "mend it", None),
        (ResultError("out", "is a file", "choose another"), "out", "is a file", None, None),
        (LogError("a.csv", "is empty", "record it"), "a.csv", "is empty", "record it", None),
        (
            LogError("a.csv", "is no number", "mend it", where="line 3", field="x", value="1.O"),
            "a.csv line 3",
            "x = '1.O': is no number",
            "mend it",
            "a.csv line 3: x = '1.O': is no number; mend it",
        ),
        (LogError("a.csv", "twice", "drop one", field="x"), "a.csv", "x: twice", "drop one", None),
        (ScenarioError(["a: one", "b: two"]), "", "a: one\nb: two", "", "a: one\nb: two"),
    ],
)
def test_an_error_is_one_sentence_of_its_parts(error, where, what, fix, sentence):
    fix = error.fix if fix is None else fix
    assert (error.where, error.what, error.fix) == (where, what, fix)
    assert str(error) == (sentence or f"{where}: {what}; {fix}")


def test_a_failing_disk_is_not_bad_input():
    assert RobinsError("x").bad_input
    assert ResultError("out", "x", "y").bad_input
    assert not result_error("out", "write", OSError(28, "full")).bad_input
    assert result_error("out", "write", ValueError("a name")).bad_input
    assert not LinkLost("adm", OSError(5, "gone")).bad_input
