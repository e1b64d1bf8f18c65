"""The commands of the test bench: a run part by part, the replay of a part, a part by hand."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from robins.bench.parts.config_files import private_folder, put
from robins.bench.parts.station import Station, ready, serve
from robins.bench.ports.port import address, open_port, program
from robins.bench.recording import open_record
from robins.bench.recording.differences import Differences, FieldDifference, table
from robins.bench.recording.replay import Start, recorded, replay
from robins.bench.run.outcome import outcome
from robins.bench.run.session import Session
from robins.bench.run.setup import (
    LoadedRun,
    changed,
    config_of,
    read,
    recorded_flight,
    recorded_rig,
)
from robins.bench.run.watching import PageObserver, page_for, starting_state
from robins.bench.status import BenchStatus
from robins.results import Outcome, Progress, ignore_progress
from robins.results.summary import plain
from robins.systems import trust
from robins.workbench.errors import InputError
from robins.workbench.publication import part


def bench_up(
    scenario: str,
    *,
    settings: Sequence[str] = (),
    record: str | Path | None = None,
    live: bool = False,
    paused: bool = False,
    host: str = "127.0.0.1",
    port: int = 8321,
    opened: Callable[[str], None] = print,
    progress: Progress = ignore_progress,
    **options: Any,
) -> Outcome:
    """Run a scenario on the bench: each part a process or a board on a serial line.

    Args:
        scenario: of a system that has a rig, of the bench, a file of either, or a rig of the user's
            own, "pendulum.py:rig".
        settings: "path=value" texts that change it.
        record: a file for what goes over the lines, moved into the result folder in the end; what
            interrupts the run leaves it there.
        live: serve a page that shows the run.
        paused: wait for the start that the page gives.
        host: of the page.
        port: of the page.
        opened: called with the address of the page.
        progress: called with the fraction done and the current activity.
        **options: fields of `robins.bench.run.setup.Setup` that take the place of the scenario's;
            None leaves one as it is.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be run.
        robins.bench.ports.port.PortError: a port cannot be opened.
    """
    if paused and not live:
        raise InputError("--paused waits for the page's Start", fix="give --live too.")
    flight = flight_of(scenario, settings, options)
    file = None if record is None else Path(record)
    status = BenchStatus()
    with _observer(flight, status, live, host, port, opened) as watch:
        session = Session(flight, file, watch, part(progress, 0.0, 0.95), paused)
        try:
            ran = session.run()
        except KeyboardInterrupt as interrupt:
            if file is not None:
                interrupt.add_note(f"what was flown is in {file}")
            raise
    progress(0.97, "judging the run")
    found = outcome(flight, ran, file)
    return replace(found, warnings=[*found.warnings, *filter(None, [status.refused])])


def flight_of(scenario: str, settings: Sequence[str], options: Mapping[str, Any]) -> LoadedRun:
    """Run requested by options; those that are not given keep the values of the scenario.

    Raises:
        robins.scenario.ScenarioError: there is no such scenario, or an option does not fit.
    """
    for text in (options.get("ports") or {}).values():
        if (path := program(text)) is not None:
            trust.confirm(path)  # the user names it
    # a 0 is one that was given, though it equals False
    given = {k: v for k, v in options.items() if v is not None and v is not False and v != {}}
    return changed(read(scenario, tuple(settings)), given)


@contextlib.contextmanager
def _observer(
    flight: LoadedRun,
    status: BenchStatus,
    live: bool,
    host: str,
    port: int,
    opened: Callable[[str], None],
) -> Iterator[PageObserver]:
    """The status file, and the page if it is wanted."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(status)
        status.report(starting_state(flight))
        page = None
        if live:
            try:
                title = flight.setup.title or flight.name
                page = page_for(flight.rig, flight.given, title, os.getpid(), host, port)
            except ImportError as error:
                raise InputError(str(error)) from error
            except OSError as error:
                raise InputError(
                    str(error), f"--host {host} --port {port}", "try --port 0"
                ) from error
            stack.callback(page.close)
            opened(page.url)
        yield PageObserver(page, status)


class ReplayComparison(NamedTuple):
    """Comparison of what a part sent in the record and in its replay."""

    node: str
    frames: int  # number that it sent the second time
    same: bool  # byte for byte
    differences: list[FieldDifference]
    complete: bool  # neither record was cut or damaged
    damages: list[str]  # why not, a sentence a record
    until_s: float  # end of what was compared
    planned_s: float  # planned end of the run
    first_difference: str  # the first difference, in words, where the part was run again
    compared: int  # frames

    @property
    def data(self) -> dict[str, Any]:
        """The comparison in the types of JSON."""
        rows = [vars(difference) for difference in self.differences]
        said = {"node": self.node, "frames": self.frames, "same": self.same, "differences": rows}
        said |= {"whole": self.complete, "until_s": self.until_s, "planned_s": self.planned_s}
        return plain(said)

    @property
    def text(self) -> str:
        """The comparison for people."""
        lines, so_far = [], ""
        if not self.complete:
            span = f"up to {self.until_s:g} s of a run of {self.planned_s:g} s"
            lines.append(f"Compared, and no more: {self.compared} frames, {span}.")
            so_far = "as far as the record goes, "
        if self.same:
            said = f"'{self.node}' says the same {self.frames} frames, byte for byte."
            lines.append(f"Same: {so_far}{said}")
        else:
            lines += [
                f"Different: {self.first_difference or 'see below'}\n",
                table(self.differences),
            ]
        return "\n".join(lines)


def bench_replay(
    record: str | Path,
    *,
    node: str,
    filter_: str | None = None,
    diff: str | Path | None = None,
    progress: Progress = ignore_progress,
) -> ReplayComparison:
    """Run a part again on a record and compare its answers; or compare it in two records.

    Args:
        record: of a run, as the bench wrote it.
        node: name of the part.
        filter_: another filter for it to run.
        diff: another record to compare with, in place of running the part.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError, robins.scenario.ScenarioError: no such part or filter, or both are given.
        ValueError: a file is not a record.
    """
    if filter_ and diff:
        raise InputError("the one runs a filter, the other compares records", "--filter and --diff")
    first, second = open_record(record), None if diff is None else open_record(diff)
    rig = recorded_rig(first.header, record)
    if node not in rig.parts:
        raise InputError(f"there is no part '{node}', only {', '.join(rig.parts)}", "--node")
    step_ns, first_difference = int(first.header["step_ns"]), None
    if second is None:
        flight = recorded_flight(first.header, record, filter_)
        if once := rig.once(flight.setup, node):
            raise InputError(once, "--node", "compare two records with --diff")
        other = None if filter_ else program(flight.setup.ports.get(node, ""))

        def report_progress(k: int, n: int) -> None:
            progress(k / max(n, 1), "hearing")

        with _starter(flight, node, other) as start:
            heard = replay(first.entries, rig.wire, node, start, progress=report_progress)
        frames, first_difference = heard.compared, heard.first_difference
    else:
        frames, both = Differences(rig.wire, step_ns), (first.entries, second.entries)
        for pair in zip_longest(*(recorded(entries, node) for entries in both)):
            frames.take_both(*pair)
    found = frames.found()
    same = not found if second is not None else first_difference is None
    both = ((record, first), (diff, second))
    damages = [f"{path} is not whole: {one.why}" for path, one in both if one and not one.complete]
    return ReplayComparison(
        node=node,
        frames=frames.frames[1],
        same=same,
        differences=found,
        complete=not damages,
        damages=damages,
        until_s=min(frames.until_ns) * 1e-9,
        planned_s=int(first.header["steps"]) * step_ns * 1e-9,
        first_difference=first_difference or "",
        compared=min(frames.frames),
    )


@contextlib.contextmanager
def _starter(flight: LoadedRun, part: str, other: Path | None) -> Iterator[Start]:
    """Function that starts a part of a recorded run, or the program that stood in for it."""
    with private_folder() as folder:
        path = folder / "kit"
        put(config_of(flight), path)

        @contextlib.contextmanager
        def start(port: str) -> Iterator[subprocess.Popen]:
            command = [sys.executable, "-P", "-m", "robins.bench.parts.node"]
            command += [flight.rig.address or flight.rig.name, part, port, str(path)]
            command = command if other is None else [str(other), port]
            process = subprocess.Popen(command, start_new_session=True)
            try:
                yield process
            finally:
                process.kill()
                process.wait()

        yield start


def bench_node(
    name: str,
    port: str,
    scenario: str,
    *,
    filter_: str | None = None,
    seed: int | None = None,
    opened: Callable[[], None] = lambda: None,
) -> None:
    """Run a part of a scenario at a port until the bench sends stop, as its process would.

    Args:
        name: of the part.
        port: to the bench, "/dev/ttyUSB0,460800".
        scenario: as for `bench_up`, with the same seed.
        filter_: of the part that runs one; by default that of the scenario.
        seed: of all noise.
        opened: called when the port is open.

    Raises:
        InputError, robins.scenario.ScenarioError: no such part or scenario.
        robins.bench.ports.port.PortError: the port cannot be opened.
    """
    flight = flight_of(scenario, (), {"filter": filter_, "seed": seed})
    rig = flight.rig
    if name not in rig.parts:
        raise InputError(f"no part '{name}', only {', '.join(rig.parts)}")
    at = address(port)
    kit = config_of(flight)
    made = Station(ready(rig.part(name, kit), kit.frames), rig.wire)
    with open_port(at, timeout_s=None) as line:
        opened()
        serve(line, made)
