"""Options that commands share."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
from click import option

from robins.workbench import InputError

LOGS = click.Path(path_type=Path)
RESULTS = Path("results")


def examples(*lines: str) -> str:
    """End of a help text; a control character keeps click from joining its lines."""
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in lines)))


def add_examples(text: str | None, *commands: click.Command) -> None:
    """End the help of commands, and of those within a group, with the examples of a docstring.

    The last word of their heading is the name of the command. Python -OO leaves no docstring.
    """
    _, *parts = re.split(r"\n\nExamples of `[\w ]*?(\w+)`::\n\n", text or "")
    blocks = dict(zip(parts[::2], parts[1::2], strict=True))
    for one in commands:
        if lines := blocks.get(one.name or "", "").strip().splitlines():
            one.epilog = examples(*map(str.strip, lines))
        if isinstance(one, click.Group):
            add_examples(text, *one.commands.values())


Callback = Callable[[click.Context, click.Parameter, Any], Any]


def of_value(function: Callable) -> Callback:
    """Callback of an option from a function of its value alone."""
    return lambda _context, _given, value: function(value)


DEBUG = option("--debug", is_flag=True, expose_value=False, help="Show tracebacks.")
JSON = option(
    "--json", "as_json", is_flag=True, help="Print one JSON object, nothing else, to stdout."
)
OUT = option("--out", type=LOGS, metavar="DIR", help="Result folder. [default: results/<name>]")
_FORMATS = "robins.formats"  # key of the names while a command line is read


def _name_formats(
    context: click.Context, _given: click.Parameter, names: tuple[str, ...]
) -> tuple[str, ...]:
    context.meta[_FORMATS] = tuple(f"format:{name}" for name in names)
    return names


def _with_formats(
    context: click.Context, _given: click.Parameter, files: tuple[Path, ...]
) -> tuple[Path | str, ...]:
    return *files, *context.meta.get(_FORMATS, ())


_TOML = option(
    "--columns",
    type=LOGS,
    multiple=True,
    callback=_with_formats,
    metavar="TOML",
    help="Declares the columns of a log that is in no known format; may be repeated.",
)
_NAME = option(
    "--format",
    multiple=True,
    is_eager=True,
    expose_value=False,
    callback=_name_formats,
    metavar="NAME",
    help="Format of a log that is not recognised, such as tum; may be repeated.",
)


def COLUMNS(command: Callable) -> Callable:
    """Options that name the columns of a log in an unknown format."""
    return _NAME(_TOML(command))


def _confirm(files: tuple[Path, ...]) -> tuple[Path, ...]:
    """Confirm files of user code before the command reads files that name them."""
    if files:
        from robins.systems import trust

        for file in files:
            trust.confirm(file)
    return files


MACHINE = option(
    "--machine",
    type=click.Choice(["vm", "c", "jax"]),
    callback=of_value(lambda name: name or ""),
    help="What computes: an interpreter at once, compiled C, or JAX. [default: vm]",
)
TRUST = option(
    "--trust",
    type=LOGS,
    multiple=True,
    is_eager=True,
    expose_value=False,
    callback=of_value(_confirm),
    metavar="FILE",
    help="Let this code run, which a file names; remembered until it changes. May be repeated.",
)


def answers(command: Callable) -> Callable:
    """Options of every command that prints a result."""
    return JSON(DEBUG(command))


def publishes(command: Callable) -> Callable:
    """Options of every command that writes a result."""
    return OUT(answers(command))


def as_names(text: str | None) -> tuple[str, ...]:
    """Names separated by commas."""
    if text is None:
        return ()
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise click.BadParameter(f"{text!r} has an empty name; write it as a,b")
    return names


def as_settings(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Settings, each key=value."""
    for text in texts:
        key, equals, _ = text.partition("=")
        if not equals or not key.strip():
            raise click.BadParameter(f'{text!r} is not key=value, such as imu.gyro_bias="5 deg/h"')
    return texts


SETTINGS = option(
    "--set",
    "settings",
    multiple=True,
    callback=of_value(as_settings),
    metavar="key=value",
    help="Change a parameter, with its unit; may be repeated.",
)


SEED = option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, help="Seed of all noise.")
_FILTERS: dict[str, Any] = {"metavar": "a,b", "help": "Which filters to compare."}
FILTERS = option("--filters", callback=of_value(as_names), **_FILTERS)


def _one_filter(text: str | None) -> str:
    """Name of one filter; empty where none is given."""
    filters = as_names(text)
    if len(filters) > 1:
        raise InputError(
            "a bound is that of one model", f"--filters {','.join(filters)}", "name one."
        )
    return "".join(filters)


FILTER = option("--filters", "filter_name", callback=of_value(_one_filter), **_FILTERS)


def choices(command: Callable) -> Callable:
    """Options shared by the commands that compute a campaign."""
    return MACHINE(SEED(SETTINGS(FILTERS(TRUST(answers(command))))))


def folder_name(scenario: str) -> str:
    """Name of the result folder of a scenario."""
    if ".py:" in scenario:
        return Path(scenario).name.replace(".py:", "-")
    return Path(scenario).stem if scenario.endswith(".toml") else scenario.replace("/", "-")


def log_name(log: Sequence[Path]) -> str:
    """Name of the result folder of a log, from its first file that is no configuration."""
    first = next((path for path in log if path.suffix != ".toml"), log[0])
    return os.path.basename(os.path.abspath(first)).split(".")[0] or "log"


def result_name(given: str | Path | Sequence[str | Path]) -> str:
    """Name of the result folder of a scenario, of a problem, or of the files of a log."""
    files = [given] if isinstance(given, str | Path) else list(given)
    one = files[0]
    scenario = isinstance(one, str) and (one.endswith(".toml") or not Path(one).is_file())
    return (
        folder_name(str(one)) if scenario and len(files) == 1 else log_name(list(map(Path, files)))
    )
