"""The front door with its types: `src/robins/__init__.pyi`, for editors and checkers.

python tests/front_door.py    write it of the table `robins.FRONT_DOOR`
"""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import robins

STUB = Path(robins.__file__).with_suffix(".pyi")
HEAD = '''"""Types of `robins.FRONT_DOOR`; written by `python tests/front_door.py`, not by hand."""

'''


def home_of(name: str) -> tuple[str, str]:
    """Module that defines what a name of the front door means, and its name there."""
    found = getattr(robins, name)
    return found.__module__, found.__qualname__


def stub() -> str:
    """Text of the stub, before ruff sorts it."""
    homes = [(*home_of(name), name) for name in robins.__all__]
    lines = [f"from {module} import {home} as {name}" for module, home, name in homes]
    names = f"__all__ = {robins.__all__}"
    return HEAD + "\n".join(
        [*lines, "", names, "__version__: str", "FRONT_DOOR: dict[str, str]", ""]
    )


def typed(text: str) -> dict[str, object]:
    """Names that the imports of a stub give, with what each of them is."""
    imports = [node for node in ast.parse(text).body if isinstance(node, ast.ImportFrom)]
    return {
        alias.asname or alias.name: getattr(importlib.import_module(node.module or ""), alias.name)
        for node in imports
        for alias in node.names
    }


if __name__ == "__main__":
    STUB.write_text(stub(), "utf-8")
    for step in ("check --fix --quiet --select I,RUF022", "format --quiet"):
        subprocess.run([sys.executable, "-m", "ruff", *step.split(), STUB], check=True)
