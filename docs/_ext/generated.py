"""Common parts of the tables of the documents: Markdown, and files that pages include."""

from collections.abc import Callable, Iterable
from pathlib import Path


def table(head: tuple[str, ...], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown; the first column is code."""
    lines = [head, ("---",) * len(head), *((f"`{first}`", *rest) for first, *rest in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def setup_of(**makers: Callable[[], str]) -> Callable:
    """The setup of an extension that writes what pages include, before Sphinx looks for sources.

    A file whose text has not changed is left untouched.
    """

    def write(app) -> None:
        folder = Path(app.srcdir) / "_generated"
        folder.mkdir(exist_ok=True)
        for name, make in makers.items():
            path, text = folder / f"{name}.txt", make()
            if not path.exists() or path.read_text("utf-8") != text:
                path.write_text(text, "utf-8")

    def setup(app) -> dict:
        app.connect("builder-inited", write)
        return {"parallel_read_safe": True, "parallel_write_safe": True}

    return setup
