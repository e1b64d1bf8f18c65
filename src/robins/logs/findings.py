"""What is said about a log: findings, which are counted and read on, and errors, which stop.

Both name the file, the line or time, the value, the likely cause and the mend, in one sentence.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing worth saying about a log.

    An *error* means a run on these data would be wrong or meaningless, a *warning* that it will be
    worse than it could be or that samples were refused, a *note* that someone should know.
    """

    severity: Severity
    code: str  # for programs: "gravity_unit", "time_gap", ...
    file: str
    where: str  # "line 12", "lines 12-40", "time 3.250 s", "" for the whole file
    value: float | int | str
    sentence: str  # for people; complete without the other fields

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


class LogError(ValueError):
    """A log was refused.

    Attributes:
        file: the file, or what stood in its place.
        where: line or time; empty when the whole file is meant.
        field: name of the column; empty when the whole line is meant.
        value: the offending text or number.
        cause: what is wrong.
        mend: what to do about it.
    """

    def __init__(
        self,
        file: str,
        cause: str,
        mend: str,
        *,
        where: str = "",
        field: str = "",
        value: object = "",
    ):
        super().__init__(file, where, field, value, cause, mend)
        self.file, self.where, self.field = file, where, field
        self.value, self.cause, self.mend = value, cause, mend

    def __str__(self) -> str:
        at = f"{self.file} {self.where}".strip()
        what = self.field if self.value == "" else f"{self.field} = {self.value!r}"
        return f"{': '.join(part for part in (at, what, self.cause) if part)}; {self.mend}"


class LogWarning(UserWarning):
    """A finding of a reader that was given no list to put it in."""


def report(findings: list[Finding] | None, finding: Finding) -> None:
    """Append to the list; without one, issue a `LogWarning`: nothing is refused silently."""
    if findings is None:
        warnings.warn(str(finding), LogWarning, stacklevel=3)
    else:
        findings.append(finding)


def by_severity(findings: list[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes; otherwise in the order they were made."""
    return sorted(findings, key=lambda f: SEVERITIES.index(f.severity))
