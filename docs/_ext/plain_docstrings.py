"""Docstrings as they are typed: an asterisk multiplies, a bar is a modulus, an indent is code.

reStructuredText reads ``|f|`` as a substitution, ``lambda_`` as a link and ``K* x`` as emphasis.
Navigation docstrings are full of these, so they are escaped before Sphinx sees them, and an
indented block after a blank line (an equation, an example) is shown as it stands. Backticks,
``*emphasis*``, ``**strong**``, lists and Google sections keep their meaning.
"""

import re
from collections.abc import Iterator
from itertools import groupby

# Spans that keep their meaning: code, roles, emphasis, bullets, rows of drawn tables.
_KEPT = re.compile(
    r"``.+?``|(?::[\w:]+:)?`[^`]+`_{0,2}"
    r"|(?<!\S)\*\*\w[^*]*\*\*(?!\w)|(?<!\S)\*\w[^*\n]*\*(?!\w)"
    r"|^ *\* |^ *[|+][-=| ].*$",
    re.DOTALL | re.MULTILINE,
)
_MARKUP = re.compile(r"(?<!\\)[*|]|(?<=\w)_(?!\w)")
_AS_IT_IS = re.compile(r" *(>>> |=+ +=)")  # examples with results; tables, which must stay aligned
_LIST_ITEM = re.compile(r" *([-*+]|\d+[.)]|#\.) ")


def _escape(text: str) -> str:
    out, at = [], 0
    for kept in _KEPT.finditer(text):
        out += [_MARKUP.sub(r"\\\g<0>", text[at : kept.start()]), _apart(kept)]
        at = kept.end()
    return "".join([*out, _MARKUP.sub(r"\\\g<0>", text[at:])])


def _apart(kept: re.Match) -> str:
    """A span as reStructuredText wants it: code without outer blanks, not glued to a word."""
    span = kept[0]
    if not span.endswith("`"):
        return span
    if span.startswith("``"):
        span = f"``{span[2:-2].strip()}``"
    before, after = kept.string[: kept.start()][-1:], kept.string[kept.end() :][:1]
    return (r"\ " if before.isalnum() else "") + span + (r"\ " if after.isalnum() else "")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def plain(lines: list[str]) -> Iterator[str]:
    """The lines of a docstring as reStructuredText that shows what was typed."""
    base, last, literal = 0, "", False
    for blank, paragraph in groupby(lines, lambda line: not line.strip()):
        block = list(paragraph)
        if blank:
            yield from block
            continue
        deeper = _indent(block[0]) > base
        listed = _LIST_ITEM.match(last) or _LIST_ITEM.match(block[0])
        if deeper and last and (literal or not listed):
            if not literal and not last.endswith("::"):
                yield from (" " * base + "::", "")
            code = next((k for k, line in enumerate(block) if _indent(line) <= base), len(block))
            yield from block[:code]
            block = block[code:]
            literal = not block
            if literal:
                continue
            yield ""
        literal = False
        base, last = _indent(block[-1]), block[-1]
        text = "\n".join(block)
        yield from (text if _AS_IT_IS.match(text) else _escape(text)).split("\n")


def setup(app) -> dict:
    """Run before napoleon (priority 500), which adds markup of its own."""

    def process(_app, _what, _name, _thing, _options, lines):
        lines[:] = plain(lines)

    app.connect("autodoc-process-docstring", process, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
