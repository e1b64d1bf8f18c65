"""Errors of this room when it cannot make a program, or cannot build one."""

from __future__ import annotations

from robins.errors import RobinsError


class ProgramError(RobinsError, ValueError):
    """A function cannot be made a program: it names the operation and the line that uses it."""


class BuildError(RobinsError):
    """No compiler was found, or it did not accept a program."""

    bad_input = False
