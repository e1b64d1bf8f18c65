"""Tables of the doctor's findings and of what `clean` refuses, out of `robins.logs.checks`."""

from pathlib import Path

from robins.logs.checks import ALONE, OF_READERS, REFUSALS, TOGETHER


def table(head: tuple[str, ...], rows) -> str:
    """A table in Markdown; the first column is code."""
    lines = [head, ("---",) * len(head), *((f"`{first}`", *rest) for first, *rest in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def findings() -> str:
    """A heading and a table for each topic, in the order of the examination."""
    topics = {"In the files": list(OF_READERS)}
    for check in (*ALONE, *TOGETHER):
        topics.setdefault(check.topic, []).extend(check.codes)
    head = ("code", "severity", "says")
    return "\n".join(f"### {topic}\n\n{table(head, codes)}" for topic, codes in topics.items())


def refusals() -> str:
    """Why rows are refused."""
    return table(("reason", "what"), REFUSALS.items())


def write(app) -> None:
    """Write what `logs.md` includes; a table that has not changed is left untouched."""
    folder = Path(app.srcdir) / "_generated"
    folder.mkdir(exist_ok=True)
    for name, text in {"findings.txt": findings(), "refusals.txt": refusals()}.items():
        path = folder / name
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def setup(app) -> dict:
    """Write the tables before Sphinx looks for sources."""
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
