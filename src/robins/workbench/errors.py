"""Errors about input that cannot be used."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from robins.errors import RobinsError


class InputError(RobinsError, ValueError):
    """An input of a command that cannot be used."""


@contextlib.contextmanager
def refusing(what: object) -> Iterator[None]:
    """Add to a ValueError what it is about.

    Raises:
        InputError: in its place.
    """
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), what) from error
