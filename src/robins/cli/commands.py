"""The commands and their options."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path
from typing import Any

import click
from click import option

from robins import __version__
from robins.cli.bench import bench
from robins.cli.campaign import campaign, sweep
from robins.cli.doctor import judge, warn
from robins.cli.export import write
from robins.cli.listing import listing
from robins.cli.made import Call, Given, Made
from robins.cli.options import (
    COLUMNS,
    LOGS,
    SETTINGS,
    TRUST,
    answers,
    examples,
    folder_name,
)
from robins.cli.tell import say
from robins.workbench import InputError

_EXAMPLES = """
\b
Examples:
  robins demo                                    a first look; needs no data
  robins list                                    what there is to run
  robins run ins-gnss/drive --runs 20            simulate and compare filters
  robins run ins-gnss/drive --set imu.gyro_bias="5 deg/h" --filters ekf,ukf
  robins campaign run ins-gnss/drive --runs 500 --out drives   many runs; goes on if stopped
  robins sweep ins-gnss/drive --vary "imu.gyro_bias=1 deg/h,10 deg/h" --out biases
  robins tune imu.csv gnss.pos --filter ekf --vary imu.accel_noise --out tuned
  robins sensitivity my.toml --vary "gnss.sigma=1 m to 5 m" --vary "start.tilt=1 deg to 5 deg"
  robins bound ins-gnss/drive                    how accurate can these sensors be at best?
  robins doctor imu.csv gnss.pos                 can my log be navigated?
  robins guess my.csv > columns.toml             declare the columns of any other table
  robins replay imu.csv gnss.pos --out walk      navigate it
  robins allan still.csv                         noise parameters of my IMU
  robins calibrate turned.csv                    hard and soft iron of my magnetometer
  robins design attitude-axis                    gains that bound the worst case, and their price
  robins export satellite/s1 --to satellite-c    a filter as C for a board
  robins bench up satellite/s1                   the same filter over serial lines, part by part

Every command that computes writes a folder with a summary, the time series, figures and a page
report.html to open in a browser. With --json a command prints one JSON object for scripts.

\b
Exit status: 0 done, 1 failed, 2 bad input, 3 interrupted (run it again).
"""


@click.group(epilog=_EXAMPLES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="robins")
@click.option("--debug", is_flag=True, expose_value=False, help="Show tracebacks.")
def app() -> None:
    """Robust inertial navigation: simulate, navigate real logs, compare filters, check claims."""


app.list_commands = lambda ctx: list(app.commands)  # in the order in which one meets them


def one_run(runs: int | None, what: str) -> None:
    """Refuse more runs than one of what was recorded."""
    if runs not in (None, 1):
        raise InputError(f"a recorded {what} is one run", f"--runs {runs}", "omit the option.")


_ONE_RUN = option(
    "--runs",
    type=click.IntRange(min=1),
    expose_value=False,
    callback=lambda _context, _given, runs: one_run(runs, "log"),
    help="Monte Carlo runs. [default: as given]",
)
_PAIR = (
    option("--master", type=LOGS, metavar="LOG", help="What a master INS reported, with --slave."),
    option("--slave", type=LOGS, metavar="LOG", help="Samples of the IMU to be aligned to it."),
    COLUMNS,
)


def _simulated_or_aligned(given: Given) -> Call:
    """A scenario simulated, or a recorded pair aligned."""
    name, master, slave = (given.pop(key) for key in ("name", "master", "slave"))
    if master is None and slave is None:
        if columns := given.pop("columns"):
            from robins.workbench.doctor import typed

            where = typed((), columns[:1])
            raise InputError("the option is for logs", where, "give --master and --slave too.")
        return "run", [name], folder_name(name)
    if master is None or slave is None:
        raise InputError("--master and --slave belong together", fix="give both files, or neither.")
    one_run(given.pop("runs"), "pair")
    if given.pop("machine"):
        raise InputError("a recorded pair runs by jax", "--machine", "omit the option.")
    given["findings"] = warn
    return "align", [name, master, slave], slave.name.split(".")[0]


for _made in (
    Made("run:demo", "Simulate a drive and navigate it: a first look."),
    Made("run:run", "Simulate a scenario with several filters.", _simulated_or_aligned, (1, _PAIR)),
    Made("bound:bound", "Compute the best accuracy that the sensors of a scenario allow."),
    Made("replay:replay", "Navigate a recorded log.", more=(0, (_ONE_RUN,))),
):
    app.add_command(_made)


@app.command(
    short_help="Examine a log before it is navigated.",
    epilog=examples(
        "robins doctor imu.csv gnss.pos",
        "robins doctor imu.csv unit.toml --json",
        "robins doctor imu.csv gnss.pos --write found.toml",
    ),
)
@click.argument("log", nargs=-1, required=True, type=LOGS)
@option("--write", type=click.Path(path_type=Path), metavar="FILE", help="Write what it found.")
@COLUMNS
@answers
def doctor(
    log: tuple[Path, ...], write: Path | None, columns: tuple[Path | str, ...], as_json: bool
) -> int:
    """Examine a log as an engineer would: units, axes, gravity, rates, gaps, time, sigmas.

    The exit status is 2 if a run on it would be wrong, 0 otherwise. A .toml file among LOG... gives
    the mounting of the sensor, as for `robins replay`.

    With --write, what the log shows of the unit and the receiver (mounting, latency, window of the
    velocities, noise at rest) becomes a configuration for `robins replay`.
    """
    return judge(log, columns, as_json, write)


@app.command(
    short_help="Guess the columns of a table that is in no known format.",
    epilog=examples("robins guess my.csv > columns.toml"),
)
@click.argument("log", type=LOGS)
@answers
def guess(log: Path, as_json: bool) -> None:
    """Print TOML that declares the columns of LOG, for the option --columns of other commands.

    Headings tell what columns hold. Units that they do not state are proved by gravity, by the
    field of the Earth and by the doctor; what is only likely is marked GUESSED in a comment, and
    what is not known is left out.
    """
    text = importlib.import_module("robins.workbench").guess(log)
    say({"toml": text}, text.rstrip("\n"), as_json)
    words = shlex.join(["robins", "doctor", str(log), "--columns", "columns.toml"])
    click.echo(f"Next:   save it as columns.toml, check what is GUESSED, then {words}", err=True)


for _made in (
    Made("allan:allan", "Estimate the noise parameters of a resting IMU."),
    Made("calibrate:calibrate", "Calibrate hard and soft iron of a magnetometer."),
    Made("design:design", "Design gains that bound the worst case, and show their cost."),
    bench,
    campaign,
    sweep,
    Made("tune:tune", "Find parameters of a filter, and judge them on data held out."),
    Made(
        "sensitivity:sensitivity",
        "Which uncertain parameter the variance of the error comes from.",
    ),
):
    app.add_command(_made)


@app.command(
    short_help="Write a filter as C for a board.",
    epilog=examples(
        "robins export ins-gnss/drive --filter ekf --to drive-c",
        "robins export transfer-alignment/s0 --filter kf-flexure --to alignment-c --fast",
        "make -C drive-c check",
        "robins export satellite/s1 --filter mixed-bias --to adm --board",
        "robins export rocket/a1 --filter huber --to rocket-c --adjust 'rules[0].inner.limit'",
    ),
)
@click.argument("scenario")
@option(
    "--filter", "filter_name", default="", metavar="NAME", help="Which. [default: the system's]"
)
@option("--to", type=click.Path(path_type=Path), required=True, metavar="DIR", help="A new folder.")
@option("--small/--fast", "small", default=True, help="Keep loops, or write them out.")
@option("--float32", is_flag=True, help="Single precision, and what it costs.")
@option("--board", is_flag=True, help="Build it as a part of the bench too.")
@option("--adjust", multiple=True, metavar="NAME", help="A number to be set on board; repeatable.")
@option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, help="Of the recorded run.")
@SETTINGS
@TRUST
@answers
def export(scenario: str, to: Path, small: bool, as_json: bool, **options: Any) -> None:
    """Write a filter of SCENARIO as C99, with a test of it for your own compiler.

    DIR gets one file of C that needs math.h alone, a header that names all fields with their units,
    a page that explains how to call it, and `make check`: it replays recorded steps and compares
    each state and each code with those of this program. With --float32 it runs the scenario in
    single precision too, and reports what that costs against the simulated truth. With --board it
    builds a program that stands for a part of the bench: the satellite's attitude determination, or
    the navigation computer of INS/GNSS. A number named by --adjust is a field of the state in the
    place of a constant; a name that the filter does not have lists those it has.
    """
    write(scenario, to, fast=not small, as_json=as_json, **options)


@app.command(
    short_help="Compare two results: their requests and figures.",
    epilog=examples("robins compare results/before results/after"),
)
@click.argument("first", type=LOGS)
@click.argument("second", type=LOGS)
@answers
def compare(first: Path, second: Path, as_json: bool) -> None:
    """Compare the result folders FIRST and SECOND: parameters, versions, metrics and verdicts.

    A metric that differs is shown with the ratio of the second to the first, by component.
    """
    comparison = importlib.import_module("robins.workbench.compare")
    found = comparison.compare(first, second)
    say(found._asdict(), "\n".join(comparison.lines(found)), as_json)


@app.command(
    short_help="Check that a result is whole and unchanged.",
    epilog=examples("robins verify results/before"),
)
@click.argument("folder", type=LOGS)
@answers
def verify(folder: Path, as_json: bool) -> None:
    """Check every file of the result FOLDER against its checksum; bad input if one is damaged."""
    found = importlib.import_module("robins.workbench.compare").verify(folder)
    say(found, f"{folder}: whole, {found['files']} files of {found['scenario']}", as_json)


@app.command(
    "list",
    short_help="List the systems and scenarios, or the filters and claims of a system.",
    epilog=examples("robins list", "robins list ins-gnss", "robins list --json"),
)
@click.argument("system", required=False)
@answers
def list_(system: str | None, as_json: bool) -> None:
    """List the systems and their scenarios, or the filters and claims of SYSTEM.

    With --json it prints everything, or SYSTEM alone.
    """
    listing(system, as_json)
