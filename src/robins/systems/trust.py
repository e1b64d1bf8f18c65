"""User code that robins may run, and the user's confirmation of it.

A file that the user names, on the command line or in a call, runs as any Python script does. A
file that another file names (a scenario, a campaign, the header of a record) runs only if the user
has confirmed it. Confirmations are kept in the user's configuration folder, by path, with a digest
of the file and of the local modules that it can import. What runs is the text that was hashed: no
compiled file next to it is read, and no folder is added to `sys.path`.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import json
import os
import shlex
import sys
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from robins.errors import RobinsError

_SUFFIXES = (".py", *EXTENSION_SUFFIXES)
_here: dict[str, str] = {}  # digests confirmed in this process, by path
_local: dict[str, tuple[Path, bytes]] = {}  # files and contents of local modules, by module name


def store() -> Path:
    """File of the confirmations: JSON, path -> digest."""
    home = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(home) / "robins" / "trusted.json"


def confirm(path: Path) -> None:
    """Let a file run, with the local modules that it imports, now and until one of them changes.

    Raises:
        RobinsError: there is no such file.
    """
    path = path.resolve()
    now = _here[str(path)] = digest(path)
    if (known := _stored()).get(str(path)) == now:
        return
    with contextlib.suppress(OSError):  # then the confirmation holds only in this process
        store().parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor, new = tempfile.mkstemp(dir=store().parent)
        with open(descriptor, "w", encoding="utf-8") as file:
            json.dump(known | {str(path): now}, file, indent=2)
        os.replace(new, store())


def confirmed() -> list[str]:
    """Files confirmed in this process, for the processes that it starts."""
    return list(_here)


def require(path: Path, named_in: str | os.PathLike[str]) -> None:
    """Refuse to run a file named in another file unless the user has confirmed it.

    Args:
        path: Python file, or a program.
        named_in: file, folder or address that names it, for the error.

    Raises:
        RobinsError: it is not confirmed, has changed since, or does not exist.
    """
    path = path.resolve()
    now, known = digest(path), _stored().get(str(path))
    if now in (known, _here.get(str(path))):
        return
    others = len(modules(path)) - 1
    with_others = f" with {others} local modules" if others else ""
    state = "has changed since you confirmed it" if known else "you have not confirmed"
    raise RobinsError(
        f"names code, {path}{with_others}, that {state}",
        named_in,
        f"read it; if it may run, repeat the command with --trust {shlex.quote(str(path))}",
    )


def _stored() -> dict[str, str]:
    try:
        known = json.loads(store().read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def digest(path: Path) -> str:
    """SHA-256 of a file and of the local modules that it can import.

    Raises:
        RobinsError: there is no such file.
    """
    sha = hashlib.sha256()
    for file, content in sorted(modules(path.resolve()).values()):
        inside = hashlib.sha256(content).hexdigest()
        sha.update(f"{os.path.relpath(file, path.resolve().parent)}\0{inside}\n".encode())
    return sha.hexdigest()


def modules(path: Path) -> dict[str, tuple[Path, bytes]]:
    """A file and the modules of its folder that it imports, with their contents, by module name.

    Imports anywhere in a file count, and all files of a package. A name that Python finds
    elsewhere is not local.

    Raises:
        RobinsError: the file cannot be read.
    """
    if not path.is_file():
        raise RobinsError("there is no such file", path)
    try:
        found = {path.stem: (path, path.read_bytes())}
        waiting = [path.stem]
        while waiting and path.suffix == ".py":
            name = waiting.pop()
            new = dict(_named_by(name, *found[name], path.parent))
            waiting += [one for one in new if one not in found]
            found = new | found
    except OSError as error:
        raise RobinsError(f"cannot be read: {error}", path) from None
    return found


def _named_by(
    name: str, file: Path, content: bytes, root: Path
) -> Iterator[tuple[str, tuple[Path, bytes]]]:
    """Local modules that the import statements of a module can name."""
    for wanted in _imports(name, file, content):
        steps = wanted.split(".")
        if elsewhere(steps[0], root):
            continue
        for end in range(1, len(steps) + 1):
            folder = root.joinpath(*steps[:end])
            if (folder / "__init__.py").is_file():
                files = sorted(p for p in folder.rglob("*") if p.name.endswith(_SUFFIXES))
            else:
                beside = (folder.with_name(folder.name + suffix) for suffix in _SUFFIXES)
                files = [one for one in beside if one.is_file()]
            for one in files:
                parts = [*one.relative_to(root).parts[:-1], one.name.partition(".")[0]]
                dotted = ".".join(parts).removesuffix(".__init__")
                yield dotted, (one, one.read_bytes())


def _imports(name: str, file: Path, content: bytes) -> Iterator[str]:
    """Dotted names in the import statements of a module."""
    try:
        tree = ast.parse(content) if file.suffix == ".py" else ast.Module([], [])
    except (SyntaxError, ValueError):
        return  # importing it will report the line
    package = name.split(".") if file.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*up, *filter(None, [node.module])])
            yield from (f"{base}.{alias.name}".strip(".") for alias in node.names)


def elsewhere(name: str, root: Path) -> str:
    """File of a top-level module that Python finds outside the folder `root`; "" if none."""
    if name in sys.stdlib_module_names:
        return f"the standard library's {name}"
    for finder in sys.meta_path:
        spec = None if finder is _FINDER else finder.find_spec(name, None)
        if spec is not None and spec.origin is not None:
            return "" if Path(spec.origin).resolve().is_relative_to(root) else spec.origin
    return ""


def load(path: Path) -> ModuleType:
    """Import a file and, as it imports them, the local modules that belong to its digest.

    Raises:
        RobinsError: a local module has the name of another module.
        Exception: any that the file raises.
    """
    path = path.resolve()
    found = modules(path)
    names = {path.stem: elsewhere(path.stem, path.parent)}
    for name, (file, _) in found.items():
        loaded = getattr(sys.modules.get(name), "__file__", None)
        if loaded is not None and Path(loaded).resolve() != file:
            names[name] = loaded
    for name, other in names.items():
        if other:
            raise RobinsError(
                f"the name {name} is that of another module, {other}",
                found[name][0],
                "give the file another name",
            )
    _local.update(found)
    return importlib.import_module(path.stem)


def place(error: BaseException, files: Iterable[Path] = ()) -> str:
    """File and line of the last call of an error in certain files; "" if it has none in them.

    Args:
        error: as caught.
        files: resolved; those loaded in this process where none is given.
    """
    files = set(files) or {file for file, _ in _local.values()}
    calls = [
        f"{path}, line {frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if (path := Path(frame.filename).resolve()) in files
    ]
    return calls[-1] if calls else ""


def _spec(
    name: str, _path: Iterable[str] | None = None, _target: ModuleType | None = None
) -> ModuleSpec | None:
    """Specification of a local module, from the text that was hashed."""
    if name not in _local:
        folders = {file.parent for key, (file, _) in _local.items() if key.startswith(f"{name}.")}
        return ModuleSpec(name, None, is_package=True) if folders else None
    file, content = _local[name]
    if file.suffix != ".py":
        return spec_from_file_location(name, file)
    loader = SourceFileLoader(name, str(file))
    loader.get_code = lambda fullname: loader.source_to_code(content, str(file))
    home = [str(file.parent)] if file.name == "__init__.py" else None
    return spec_from_file_location(name, file, loader=loader, submodule_search_locations=home)


_FINDER: Any = SimpleNamespace(find_spec=_spec)
sys.meta_path.insert(0, _FINDER)
