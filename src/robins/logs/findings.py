"""Messages about a log: findings, which are counted, and errors, which stop the reading.

Both give file, line or time, value, likely cause and fix in one sentence.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from robins.dataset import Finding as Finding  # defined with datasets; exported from here too
from robins.dataset import Severity as Severity
from robins.errors import RobinsError

AnyPath: TypeAlias = str | os.PathLike[str]
Findings: TypeAlias = list[Finding] | None
"""List for omissions and doubts of a reader; None: they are issued as `LogWarning`."""
Value = float | int | str
FETCH_AGAIN = "fetch it again; nothing of it was used, for no number in it can be trusted"
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


class LogError(RobinsError, ValueError):
    """A log was refused; `where` names the file, and line or time unless it is the whole file.

    Attributes:
        file: the file, or its replacement in messages.
        field: name of the column; "" for the whole line.
        value: the offending text or number.
    """

    def __init__(
        self,
        file: str,
        what: str,
        fix: str,
        *,
        where: str = "",
        field: str = "",
        value: object = "",
    ):
        cell = field if value == "" else f"{field} = {value!r}"
        super().__init__(f"{cell}: {what}" if cell else what, f"{file} {where}".strip(), fix)
        self.file, self.field, self.value = file, field, value


def refused(
    file: str, where: str = "", field: str = "", value: object = ""
) -> Callable[[str, str], LogError]:
    """Maker of a `LogError` about a place in a file, from the fault and its fix."""
    return lambda what, fix: LogError(file, what, fix, where=where, field=field, value=value)


@contextmanager
def os_errors(file: str, done: str = "read", fix: str = "check path and permissions"):
    """Context that turns an error of the operating system into a `LogError`."""
    try:
        yield
    except OSError as error:
        raise LogError(file, f"cannot be {done}: {error.strerror or error}", fix) from error


@contextmanager
def extra_package(file: str, what: str, package: str = "the package that reads it"):
    """Context that turns a failed import of a package of the extra `logs` into a `LogError`."""
    try:
        yield
    except ImportError as error:
        cause = f"is {what}, and {package} is not installed"
        raise LogError(file, cause, "install it with: pip install 'robins[logs]'") from error


class LogWarning(UserWarning):
    """A finding of a reader that was called without a list of findings."""


def make_finding(
    severity: Severity, code: str, file: str, where: str = "", value: Value = "", name: str = ""
) -> Callable[[str], Finding]:
    """Maker of a finding from its sentence, which follows name (or file) and place."""
    begin = f"{name or Path(file).name} {where}".rstrip()
    return lambda sentence: Finding(severity, code, file, where, value, f"{begin}: {sentence}")


def report(findings: Findings, finding: Finding) -> None:
    """Append to the list; without one, issue a `LogWarning`, so that nothing is silent."""
    if findings is None:
        warnings.warn(str(finding), LogWarning, stacklevel=3)
    else:
        findings.append(finding)


def finding_reporter(
    findings: Findings, severity: Severity, code: str, file: str, where: str = "", value: Value = ""
) -> Callable[[str], None]:
    """Reporter of the finding that `make_finding` makes of a sentence."""
    make = make_finding(severity, code, file, where, value)
    return lambda sentence: report(findings, make(sentence))


def damaged(file: str) -> Callable[[str], LogError]:
    """Maker of the error about a damaged file, from the reason."""
    return lambda why: LogError(file, f"is damaged ({why})", FETCH_AGAIN)


def report_left_out(findings: Findings, file: str, count: int, what: str) -> None:
    """Report the number of items not read because they are damaged, unless zero."""
    if count:
        make = finding_reporter(findings, "warning", "damaged_frames", file, value=count)
        make(f"{count} {what}; they are left out.")


def report_undated(findings: Findings, file: str, count: int, what: str) -> None:
    """Report the number of fixes without a date, unless zero."""
    if count:
        make = finding_reporter(findings, "note", "undated", file, value=count)
        make(f"{count} {what} have no date yet; they are left out.")


def report_cut_end(findings: Findings, file: str, at: int) -> None:
    """Report an incomplete last message."""
    finding_reporter(findings, "warning", "ends_early", file, f"byte {at}", at)(
        "the last message is not whole: the recording or the copy was interrupted. All before it "
        "was read."
    )


def report_geoid_heights(
    findings: Findings, file: str, fix: str, where: str = "", value: Value = "geoid"
) -> None:
    """Report heights that are not above the ellipsoid."""
    finding_reporter(findings, "warning", "height_above_geoid", file, where, value)(
        "heights are above the geoid, and robins takes them as above the WGS-84 ellipsoid. "
        f"Differences of height stay right; gravity errs by 3e-6 m/s^2 per metre. {fix}"
    )


def by_severity(findings: list[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes; otherwise in the order they were made."""
    return sorted(findings, key=lambda f: SEVERITIES.index(f.severity))
