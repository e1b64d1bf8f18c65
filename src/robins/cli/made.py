"""Commands whose options are the parameters of a function of the workbench.

The function is read from the text of its file, not imported: help and usage errors need no JAX.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib.resources import files
from inspect import signature
from operator import not_
from pathlib import Path
from typing import Any, get_args, get_origin

import click

from robins.cli.doctor import warn
from robins.cli.options import (
    COLUMNS,
    FILTER,
    FILTERS,
    LOGS,
    MACHINE,
    RESULTS,
    SEED,
    SETTINGS,
    TRUST,
    answers,
    as_names,
    examples,
    of_value,
    publishes,
    result_name,
)
from robins.cli.printing import carry_out
from robins.workbench import options

Decorator = Callable[[Callable], Callable]

SHARED: Mapping[str, Decorator] = {
    "columns": COLUMNS,
    "filter_name": FILTER,
    "filters": FILTERS,
    "machine": MACHINE,
    "seed": SEED,
    "settings": SETTINGS,
}
"""Options of parameters that have these names and no metadata."""


class Made(click.Command):
    """A command made of a function of the workbench, whose file is read when it is needed.

    Without a body it computes an outcome, prints it, and writes it as a result.

    Args:
        function: "module:name" in `robins.workbench`.
        short: its line in `robins --help`.
        body: called instead with all parameters; one that takes no `out` only prints.
        more: options that the function does not have, and the position of the first among the rest.
        name: of the command; default: that of the function.
    """

    def __init__(
        self,
        function: str,
        short: str,
        body: Callable[..., int | None] | None = None,
        more: tuple[int, Sequence[Decorator]] = (0, ()),
        name: str = "",
    ):
        self.module, _, self.function = function.partition(":")
        self.more, body = more, body or self._publish
        self.common = publishes if "out" in signature(body).parameters else answers
        super().__init__(name or self.function, callback=body, short_help=short)
        del self.params, self.help, self.epilog  # replaced by properties that read the function

    @cached_property
    def _file(self) -> ast.Module:
        return ast.parse((files("robins") / "workbench" / f"{self.module}.py").read_text("utf-8"))

    @cached_property
    def _read(self) -> ast.FunctionDef:
        defined = (node for node in self._file.body if isinstance(node, ast.FunctionDef))
        return next(node for node in defined if node.name == self.function)

    @cached_property
    def help(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Docstring of the function, without its sections."""
        return re.split(r"\n\n(?:Args|Raises|Returns):\n", ast.get_docstring(self._read) or "")[0]

    @cached_property
    def epilog(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Examples of this command among those in the first lines of the file."""
        text = (ast.get_docstring(self._file) or "").partition("\n\nExamples::\n\n")[2]
        lines = [line.strip() for line in text.splitlines()]
        own = [x for x in lines if not x.startswith("robins") or x.split()[1] == self.name]
        return examples(*own) if own else None

    @cached_property
    def params(self) -> list[click.Parameter]:  # pyright: ignore
        """Arguments and options, in the order of the signature."""
        given = self._read.args
        defaults = [None] * (len(given.args) - len(given.defaults)) + given.defaults
        found = list(_parameters(given.args, defaults, positional=True))
        found += _parameters(given.kwonlyargs, given.kw_defaults)
        first = sum(isinstance(one, click.Argument) for one in found) + self.more[0]
        found[first:first] = (one for decorator in self.more[1] for one in _made_by(decorator))
        if any(str(one.metavar).startswith("SCENARIO") for one in found):
            found += _made_by(TRUST)
        return found + _made_by(self.common)

    def _publish(self, out: Path | None, as_json: bool, **given: Any) -> None:
        places = [given.pop(one.arg) for one in self._read.args.args]
        folder = "-".join([self.function, *map(result_name, places)]).removeprefix("replay-")
        if any(one.arg == "findings" for one in self._read.args.kwonlyargs):
            given["findings"] = warn
        carry_out(self.function, *places, out=out or RESULTS / folder, as_json=as_json, **given)


def _made_by(decorator: Decorator) -> list[click.Parameter]:
    """Parameters that a decorator of click adds, in the order of the help."""

    def none() -> None:
        """Carry the parameters."""

    return click.command()(decorator(none)).params


def _metadata(annotation: ast.expr | None) -> tuple[Any, options.Option] | None:
    """Type and metadata of an annotation; None where it has no metadata."""
    text = ast.unparse(annotation) if annotation else ""
    if not (text.startswith("Annotated[") or get_origin(vars(options).get(text))):
        return None
    found = eval(text, {"Path": Path, **vars(options)})
    kind, *more = get_args(found)
    option = next((one for one in more if isinstance(one, options.Option)), None)
    return None if option is None else (kind, option)


def _parameters(
    every: Sequence[ast.arg], defaults: Sequence[ast.expr | None], positional: bool = False
) -> Iterator[click.Parameter]:
    """Parameters that the command line gives: those with metadata, and the shared ones."""
    for one, default in zip(every, defaults, strict=True):
        found = _metadata(one.annotation)
        if found is None:
            yield from _made_by(SHARED[one.arg]) if one.arg in SHARED else ()
        elif positional and not found[1].flag:
            yield _argument(one.arg, *found, default)
        else:
            yield _option(one.arg, *found, default)


def _argument(
    name: str, kind: Any, option: options.Option, default: ast.expr | None
) -> click.Argument:
    """Argument of a positional parameter; a sequence takes one at least."""
    return click.Argument(
        [name],
        type=LOGS if "Path" in str(kind) else str,
        nargs=-1 if get_origin(kind) is Sequence else 1,
        required=default is None,
        metavar=option.metavar,
    )


def _option(name: str, kind: Any, option: options.Option, default: ast.expr | None) -> click.Option:
    """Option of a parameter of this type, with the default of the signature."""
    several, opposite = get_origin(kind) is Sequence, "/" in option.flag
    settings: dict[str, Any] = {"is_flag": True} if kind is bool else {}
    if int in (kind, *get_args(kind)):
        limits = option.least, option.most
        settings["type"] = int if limits == (None, None) else click.IntRange(*limits)
    elif "Path" in str(kind):
        settings["type"] = LOGS
    if default is not None and not several:
        value = ast.literal_eval(default)
        settings["default"] = not value if opposite else value
    return click.Option(
        [name, option.flag or f"--{name.replace('_', '-')}"],
        help=option.help,
        metavar=option.metavar,
        required=default is None,
        multiple=several and not option.names,
        callback=of_value(as_names if option.names else not_) if option.names or opposite else None,
        show_default=option.shown,
        **settings,
    )
