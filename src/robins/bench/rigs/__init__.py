"""The rigs of the bench: one per vehicle, each in its own folder or file, and listed in a table.

A user's own rig is named with its file, "pendulum.py:rig".
"""

from __future__ import annotations

import importlib
import os
from functools import cache
from pathlib import Path

from robins.bench.rig import Rig
from robins.errors import RobinsError, hint
from robins.systems import trust
from robins.systems.catalogue import is_file

__all__ = ["RIGS", "UnknownRig", "rig_of"]

RIGS: tuple[str, ...] = ("satellite", "ins-gnss", "airship", "laboratory", "multirotor")
"""Rigs that come with robins: each is a module here with the attribute RIG."""


class UnknownRig(RobinsError, ValueError):
    """A name that is not a rig, or an object that is none."""


def rig_of(name: str, folder: Path = Path(), named_in: str | os.PathLike[str] = "") -> Rig:
    """Find a rig by its name, or by "file.py:name" relative to a folder.

    Args:
        name: of the rig.
        folder: to which the file is relative.
        named_in: file that names the rig; empty if the user does.

    Raises:
        UnknownRig: there is no such rig; the message lists the known ones.
        RobinsError: it is a file named in another file, and the user has not confirmed it.
    """
    if name in RIGS:
        return importlib.import_module(f"{__name__}.{name.replace('-', '_')}").RIG
    if is_file(name):
        where, _, wanted = name.partition(":")
        path = (folder / where).resolve()
        if named_in:
            trust.require(path, named_in)
        return _of_file(path, wanted)
    raise UnknownRig(
        f"no rig '{name}'{hint(name, RIGS)} There are {', '.join(RIGS)}",
        fix="for one of your own write file.py:name",
    )


@cache
def _of_file(path: Path, wanted: str) -> Rig:
    from robins.systems.finding import imported

    module = imported(path)
    if not isinstance(found := getattr(module, wanted, None), Rig):
        offered = [key for key, value in vars(module).items() if isinstance(value, Rig)]
        raise UnknownRig(
            f"no rig '{wanted}' in it{hint(wanted, offered)}" if wanted else "no rig is named",
            path,
            "assign a robins.bench.Rig to a name at its top level",
        )
    return found.varied(address=f"{path}:{wanted}")
