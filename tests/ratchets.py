"""Counts of the source that may fall and never rise, room by room.

python tests/ratchets.py           the table, with the most that is allowed, and lines of code
python tests/ratchets.py --lower   write what has fallen into `ratchets.toml`
"""

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "robins"
MOST = Path(__file__).with_name("ratchets.toml")
LONG = 60  # lines of a function
KINDS = {
    "clauses": "docstrings that begin with a clause",
    "classes": "classes that are no values",
    "circular": "files in a circle of imports",
    "long": "functions of more than 60 lines",
    "loose": "`Any` and `object` in signatures",
}

LAYOUT = ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")

# First words of a subordinate clause, where a noun phrase or an imperative belongs.
CLAUSE = re.compile(
    r"(What|Whether|Whoever|Where|Who|As of|Of|With|That|To|In|Those|Such|How|Why|By|At|So)\b"
)


def room_of(file: Path, source: Path = SOURCE) -> str:
    """Room of a file: the first part of its path."""
    return file.relative_to(source).parts[0].removesuffix(".py")


def loose(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Number of `Any` and `object` in the annotations of a signature."""
    a = function.args
    hints = [x.annotation for x in (*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg) if x]
    names = [n for hint in (*hints, function.returns) if hint for n in ast.walk(hint)]
    return sum(getattr(n, "id", getattr(n, "attr", "")) in ("Any", "object") for n in names)


def is_value(node: ast.ClassDef) -> bool:
    """Test for a class that is a value of `robins.filters.values`, which stands for a function."""
    return any(getattr(one, "id", "") == "value" for one in node.decorator_list)


def counted(tree: ast.Module) -> Counter[str]:
    """Clause-first docstrings, classes, long functions and loose types of a module."""
    found = Counter[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            found["clauses"] += bool(CLAUSE.match(ast.get_docstring(node) or ""))
        found["classes"] += isinstance(node, ast.ClassDef) and not is_value(node)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            found["long"] += node.end_lineno - node.lineno + 1 > LONG  # type: ignore[operator]
            found["loose"] += loose(node)
    return found


def code_lines(text: str) -> int:
    """Number of lines that are neither blank, comment, docstring nor import."""
    tree, layout = ast.parse(text), {getattr(tokenize, name) for name in LAYOUT}
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {n for t in tokens if t.type not in layout for n in range(t.start[0], t.end[0] + 1)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            left_out = node.body[:1] if ast.get_docstring(node) is not None else []
        else:
            left_out = [node] if isinstance(node, ast.Import | ast.ImportFrom) else []
        code -= {n for one in left_out for n in range(one.lineno, (one.end_lineno or 0) + 1)}
    return len(code)


def imported_modules(tree: ast.AST, package: str) -> Iterator[tuple[int, str]]:
    """Line and full name of everything imported, relative and dynamic imports included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: 1 - node.level or None] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and "import" in ast.unparse(node.func):
            yield from (
                (node.lineno, str(a.value)) for a in node.args[:1] if isinstance(a, ast.Constant)
            )


def depends(tree: ast.Module, package: str, modules: set[str]) -> set[str]:
    """Modules that a file imports anywhere in it: in functions and for types too."""
    names = (name for _, name in imported_modules(tree, package))
    return {name if name in modules else name.rpartition(".")[0] for name in names} & modules


def circular(edges: dict[str, set[str]]) -> set[str]:
    """Modules that import themselves through others, by the transitive closure."""
    reach = {name: set(to) for name, to in edges.items()}
    for middle in reach:
        for name, to in reach.items():
            if middle in to:
                reach[name] = to | reach[middle]
    return {name for name, to in reach.items() if name in to}


def measured(source: Path = SOURCE) -> dict[str, Counter[str]]:
    """Counts by room."""
    found: dict[str, Counter[str]] = defaultdict(Counter)
    trees = {p: ast.parse(p.read_text("utf-8")) for p in sorted(source.rglob("*.py"))}
    files, packages = dict[str, Path](), dict[str, str]()
    for path in trees:
        parts = ("robins", *path.relative_to(source).with_suffix("").parts)
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        files[name], packages[name] = path, ".".join(parts[:-1])
    edges = {
        name: depends(trees[path], packages[name], set(files)) - {name}
        for name, path in files.items()
    }
    for path, tree in trees.items():
        found[room_of(path, source)].update(counted(tree))
    for name in circular(edges):
        found[room_of(files[name], source)]["circular"] += 1
    return dict(found)


def most() -> dict[str, dict[str, int]]:
    """The most that is allowed, by room."""
    return tomllib.loads(MOST.read_text("utf-8"))


def risen(found: dict[str, Counter[str]], allowed: dict[str, dict[str, int]]) -> list[str]:
    """A sentence for each count that rose, and for each new room that has any."""
    return [
        f"{room}: {counts[kind]} {what}, {allowed.get(room, {}).get(kind, 0)} allowed"
        for room, counts in found.items()
        for kind, what in KINDS.items()
        if counts[kind] > allowed.get(room, {}).get(kind, 0)
    ]


def written(found: dict[str, Counter[str]], allowed: dict[str, dict[str, int]]) -> str:
    """`ratchets.toml`: the lesser of what is allowed and what is found."""
    lines = [
        "# The most of each count in a room; tests/ratchets.py says what is counted. They fall and",
        "# never rise: `python tests/ratchets.py --lower` writes what has fallen.",
    ]
    for room, counts in sorted(found.items()):
        row = {k: min(counts[k], allowed.get(room, {}).get(k, counts[k])) for k in KINDS}
        lines.append(f"{room} = {{ {', '.join(f'{k} = {n}' for k, n in row.items())} }}")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Print the table; write what has fallen where it is asked for."""
    found, allowed = measured(), most() if MOST.exists() else {}
    code = Counter[str]()
    for path in SOURCE.rglob("*.py"):
        code[room_of(path)] += code_lines(path.read_text("utf-8"))
    print(f"{'room':12}" + "".join(f"{kind:>14}" for kind in KINDS) + f"{'code':>8}")
    for room, counts in sorted(found.items()):
        rows = (f"{counts[k]} / {allowed.get(room, {}).get(k, counts[k])}" for k in KINDS)
        print(f"{room:12}" + "".join(f"{row:>14}" for row in rows) + f"{code[room]:8}")
    total = (sum(counts[kind] for counts in found.values()) for kind in KINDS)
    print(f"{'all':12}" + "".join(f"{n:>14}" for n in total) + f"{code.total():8}")
    if "--lower" in sys.argv:
        MOST.write_text(written(found, allowed), "utf-8")
    return bool(MOST.exists() and risen(found, most()))


if __name__ == "__main__":
    sys.exit(main())
