"""What robins raises when it cannot use what it was given, or cannot do what it was asked."""

from __future__ import annotations


class RobinsError(Exception):
    """The base of all errors of robins: one sentence, ``where: what; fix``.

    Most are also a ValueError, for callers that catch those.

    Attributes:
        what: what is wrong.
        where: file and line, folder, option or part; empty where `what` names it.
        fix: what to do about it; empty where `what` says it.
        bad_input: whether what was given is wrong; otherwise doing it failed, as on a full disk.
    """

    bad_input: bool = True

    def __init__(self, what: str, where: object = "", fix: str = ""):
        self.what, self.where, self.fix = what, str(where), fix
        super().__init__(str(self))

    def __str__(self) -> str:
        sentence = f"{self.where}: {self.what}" if self.where else self.what
        return f"{sentence}; {self.fix}" if self.fix else sentence


_NOTHING = object()


def require(holds: object, sentence: str, got: object = _NOTHING) -> None:
    """Refuse an argument unless something holds of it: ``sentence, got ...`` where that is given.

    Raises:
        ValueError: it does not hold.
    """
    if not holds:
        raise ValueError(sentence if got is _NOTHING else f"{sentence}, got {got}")
