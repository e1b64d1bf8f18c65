"""Errors about input that cannot be used."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from robins.errors import RobinsError


class InputError(RobinsError, ValueError):
    """An input of a command that cannot be used."""


@contextlib.contextmanager
def refusing(what: str | os.PathLike[str]) -> Iterator[None]:
    """Raise a ValueError as an InputError that names what it is about.

    Raises:
        InputError: in place of the ValueError.
    """
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), what) from error
