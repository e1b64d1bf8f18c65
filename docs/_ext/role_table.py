"""The arrays of a result folder, as a table for people, made of the table of roles."""

import re
from collections.abc import Iterator

from generated import setup_of

from robins.report import FIGURES
from robins.results import ROLES
from robins.results.roles import Role


def names(role: Role) -> str:
    """Names of the arrays of a row."""
    found = re.search(r"\{(.*)\}", role.variable)
    choices = found[1].split("|") if found else []
    every = [role.array_name(of) for of in choices] if len(choices) > 1 else [role.variable]
    return ", ".join(f"`{name}`" for name in every)


def drawn(role: Role) -> str:
    """Figures that show a role, each linked to its function."""
    made = (f.draw for f in FIGURES if role.name in f.roles.split())
    return ", ".join(f"{{py:func}}`~{d.__module__}.{d.__name__}`" for d in made)


def rows() -> Iterator[str]:
    """The table in Markdown."""
    yield "| role | arrays | dimensions | unit | what it is | drawn by |"
    yield "|---|---|---|---|---|---|"
    for role in ROLES:
        found = re.search(r"\{\w+\}", role.variable)
        of = found[0] if found else ""
        dims = ", ".join(role.dims.replace("{of}", of).split())
        needs = ", ".join(f"`{attr}`" for attr in role.attrs if f"`{attr}`" not in role.text)
        text = role.text.replace("{of}", of) + (needs and f"; attribute {needs}")
        cells = (f"`{role.name}`", names(role), dims, role.unit, text, drawn(role))
        yield f"| {' | '.join(cells)} |"


setup = setup_of(arrays=lambda: "\n".join([*rows(), ""]))
