"""The command `export`: a filter of a scenario as C, the one that was judged, for a board.

Examples::

    robins export ins-gnss/drive --filter ekf --to drive-c
    robins export transfer-alignment/s0 --filter kf-flexure --to alignment-c --fast
    make -C drive-c check
    robins export satellite/s1 --filter mixed-bias --to adm --board
    robins export rocket/a1 --filter huber --to rocket-c --adjust 'rules[0].inner.limit'
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from robins import _float64, scenario
from robins.bench.rig import Rig
from robins.bench.rigs import RIGS, rig_of
from robins.bench.run.setup import changed, read
from robins.bench.wire.c_header import firmware
from robins.export.folder import Request, files_of, with_adjustable, write_folder
from robins.export.single_precision import PrecisionCost
from robins.program import DOUBLE, SINGLE
from robins.workbench.errors import InputError, refusing
from robins.workbench.options import MOST_OF_SEED, Option, Scenario
from robins.workbench.scenarios import check_filters, find_scenario, read_scenario

SMALL = 200  # scalar operations up to which a loop is written out where the code is to be small


class FilterExport(NamedTuple):
    """Files written, and remarks on them."""

    folder: Path
    files: tuple[str, ...]
    filter: str
    scalars: Mapping[str, int]  # of each entry point, nodes of its program
    bytes: int  # of the C
    real: str  # the type of its reals
    cost: PrecisionCost | None  # of single precision
    program: Path | None = None  # that stands for a part of the bench


def export_filter(
    name: Scenario,
    to: Annotated[Path, Option("A new folder.", "--to", "DIR")],
    *,
    filter_name: Annotated[
        str, Option("Which. [default: the system's, else the scenario's first]", "--filter", "NAME")
    ] = "",
    fast: Annotated[bool, Option("Keep loops, or write them out.", "--small/--fast")] = False,
    float32: Annotated[bool, Option("Single precision, and what it costs.")] = False,
    board: Annotated[bool, Option("Build it as a part of the bench too.")] = False,
    adjust: Annotated[
        Sequence[str], Option("A number to be set on board; repeatable.", metavar="NAME")
    ] = (),
    seed: Annotated[int, Option("Of the recorded run.", least=0, most=MOST_OF_SEED)] = 0,
    settings: Sequence[str] = (),
) -> FilterExport:
    """Write a filter of SCENARIO as C99, with a test of it for your own compiler.

    DIR gets one file of C that needs math.h alone, a header that names all fields with their units,
    a page that explains how to call it, and `make check`: it replays recorded steps and compares
    each state and each code with those of this program. With --float32 it runs the scenario in
    single precision too, and reports what that costs against the simulated truth. With --board it
    builds a program that stands for a part of the bench: the satellite's attitude determination, or
    the navigation computer of INS/GNSS. A number named by --adjust is a field of the state in the
    place of a constant; a name that the filter does not have lists those it has.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own; or
            what configures a replay, where the system has no scenario: "marg/replay", or a copy.
        to: a folder that is not there yet, or is empty.
        filter_name: by default that of the system, else the first of the scenario.
        fast: write loops out; larger, and faster where the code fits into the cache.
        float32: reals in single precision, with a report of what that costs.
        seed: of the run that is recorded for the test.
        settings: "path=value" texts that change the scenario.
        board: build it, too, as a part of the bench, for this machine.
        adjust: numbers of the filter that are fields of its state, to be set on board.

    Raises:
        InputError: there is no such scenario, filter or number, it calls Python at its steps, or
            the folder holds something; or no part of a rig is made of such a filter.
        robins.program.ProgramError: the filter does what has no place in C yet; the message names
            the line of the model or the rule.
        robins.program.BuildError: single precision is requested, and there is no compiler here by
            which to measure its cost.
    """
    _float64.require()
    if to.exists() and (not to.is_dir() or any(to.iterdir())):
        raise InputError("it is there and not empty", str(to), "name a new folder with --to.")
    rig = _rig_for(name) if board else None
    asked = _exportable(_request_for_rig(rig, float32, name, filter_name, seed, settings), adjust)
    precision = SINGLE if float32 else DOUBLE
    texts, library, found = files_of(asked, None if fast else SMALL, precision)
    files = {**texts, **(firmware(rig.wire) if rig else {}), **asked.files}
    write_folder(to, files)
    made = _built(to, rig.exported) if rig else None
    scalars = {entry.name: len(entry.program.live) for entry in library.entries}
    size, kind = len(texts[f"{library.name}.c"]), precision.kind
    return FilterExport(to, tuple(files), asked.filter, scalars, size, kind, found, made)


def _rig_for(name: str) -> Rig:
    """The rig of the system of a scenario, of which a part can be an exported filter.

    Raises:
        InputError: there is none.
    """
    system = find_scenario(name, recorded=True)[0].name
    rig = rig_of(system) if system in RIGS else None
    if rig is None or not rig.exported:
        what = f"no part of the bench is made of a filter of {system}"
        fix = "leave --board out, and write its loop around robins_wire.h (robins bench header)"
        raise InputError(what, "--board", fix)
    return rig


def _built(folder: Path, part: str) -> Path:
    """Build the part as a program.

    Raises:
        InputError: it cannot be built; the files are there.
    """
    command = ["make", "-s", "-C", str(folder), "-f", "board.mk", f"{part}_board"]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except FileNotFoundError:
        raise InputError("there is no make on this machine", "--board", "install one") from None
    except subprocess.CalledProcessError as error:
        why = (error.stderr.strip().splitlines() or ["no word from it"])[0]
        fix = f"a filter of another state needs another {part}_board.c: see docs/board.md"
        raise InputError(f"{part}_board does not build: {why}", str(folder), fix) from None
    return folder / f"{part}_board"


def _request_for_rig(
    rig: Rig | None, float32: bool, name: str, filter_name: str, seed: int, settings: Sequence[str]
) -> Request:
    """Request for the filter as a part of a rig in this scenario; else as in a simulation."""
    if rig is None or rig.aboard is None:
        return _request_for_scenario(name, filter_name, seed, settings)
    if float32:
        what = f"the {rig.name} is not navigated in single precision"
        raise InputError(what, "--float32", "leave it out with --board")
    options = {"seed": seed} | ({"filter": filter_name} if filter_name else {})
    flight = changed(read(name, tuple(settings)), options)
    made, label = rig.aboard(flight), find_scenario(name, recorded=True)[1]
    return Request(made.problem, flight.setup.filter, label, made.library, made.files)


def _exportable(asked: Request, adjust: Sequence[str]) -> Request:
    """Request with its adjustable numbers; refused where the filter cannot run in C."""
    if why := asked.problem.contenders[asked.filter].on_host:
        what = f"filter '{asked.filter}' cannot be exported: {why}, which no program in C does"
        raise InputError(what, asked.label, "choose another by --filter")
    if not adjust:
        return asked
    with refusing("--adjust"):
        return with_adjustable(asked, adjust)


def _request_for_scenario(
    name: str, filter_name: str, seed: int, settings: Sequence[str]
) -> Request:
    """Request for a filter, with the problem by which it is tested."""
    system, label, text = find_scenario(name, recorded=True)
    if system.aboard is not None and system.replay_parameters is not None:
        given = scenario.parse(system.replay_parameters, text, settings, source=name)
        wanted = filter_name or system.default
        check_filters(label, [system.default], [wanted])
        with refusing(name):
            return Request(system.aboard(given, seed), wanted, label)
    one = read_scenario(name, (*settings, "runs=1"))  # which refuses what simulates nothing
    filters = one.study.filters
    wanted = filter_name or (system.default if system.default in filters else one.own[0])
    check_filters(label, filters, [wanted])
    return Request(one.problem((wanted,), seed), wanted, label)
