"""What the user gave and cannot be used."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterable, Iterator


class InputError(ValueError):
    """Something the user gave cannot be used; the message names it, says why and what to do."""


@contextlib.contextmanager
def refusing(what: object) -> Iterator[None]:
    """Say of a ValueError what it is about.

    Raises:
        InputError: in its place.
    """
    try:
        yield
    except ValueError as error:
        raise InputError(f"{what}: {error}") from error


def hint(word: str, among: Iterable[str]) -> str:
    """The end of a sentence about a word that is not known."""
    near = difflib.get_close_matches(word, list(among), 1)
    return f"; did you mean '{near[0]}'?" if near else "."
