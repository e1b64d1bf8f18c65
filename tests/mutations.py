"""Random mutants: small changes of the source at places drawn from a fixed seed.

    python tests/mutants.py --random 100 --seed 42 --out before.json

A mutant changes one operator, constant, index or condition, or drops one statement. It keeps the
text of its statement, so that it can be planted in a later commit where the statement is unchanged.
"""

import ast
import contextlib
import random
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

SWAPPED = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.MatMult: ("@", "*"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}


class Change(NamedTuple):
    """Bytes ``start`` to ``end`` of a file become ``new``; ``of`` spans the whole statement."""

    start: int
    end: int
    new: str
    of: tuple[int, int]


class Places(ast.NodeVisitor):
    """Changes of one file. Annotations, messages of errors and docstrings are left alone."""

    def __init__(self, text: str):
        self.raw = text.encode()
        self.lines = [0]
        for line in self.raw.splitlines(keepends=True):
            self.lines.append(self.lines[-1] + len(line))
        self.statement: tuple[int, int] = (0, 0)
        self.found: list[Change] = []
        self.visit(ast.parse(text))

    def span(self, node: ast.AST) -> tuple[int, int]:
        """First byte of a node and the one after its last."""
        start = self.lines[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]
        return start, self.lines[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]

    def visit(self, node: ast.AST) -> None:
        """Visit expressions of each statement that can change what it computes."""
        if isinstance(node, (ast.Raise, ast.Assert, ast.Import, ast.ImportFrom, ast.JoinedStr)):
            return
        if isinstance(node, ast.stmt) and not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            self.statement = self.span(node)
            body = getattr(node, "body", None)
            if body:  # the head of a loop, a condition or a context only
                self.statement = self.statement[0], self.span(body[0])[0]
        if isinstance(node, ast.Expr) and not isinstance(node.value, ast.Constant):
            self.found.append(Change(*self.statement, "pass", self.statement))
        super().visit(node)

    def generic_visit(self, node: ast.AST) -> None:
        """Visit children, but neither annotations nor decorators nor defaults of type names."""
        left = {"annotation", "returns", "decorator_list", "bases", "keywords"}
        for name, value in ast.iter_fields(node):
            if name in left and not isinstance(node, ast.Call):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    self.visit(child)

    def between(self, op: ast.AST, left: ast.AST, right: ast.AST) -> None:
        """Swap the operator written between two operands."""
        old, new = SWAPPED.get(type(op), ("", ""))
        start, end = self.span(left)[1], self.span(right)[0]
        at = self.raw[start:end].find(old.encode()) if old else -1
        if at >= 0:
            here = start + at
            self.found.append(Change(here, here + len(old), new, self.statement))

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self.between(node.op, node.left, node.right)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        self.between(node.ops[0], node.left, node.comparators[0])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self.between(node.op, node.values[0], node.values[1])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, (ast.USub, ast.Not)):
            start, operand = self.span(node)[0], self.span(node.operand)[0]
            self.found.append(Change(start, operand, " ", self.statement))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.found.append(Change(*self.span(node), str(not value), self.statement))
        elif isinstance(value, (int, float)):
            new = f"{value + 1}" if isinstance(value, int) else f"{value * 1.5 + 0.1!r}"
            self.found.append(Change(*self.span(node), new, self.statement))


def changes(file: Path, source: Path) -> Iterator[dict]:
    """Mutants of one file, as rows of `mutants.toml`."""
    places = Places(file.read_text("utf-8"))
    name = str(file.relative_to(source))
    for k, change in enumerate(places.found):
        start, end = change.of
        old = places.raw[start:end].decode()
        new = places.raw[start : change.start] + change.new.encode() + places.raw[change.end : end]
        line = places.raw[: change.start].count(b"\n") + 1
        yield {
            "id": f"{name}:{line}:{k}",
            "file": name,
            "old": old,
            "new": new.decode(),
            "what": f"{old.strip()[:60]!r} -> {new.decode().strip()[:60]!r}",
        }


def drawn(source: Path, tests: Path, number: int, seed: int) -> list[dict]:
    """Random mutants of all rooms, as many in a room as it has places, at least one.

    A statement that stands twice in its file is not drawn, since it could not be found again.
    """
    rooms: dict[str, list[dict]] = {}
    for file in sorted(source.rglob("*.py")):
        text = file.read_text("utf-8")
        room = file.relative_to(source).parts[0].removesuffix(".py")
        found = [c for c in changes(file, source) if text.count(c["old"]) == 1]
        rooms.setdefault(room, []).extend(found)
    rooms = {room: found for room, found in rooms.items() if found and tests_of(room, tests)}
    total, chance = sum(map(len, rooms.values())), random.Random(seed)
    return [
        mutant | {"tests": tests_of(room, tests)}
        for room, found in sorted(rooms.items())
        for mutant in chance.sample(found, max(1, round(number * len(found) / total)))
        if is_python((source / mutant["file"]).read_text("utf-8"), mutant)
    ]


def is_python(text: str, mutant: dict) -> bool:
    """Test for a mutant that can be read; any test would catch one that cannot."""
    with contextlib.suppress(SyntaxError):
        return bool(ast.parse(text.replace(mutant["old"], mutant["new"])))
    return False


def tests_of(room: str, tests: Path) -> list[str]:
    """The folder or file of the tests of a room."""
    if (tests / room).is_dir():
        return [room]
    return [
        name
        for name in (f"test_{room}.py", f"test_robins_{room[:-1]}.py")
        if (tests / name).exists()
    ]
