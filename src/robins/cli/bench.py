"""The commands of the test bench and their options.

Examples of `robins bench`::

    robins bench up satellite/s1                  seven processes, one loop, bit for bit
    robins bench up satellite/s1 --live           with a page to watch it
    robins bench up noisy-line                    damaged, lost, late frames
    robins bench up ins-gnss/drive --filter ekf   inertial unit, receiver, navigation
    robins bench up satellite/s1 --clock realtime --node gyro=/dev/ttyUSB0,460800
    robins bench replay results/bench-satellite-s1/record.mcap --node adm

Examples of `robins bench up`::

    robins bench up satellite/s1 --seconds 60
    robins bench up satellite/s2 --filter mixed-bias --live
    robins bench up wrong-star --filter mekf
    robins bench up satellite/s1 --clock realtime --rate 100 --seconds 60 --json
    robins bench up satellite/s1 --set gyro.bias="10 deg/h" --node gyro=/dev/ttyUSB0

Examples of `robins bench replay`::

    robins bench replay results/bench-satellite-s1/record.mcap --node adm
    robins bench replay record.mcap --node adm --filter ekf-quaternion
    robins bench replay record.mcap --node adm --diff other.mcap

Examples of `robins bench node`::

    robins bench node gyro /dev/ttyUSB0,460800 satellite/s1 --seed 3

Examples of `robins bench header`::

    robins bench header > robins_wire.h
    robins bench header --to board
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click import option

from robins.cli import cache
from robins.cli.frame import ExitStatus, only_json
from robins.cli.options import (
    DEBUG,
    LOGS,
    RESULTS,
    SETTINGS,
    TRUST,
    add_examples,
    answers,
    folder_name,
    of_value,
    publishes,
)
from robins.cli.printing import carry_out, print_data
from robins.cli.progress import Progress


@click.group(short_help="Run a vehicle part by part over serial lines.")
def bench() -> None:
    """The test bench: each part of a vehicle is a process or a board on a serial line."""


def _ports(texts: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for text in texts:
        part, equals, port = text.partition("=")
        if not equals or not part.strip() or not port.strip():
            raise click.BadParameter(f"{text!r} is not PART=PORT, such as gyro=/dev/ttyUSB0,460800")
        found[part.strip()] = port.strip()
    return found


_SEED = option("--seed", type=click.IntRange(0, 2**63 - 1), help="Seed of all noise. [default: 0]")
_NODE = option(
    "--node",
    "ports",
    multiple=True,
    callback=of_value(_ports),
    metavar="PART=PORT",
    help="Put a board (PATH,BAUD) or a program in the place of PART.",
)
_FILTER = option("--filter", "filter_", metavar="NAME", help="Filter to fly with.")


@bench.command(short_help="Start a bench and run a scenario on it.")
@click.argument("scenario")
@_FILTER
@option("--seconds", type=click.FloatRange(0.0, min_open=True), help="Length. [default: all]")
@option("--clock", type=click.Choice(["lockstep", "realtime"]), help="[default: lockstep]")
@option("--rate", type=click.FloatRange(0.0, min_open=True), metavar="HZ", help="Real-time rate.")
@option("--overrun", type=click.Choice(["continue", "skip", "abort"]), help="For a late step.")
@option("--on-death", type=click.Choice(["fail", "restart"]), help="If a part dies.")
@option("--restarts", type=click.IntRange(1, 100_000), help="Upper limit. [default: 10]")
@_NODE
@option(
    "--baud",
    type=click.IntRange(300),
    help="Speed of the virtual lines; of a board: --node PART=PATH,BAUD.",
)
@option("--fifo", is_flag=True, help="Ask for the real-time scheduler SCHED_FIFO.")
@option("--live", is_flag=True, help="Serve a page that shows the run.")
@option("--paused", is_flag=True, help="With --live: wait for Start on the page.")
@option("--host", default="127.0.0.1", show_default=True, help="Page address.")
@option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8321,
    show_default=True,
    help="TCP port of the page.",
)
@SETTINGS
@_SEED
@TRUST
@publishes
def up(scenario: str, out: Path | None, filter_: str | None, **options: Any) -> int:
    """Run SCENARIO on the bench: one of a vehicle, one of the bench, or a file of either.

    Each part of the vehicle, such as plant, gyro or attitude determination, is a process on its own
    serial line; the bench connects, records and disturbs the lines. With --node a board replaces a
    process, or a program of your own that is given the path of a line. In lock-step (the default)
    the run equals `robins run` bit for bit; real time is soft, as on any ordinary kernel. A rig of
    your own is named with its file, my_rig.py:rig.

    Scenarios of the bench: dark-sky, false-place, killed-adm, lost-gnss, lost-star, lost-wheel,
    noisy-line, pointing-command, power-adm, sign-star, stuck-star, windy-hover, wrong-star.
    """
    out = out or RESULTS / f"bench-{folder_name(scenario)}"
    outcome = carry_out(
        "bench_up",
        scenario,
        out=out,
        filter=filter_,
        record=f"{out}.record.mcap",
        opened=lambda url: click.echo(f"Page:   {url}", err=True),
        **options,
    )
    return ExitStatus.FAILED if outcome.failure else ExitStatus.DONE


@bench.command(short_help="Show the benches that run on this machine.")
@answers
def status(as_json: bool) -> None:
    """Show the benches that run on this machine: step, processes, links."""
    from robins.bench.status import running, table

    found = running()
    print_data({"benches": found}, table(found), as_json)


@bench.command(short_help="Send a record to a part again and compare its answers.")
@click.argument("record", type=LOGS)
@option("--node", required=True, metavar="PART", help="Which part.")
@_FILTER
@option("--diff", type=LOGS, metavar="RECORD", help="Compare with another record.")
@TRUST
@answers
def replay(record: Path, as_json: bool, **options: Any) -> int:
    """Start a part alone and send it RECORD, the record.mcap of a run, again.

    The exit status is 1 if the part does not answer with the same bytes. With --filter another
    filter gets the same input, and with --diff the part of two records is compared, field by
    field; then differences are expected and are not a failure.
    """
    cache.enable()
    with only_json(as_json), Progress() as progress:
        from robins.workbench import bench_replay

        found = bench_replay(record, progress=progress, **options)
    for damage in found.damages:
        click.echo(damage, err=as_json)
    print_data(found.data, found.text, as_json)
    asked = options["filter_"] is not None or options["diff"] is not None
    return ExitStatus.DONE if (found.same or asked) and found.complete else ExitStatus.FAILED


@bench.command(short_help="List the serial ports of this machine.")
@answers
def ports(as_json: bool) -> None:
    """List the serial ports of this machine, and whether you may use them."""
    from robins.bench.ports.port import list_ports, table

    found = list_ports()
    print_data({"ports": [port._asdict() for port in found]}, table(found), as_json)


@bench.command(short_help="Run one part at a port, by hand.")
@click.argument("part")
@click.argument("port")
@click.argument("scenario")
@_FILTER
@_SEED
@TRUST
@DEBUG
def node(part: str, port: str, scenario: str, **options: Any) -> None:
    """Run PART of SCENARIO at PORT until the bench sends stop, as its process would.

    Use it for a part on another machine, at the other end of a serial cable: there `robins bench
    up SCENARIO --node PART=PORT` runs with the same seed.
    """
    cache.enable()
    from robins.workbench import bench_node

    says = f"'{part}' of {scenario} at {port}, until the bench says stop (Ctrl-C ends it)"
    bench_node(part, port, scenario, opened=lambda: click.echo(says), **options)
    click.echo("The bench has said stop.")


@bench.command(short_help="Print the wire as a C header, for firmware.")
@click.argument("rig", default="satellite")
@option("--to", type=click.Path(path_type=Path), metavar="DIR", help="Write the examples too.")
@DEBUG
def header(rig: str, to: Path | None) -> None:
    """Print robins_wire.h of RIG: every message, frames, a receiver; C99 or C++11, no heap.

    RIG is one that comes with robins, by default the satellite, or "file.py:rig". With --to it goes
    into a folder, with all else that a board needs, and examples where there are some.
    """
    from robins.bench.rigs import rig_of
    from robins.bench.wire.c_header import c_header, firmware

    wire = rig_of(rig).wire
    if to is None:
        return click.echo(c_header(wire), nl=False)
    to.mkdir(parents=True, exist_ok=True)
    files = firmware(wire)
    for name, text in files.items():
        (to / name).write_text(text, "utf-8")
    click.echo(f"Wrote:  {to}/  {', '.join(files)}")
    examples = [name.removesuffix(".c") for name in files if name.endswith("_board.c")]
    then = "write PART_board.c around platform.h   there is an example for the satellite alone"
    if examples:
        then = f"make -C {to} -f board.mk {examples[-1]}   builds an example for this machine"
    click.echo(f"Next:   {then}")


add_examples(__doc__, bench)
