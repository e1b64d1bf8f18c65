"""The folder of a filter as C: a library, recorded steps that test it, and a page on it."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np

from robins import __version__
from robins.campaign.monte_carlo import reported_rows
from robins.export.field_notes import (
    MEAN,
    attitude_lines,
    components,
    field_notes,
    tangent_axes,
    tangent_fields,
)
from robins.export.harness import Key, RecordedSteps, check_c, makefile, recorded_h
from robins.export.library import EntryPoint, Library, symbol
from robins.export.page import page
from robins.export.runs import (
    BoardRun,
    Calls,
    EntryFunction,
    board_runs,
    by_jax,
    ends,
    entry_functions,
    reset_function,
)
from robins.export.single_precision import (
    LEAST,
    MARGIN,
    PrecisionCost,
    cost,
    differences,
    in_floats,
)
from robins.filters import FilterState
from robins.filters.composite.adjustable import adjustable
from robins.filters.model import Data
from robins.filters.trees import row_of
from robins.program import SINGLE, Precision, Program, trace_steps
from robins.systems.study import Case, Problem

STEPS = 60  # of a run, recorded for the test
RUNS = 3  # by which the cost of single precision is measured
NIS = 1e-7  # tolerance: the square of a small difference of large readings
RESET = "reset"  # the entry point that restarts the filter
ENTRIES = {  # arguments after the state, and the sentence that describes an entry point
    "predict": (("input",), "Propagates the state by one step."),
    RESET: (("belief",), "Starts again from a belief, all else as by init."),
}


class Request(NamedTuple):
    """Request of an export."""

    problem: Problem  # by which the filter is tried
    filter: str
    label: str  # of the problem
    library: str = "robins"
    files: Mapping[str, str] = MappingProxyType({})  # additional, such as a loop around it


def with_adjustable(request: Request, numbers: Sequence[str]) -> Request:
    """Request with some numbers of its filter as fields of the state.

    Raises:
        ValueError: the filter has no such number.
    """
    problem, name = request[:2]
    one = problem.contenders[name]
    filter_ = adjustable(one.filter, numbers)

    def case(world: Data) -> Case:
        made = one.case(world)
        if isinstance(made.start, FilterState):
            return made._replace(start=filter_.begun(made.start))
        return made

    contender = replace(one, filter=filter_, case=case)
    return request._replace(problem=replace(problem, contenders={name: contender}))


def files_of(
    request: Request, unroll: int | None, precision: Precision
) -> tuple[dict[str, str], Library, PrecisionCost | None]:
    """Texts of an exported folder by name, their library, and the cost of single precision.

    Args:
        request: the filter, and the problem by which it is tried.
        unroll: scalar operations up to which a loop is written out; None: all are.
        precision: of the reals.

    Raises:
        robins.program.ProgramError: the filter does what has no place in C yet.
        robins.program.BuildError: there is no compiler here to measure single precision by.
    """
    library, c, record, found = _library(request, unroll, precision)
    files = {
        f"{library.name}.h": library.header(),
        f"{library.name}.c": c,
        "recorded.h": recorded_h(library, record),
        "test.c": check_c(library, record),
        "Makefile": makefile(library),
        "README.md": page(library, request.filter, request.label, found),
    }
    return files, library, found


def _library(
    request: Request, unroll: int | None, precision: Precision
) -> tuple[Library, str, RecordedSteps, PrecisionCost | None]:
    """The filter as a library, its C, recorded steps by JAX, and the cost of single precision."""
    problem, name, label = request[:3]
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
    library = Library(request.library, entries, run.start, (), notes, precision)
    c = library.source()
    identity = hashlib.sha256((library.header() + c).encode()).hexdigest()
    about = (
        f"Filter '{name}' of {label}, by robins {__version__}; program {identity[:16]}.",
        "SI units and radians. NaN is missing, for each component of a reading.",
        *(["Single precision: README.md states the cost."] if single else []),
        *attitude_lines(belief.mean),
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


def _entry(name: str, program: Program) -> EntryPoint:
    """Entry point with the sentence that describes it."""
    reading = ("reading", "about"), f"Uses a reading of {name.removeprefix('update_')}."
    return EntryPoint(name, program, *ENTRIES.get(name, reading))


def _any_start(runs: Sequence[BoardRun]) -> FilterState:
    """A state that is zero only where the starts of all runs are."""

    def either(first: FilterState, other: FilterState) -> FilterState:
        return jax.tree_util.tree_map(lambda a, b: np.where(np.asarray(a) == 0, b, a), first, other)

    return reduce(either, (run.start for run in runs))


def _record(
    run: BoardRun, functions: Mapping[str, EntryFunction], anew: EntryFunction
) -> RecordedSteps:
    """Record the steps by JAX, and then a reset to the belief after the first step."""
    made = by_jax(functions, run, dict)
    states = list(made.values())[-1][0]
    first, last = (jax.tree_util.tree_map(lambda a, k=k: a[k], states) for k in (0, -1))
    once = jax.jit(anew)(last, first.belief)
    made[RESET] = jax.tree_util.tree_map(lambda x: np.asarray(x)[None], once)
    sizes = _sizes(made)
    tolerances = {key: NIS for key in sizes if key[1] == "nis"}
    return RecordedSteps(run.given, made, tolerances, 0, sizes, {RESET: (first.belief,)})


def _sizes(made: Calls) -> dict[Key, float]:
    """Sizes by struct and field, relative to which a difference of 1e-9 is rounding.

    They are the largest sigma for fields in the units of a sigma, and the degrees of freedom for a
    NIS.
    """
    sizes: dict[Key, float] = {}
    for entry, (state, answer) in made.items():
        factor, mean = state.belief.factor, state.belief.mean
        sigma = np.sqrt(np.sum(np.square(factor), axis=-1))
        for name, first, end, own in tangent_fields(row_of(mean, 0), MEAN):
            if not own:
                key = "state", name
                sizes[key] = max(sizes.get(key, 0.0), _largest(sigma[:, first:end]))
        if hasattr(answer, "innovation"):
            struct = f"{symbol(entry)}_result"
            sizes[struct, "innovation"] = _largest(answer.sigma)
            sizes[struct, "nis"] = _largest(answer.dof)
    return sizes


def _largest(numbers: np.ndarray) -> float:
    return float(np.max(numbers, initial=0.0, where=np.isfinite(numbers)))


def _compared(library: Library, record: RecordedSteps, singles: Calls) -> RecordedSteps:
    """Record with the tolerances of single precision: its differences times a margin."""
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


def write_folder(to: Path, files: Mapping[str, str]) -> None:
    """Write all files, or none."""
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
