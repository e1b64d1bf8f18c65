"""The report: one self-contained HTML file, for screen (light and dark) and print."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

from robins.report import numbers
from robins.report.embed import Embedded, RenderedPicture, embed
from robins.report.numbers import Claim, Summary, Values
from robins.report.style import Picture

LIMIT = 500_000  # bytes of the whole page

_SIGNS = {"reproduced": "✓", "partly": "≈", "not": "✗", "undecided": "?"}
_LOCKED = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_LONGEST_SCENARIO = 40_000  # characters shown; the manifest has the whole


class ReportOrigin(NamedTuple):
    """Origin of a result."""

    command: str
    scenario_text: str
    device: str
    versions: Mapping[str, str]
    created_utc: str
    notes: Sequence[str] = ()  # sentences for the reader


def page(
    summary: Summary,
    drawn: Sequence[RenderedPicture],
    origin: ReportOrigin,
    limit: int = LIMIT,
) -> str:
    """The report as HTML of at most `limit` bytes; pictures are made coarser or left out to fit."""
    text = _page(summary, _figures([]), origin)
    room = limit - len(text.encode()) - sum(len(_frame(d.picture).encode()) for d in drawn)
    return _page(summary, _figures(embed(drawn, max(room, 0))), origin)


def _page(summary: Summary, figures: str, origin: ReportOrigin) -> str:
    title = escape(summary["scenario"])
    runs = "1 run" if summary["runs"] == 1 else f"{summary['runs']} runs"
    meta = [
        runs,
        f"seed {summary['seed']}",
        f"{numbers.show(summary['seconds'])} s on {escape(origin.device)}",
        f"robins {escape(origin.versions.get('robins', ''))}",
        escape(origin.created_utc),
    ]
    here = Path(__file__)
    texts = {name: here.with_name(name).read_text("utf-8") for name in ("page.html", "page.css")}
    return texts["page.html"].format(
        locked=_LOCKED,
        title=title,
        css=texts["page.css"],
        meta=" · ".join(meta),
        verdict=_verdict(summary),
        warnings=_sentences("warning", summary.get("warnings", ())),
        notes=_sentences("note", origin.notes),
        metrics=_metrics(summary["filters"]),
        claims=_claims(summary["claims"]),
        figures=figures,
        counts=_counts(summary["counts"]),
        reproduce=_reproduce(summary, origin),
    )


def _verdict(summary: Summary) -> str:
    claims = summary["claims"]
    if sentence := summary.get("verdict", ""):
        worst = numbers.verdict_class(sentence)
        return f'<p class="verdict {worst}">{_SIGNS.get(worst, "")} {escape(sentence)}</p>'
    if not claims and not summary.get("machine"):
        return ""  # of a recorded log nothing is claimed
    verdicts = {claim["verdict"] for claim in claims}
    worst = next((v for v in ("not", "undecided", "partly", "reproduced") if v in verdicts), "")
    sign = f"{_SIGNS[worst]} " if worst else ""
    return f'<p class="verdict {worst}">{sign}{escape(numbers.verdict(claims))}</p>'


def _sentences(kind: str, sentences: Sequence[str]) -> str:
    return "\n".join(f'<p class="{kind}">{escape(sentence)}</p>' for sentence in sentences)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = "") -> str:
    body = "\n".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    named = f' class="{kind}"' if kind else ""
    return (
        f'<div class="scroll"><table{named}>\n<thead><tr>{"".join(head)}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _th(text: str, kind: str = "") -> str:
    return f'<th scope="col" class="{kind}">{escape(text)}</th>'


def _td(text: str, kind: str = "") -> str:
    return f'<td class="{kind}">{escape(text)}</td>'


def _metrics(filters: Mapping[str, Values]) -> str:
    names = dict.fromkeys(name for values in filters.values() for name in values)
    if not names:
        return ""
    head = [_th("Metric"), _th("Unit"), *(_th(name, "number") for name in filters)]
    rows = []
    for name in names:
        text, unit = numbers.label(name)
        cells = [
            _td(numbers.marked(of, name), f"number{' outside' * numbers.outside(of, name)}")
            for of in filters.values()
        ]
        rows.append([f'<th scope="row" title="{escape(name)}">{escape(text)}</th>'])
        rows[-1] += [_td(unit, "unit"), *cells]
    far = any(numbers.outside(of, name) for of in filters.values() for name in names)
    note = f'<p class="meta">{numbers.MARK} outside its band</p>' if far else ""
    return f"<section>\n<h2>Summary</h2>\n{_table(head, rows, 'metrics')}\n{note}</section>"


def _claims(claims: Sequence[Claim]) -> str:
    if not claims:
        return ""
    head = [_th("Verdict"), _th("Claim"), _th("Found", "number"), _th("Band", "number")]
    rows = [
        [
            _td(f"{_SIGNS[c['verdict']]} {c['verdict']}", f"tag {c['verdict']}"),
            f"<td>{escape(c['text'])} <span class='meta'>({escape(c['id'])})</span></td>",
            _td(numbers.claim_value(c["value"], c.get("interval")), "number"),
            _td(numbers.band(c["band"]), "number"),
        ]
        for c in claims
    ]
    return f"<section>\n<h2>Claims</h2>\n{_table(head, rows, 'claims')}\n</section>"


def _frame(picture: Picture) -> str:
    """HTML of a picture without its source."""
    return _figure(picture, "", 99999, 99999) + "\n" + " " * 80


def _figure(picture: Picture, source: str, width: int, height: int) -> str:
    head = f"<h3>{escape(picture.title)}</h3>{escape(picture.caption)}"
    if source:
        image = (
            f'<img src="{source}" width="{width}" height="{height}" alt="{escape(picture.title)}">'
        )
    else:
        name = escape(f"figures/{picture.name}.png")
        image = f'<p class="meta">Too large for this page: <a href="{name}">{name}</a></p>'
    return f"<figure><figcaption>{head}</figcaption>\n{image}\n</figure>"


def _figures(shown: Sequence[Embedded]) -> str:
    if not shown:
        return ""
    each = (_figure(one.picture, one.source, one.width, one.height) for one in shown)
    return "<section>\n<h2>Figures</h2>\n" + "\n".join(each) + "\n</section>"


def _counts(counts: Mapping[str, int]) -> str:
    if not any(counts.values()):
        body = "<p>Every sample was used.</p>"
    else:
        rows = [
            [
                f'<th scope="row">{escape(numbers.words(reason))}</th>',
                _td(numbers.show(n), "number"),
            ]
            for reason, n in counts.items()
        ]
        head = [_th("Reason"), _th("Samples", "number")]
        body = _table(head, rows, "narrow")
    return f"<section>\n<h2>Refused samples</h2>\n{body}\n</section>"


def _reproduce(summary: Summary, origin: ReportOrigin) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in origin.versions.items())
    command = origin.command or "(called from Python)"
    text = origin.scenario_text
    if len(text) > _LONGEST_SCENARIO:
        text = text[:_LONGEST_SCENARIO] + "\n(the rest is in manifest.json)"
    scenario = f"<details><summary>Scenario</summary><pre>{escape(text)}</pre></details>"
    return (
        "<section>\n<h2>How to reproduce</h2>\n"
        f"<pre>{escape(command)}</pre>\n"
        f"<p>Seed {summary['seed']}, device {escape(origin.device)}; {escape(versions)}.</p>\n"
        f"{scenario if text else ''}\n</section>"
    )
