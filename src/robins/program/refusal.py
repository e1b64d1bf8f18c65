"""Errors for functions that cannot become programs, and for programs that cannot be built."""

from __future__ import annotations

from robins.errors import RobinsError


class ProgramError(RobinsError, ValueError):
    """A function that cannot become a program; names the operation and the line that uses it."""


class BuildError(RobinsError):
    """No compiler was found, or it did not accept a program."""

    bad_input = False
