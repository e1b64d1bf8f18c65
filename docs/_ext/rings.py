"""The three rings of names: stable, may change, inside; and the front door as a table."""

import importlib
import inspect
import pkgutil
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

from generated import setup_of, table

import robins

DOCS = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(r"^from (robins[\w.]*) import (\w[\w, ]*|\([\w,\s]+\))$", re.MULTILINE)


def home_of(thing: object, module: str, name: str) -> tuple[str, str]:
    """Module that defines something, and its name there; as it was found where it does not say."""
    home = getattr(thing, "__module__", None)
    return (home, thing.__name__) if home and hasattr(thing, "__name__") else (module, name)


def packages() -> list[str]:
    """Packages of robins, each with a list of its public names."""
    below = pkgutil.walk_packages(robins.__path__, "robins.")
    return [m.name for m in below if m.ispkg and "._" not in m.name]


def imported_by_pages() -> set[tuple[str, str]]:
    """Module and name of whatever the examples of a page import."""
    texts = (p.read_text("utf-8") for p in DOCS.rglob("*") if p.suffix in (".md", ".py"))
    found = (pair for text in texts for pair in _IMPORT.findall(text))
    return {(module, name) for module, names in found for name in re.findall(r"\w+", names)}


@cache
def rings() -> dict[str, dict[str, set[str]]]:
    """Module -> ring -> names of the module that are in it; all others are inside."""
    found: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    stable = [tuple(place.split(":")) for place in robins.FRONT_DOOR.values()]
    listed = [(p, name) for p in packages() for name in importlib.import_module(p).__all__]
    for ring, names in (("stable", stable), ("may change", [*listed, *imported_by_pages()])):
        for module, name in names:
            thing = getattr(importlib.import_module(module), name, None)
            home, called = home_of(thing, module, name)
            if called not in found[home]["stable"] and not called.startswith("_"):
                found[home][ring].add(called)
    return found


def line_of(name: str) -> str:
    """Rings of the names of a module, in a line for its page."""
    module = importlib.import_module(name)
    package, room = hasattr(module, "__path__"), name.count(".") == 1
    if package:
        return "*Names listed here may change*, but for those of the front door, which are stable."
    mine = rings()[name]
    stable = ", ".join(f"`{n}`" for n in sorted(mine["stable"]))
    change = ", ".join(f"`{n}`" for n in sorted(mine["may change"]))
    if room:
        return f"*May change*{f', but {stable} is stable' if stable else ''}."
    parts = [f"*Stable:* {stable}." if stable else "", f"*May change:* {change}." if change else ""]
    rest = "*All other names are inside.*" if stable or change else "*Inside.*"
    return " ".join([*filter(None, parts), rest])


def front_door() -> str:
    """Names of the front door, each with its home and the first sentence about it."""
    rows = []
    for name, place in robins.FRONT_DOOR.items():
        thing = getattr(robins, name)
        home = ".".join(home_of(thing, *place.split(":")))
        kind = "class" if inspect.isclass(thing) else "func"
        text = re.sub(r"\s*\([^)]*\)", "", inspect.getdoc(thing) or "").split("\n\n")[0]
        first = text.split(". ")[0].replace("\n", " ")
        rows.append((f"rb.{name}", f"{{py:{kind}}}`{home}`", first.rstrip(".").replace("|", "\\|")))
    return table(("name", "home", "what it is"), rows)


setup = setup_of(front_door=front_door)
