"""Columns of numbers from a text log: fast, strict, in bounded memory.

Blocks of complete lines are read by NumPy's C reader, which reads a number exactly or not at all.
Refused blocks are read again line by line, to allow comments and empty fields or to name line,
field and value. A number is never completed, shortened or guessed:

- a last line without its line end may have lost digits, so it is omitted and reported;
- a first line shorter than the next (a recording that began mid-line) likewise;
- an empty field, ``nan`` and ``inf`` are kept as NaN and infinities, for `clean` to count;
- anything else that is not a number is a `LogError`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robins.logs.findings import AnyPath, Finding, Findings, LogError, refused, report
from robins.logs.opening import Source

_PARSE_BYTES = 1 << 22
_LONGEST_LINE = 1 << 16
_TEXT_BYTES = 40
_TEXT, _NUMBER_TYPE, _UNREAD = f"S{_TEXT_BYTES}", "f8", "S1"
_BOM, _LF = b"\xef\xbb\xbf", b"\n"
_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.I)
COMMENTS = ("#", "%")


class TextLayout(NamedTuple):
    """Layout of the lines of a file.

    Columns at the indices `texts`, at least one, are kept as text (time stamps are read from their
    digits), those at `numbers` are numbers, others may hold anything. More columns than those named
    may follow; all lines must have as many as the first ones.
    """

    names: tuple[str, ...]
    delimiter: str | None  # None: blanks
    texts: tuple[int, ...] = (0,)
    numbers: tuple[int, ...] | None = None  # ascending; None: all that are not text
    skip: int = 0  # header lines
    all_named: bool = False  # no further columns: additional fields are decimal commas
    decimal: str = "."

    def number(self, place: int) -> int:
        """Index into `Columns.values` of the column with this index in the file."""
        if self.numbers is not None:
            return self.numbers.index(place)
        return place - sum(text < place for text in self.texts)


class Columns(NamedTuple):
    """Text columns and number columns of n rows, and their line numbers."""

    texts: np.ndarray  # (n, texts) bytes
    values: np.ndarray  # (n, numbers) float64
    rows: np.ndarray  # (n,) line numbers, from 1


class Head(NamedTuple):
    """First complete lines of a file, to recognise its format; none for a binary one."""

    file: str
    lines: list[str]
    start: bytes = b""  # the first bytes of a binary file
    names: tuple[str, ...] = ()  # of the columns, for an archive
    arrays: tuple[np.ndarray, ...] = ()  # the columns of an archive

    def data(self, count: int = 50) -> list[tuple[int, str]]:
        """Line numbers and text of the first lines that are neither blank nor comments."""
        lines = enumerate(self.lines, start=1)
        found = [(k, t) for k, t in lines if t.strip() and not t.lstrip().startswith(COMMENTS)]
        return found[:count]


def peek(path: AnyPath) -> Head:
    """Read the first lines of a file, at most 64 KiB.

    Raises:
        LogError: the file is empty, cannot be opened, or is not text.
    """
    start = b""
    for block in Source(path):
        start += block[:_LONGEST_LINE]
        if len(start) >= _LONGEST_LINE:
            break
    file = str(path)
    if not start:
        raise LogError(file, "is empty (0 bytes)", "record or copy it again")
    _refuse_nul(file, start[:_LONGEST_LINE], 1)
    start = start[:_LONGEST_LINE].removeprefix(_BOM)
    if b"\r" in start and _LF not in start:
        remedy = "save it with line ends LF or CR LF"
        raise refused(file, "line 1")("its lines end in CR alone", remedy)
    try:
        text = start[: start.rfind(_LF) + 1 or None].decode("utf-8")
    except UnicodeDecodeError as error:
        line = start[: error.start].count(_LF) + 1
        at = refused(file, f"line {line}")
        raise at("is not text in UTF-8", "is this the log itself?") from error
    return Head(file, [line.removesuffix("\r") for line in text.removesuffix("\n").split("\n")])


def read_columns(path: AnyPath, layout: TextLayout, findings: Findings = None) -> Columns:
    """Read all lines of a file.

    Args:
        path: the file; .xz and .gz are recognised by content.
        layout: names, delimiter and header of its columns.
        findings: receives omissions; without it they are issued as `LogWarning`.

    Raises:
        LogError: no samples, a field that is not a number, a line of another length, no text file.
    """
    file = str(path)
    width, cut_first = _width(peek(path), layout)
    reader = _BlockReader(file, layout, width)
    source = Source(path)
    parts, line, ends_early = [], 1, ""
    for block, whole in _blocks_of_lines(file, source):
        if not whole:
            ends_early = block.decode("utf-8", "replace")
            break
        count = block.count(_LF)
        skip = min(max(layout.skip - line + 1, 0), count)
        body = block.split(_LF, skip)[-1] if skip else block
        parts.append(reader.read(body, line + skip, cut_first))
        line += count
    table = Columns(*(np.concatenate(p) for p in zip(*parts, strict=True))) if parts else None
    if cut_first is not None:
        report(findings, _begins_midway(file, *cut_first))
    if table is None or not len(table.rows):
        raise LogError(file, "holds no whole line of samples", "record or copy it again")
    if ends_early or source.cut:
        report(findings, _ends_early(file, line, ends_early, source.cut))
    return table


def _refuse_nul(file: str, data: bytes, line: int) -> None:
    """Raise if the bytes contain NUL; `line` is the number of their first line."""
    if b"\0" in data:
        utf16 = data.startswith((b"\xff\xfe", b"\xfe\xff"))
        cause = "is UTF-16 text" if utf16 else "holds NUL bytes: a binary file, or one with a hole"
        remedy = "save it as UTF-8" if utf16 else "copy it again, or cut it before this line"
        raise refused(file, f"line {line + data[: data.index(bytes(1))].count(_LF)}")(cause, remedy)


def _blocks_of_lines(file: str, source: Source) -> Iterator[tuple[bytes, bool]]:
    """Blocks of complete lines, with True; then any rest after the last line end, with False."""
    line, rest = 1, b""  # rest begins on this line
    pending: list[bytes] = []
    for block in source:
        _refuse_nul(file, block, line + sum(p.count(_LF) for p in pending))
        pending.append(block)
        if sum(map(len, pending)) < _PARSE_BYTES:
            continue
        lines, rest = _split(b"".join(pending), line)
        line += lines.count(_LF)
        if len(rest) > _LONGEST_LINE:
            cause = f"is longer than {_LONGEST_LINE} bytes"
            raise refused(file, f"line {line}")(cause, "is this a text log with one sample a line?")
        yield lines, True
        pending = [rest]
    lines, rest = _split(b"".join(pending), line)
    if lines:
        yield lines, True
    if rest.strip():
        yield rest, False


def _split(data: bytes, line: int) -> tuple[bytes, bytes]:
    """Complete lines, and the rest after the last line end."""
    if line == 1:
        data = data.removeprefix(_BOM)
    at = data.rfind(_LF) + 1
    return data[:at], data[at:]


def _width(head: Head, layout: TextLayout) -> tuple[int, tuple[int, str] | None]:
    """Number of fields per line, and the first line if it is shorter than the second."""
    data = [d for d in head.data(layout.skip + 3) if d[0] > layout.skip]
    if not data:
        raise LogError(head.file, "holds no sample: header only", "record it again")
    widths = [len(_fields(text.encode(), layout.delimiter)) for _, text in data[:2]]
    cut = len(widths) == 2 and widths[0] < widths[1]
    width = max(widths)
    if width < len(layout.names) or (layout.all_named and width > len(layout.names)):
        raise refused(head.file, f"line {data[-1][0] if cut else data[0][0]}")(
            f"{width} fields where {len(layout.names)} are needed: {', '.join(layout.names)}",
            "is it of another format, or separated by other characters?"
            if width < len(layout.names)
            else "write numbers with a decimal point, not a comma; or name all columns",
        )
    return width, (data[0] if cut else None)


def _fields(line: bytes, delimiter: str | None) -> list[bytes]:
    return line.split(delimiter.encode() if delimiter else None)


class _BlockReader:
    """Converter of blocks of complete lines to arrays."""

    def __init__(self, file: str, layout: TextLayout, width: int):
        self.file, self.layout, self.width = file, layout, width
        numbers = range(width) if layout.numbers is None else layout.numbers
        self.kinds = [
            _TEXT if k in layout.texts else _NUMBER_TYPE if k in numbers else _UNREAD
            for k in range(width)
        ]
        runs = [(kind, len(list(run))) for kind, run in groupby(self.kinds)]
        self.dtype = np.dtype([(str(k), kind, (n,)) for k, (kind, n) in enumerate(runs)])
        self.runs = [kind for kind, _ in runs]

    def read(self, block: bytes, line: int, cut_first: tuple[int, str] | None) -> Columns:
        """Columns of a block whose first line has this number."""
        if self.layout.decimal != ".":
            block = block.replace(self.layout.decimal.encode(), b".")
        try:
            table, separator = np.zeros(0, self.dtype), self.layout.delimiter
            if block.strip():
                lines = io.BytesIO(block)
                table = np.loadtxt(lines, self.dtype, None, separator, ndmin=1, encoding="latin1")
        except Exception:  # from the decoder of NumPy: line by line, the place is found
            table = None
        if table is None or len(table) != block.count(_LF):
            return self._line_by_line(block, line, cut_first)
        texts = self._joined(table, _TEXT)
        if np.any(texts.view(np.uint8)[:, _TEXT_BYTES - 1 :: _TEXT_BYTES]):
            return self._line_by_line(block, line, cut_first)
        rows = np.arange(line, line + len(table))
        return Columns(texts, self._joined(table, _NUMBER_TYPE), rows)

    def _joined(self, table: np.ndarray, kind: str) -> np.ndarray:
        """Columns of one kind, stacked."""
        runs = [table[str(k)] for k, own in enumerate(self.runs) if own == kind]
        return np.hstack(runs) if runs else np.zeros((len(table), 0), kind)

    def _line_by_line(self, block: bytes, line: int, cut_first: tuple[int, str] | None) -> Columns:
        comments = tuple(c.encode() for c in COMMENTS)
        texts, values, rows = [], [], []
        for number, raw in enumerate(block.removesuffix(_LF).split(_LF), start=line):
            text = raw.strip(b" \r" if self.layout.delimiter == "\t" else None)
            if not text or text.startswith(comments):
                continue
            if cut_first is not None and number == cut_first[0]:
                continue
            fields = _fields(text, self.layout.delimiter)
            if len(fields) != self.width:
                raise refused(self.file, f"line {number}")(
                    f"{len(fields)} fields where the first lines have {self.width}",
                    "bytes are missing, or numbers have decimal commas; delete or repair the line",
                )
            texts.append([self._text(number, k, fields[k]) for k in self._places(_TEXT)])
            values.append([self._number(number, k, fields[k]) for k in self._places(_NUMBER_TYPE)])
            rows.append(number)
        return Columns(
            np.array(texts, _TEXT).reshape(len(rows), self.kinds.count(_TEXT)),
            np.array(values, np.float64).reshape(len(rows), self.kinds.count(_NUMBER_TYPE)),
            np.array(rows, np.int64),
        )

    def _places(self, kind: str) -> list[int]:
        return [k for k, own in enumerate(self.kinds) if own == kind]

    def _text(self, line: int, k: int, field: bytes) -> bytes:
        field = field.strip()
        if len(field) >= _TEXT_BYTES:
            raise self._no_number(line, k, field, "is too long for a time stamp")
        return field

    def _number(self, line: int, k: int, field: bytes) -> float:
        field = field.strip()
        if not field:
            return np.nan
        if not _NUMBER.fullmatch(field):
            comma = " (a decimal comma?)" if b"," in field else ""
            raise self._no_number(line, k, field, f"is not a number{comma}")
        return float(field)

    def _no_number(self, line: int, k: int, field: bytes, cause: str) -> LogError:
        names, shown = self.layout.names, field[:_TEXT_BYTES].decode("utf-8", "replace")
        name = names[k] if k < len(names) else f"column {k + 1}"
        return refused(self.file, f"line {line}", name, shown)(
            cause,
            "write numbers with a decimal point, nan where one is missing; or delete the line",
        )


def _ends_early(file: str, line: int, rest: str, cut: bool) -> Finding:
    shown = rest.strip()[:60]
    what = "the compressed stream has no end mark" if cut else "the last line has no line end"
    lost = f"; line {line} ({shown!r}) may have lost digits and is left out" if rest else ""
    sentence = (
        f"{Path(file).name} ends early at line {line}: {what}{lost}. The recording or the copy was "
        "interrupted; all lines before it were read. Copy it again if the original is longer."
    )
    return Finding("warning", "ends_early", file, f"line {line}", shown, sentence)


def _begins_midway(file: str, line: int, text: str) -> Finding:
    sentence = (
        f"{Path(file).name} line {line} ({text[:60]!r}) has fewer fields than the next: the "
        "recording began in the middle of a line. It is left out; nothing else is affected."
    )
    return Finding("warning", "begins_midway", file, f"line {line}", text[:60], sentence)
