"""A filter of a scenario as C for a board: the filter that was judged is the one that flies."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from robins import __version__, _float64, scenario
from robins.bench.rig import Rig
from robins.bench.rigs import RIGS, rig_of
from robins.bench.run.setup import changed, read
from robins.bench.wire.c_header import firmware
from robins.campaign.monte_carlo import reported_rows
from robins.filters import SENTENCES, Code, FilterState
from robins.filters.composite.adjustable import adjustable
from robins.filters.model import Data
from robins.program import DOUBLE, SINGLE, Precision, Program, trace_steps
from robins.program.harness import Key, Recorded, check_c, makefile, recorded_h
from robins.program.library import Entry, Library, symbol
from robins.systems.study import Case, Problem
from robins.workbench.board_runs import (
    BoardRun,
    Calls,
    board_runs,
    by_jax,
    ends,
    entry_functions,
    reset_function,
)
from robins.workbench.board_words import components, field_notes, mean_fields, tangent_axes
from robins.workbench.errors import InputError, refusing
from robins.workbench.scenarios import check_filters, find_scenario, read_scenario
from robins.workbench.single_precision import Cost, cost, differences, in_floats

STEPS = 60  # of a run, recorded for the test
RUNS = 3  # by which the cost of single precision is measured
NIS = 1e-7  # tolerance: it squares what is left of readings far larger than their sigma
MARGIN, LEAST = 4.0, 1e-6  # of its differences in the test: other compilers round otherwise
RESET = "reset"  # the entry point that starts again
SMALL = 200  # scalar operations up to which a loop is written out where the code is to be small


class Exported(NamedTuple):
    """Files written, and remarks on them."""

    folder: Path
    files: tuple[str, ...]
    filter: str
    scalars: Mapping[str, int]  # of each entry point, nodes of its program
    bytes: int  # of the C
    real: str  # the type of its reals
    cost: Cost | None  # of single precision
    program: Path | None = None  # that stands for a part of the bench


def export_filter(
    name: str,
    to: Path,
    *,
    filter_name: str = "",
    fast: bool = False,
    float32: bool = False,
    seed: int = 0,
    settings: Sequence[str] = (),
    board: bool = False,
    adjust: Sequence[str] = (),
) -> Exported:
    """Write a filter of a scenario as C99, with a test for the user's own compiler.

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
    if rig is not None and rig.aboard is not None:
        if float32:
            what = f"the {rig.name} is not navigated in single precision"
            raise InputError(what, "--float32", "leave it out with --board")
        asked = _aboard(rig, name, filter_name, seed, settings)
    else:
        asked = _asked(name, filter_name, seed, settings)
    problem, wanted, label = asked.problem, asked.filter, asked.label
    if why := problem.contenders[wanted].on_host:
        what = f"filter '{wanted}' cannot be exported: {why}, which no program in C does"
        raise InputError(what, label, "choose another by --filter")
    if adjust:
        asked = asked._replace(problem=_adjustable(problem, wanted, adjust))
    precision = SINGLE if float32 else DOUBLE
    unroll = None if fast else SMALL
    library, c, record, found = _library(asked, unroll, precision)
    files = {
        f"{library.name}.h": library.header(),
        f"{library.name}.c": c,
        "recorded.h": recorded_h(library, record),
        "test.c": check_c(library, record),
        "Makefile": makefile(library),
        "README.md": _readme(library, wanted, label, found),
        **(firmware(rig.wire) if rig else {}),
        **asked.files,
    }
    _write(to, files)
    made = _built(to, rig.exported) if rig else None
    scalars = {entry.name: len(entry.program.live) for entry in library.entries}
    return Exported(to, tuple(files), wanted, scalars, len(c), precision.kind, found, made)


def _adjustable(problem: Problem, name: str, numbers: Sequence[str]) -> Problem:
    """The problem with some numbers of a filter in its state."""
    one = problem.contenders[name]
    with refusing("--adjust"):
        filter_ = adjustable(one.filter, numbers)

    def case(world: Data) -> Case:
        made = one.case(world)
        if isinstance(made.start, FilterState):
            return made._replace(start=filter_.begun(made.start))
        return made

    return replace(problem, contenders={name: replace(one, filter=filter_, case=case)})


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
    """The part as a program.

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


class _Asked(NamedTuple):
    """Request of an export."""

    problem: Problem  # by which the filter is tried
    filter: str
    label: str  # of the problem
    library: str = "robins"
    files: Mapping[str, str] = MappingProxyType({})  # of a loop around it


def _aboard(rig: Rig, name: str, filter_name: str, seed: int, settings: Sequence[str]) -> _Asked:
    """The filter as a part of a rig has it, in a run of this scenario, and the part's loop."""
    assert rig.aboard is not None
    options = {"seed": seed} | ({"filter": filter_name} if filter_name else {})
    flight = changed(read(name, tuple(settings)), options)
    made, label = rig.aboard(flight), find_scenario(name, recorded=True)[1]
    return _Asked(made.problem, flight.setup.filter, label, made.library, made.files)


def _asked(name: str, filter_name: str, seed: int, settings: Sequence[str]) -> _Asked:
    """The problem by which a filter is tried."""
    system, label, text = find_scenario(name, recorded=True)
    if system.aboard is not None and system.replay_parameters is not None:
        given = scenario.parse(system.replay_parameters, text, settings, source=name)
        wanted = filter_name or system.default
        check_filters(label, [system.default], [wanted])
        with refusing(name):
            return _Asked(system.aboard(given, seed), wanted, label)
    one = read_scenario(name, (*settings, "runs=1"))  # which refuses what simulates nothing
    filters = one.study.filters
    wanted = filter_name or (system.default if system.default in filters else one.own[0])
    check_filters(label, filters, [wanted])
    return _Asked(one.problem((wanted,), seed), wanted, label)


def _library(
    asked: _Asked, unroll: int | None, precision: Precision
) -> tuple[Library, str, Recorded, Cost | None]:
    """The filter as a library, its C, some steps of it by JAX, and what single precision costs."""
    problem, name, label = asked[:3]
    contender = problem.contenders[name]
    single = precision is SINGLE
    runs = board_runs(problem, name, RUNS if single else 1)
    run = runs[0]
    functions = entry_functions(contender.filter, contender.model, run.given)
    anew = reset_function(contender.filter, run.start)
    belief = run.start.belief
    first = run.row(0)
    steps = [(functions[e], first[e]) for e in functions]
    programs = trace_steps([*steps, (anew, (belief,))], _any_start(runs), unroll=unroll)
    entries = [_entry(n, p) for n, p in zip([*functions, RESET], programs, strict=True)]
    reported = reported_rows(contender.reported, run.case)[0]
    axes = tangent_axes(problem, reported, len(belief.factor))
    notes = field_notes(problem, axes, run.start, first, contender.filter.suspects)
    library = Library(asked.library, entries, run.start, (), notes, precision)
    c = library.source()
    identity = hashlib.sha256((library.header() + c).encode()).hexdigest()
    about = (
        f"Filter '{name}' of {label}, by robins {__version__}; program {identity[:16]}.",
        "SI units and radians. NaN is missing, for each component of a reading.",
        *(["Single precision: README.md states the cost."] if single else []),
        *components(axes),
    )
    library = library._replace(about=about)
    c = library.headed(c)
    record = _record(run.cut(STEPS), functions, anew)
    if not single:
        return library, c, record, None
    doubles = [by_jax(functions, one, ends) for one in runs]
    singles = in_floats(library, runs, ends)
    found = cost(problem, contender, library, runs, doubles, singles)
    record = _compared(library, record, in_floats(library, [run.cut(STEPS)], dict)[0])
    return library, c, record._replace(ruined="" if found.bearable else found.verdict), found


def _entry(name: str, program: Program) -> Entry:
    """An entry point with its words."""
    if name == "predict":
        return Entry(name, program, ("input",), "Moves on by one step.")
    if name == RESET:
        return Entry(name, program, ("belief",), "Starts again from a belief, all else as by init.")
    return Entry(name, program, ("reading", "about"), f"Uses a reading of {name[7:]}.")


def _any_start(runs: Sequence[BoardRun]) -> Any:
    """A state that is zero only where the starts of all runs are."""

    def either(first: Any, *others: Any) -> Any:
        for other in others:
            first = np.where(np.asarray(first) == 0, other, first)
        return first

    return jax.tree_util.tree_map(either, *(run.start for run in runs))


def _record(run: BoardRun, functions: Mapping[str, Any], anew: Any) -> Recorded:
    """The steps by JAX, and then a new start from what was believed after the first."""
    made = by_jax(functions, run, dict)
    states = list(made.values())[-1][0]
    first, last = (jax.tree_util.tree_map(lambda a, k=k: a[k], states) for k in (0, -1))
    once = jax.jit(anew)(last, first.belief)
    made[RESET] = jax.tree_util.tree_map(lambda x: np.asarray(x)[None], once)
    sizes = _sizes(made)
    tolerances = {key: NIS for key in sizes if key[1] == "nis"}
    return Recorded(run.given, made, tolerances, 0, sizes, {RESET: (first.belief,)})


def _sizes(made: Calls) -> dict[Key, float]:
    """Sizes against which a billionth is no difference, by struct and field.

    They are the largest sigma of what is in the units of a sigma, and the degrees of freedom of a
    NIS.
    """
    sizes: dict[Key, float] = {}
    for entry, (state, told) in made.items():
        factor, mean = state.belief.factor, state.belief.mean
        sigma = np.sqrt(np.sum(np.square(factor), axis=-1))
        for name, first, end, own in mean_fields(jax.tree_util.tree_map(lambda a: a[0], mean)):
            if not own:
                key = "state", name
                sizes[key] = max(sizes.get(key, 0.0), _largest(sigma[:, first:end]))
        if hasattr(told, "innovation"):
            struct = f"{symbol(entry)}_result"
            sizes[struct, "innovation"] = _largest(told.sigma)
            sizes[struct, "nis"] = _largest(told.dof)
    return sizes


def _largest(numbers: np.ndarray) -> float:
    return float(np.max(numbers, initial=0.0, where=np.isfinite(numbers)))


def _compared(library: Library, record: Recorded, singles: Calls) -> Recorded:
    """Record with the tolerances of floats: their differences times a margin."""
    parts: dict[Key, float] = {}
    off = 0
    for entry in library.entries:
        if entry.name not in singles:
            continue
        result = f"{entry.symbol}_result"
        fields = ("state", library.state), (result, library.result(entry))
        pairs = zip(record.made[entry.name], singles[entry.name], strict=True)
        changed = np.zeros(len(singles[entry.name][1].code), bool)
        for (struct, own), (wide, narrow) in zip(fields, pairs, strict=True):
            least = {f: size for (one, f), size in record.sizes.items() if one == struct}
            for name, part in differences(own, wide, narrow, least).items():
                parts[struct, name] = max(part, parts.get((struct, name), 0.0))
            for a, b in zip(*map(jax.tree_util.tree_leaves, (wide, narrow)), strict=True):
                if a.dtype != np.float64:
                    changed |= np.any((a != b).reshape(len(a), -1), axis=1)
        off += int(np.sum(changed))
    tolerances = {key: max(MARGIN * part, LEAST) for key, part in parts.items()}
    return record._replace(tolerances=tolerances, codes_off=off)


def _readme(library: Library, name: str, label: str, found: Cost | None) -> str:
    """README of the exported folder."""
    n, calls = library.name, "\n".join(f"    {library.signature(e)};" for e in library.entries)
    codes = "\n".join(f"| {int(code)} | {sentence} |" for code, sentence in SENTENCES.items())
    return f"""# Filter `{name}` of `{label}` in C

By robins {__version__}. C99, no allocation, no global state, no recursion, no library but `math.h`;
one thread may use one state, several threads several states.

    make check     compiles the library and a test, replays recorded steps, compares all outputs
    make stack     lists the stack of each function

`{n}.h` names all fields; `{n}.c` needs nothing else. The numbers of the model (noise, axes,
constants) is in the code: export again to change it.

    void {n}_init({n}_state *state);
{calls}

Each step calls `{n}_predict`, then the update of each sensor that has a reading. A component that
is missing is NaN, so the header refuses `-ffast-math`. Each call returns a code:

| code | meaning |
|---|---|
{codes}

Where a reading was used, `sigma` of the result is the standard deviation of each component of the
innovation: a reading is suspicious where the innovation exceeds three of them.

`{n}_init` begins where the recorded run does. `{n}_reset` starts again from a mean and the factor
of a covariance, in any state: whatever else the filter has learned is then as after `{n}_init`. A
belief that is not finite is not taken (code {int(Code.NOT_FINITE)}). Read the state, copy it, but
change it by `{n}_init` and the calls only.
{_costs(found)}"""


def _costs(found: Cost | None) -> str:
    """The part of the page on single precision."""
    if found is None:
        return ""
    return f"""
## Single precision

**{found.verdict}**

{found.runs} runs of the scenario, {found.steps} steps each, by this library as compiled on the
machine that exported it, given the same readings rounded to floats; in double precision by JAX.
{found.codes_off} of {found.codes} codes differ.

{found.table()}

`make check` compares with double precision. What it allows is {MARGIN:.0f} times what single
precision was found to cost in the recorded steps, and at least {LEAST:.0e} of a field: see
`recorded.h`.{" It fails, since the filter is ruined." if not found.bearable else ""}
"""


def _write(to: Path, files: Mapping[str, str]) -> None:
    """All files or none."""
    to.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(dir=to.parent, prefix=f".{to.name}-"))
    try:
        for name, text in files.items():
            (made / name).write_text(text, "utf-8")
        made.chmod(0o755)
        if to.exists():
            to.rmdir()
        made.replace(to)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise
