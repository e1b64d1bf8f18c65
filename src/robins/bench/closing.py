"""Objects that close at the end of a context."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TypeVar

ClosingT = TypeVar("ClosingT", bound="Closing")


class Closing(ABC):
    """A context manager that closes itself."""

    @abstractmethod
    def close(self) -> None:
        """Release what it holds. May be repeated."""

    def __enter__(self: ClosingT) -> ClosingT:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
