"""The command `sensitivity` and its options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click import option

from robins.cli.options import RESULTS, SETTINGS, TRUST, examples, folder_name, publishes
from robins.cli.tell import carry_out


@click.command(
    short_help="Which uncertain parameter the variance of the error comes from.",
    epilog=examples(
        "robins sensitivity transfer-alignment/s0 --filter kf-flexure "
        '--vary "slave.gyro_bias=1 deg/h to 10 deg/h" --vary "flexure.sigma=1 arcmin to 5 arcmin"',
        'robins sensitivity airship/s1 --filter product --vary "sar.position=10 m to 50 m" '
        '--vary "barometer.height=5 m to 30 m" --samples 128 --out budget',
    ),
)
@click.argument("scenario")
@option("--filter", "filter_name", default="", metavar="NAME", help="Which. [default: the first]")
@option("--vary", multiple=True, required=True, metavar="key=low to high", help="May be repeated.")
@option("--runs", type=click.IntRange(min=1), default=10, show_default=True, help="At each point.")
@option(
    "--samples",
    type=int,
    default=256,
    show_default=True,
    help="Of each parameter; a power of two. There are samples x (parameters + 2) points.",
)
@SETTINGS
@option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, help="Of all noise and points.")
@TRUST
@publishes
def sensitivity(scenario: str, out: Path | None, **options: Any) -> None:
    """Attribute the variance of a filter's error to the parameters of SCENARIO.

    An error budget: the simulated world varies between the ends, independently in each parameter,
    and the filter goes on believing the scenario as written. For each block of the state there are
    Sobol indices of first order (alone) and in total (with others), with their 95 % bounds.
    """
    out = out or RESULTS / f"sensitivity-{folder_name(scenario)}"
    carry_out("sensitivity", scenario, out=out, **options)
