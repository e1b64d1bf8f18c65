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
from robins.cli.made import Made
from robins.cli.options import COLUMNS, LOGS, RESULTS, folder_name, of_value
from robins.cli.printing import carry_out, print_data
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


app.list_commands = lambda ctx: list(app.commands)  # in the order in which a user needs them


def one_run(runs: int | None, what: str) -> None:
    """Refuse more than one run for recorded data."""
    if runs not in (None, 1):
        raise InputError(f"a recorded {what} is one run", f"--runs {runs}", "omit the option.")


_ONE_RUN = option(
    "--runs",
    type=click.IntRange(min=1),
    expose_value=False,
    callback=of_value(lambda runs: one_run(runs, "log")),
    help="Monte Carlo runs. [default: as given]",
)
_PAIR = (
    option("--master", type=LOGS, metavar="LOG", help="What a master INS reported, with --slave."),
    option("--slave", type=LOGS, metavar="LOG", help="Samples of the IMU to be aligned to it."),
    COLUMNS,
)


def _simulated_or_aligned(
    name: str,
    master: Path | None,
    slave: Path | None,
    columns: tuple[Path | str, ...],
    out: Path | None,
    **options: Any,
) -> None:
    if master is None and slave is None:
        if columns:
            from robins.workbench.doctor import typed

            where = typed((), columns[:1])
            raise InputError("the option is for logs", where, "give --master and --slave too.")
        carry_out("run", name, out=out or RESULTS / folder_name(name), **options)
        return
    if master is None or slave is None:
        raise InputError("--master and --slave belong together", fix="give both files, or neither.")
    one_run(options.pop("runs"), "pair")
    if options.pop("machine"):
        raise InputError("a recorded pair runs by jax", "--machine", "omit the option.")
    out = out or RESULTS / slave.name.split(".")[0]
    options |= {"columns": columns, "findings": warn}
    carry_out("align", name, master, slave, out=out, **options)


def _guessed(path: Path, as_json: bool) -> None:
    text = importlib.import_module("robins.workbench").guess(path)
    print_data({"toml": text}, text.rstrip("\n"), as_json)
    name = f"{path.name.split('.')[0] or 'columns'}.toml"
    words = shlex.join(["robins", "doctor", str(path), "--columns", name])
    todo = ["fill in the lines marked NOT KNOWN"] * ("NOT KNOWN" in text)
    todo += ["check what is GUESSED"] * ("GUESSED" in text)
    click.echo(f"Next:   save it as {name}, {', '.join([*todo, f'then {words}'])}", err=True)
    click.echo("        give --columns again for each further file of the log", err=True)


def _compared(first: Path, second: Path, as_json: bool) -> None:
    comparison = importlib.import_module("robins.workbench.compare")
    found = comparison.compare(first, second)
    print_data(found._asdict(), "\n".join(comparison.lines(found)), as_json)


def _verified(where: Path, as_json: bool) -> None:
    found = importlib.import_module("robins.workbench.compare").verify(where)
    print_data(found, f"{where}: whole, {found['files']} files of {found['scenario']}", as_json)


_WRITE = option(
    "--write", type=click.Path(path_type=Path), metavar="FILE", help="Write what it found."
)
for _command in (
    Made("run:demo", "Simulate a drive and navigate it: a first look."),
    Made("run:run", "Simulate a scenario with several filters.", _simulated_or_aligned, (1, _PAIR)),
    Made("bound:bound", "Compute the best accuracy that the sensors of a scenario allow."),
    Made("replay:replay", "Navigate a recorded log.", more=(0, (_ONE_RUN,))),
    Made(
        "doctor:examine", "Examine a log before it is navigated.", judge, (0, (_WRITE,)), "doctor"
    ),
    Made("guess:guess", "Guess the columns of a table that is in no known format.", _guessed),
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
    Made("export:export_filter", "Write a filter as C for a board.", write, name="export"),
    Made("compare:compare", "Compare two results: their requests and figures.", _compared),
    Made("compare:verify", "Check that a result is whole and unchanged.", _verified),
    Made(
        "list:inventory",
        "List the systems and scenarios, or the filters and claims of a system.",
        listing,
        name="list",
    ),
):
    app.add_command(_command)
