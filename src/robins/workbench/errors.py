"""What the user gave and cannot be used."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterable, Iterator

from robins.errors import RobinsError


class InputError(RobinsError, ValueError):
    """Something a command was given cannot be used."""


@contextlib.contextmanager
def refusing(what: object) -> Iterator[None]:
    """Say of a ValueError what it is about.

    Raises:
        InputError: in its place.
    """
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), what) from error


def hint(word: str, among: Iterable[str]) -> str:
    """The end of a sentence about a word that is not known."""
    near = difflib.get_close_matches(word, list(among), 1)
    return f"; did you mean '{near[0]}'?" if near else "."
