"""The tables of log formats and of what columns hold, as `robins.logs` has them."""

from pathlib import Path

from robins.logs.quantities import GROUPS, TABLES
from robins.logs.registry import FORMATS
from robins.logs.text_format import ANY
from robins.logs.text_formats import TEXT_FORMATS


def table(head: tuple[str, ...], rows) -> str:
    """A table in Markdown; the first column is code."""
    lines = [head, ("---",) * len(head), *((f"`{first}`", *rest) for first, *rest in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def formats() -> str:
    """Every format and what it holds."""
    rows = ((f.name, ", ".join(TABLES[k].text for k in f.holds), f.about) for f in FORMATS)
    return table(("name", "holds", "written by"), rows)


def columns() -> str:
    """The columns of every format of text."""
    rows = []
    for row in TEXT_FORMATS:
        names = ", ".join(f"`{column.names[0]}`" for column in row.columns)
        units = dict.fromkeys(u for c in row.columns for u in c.units[1:])
        others = ", ".join("any" if u == ANY else u for u in units)
        between = "blanks" if row.separator == " " else f"`{row.separator}`"
        found = "by name" if row.named else "in order"
        rows.append((row.name, names, f"{found}, {between}", others))
    return table(("format", "columns", "found, parted by", "other units"), rows)


def quantities() -> str:
    """What a column may hold."""
    rows = (
        ("` `".join(g.kinds), ", ".join(dict.fromkeys(g.kinds.values())), g.text)
        for g in GROUPS.values()
    )
    return table(("quantities", "kind of unit", "meaning"), rows)


def write(app) -> None:
    """Write what `logs.md` includes; a table that has not changed is left untouched."""
    folder = Path(app.srcdir) / "_generated"
    folder.mkdir(exist_ok=True)
    for make in (formats, columns, quantities):
        path, text = folder / f"{make.__name__}.txt", make()
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def setup(app) -> dict:
    """Write the tables before Sphinx looks for sources."""
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
