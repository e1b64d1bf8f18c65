"""Lines of C that fit a page."""

from __future__ import annotations

COLUMNS = 100


def wrapped(text: str) -> str:
    """Text of C with its long lines wrapped."""
    return "\n".join(part for line in text.split("\n") for part in _parts(line))


def _parts(line: str) -> list[str]:
    """Break a line of C at spaces, in code after commas, into lines of at most 100 columns."""
    begin = line[: len(line) - len(line.lstrip())]
    lines = []
    while len(line) > COLUMNS and not line.startswith("#"):
        least = len(begin) + 24  # break no earlier than this
        comma, space = line.rfind(", ", least, COLUMNS), line.rfind(" ", least, COLUMNS)
        is_code = "/*" not in line and "*/" not in line
        at = comma + 1 if comma > 0 and is_code else space
        if at <= 0:
            break
        lines.append(line[:at])
        line = f"{begin}    {line[at + 1 :]}"
    return [*lines, line]
