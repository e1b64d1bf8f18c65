"""The API reference: one page per public room of robins, written from the tree."""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

from rings import line_of
from sphinx import addnodes

import robins

_ARRAY = re.compile(r"\bjax(lib)?(\.\w+)*\.Array\b")


def modules_of(name: str) -> list[str]:
    """A room and the public modules below it."""
    room = importlib.import_module(name)
    below = pkgutil.walk_packages(getattr(room, "__path__", []), f"{name}.")
    return [name, *(m.name for m in below if "._" not in m.name)]


def section(name: str, underline: str = "-") -> str:
    """Reference of one module: what its docstring says, then its names.

    A package shows a list of its public names, each linked to the module that defines it.
    """
    module = importlib.import_module(name)
    lines = [name, underline * len(name), "", line_of(name), "", f".. automodule:: {name}"]
    if not hasattr(module, "__path__"):
        return "\n".join([*lines, "   :members:", ""])
    lines += ["   :no-members:", ""]
    for public in getattr(module, "__all__", []):
        thing = getattr(module, public)
        home = getattr(thing, "__module__", None)
        if inspect.ismodule(thing):
            lines.append(f"- `{public} <{thing.__name__}>`")
        elif isinstance(home, str) and home.startswith("robins.") and home != name:
            lines.append(f"- `{public} <{home}.{public}>`")
        else:
            lines.append(f"- ``{public}``")
    return "\n".join([*lines, ""])


def write(app) -> None:
    """Write the pages; one that has not changed is left untouched, so Sphinx skips it."""
    folder = Path(app.srcdir) / "_generated"
    folder.mkdir(exist_ok=True)
    rooms = sorted(m.name for m in pkgutil.iter_modules(robins.__path__) if m.name[0] != "_")
    pages = {f"robins.{room}.rst": f"robins.{room}" for room in rooms}
    for page in folder.glob("*.rst"):
        if page.name not in pages:
            page.unlink()
    for page, name in pages.items():
        first, *below = modules_of(name)
        text = "\n".join([section(first, "="), *map(section, below)])
        path = folder / page
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def skip_field_aliases(_app, _what, _name, thing, skip, _options):
    """Leave out fields of named tuples: their text is only "Alias for field number"."""
    alias = (inspect.getdoc(thing) or "").startswith("Alias for field number")
    return True if alias and not callable(thing) else skip


def shorten(_app, _what, _name, _thing, _options, signature, returned):
    """Say ``Array`` where the signature would name the place in jaxlib."""
    return tuple(text and _ARRAY.sub("Array", text) for text in (signature, returned))


def qualify(_app, doctree) -> None:
    """Let a bare name mean what it means in the module whose page it stands on.

    Annotations that are text, and `names` in docstrings, say ``Motion`` where two rooms have one.
    """
    for link in doctree.findall(addnodes.pending_xref):
        target, module = link.get("reftarget", ""), link.get("py:module")
        if module and target.isidentifier():
            thing = getattr(importlib.import_module(module), target, None)
            home, name = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
            if home and name and home.split(".")[0] == "robins":
                link["reftarget"] = f"{home}.{name}"


def setup(app) -> dict:
    """Write the pages before Sphinx looks for sources."""
    app.connect("builder-inited", write)
    app.connect("autodoc-skip-member", skip_field_aliases)
    app.connect("autodoc-process-signature", shorten)
    app.connect("doctree-read", qualify)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
