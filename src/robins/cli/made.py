"""Commands that compute an outcome, with the parameters of a function of the workbench as options.

The function is read from the text of its file, not imported: help and usage errors need no JAX.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib.resources import files
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
    as_names,
    examples,
    publishes,
    result_name,
)
from robins.cli.tell import carry_out
from robins.workbench import options

Decorator = Callable[[Callable], Callable]
Given = dict[str, Any]  # values by parameter
Call = tuple[str, Sequence[Any], str]  # function of the workbench, its arguments, result folder

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

    Args:
        function: "module:name" in `robins.workbench`.
        short: its line in `robins --help`.
        call: of all that is given, what to call instead of the function.
        more: options that the function does not have, and the place of the first among the others.
    """

    def __init__(
        self,
        function: str,
        short: str,
        call: Callable[[Given], Call] | None = None,
        more: tuple[int, Sequence[Decorator]] = (0, ()),
    ):
        self.module, _, self.function = function.partition(":")
        self.call, self.more = call, more
        super().__init__(self.function, callback=self._carry_out, short_help=short)
        del self.params, self.help, self.epilog  # they are read from the function

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
        return (ast.get_docstring(self._read) or "").partition("\n\nArgs:\n")[0]

    @cached_property
    def epilog(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Examples, which stand in the first lines of the file that bears the name of a command."""
        text = (ast.get_docstring(self._file) or "").partition("\n\nExamples::\n\n")[2]
        lines = [line.strip() for line in text.splitlines()]
        return examples(*lines) if self.module == self.function else None

    @cached_property
    def params(self) -> list[click.Parameter]:  # pyright: ignore
        """Arguments and options, in the order of the signature."""
        arguments = self._read.args
        found = [_argument(one) for one in arguments.args]
        chosen = list(_options(arguments))
        at, more = self.more
        chosen[at:at] = (one for decorator in more for one in _made_by(decorator))
        code = any(str(one.metavar).startswith("SCENARIO") for one in found)
        common = [one for own in ((TRUST,) if code else ()) for one in _made_by(own)]
        return [*found, *chosen, *common, *_made_by(publishes)]

    def _carry_out(self, out: Path | None, as_json: bool, **given: Any) -> None:
        if self.call is not None:
            name, places, folder = self.call(given)
        else:
            name, places = self.function, [given.pop(one.arg) for one in self._read.args.args]
            folder = "-".join([name, *map(result_name, places)]).removeprefix("replay-")
        if any(one.arg == "findings" for one in self._read.args.kwonlyargs):
            given["findings"] = warn
        carry_out(name, *places, out=out or RESULTS / folder, as_json=as_json, **given)


def _made_by(decorator: Decorator) -> list[click.Parameter]:
    """Parameters that a decorator of click adds, in the order of the help."""

    def none() -> None:
        """Take them."""

    return click.command()(decorator(none)).params


def _metadata(annotation: ast.expr | None) -> tuple[Any, options.Option] | None:
    """Type and metadata of an annotation; None where it has no metadata."""
    text = ast.unparse(annotation) if annotation else ""
    if not (text.startswith("Annotated[") or get_origin(vars(options).get(text))):
        return None
    found = eval(text, dict(vars(options)))
    kind, *more = get_args(found)
    option = next((one for one in more if isinstance(one, options.Option)), None)
    return None if option is None else (kind, option)


def _argument(one: ast.arg) -> click.Argument:
    """Argument of a positional parameter; one that is a path is one, several are at least one."""
    kind, option = _metadata(one.annotation) or (str, options.Option())
    several = get_origin(kind) is Sequence
    path = "PathLike" in str(kind)
    return click.Argument(
        [one.arg],
        type=LOGS if path else str,
        nargs=-1 if several else 1,
        required=True,
        metavar=option.metavar,
    )


def _options(arguments: ast.arguments) -> Iterator[click.Parameter]:
    """Options of the keyword parameters that the command line gives."""
    for one, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        found = _metadata(one.annotation)
        if found is not None:
            yield _option(one.arg, *found, default)
        elif one.arg in SHARED:
            yield from _made_by(SHARED[one.arg])


def _option(name: str, kind: Any, option: options.Option, default: ast.expr | None) -> click.Option:
    """Option of a parameter of this type, with the default of the signature."""
    several = get_origin(kind) is Sequence
    settings: dict[str, Any] = {"is_flag": True} if kind is bool else {}
    if int in (kind, *get_args(kind)):
        limits = option.least, option.most
        settings["type"] = int if limits == (None, None) else click.IntRange(*limits)
    if default is not None and not several:
        settings["default"] = ast.literal_eval(default)
    return click.Option(
        [name, option.flag or f"--{name.replace('_', '-')}"],
        help=option.help,
        metavar=option.metavar,
        required=default is None,
        multiple=several and not option.names,
        callback=as_names if option.names else None,
        show_default=option.shown,
        **settings,
    )
