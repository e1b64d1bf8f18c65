"""The tables of log formats and of what columns hold, as `robins.logs` has them."""

from generated import setup_of, table

from robins.logs.quantities import GROUPS, TABLES
from robins.logs.registry import FORMATS
from robins.logs.text_format import ANY
from robins.logs.text_formats import TEXT_FORMATS


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


setup = setup_of(formats=formats, columns=columns, quantities=quantities)
