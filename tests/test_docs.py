"""The documents are true: their examples run, and their docstrings show what was typed.

Each example is compiled, and what it imports and calls is looked up. Of pages of one kind, such as
those of filters on a few numbers, some are also run; `make certify` runs all. Pages of filters are
many runs of one kind: most are interpreted, not compiled.
"""

import ast
import dataclasses
import doctest
import importlib
import inspect
import itertools
import json
import re
import tomllib
from pathlib import Path

import click
import interpreted
import matplotlib.pyplot as plt
import pytest
from plain_docstrings import plain

from robins import filters, scenario
from robins.bench.rigs import rig_of
from robins.bench.run.setup import setup_of
from robins.cli import ExitStatus, app
from robins.filters import Filter
from robins.filters.rule import Hooks
from robins.logs import columns_from
from robins.results.summary import checked
from robins.systems.finding import find_system

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "robins"
BUILT = {"_build", "_generated"}
FENCE = re.compile(r"^(?P<indent> *)(?P<mark>`{3,}|~{3,})(?P<language>.*)$")


def pages() -> list[Path]:
    inside = (ROOT / "docs").rglob("*.md")
    kept = [p for p in inside if not BUILT & set(p.relative_to(ROOT).parts)]
    return sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *kept])


def blocks(text: str) -> list[tuple[int, str, str]]:
    """Fenced blocks of a page: first line number, language, code."""
    found, opened, code, at = [], None, [], 0
    for number, line in enumerate(text.splitlines(), 1):
        fence = FENCE.match(line)
        if opened is None:
            if fence:
                opened, code, at = fence, [], number + 1
        elif fence and fence["mark"].startswith(opened["mark"]) and not fence["language"].strip():
            found.append((at, opened["language"].strip(), "\n".join(code)))
            opened = None
        else:
            code.append(line.removeprefix(opened["indent"]))
    if opened is not None:
        raise ValueError(f"line {at - 1}: block without an end")
    return found


def examples(page: Path) -> list[tuple[int, str]]:
    """Blocks of a page that are Python: first line number, code."""
    return [
        (at, code) for at, language, code in blocks(page.read_text("utf-8")) if language == "python"
    ]


def execute(page: Path) -> int:
    """Run a page's ```python blocks in order in one namespace; return how many there are.

    A block that is not to be run says so by its language: `text`, `console`.
    """
    namespace = {"__name__": "__main__"}
    found = examples(page)
    for line, code in found:
        # Blank lines before it make tracebacks name the line of the page.
        exec(compile("\n" * (line - 1) + code, page, "exec", dont_inherit=True), namespace)
    return len(found)


EACH = pytest.mark.parametrize(
    "page", [p for p in pages() if examples(p)], ids=lambda p: str(p.relative_to(ROOT))
)


def imported(tree: ast.AST) -> dict[str, object]:
    """Objects that the imports of a tree bind, by their names there."""
    bound: dict[str, object] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for one in node.names:
                whole = importlib.import_module(one.name)
                first = importlib.import_module(one.name.partition(".")[0])
                bound[one.asname or first.__name__] = whole if one.asname else first
        elif isinstance(node, ast.ImportFrom):
            whole = importlib.import_module(node.module)
            for one in node.names:
                if not hasattr(whole, one.name):
                    importlib.import_module(f"{node.module}.{one.name}")
                bound[one.asname or one.name] = getattr(whole, one.name)
    return bound


def looked_up(node: ast.AST, bound: dict[str, object]) -> object:
    """The object that a dotted name means; None where it begins with no import."""
    if isinstance(node, ast.Name):
        return bound.get(node.id)
    if isinstance(node, ast.Attribute):
        owner = looked_up(node.value, bound)
        return None if owner is None else getattr(owner, node.attr)
    return None


def fits(page: Path) -> int:
    """Compile the examples of a page and look up all that they take from modules.

    Returns:
        How many calls of functions of robins there are, whose arguments fit.
    """
    bound: dict[str, object] = {}
    found = 0
    for line, code in examples(page):
        tree = compile("\n" * (line - 1) + code, page, "exec", ast.PyCF_ONLY_AST, dont_inherit=True)
        bound |= imported(tree)
        for node in ast.walk(tree):
            looked_up(node, bound)
            called = looked_up(node.func, bound) if isinstance(node, ast.Call) else None
            if (getattr(called, "__module__", None) or "").startswith("robins."):
                named = {keyword.arg: None for keyword in node.keywords}
                if None not in named and not any(isinstance(a, ast.Starred) for a in node.args):
                    inspect.signature(called).bind(*node.args, **named)
                    found += 1
    return found


@EACH
def test_examples_fit_what_they_import(page):
    fits(page)


def test_an_example_that_does_not_fit_is_found(tmp_path):
    page = tmp_path / "page.md"
    head = "# Page\n```python\nfrom robins.filters import kalman\nfrom robins import logs\n"
    for body, error in (
        ("kalman(rules=[])", None),
        ("kalman(rulez=[])", "rulez"),
        ("kalman(rules=[]", "never closed"),
        ("logs.examined", "examined"),
        ("from robins.filters import kalmann", "kalmann"),
    ):
        page.write_text(f"{head}{body}\n```\n")
        if error is None:
            assert fits(page) == 1
            continue
        with pytest.raises((TypeError, SyntaxError, AttributeError, ImportError), match=error):
            fits(page)


@EACH
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page.parent.name == "filters" and page.stem not in ("igg3", "particle"):
        monkeypatch.setattr(filters, "run", interpreted.run)
    try:
        execute(page)
    finally:
        plt.close("all")


WITH_RESULTS = [
    ".".join(("robins", *path.relative_to(SOURCE).with_suffix("").parts))
    for path in sorted(SOURCE.rglob("*.py"))
    if ">>> " in path.read_text("utf-8")
]


@pytest.mark.parametrize("name", WITH_RESULTS)
def test_examples_in_docstrings_give_their_results(name):
    done = doctest.testmod(importlib.import_module(name))
    assert done.attempted
    assert not done.failed


def test_the_readme_shows_the_library():
    languages = [language for _, language, _ in blocks((ROOT / "README.md").read_text("utf-8"))]
    assert "python" in languages


ANSWERS = {"reports", "suspects"}  # properties of a filter with a default
OPTIONAL = {"members", "report", "suspicions"} | ANSWERS  # all that has one


@pytest.mark.parametrize("page", ["architecture.md", "filters/index.md", "filters/protocol.md"])
def test_the_pages_name_all_methods_of_a_filter(page):
    text = (ROOT / "docs" / page).read_text("utf-8")
    told = re.search(r"A filter is a value.*?methods\s(.*?`reset)", text, re.DOTALL)
    assert told
    needed = {name for name in vars(Filter) if not name.startswith("_")} - OPTIONAL
    assert set(re.findall(r"`(\w+)", told[1])) == needed
    if page == "filters/protocol.md":
        assert all(f"`{name}(s" in text for name in OPTIONAL - ANSWERS)
        assert all(f"`{name}`" in text for name in ANSWERS)


def test_the_protocol_names_all_hooks_of_a_rule():
    text = (ROOT / "docs" / "filters" / "protocol.md").read_text("utf-8")
    table = text.partition("## The hooks of a rule")[2].partition("## ")[0]
    told = re.findall(r"^\| `(\w+)\(", table, re.MULTILINE)
    assert {*told, "name"} == {field.name for field in dataclasses.fields(Hooks)}


def test_no_example_escapes_by_its_spelling():
    known = re.compile(r"python|text|console|toml|json|csv|\{(?!code)[\w-]+\}.*")
    found = {language for p in pages() for _, language, _ in blocks(p.read_text("utf-8"))}
    assert not {language for language in found if not known.fullmatch(language)}


def test_the_documented_summary_is_one():
    contract = ROOT / "docs" / "contract.md"
    (code,) = (code for _, language, code in blocks(contract.read_text()) if language == "json")
    shown = json.loads(code)
    made = checked({key: value for key, value in shown.items() if key != "files"})
    assert list(made) == list(shown)
    assert made | {"files": shown["files"]} == shown


def rows_of(page: Path, heading: str) -> list[list[str]]:
    """Cells of the tables below a heading, down to the next of its rank."""
    rank = heading.split()[0]
    part = page.read_text("utf-8").split(f"\n{heading}\n")[1].split(f"\n{rank} ")[0]
    rows = [line.strip("|").split("|") for line in part.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in row] for row in rows]


def test_the_contract_names_every_command_option_and_status():
    contract = ROOT / "docs" / "contract.md"
    rows = rows_of(contract, "## Commands")
    commands = [row[0].split()[1].strip("`") for row in rows if row[0].startswith("`robins ")]
    assert sorted(commands) == sorted(app.commands)
    has: dict[str, list[str]] = {}
    alone = {k: c for k, c in app.commands.items() if not isinstance(c, click.Group)}
    for name, command in alone.items():
        for flag in itertools.chain(*(option.opts for option in command.params)):
            if flag.startswith("--"):
                has.setdefault(flag, []).append(name)
    options = {
        row[0].strip("`").split()[0]: list(alone) if row[1] == "all" else row[1].split(", ")
        for row in rows
        if row[0].startswith("`--")
    }
    assert {k: sorted(v) for k, v in options.items()} == {k: sorted(v) for k, v in has.items()}
    statuses = re.findall(r"^\| (\d) \|", contract.read_text("utf-8"), re.MULTILINE)
    assert [int(status) for status in statuses] == sorted(ExitStatus)


def test_the_configurations_shown_can_be_read(tmp_path):
    every = [block for page in pages() for block in blocks(page.read_text("utf-8"))]
    shown = [code for _, language, code in every if language == "toml"]
    assert any("[columns]" in code for code in shown)
    assert any("bench" in scenario.mapping_of(code) for code in shown)
    for code in shown:
        mapping = scenario.mapping_of(code)
        if "columns" in mapping:
            (tmp_path / "shown.toml").write_text(code)
            columns_from(tmp_path / "shown.toml")
            continue
        if "bench" in mapping:
            scenario.validate(setup_of(rig_of(mapping["bench"])), mapping)
            continue
        if "project" in mapping:  # of a package of the user's
            continue
        system = find_system(mapping["system"], ROOT / "docs" / "examples")
        study = system.alignment or next(iter(system.studies.values()), None)
        parameters = system.replay_parameters or study.parameters
        scenario.validate(parameters, mapping)


def test_a_failing_example_is_found_at_its_line(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n```python\nx = 1\n```\n```text\nnot code\n```\n1. item\n\n"
        "   ```python\n   y = x + 1\n   assert y == 3, 'planted'\n   ```\n"
    )
    with pytest.raises(AssertionError, match="planted") as caught:
        execute(page)
    assert (caught.traceback[-1].path, caught.traceback[-1].lineno + 1) == (page, 12)
    page.write_text(page.read_text().replace("== 3", "== 2"))
    assert execute(page) == 2


def test_links_between_pages_lead_somewhere():
    for page in pages():
        targets = re.findall(r"\]\((?!\w+:|#)([^)#\s]+)", page.read_text("utf-8"))
        assert [t for t in targets if not (page.parent / t).exists()] == [], page


def files_meant(text: str) -> list[Path]:
    """Files of this repository behind the absolute addresses of a page, which PyPI needs."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["urls"]
    raw = urls["Source"].replace("https://github.com", "https://raw.githubusercontent.com")
    pages = re.findall(rf"{re.escape(urls['Documentation'])}/en/latest/([\w/-]+)\.html", text)
    files = re.findall(
        rf"(?:{re.escape(urls['Source'])}/blob|{re.escape(raw)})/main/([^)\s]+)", text
    )
    return [*(ROOT / "docs" / f"{page}.md" for page in pages), *(ROOT / file for file in files)]


def test_the_readme_can_be_read_on_pypi():
    text = (ROOT / "README.md").read_text("utf-8")
    assert re.findall(r"\]\((?!https://|#)([^)]+)", text) == []
    meant = files_meant(text)
    assert {".png", ".md", ".cff"} <= {path.suffix for path in meant}
    assert [str(path) for path in meant if not path.is_file()] == []
    own = [part for part in re.findall(r"https://[^)\s]+", text) if "robins" in part]
    assert len(own) == len(meant)  # none by another address


@pytest.mark.parametrize(
    ("typed", "shown"),
    [
        ("K* x of |f|, lambda_ and a**2 b**2", r"K\* x of \|f\|, lambda\_ and a\*\*2 b\*\*2"),
        ("the *doctor*, **never**, `K*`, ``|f|``", "the *doctor*, **never**, `K*`, ``|f|``"),
        ("`x`s, ``(x, u) -> ``, snake_case_name", r"`x`\ s, ``(x, u) ->``, snake_case_name"),
        ("* item *x", r"* item \*x"),
        ("text\n\n    P |x|\n    Q\n\nmore*", "text\n\n::\n\n    P |x|\n    Q\n\nmore\\*"),
        ("text::\n\n    P*", "text::\n\n    P*"),
        ("a\n\n    P*\n\n    Q*\n\nb", "a\n\n::\n\n    P*\n\n    Q*\n\nb"),
        (">>> 2 * 3\n6", ">>> 2 * 3\n6"),
        ("==  ==\na|  b*\n==  ==", "==  ==\na|  b*\n==  =="),
        ("- item\n\n  more*", "- item\n\n  more\\*"),
        (
            "Args:\n    x: K* y\n        z*\n    w: v",
            "Args:\n    x: K\\* y\n        z\\*\n    w: v",
        ),
    ],
)
def test_docstrings_show_what_was_typed(typed, shown):
    assert "\n".join(plain(typed.split("\n"))) == shown
