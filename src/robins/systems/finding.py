"""Lookup of systems by name: of robins, of an installed package, or in a file of the user.

A file is given with the name it defines, "my_system.py:study": a `System`, or a `Study`, which
becomes a system with that study alone. The file is imported, so it runs, and it can import the
modules of its folder; `robins.systems.trust` decides which files may run.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from robins import systems  # its names are imported on first use: a rig needs no study
from robins.errors import RobinsError, hint
from robins.systems import trust
from robins.systems.catalogue import is_file

if TYPE_CHECKING:
    from robins.systems.study import System


class UnknownSystem(RobinsError, ValueError):
    """A name without a system, or an object that is neither a system nor a study."""


def find_system(name: str, folder: Path = Path(), named_in: str | os.PathLike[str] = "") -> System:
    """The system with a name as in `robins list`, or "file.py:name", relative to a folder.

    Args:
        name: of the system.
        folder: to which a file is relative.
        named_in: file that names it; empty if the user named it.

    Raises:
        UnknownSystem: there is none; the message lists the known ones.
        RobinsError: it is a file named in another file, and the user has not confirmed it.
    """
    if is_file(name):
        return _of_file(name, folder, named_in)
    if name in (known := systems.SYSTEMS):
        return known[name]
    raise UnknownSystem(
        f"no system '{name}'{hint(name, known)} There are {', '.join(known)}",
        fix="for one of your own write file.py:name",
    )


def _of_file(name: str, folder: Path, named_in: str | os.PathLike[str]) -> System:
    where, _, wanted = name.partition(":")
    path = (folder / where).resolve()
    if named_in:
        trust.require(path, named_in)
    module = imported(path)
    kinds = systems.Study | systems.System
    offered = [key for key, value in vars(module).items() if isinstance(value, kinds)]
    if not offered:
        raise UnknownSystem(
            "it defines no study", path, "assign a robins.systems.Study to a name at its top level"
        )
    if wanted not in vars(module):
        raise UnknownSystem(
            f"no study '{wanted}' in it{hint(wanted, offered)}" if wanted else "no study is named",
            path,
            f"write one of {', '.join(f'{where}:{key}' for key in offered)}",
        )
    return as_system(f"{path.stem}:{wanted}", getattr(module, wanted), str(path))


def imported(path: Path) -> ModuleType:
    """Import, as a module, a file that the user has named or confirmed.

    Raises:
        UnknownSystem: there is no such file, or it cannot be imported.
    """
    try:
        trust.confirm(path)
        return trust.load(path)
    except RobinsError as error:
        raise UnknownSystem(error.what, error.where, error.fix) from None
    except Exception as error:
        raise UnknownSystem(
            f"importing it failed: {type(error).__name__}: {error}", _place(path, error)
        ) from error


def _place(path: Path, error: Exception) -> str:
    """File and line of an error: of the syntax error, or of the last call in this file."""
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).resolve() == path:
        return f"{path}, line {error.lineno}"
    return trust.place(error, [path]) or str(path)


def as_system(name: str, found: Any, where: str) -> System:
    """The object defined under a name, as a system.

    Raises:
        UnknownSystem: it is neither a system nor a study.
    """
    if isinstance(found, systems.System):
        return found
    if isinstance(found, systems.Study):
        return systems.System(name, {name.rpartition(":")[2]: found})
    kind = type(found).__name__
    raise UnknownSystem(
        f"it is of type {kind}", where, "a system is a robins.systems.System or a Study"
    )
