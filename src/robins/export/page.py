"""The page of an exported folder: how its library is called, and what single precision costs."""

from __future__ import annotations

from robins import __version__
from robins.export.library import Library, template
from robins.export.single_precision import LEAST, MARGIN, PrecisionCost
from robins.filters import SENTENCES, Code


def page(library: Library, name: str, label: str, found: PrecisionCost | None) -> str:
    """README of an exported folder, in Markdown.

    Args:
        library: of the filter.
        name: of the filter.
        label: of the problem by which it was tried.
        found: cost of single precision; None in double precision.
    """
    calls = "\n".join(f"    {library.signature(e)};" for e in library.entries)
    codes = "\n".join(f"| {int(code)} | {sentence} |" for code, sentence in SENTENCES.items())
    return template("readme.md").format(
        n=library.name,
        filter=name,
        label=label,
        version=__version__,
        calls=calls,
        codes=codes,
        not_finite=int(Code.NOT_FINITE),
        costs=_costs(found),
    )


def _costs(found: PrecisionCost | None) -> str:
    """The part of the page on single precision."""
    if found is None:
        return ""
    fails = "" if found.bearable else " It fails, since the filter is ruined."
    text = template("single_precision.md")
    return text.format(of=found, table=found.table(), margin=MARGIN, least=LEAST, fails=fails)
