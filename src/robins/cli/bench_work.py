"""What the commands of the bench do, and how they tell it."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from robins.cli import cache
from robins.cli.frame import BadInput, Status, command_line, only_json
from robins.cli.progress import Progress

RECORD, ACCOUNT = "record.mcap", "bench.json"
_EXTRA = "the bench needs the extra 'bench': pip install 'robins[bench]'"


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """A package that is not there, as advice."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name and error.name.split(".")[0] in ("serial", "cobs", "fastcrc", "mcap"):
            raise BadInput(f"{_EXTRA} ({error.name} is missing)") from error
        raise


def _flight(scenario: str, settings: tuple[str, ...], options: Mapping[str, Any]) -> Any:
    """The run that is asked for; options that were not given stay as the scenario has them."""
    from robins.bench.run.setup import changed, read

    # a 0 is one that was given, though it equals False
    given = {k: v for k, v in options.items() if v is not None and v is not False and v != {}}
    return changed(read(scenario, settings), given)


def bring_up(
    scenario: str,
    out: Path,
    *,
    filter_: str | None,
    live: bool,
    paused: bool,
    host: str,
    port: int,
    settings: tuple[str, ...],
    as_json: bool,
    **options: Any,
) -> int:
    """Run a scenario on the bench, write and tell what came of it."""
    if paused and not live:
        raise BadInput("--paused waits for the page's Start: give --live too.")
    cache.enable()
    command = command_line()
    with only_json(as_json), _told(), Progress() as progress:
        from robins.bench.run import outcome
        from robins.bench.run.one_program import in_process
        from robins.bench.run.session import Session
        from robins.results import ResultWriter

        flight = _flight(scenario, settings, {"filter": filter_, **options})
        text = flight.text or f'bench = "satellite"\nflies = "{flight.setup.flies}"\n'
        with ResultWriter(out, command=command, scenario_text=text) as writer:
            # The record is a file of its own until the end: what kills the bench leaves it.
            record = writer.beside(RECORD)
            with _onlooker(flight, live, host, port) as watch:
                session = Session(flight, record, watch, _share(progress, 0.0, 0.85), paused)
                try:
                    ran = session.run()
                except KeyboardInterrupt:
                    click.echo(f"robins: what was flown is in {record}", err=True)
                    raise
            loop = None
            if flight.setup.clock == "lockstep" and ran.steps and not flight.setup.ports:
                progress(0.87, "the same inside one program")
                loop = in_process(flight, ran.kit)
            told = outcome.figures(flight, ran, loop)
            notes = outcome.notes(flight, told)
            _write(writer, flight, ran, told, notes, record, progress)
    _tell_run(out, told, notes, ran, as_json)
    return Status.FAILED if told["failure"] else Status.DONE


def _share(progress: Progress, low: float, high: float) -> Any:
    return lambda share, what: progress(low + (high - low) * share, what)


@contextlib.contextmanager
def _onlooker(flight: Any, live: bool, host: str, port: int) -> Iterator[Any]:
    """The status file, and the page if it is wanted."""
    from robins.bench.status import Status as StatusFile

    with contextlib.ExitStack() as stack:
        status = stack.enter_context(StatusFile())
        from robins.bench.run.watching import Looking, starting

        status.tell(starting(flight))
        page = None
        if live:
            from robins.bench.run.watching import page_for

            try:
                title = flight.setup.title or flight.name
                page = page_for(title, os.getpid(), len(flight.loop.wheels.axes), host, port)
            except ImportError as error:
                raise BadInput(str(error)) from error
            except OSError as error:
                raise BadInput(f"--host {host} --port {port}: {error}; try --port 0") from error
            stack.callback(page.close)
            click.echo(f"Page:   {page.url}", err=True)
        yield Looking(page, status)


def _write(
    writer: Any,
    flight: Any,
    ran: Any,
    told: dict[str, Any],
    notes: list[str],
    record: Path,
    progress: Any,
) -> None:
    from robins import report
    from robins.bench.run import outcome
    from robins.results.summary import dumps, plain

    writer.save_summary(outcome.summary(flight, told))
    if ran.steps:
        writer.save_solution(outcome.solution(flight, ran))
    writer.save_file(ACCOUNT, dumps(plain(told)).encode())
    writer.save_file(RECORD, record.read_bytes())
    report.add(writer, lambda done, total, what: progress(0.9, what), notes)


def _tell_run(out: Path, told: dict[str, Any], notes: list[str], ran: Any, as_json: bool) -> None:
    from robins.results.summary import dumps, plain

    if as_json:
        click.echo(dumps(plain(told)), nl=False)
        return
    counts = told["counts"]
    for name in ("attitude_rms", "attitude_peak", "pointing_rms", "pointing_peak"):
        value = told[f"{name}_arcsec"]
        click.echo(f"{name.replace('_', ' '):<16}{value:10.2f} arcsec")
    wire = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in counts.items() if v)
    click.echo(f"{'wire':<16}{wire}\n")
    click.echo(ran.latencies.table())
    for note in notes:
        click.echo(note)
    for warning in told["warnings"]:
        click.secho(f"Warning: {warning}", fg="yellow", bold=True)
    for event in told["events"]:
        if event["kind"] != "missed":
            click.echo(f"  {event['time_s']:9.2f} s  {event['text']}")
    click.echo(f"\nResult: {out}\nRecord: {out / RECORD}   (opens in MCAP viewers too)")
    click.echo(f"Report: {out / 'report.html'}   (open it in a browser)")
    click.echo(f"Next:   robins bench replay {out / RECORD} --node adm")


def tell_status(as_json: bool) -> None:
    """The benches that run."""
    import json

    with _told():
        from robins.bench.status import running, table
    found = running()
    click.echo(json.dumps({"benches": found}, indent=2) if as_json else table(found))


def tell_ports(as_json: bool) -> None:
    """The serial ports."""
    import json

    with _told():
        from robins.bench.ports.listing import list_ports, table
    found = list_ports()
    if as_json:
        click.echo(json.dumps({"ports": [p._asdict() for p in found]}, indent=2))
        return
    click.echo(table(found))


def print_header() -> None:
    """The C header."""
    with _told():
        from robins.bench.wire.c_header import c_header
    click.echo(c_header(), nl=False)


def be_node(part: str, port: str, scenario: str, *, filter_: str | None, seed: int | None) -> None:
    """Be a part until the bench says stop."""
    cache.enable()
    with _told():
        from robins.bench.parts.satellite import BUILD
        from robins.bench.parts.satellite.preparing import kit_for
        from robins.bench.parts.station import Station, ready, serve
        from robins.bench.ports.port import address, open_port
        from robins.bench.run.setup import NODES
    if part not in BUILD:
        raise BadInput(f"no part '{part}', only {', '.join(NODES)}")
    flight = _flight(scenario, (), {"filter": filter_, "seed": seed})
    at = address(port)
    table = flight.setup.table and flight.setup.table.table()
    kit = kit_for(flight.loop, flight.setup.filter, flight.setup.seed, table=table)
    made = Station(ready(BUILD[part](kit), kit.frames))
    with open_port(at, timeout_s=None) as line:
        click.echo(f"'{part}' of {scenario} at {port}, until the bench says stop (Ctrl-C ends it)")
        serve(line, made)
    click.echo("The bench has said stop.")


def hear_again(
    record: Path, *, node: str, filter_: str | None, diff: Path | None, as_json: bool
) -> int:
    """Replay a part, compare, tell."""
    if filter_ and diff:
        raise BadInput("--filter and --diff: the one runs a filter, the other compares records")
    cache.enable()
    with only_json(as_json), _told(), Progress() as progress:
        from robins.bench.recording import read_record
        from robins.bench.recording.differences import differences, table
        from robins.bench.recording.replay import recorded, replay
        from robins.bench.run.setup import NODES, recorded_flight

        if node not in NODES:
            raise BadInput(f"--node: there is no part '{node}', only {', '.join(NODES)}")
        first, second = read_record(record), None if diff is None else read_record(diff)
        damaged = False
        for path, one in ((record, first), (diff, second)):
            if one is not None and not one.whole:
                damaged = True
                click.echo(f"{path} is not whole: {one.why}")
        step_ns = int(first.header["step_ns"])
        if second is None:
            flight = recorded_flight(first.header, filter_)
            with _starter(flight, node) as start:
                heard = replay(
                    first, node, start, progress=lambda k, n: progress(k / max(n, 1), "hearing")
                )
            a, b, same, told = heard.recorded, heard.frames, heard.same, heard.first_difference
        else:
            a, b = recorded(first, node), recorded(second, node)
            same, told = not differences(a, b), None
    found = differences(a, b, step_ns)
    until_s = min(max((f.header.time_ns for f in x), default=0) for x in (a, b)) * 1e-9
    planned_s = int(first.header["steps"]) * step_ns * 1e-9
    compared = f"{min(len(a), len(b))} frames, up to {until_s:g} s of a run of {planned_s:g} s"
    if as_json:
        from robins.results.summary import dumps, plain

        rows = [vars(x) for x in found]
        said = {"node": node, "frames": len(b), "same": same, "differences": rows}
        said |= {"whole": not damaged, "until_s": until_s, "planned_s": planned_s}
        click.echo(dumps(plain(said)), nl=False)
    else:
        if damaged:
            click.echo(f"Compared, and no more: {compared}.")
        if same:
            so_far = "as far as the record goes, " if damaged else ""
            click.echo(f"Same: {so_far}'{node}' says the same {len(b)} frames, byte for byte.")
        else:
            click.echo(f"Different: {told or 'see below'}\n")
            click.echo(table(found))
    asked = filter_ is not None or diff is not None
    return Status.DONE if (same or asked) and not damaged else Status.FAILED


@contextlib.contextmanager
def _starter(flight: Any, part: str) -> Iterator[Any]:
    """What starts a part of a recorded run on a path."""
    from robins.bench.parts.satellite.preparing import kit_for

    table = flight.setup.table and flight.setup.table.table()
    kit = kit_for(flight.loop, flight.setup.filter, flight.setup.seed, table=table)
    with tempfile.TemporaryDirectory(prefix="robins-bench-") as folder:
        path = Path(folder) / "kit.pickle"
        path.write_bytes(pickle.dumps(kit))

        @contextlib.contextmanager
        def start(port: str) -> Iterator[subprocess.Popen]:
            command = [sys.executable, "-m", "robins.bench.parts.node", part, port, str(path)]
            process = subprocess.Popen(command, start_new_session=True)
            try:
                yield process
            finally:
                process.kill()
                process.wait()

        yield start
