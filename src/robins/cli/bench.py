"""The commands of the test bench and their options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from robins.cli.options import (
    LOGS,
    SETTINGS,
    debug_option,
    examples,
    folder_name,
    json_option,
    option,
    out_option,
)


@click.group(
    short_help="Run a vehicle part by part over serial lines.",
    epilog=examples(
        "robins bench up satellite/s1                  seven processes, one loop, bit for bit",
        "robins bench up satellite/s1 --live           with a page to watch it",
        "robins bench up noisy-line                    damaged, lost, late frames",
        "robins bench up satellite/s1 --clock realtime --node gyro=/dev/ttyUSB0,460800",
        "robins bench replay results/bench-satellite-s1/record.mcap --node adm",
    ),
)
def bench() -> None:
    """The test bench: each part of a vehicle a process or a board, each on a serial line."""


def _ports(
    _context: click.Context, _given: click.Parameter, texts: tuple[str, ...]
) -> dict[str, str]:
    found = {}
    for text in texts:
        part, equals, port = text.partition("=")
        if not equals or not part.strip() or not port.strip():
            raise click.BadParameter(f"{text!r} is not PART=PORT, such as gyro=/dev/ttyUSB0,460800")
        found[part.strip()] = port.strip()
    return found


_SEED = option("--seed", type=click.IntRange(0, 2**63 - 1), help="Of all noise. [default: 0]")
_FILTER = option("--filter", "filter_", metavar="NAME", help="Of the attitude determination.")


@bench.command(
    short_help="Start a bench and run a scenario on it.",
    epilog=examples(
        "robins bench up satellite/s1 --seconds 60",
        "robins bench up satellite/s2 --filter mixed-bias --live",
        "robins bench up wrong-star --filter mekf",
        "robins bench up satellite/s1 --clock realtime --rate 100 --seconds 60 --json",
        'robins bench up satellite/s1 --set gyro.bias="10 deg/h" --node gyro=/dev/ttyUSB0',
    ),
)
@click.argument("scenario")
@_FILTER
@option("--seconds", type=click.FloatRange(0.0, min_open=True), help="Of the run. [default: all]")
@option("--clock", type=click.Choice(["lockstep", "realtime"]), help="[default: lockstep]")
@option("--rate", type=click.FloatRange(0.0, min_open=True), metavar="HZ", help="In real time.")
@option("--overrun", type=click.Choice(["continue", "skip", "abort"]), help="Of a deadline.")
@option("--on-death", type=click.Choice(["fail", "restart"]), help="Of a process.")
@option("--restarts", type=click.IntRange(1, 100_000), help="At most, of processes. [default: 10]")
@option("--node", "ports", multiple=True, callback=_ports, metavar="PART=PORT", help="A board.")
@option("--baud", type=click.IntRange(300), help="Slow the virtual lines down to this.")
@option("--fifo", is_flag=True, help="Ask for the real-time scheduler SCHED_FIFO.")
@option("--live", is_flag=True, help="Serve a page that shows it.")
@option("--paused", is_flag=True, help="With --live: wait for Start on the page.")
@option("--host", default="127.0.0.1", show_default=True, help="Of the page.")
@option("--port", type=click.IntRange(0, 65535), default=8321, show_default=True, help="Same.")
@SETTINGS
@_SEED
@out_option
@json_option
@debug_option
def up(scenario: str, out: Path | None, **options: Any) -> int:
    """Run SCENARIO on the bench: one of the satellite, one of the bench, or a file of either.

    Plant, rate table, gyro, star sensor, attitude determination, control and actuators are
    processes, each on a serial line of its own, which the bench joins, records and disturbs. With
    --node a board takes the place of a process. In lock-step (the default) the run equals
    `robins run` bit for bit; real time is that of an ordinary kernel, soft.

    Scenarios of the bench: killed-adm, lost-star, lost-wheel, noisy-line, sign-star, stuck-star,
    wrong-star.
    """
    from robins.cli.bench_work import bring_up

    return bring_up(scenario, out or Path("results") / f"bench-{folder_name(scenario)}", **options)


@bench.command(short_help="How the benches of this machine are.")
@json_option
@debug_option
def status(as_json: bool) -> None:
    """Tell the benches that run on this machine: step, processes, links."""
    from robins.cli.bench_work import tell_status

    tell_status(as_json)


@bench.command(
    short_help="Let a part hear a record again, and compare what it says.",
    epilog=examples(
        "robins bench replay results/bench-satellite-s1/record.mcap --node adm",
        "robins bench replay record.mcap --node adm --filter ekf-quaternion",
        "robins bench replay record.mcap --node adm --diff other.mcap",
    ),
)
@click.argument("record", type=LOGS)
@option("--node", required=True, metavar="PART", help="Which part.")
@_FILTER
@option("--diff", type=LOGS, metavar="RECORD", help="Compare with what the part says in another.")
@json_option
@debug_option
def replay(record: Path, **options: Any) -> int:
    """Start a part alone and let it hear RECORD, the record.mcap of a run, again.

    The same part says the same bytes; exit status 1 if it does not. With --filter another filter
    hears the same, and with --diff the part of two records is compared, field by field; then
    differences are what was asked for, and no failure.
    """
    from robins.cli.bench_work import hear_again

    return hear_again(record, **options)


@bench.command(short_help="The serial ports of this machine.")
@json_option
@debug_option
def ports(as_json: bool) -> None:
    """Name the serial ports of this machine, and whether we may use them."""
    from robins.cli.bench_work import tell_ports

    tell_ports(as_json)


@bench.command(
    short_help="Be one part at a port, by hand.",
    epilog=examples("robins bench node gyro /dev/ttyUSB0,460800 satellite/s1 --seed 3"),
)
@click.argument("part")
@click.argument("port")
@click.argument("scenario")
@_FILTER
@_SEED
@debug_option
def node(part: str, port: str, scenario: str, **options: Any) -> None:
    """Be PART of SCENARIO at PORT until the bench says stop, as its process would be.

    For a part on another machine, at the other end of a serial cable: there `robins bench up
    SCENARIO --node PART=PORT` runs with the same seed.
    """
    from robins.cli.bench_work import be_node

    be_node(part, port, scenario, **options)


@bench.command(
    short_help="The wire as a C header, for firmware.",
    epilog=examples("robins bench header > robins_wire.h"),
)
@debug_option
def header() -> None:
    """Print robins_wire.h: every message, frames, a receiver; C99 or C++11, no heap."""
    from robins.cli.bench_work import print_header

    print_header()
