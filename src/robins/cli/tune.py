"""The command `tune` and its options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click import option

from robins.cli.doctor import warn
from robins.cli.options import (
    COLUMNS,
    RESULTS,
    SETTINGS,
    TRUST,
    examples,
    folder_name,
    log_name,
    publishes,
)
from robins.cli.tell import carry_out


@click.command(
    short_help="Find parameters of a filter, and judge them on data held out.",
    epilog=examples(
        "robins tune ins-gnss/drive --filter ekf --vary believed.r_factor=4",
        "robins tune imu.csv gnss.pos unit.toml --filter ekf --vary imu.gyro_noise "
        "--vary imu.accel_noise",
    ),
)
@click.argument("what", nargs=-1, required=True, metavar="SCENARIO|LOG...")
@option(
    "--vary",
    multiple=True,
    required=True,
    metavar="key[=value]",
    help="A parameter to tune, and where to begin; may be repeated.",
)
@option("--filter", "filter_name", default="", metavar="NAME", help="Which. [default: the first]")
@option("--runs", type=click.IntRange(min=6), default=16, help="Simulated runs of either half.")
@option(
    "--by", default="", metavar="WHAT", help="error, the name of a block of the state, innovations."
)
@option("--system", default="ins-gnss", help="The system that navigates a log.")
@COLUMNS
@SETTINGS
@option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, help="Seed of all noise.")
@TRUST
@publishes
def tune(what: tuple[str, ...], out: Path | None, **options: Any) -> None:
    """Find factors on parameters of a filter with which it is best.

    With a SCENARIO it is best where the true errors of simulated runs are least; the simulated
    world stays as it is written. With the files of a LOG it is best where it predicts the
    measurements best. Every third segment of a log, and as many runs as were used, are held out:
    the values found are kept only if they are better there, beyond chance.

    It refuses where the data do not determine a parameter. The folder has tuned.toml.
    """
    simulated = len(what) == 1 and (what[0].endswith(".toml") or not Path(what[0]).is_file())
    name = folder_name(what[0]) if simulated else log_name([Path(one) for one in what])
    carry_out("tune", what, out=out or RESULTS / f"tune-{name}", findings=warn, **options)
