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
from robins.cli.options import (
    COLUMNS,
    LOGS,
    MACHINE,
    RESULTS,
    SETTINGS,
    TRUST,
    answers,
    as_names,
    choices,
    examples,
    folder_name,
    log_name,
    publishes,
)
from robins.cli.sensitivity import sensitivity
from robins.cli.tell import carry_out, say
from robins.cli.tune import tune
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


class _Group(click.Group):
    """Keeps the commands in the order in which one meets them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_Group, epilog=_EXAMPLES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="robins")
@click.option("--debug", is_flag=True, expose_value=False, help="Show tracebacks.")
def app() -> None:
    """Robust inertial navigation: simulate, navigate real logs, compare filters, check claims."""


def one_run(runs: int | None, what: str) -> None:
    """Refuse more runs than one of what was recorded."""
    if runs not in (None, 1):
        raise InputError(f"a recorded {what} is one run", f"--runs {runs}", "omit the option.")


_RUNS = option("--runs", type=click.IntRange(min=1), help="Monte Carlo runs. [default: as given]")


@app.command(short_help="Simulate a drive and navigate it: a first look.")
@_RUNS
@option("--filters", callback=as_names, metavar="a,b", help="Which filters. [default: ekf]")
@publishes
def demo(out: Path | None, **options: Any) -> None:
    """Simulate a drive with a GNSS outage and navigate it: a first look, which needs no data."""
    carry_out("demo", out=out or RESULTS / "demo", **options)


@app.command(
    short_help="Simulate a scenario with several filters.",
    epilog=examples(
        "robins run ins-gnss/drive --runs 50 --filters ekf,ukf --out drive",
        'robins run my.toml --set gnss.sigma="2 m" --json',
        "robins run my_system.py:study --runs 100",
        "robins run transfer-alignment/replay --master master.csv --slave slave.csv",
    ),
)
@click.argument("scenario")
@_RUNS
@option("--master", type=LOGS, metavar="LOG", help="What a master INS reported, with --slave.")
@option("--slave", type=LOGS, metavar="LOG", help="Samples of the IMU to be aligned to it.")
@COLUMNS
@MACHINE
@choices
@TRUST
@publishes
def run(
    scenario: str,
    out: Path | None,
    master: Path | None,
    slave: Path | None,
    columns: tuple[Path | str, ...],
    **options: Any,
) -> None:
    """Simulate SCENARIO with several filters.

    SCENARIO is a name from `robins list`, a TOML file, or FILE.py:STUDY of your own.

    All filters get the same random numbers; run k of seed S is the same whatever N is.

    With --master and --slave a recorded pair replaces the simulation.
    """
    if master is None and slave is None:
        if columns:
            from robins.workbench.doctor import typed

            where = typed((), columns[:1])
            raise InputError("the option is for logs", where, "give --master and --slave too.")
        carry_out("run", scenario, out=out or RESULTS / folder_name(scenario), **options)
        return
    if master is None or slave is None:
        raise InputError("--master and --slave belong together", fix="give both files, or neither.")
    one_run(options.pop("runs"), "pair")
    if options.pop("machine"):
        raise InputError("a recorded pair runs by jax", "--machine", "omit the option.")
    out = out or RESULTS / slave.name.split(".")[0]
    options |= {"columns": columns, "findings": warn}
    carry_out("align", scenario, master, slave, out=out, **options)


@app.command(
    short_help="Compute the best accuracy that the sensors of a scenario allow.",
    epilog=examples(
        "robins bound ins-gnss/drive",
        'robins bound ins-gnss/drive --without gnss_velocity --at "60 s" --at "200 s"',
        'robins bound transfer-alignment/s0 --filters kf-flexure --set slave.gyro_bias="10 deg/h"',
    ),
)
@click.argument("scenario")
@option("--runs", type=click.IntRange(min=1), default=1, help="Trajectories to average over.")
@option("--without", multiple=True, metavar="SENSOR", help="Leave it out; may be repeated.")
@option("--at", multiple=True, metavar="TIME", help='Print that time, "200 s"; may be repeated.')
@choices
@TRUST
@publishes
def bound(scenario: str, filters: tuple[str, ...], out: Path | None, **options: Any) -> None:
    """Compute the covariance bound and observability of SCENARIO; no filter can do better.

    It needs no data: the model of a filter, by default the first of the scenario, is linearised
    about the simulated truth. It shows the best sigma of each state over time, which states the
    sensors observe, what each sensor contributes, and which directions are least observable.
    """
    if len(filters) > 1:
        raise InputError(
            "a bound is that of one model", f"--filters {','.join(filters)}", "name one."
        )
    out = out or RESULTS / f"bound-{folder_name(scenario)}"
    carry_out("bound", scenario, filter_name="".join(filters), out=out, **options)


@app.command(
    short_help="Navigate a recorded log.",
    epilog=examples(
        "robins replay imu.csv gnss.pos --out walk",
        'robins replay imu.csv gnss.pos unit.toml --set gnss.latency="-50 ms" --json',
        "robins replay my.csv --columns logger.toml --system marg",
        "robins replay imu.csv gnss.pos --out walk --export csv,kml",
    ),
)
@click.argument("log", nargs=-1, required=True, type=LOGS)
@_RUNS
@option(
    "--system", default="ins-gnss", show_default=True, help="The system that navigates the log."
)
@option(
    "--export",
    "exports",
    callback=as_names,
    metavar="a,b",
    help="Write the result for other programs too: csv, tum, kml, gpx.",
)
@COLUMNS
@choices
@publishes
def replay(log: tuple[Path, ...], runs: int | None, out: Path | None, **options: Any) -> None:
    """Navigate a recorded log: LOG... are its files, inertial samples and GNSS fixes.

    A file that ends in .toml adds what the log lacks: noise, mounting, lever arm. The file of
    --columns declares the columns of a log that is in no known format.

    --export writes files into exports/ of the result folder: csv has all estimates, tum is t x y z
    qx qy qz qw in east, north, up, kml and gpx are tracks with UTC. kml and gpx need positions.
    """
    one_run(runs, "log")
    carry_out("replay", log, out=out or RESULTS / log_name(log), findings=warn, **options)


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


@app.command(
    short_help="Estimate the noise parameters of a resting IMU.",
    epilog=examples("robins allan still.csv", "robins allan still.csv --terms N --json"),
)
@click.argument("log", type=LOGS)
@option("--terms", default="NBK", show_default=True, help="Noises to fit, of Q, N, B, K, R.")
@COLUMNS
@publishes
def allan(log: Path, out: Path | None, **options: Any) -> None:
    """Compute the Allan deviation of a resting IMU, and the noise parameters of its data sheet.

    Q quantisation, N random walk, B bias instability, K rate random walk, R rate ramp.
    """
    out = out or RESULTS / f"allan-{log_name([log])}"
    carry_out("allan", log, out=out, **options)


@app.command(
    short_help="Calibrate hard and soft iron of a magnetometer.",
    epilog=examples(
        "robins calibrate turned.csv",
        'robins calibrate turned.ulg --field "48.5 uT" --begin "20 s" --end "80 s" --json',
        "robins calibrate circle.csv --horizontal",
    ),
)
@click.argument("log", nargs=-1, required=True, type=LOGS)
@option("--field", metavar="FIELD", help='Its strength at the place, "48.5 uT"; sets the scale.')
@option("--begin", metavar="TIME", help='Use samples from "20 s" after the first one on.')
@option("--end", metavar="TIME", help='Use samples up to "80 s" after the first one.')
@option("--horizontal", is_flag=True, help="The vehicle cannot tilt: it turned about z only.")
@COLUMNS
@publishes
def calibrate(log: tuple[Path, ...], out: Path | None, **options: Any) -> None:
    """Calibrate hard and soft iron from a log in which the sensor is turned about all its axes.

    It finds the offset and the matrix of ``matrix (measured - offset)``, whose size is that of the
    Earth's field wherever the sensor points. A .toml file among LOG... gives the mounting of the
    sensor, as for `robins replay`, which takes the calibration.toml of the result.
    """
    out = out or RESULTS / f"calibrate-{log_name(log)}"
    carry_out("calibrate", log, out=out, **options)


@app.command(
    short_help="Design gains that bound the worst case, and show their cost.",
    epilog=examples(
        "robins design attitude-axis",
        'robins design my.toml --gamma "1, 0.8" --methods riccati,retuned-slack --json',
    ),
)
@click.argument("problem")
@option("--gamma", metavar="a,b", help="Bounds on the H-infinity norm. [default: a range]")
@option("--methods", callback=as_names, metavar="a,b", help="Which methods to compare.")
@publishes
def design(problem: str, out: Path | None, **options: Any) -> None:
    """Design constant gains for PROBLEM, a TOML file with the matrices of a plant or an example.

    It compares methods that keep the gain from a modelling error to the estimate below gamma, by
    the true norm from noise to the estimate. Examples: attitude-axis, attitude-axis-drift,
    baro-height, two-states.
    """
    out = out or RESULTS / f"design-{Path(problem).name.removesuffix('.toml')}"
    carry_out("design", problem, out=out, **options)


app.add_command(bench)
app.add_command(campaign)
app.add_command(sweep)
app.add_command(tune)
app.add_command(sensitivity)


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
