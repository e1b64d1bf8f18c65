"""A filter of a scenario as C for a board: the filter that was judged is the one that flies."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from robins import __version__, _float64, scenario
from robins.campaign.monte_carlo import solved, worlds
from robins.filters import SENTENCES, Belief, Filter, Model, StepInfo
from robins.program import trace
from robins.program.harness import Recorded, check_c, makefile, recorded_h
from robins.program.library import Entry, Library
from robins.systems.study import Case, Problem
from robins.workbench.errors import InputError, refusing
from robins.workbench.scenarios import check_filters, find_scenario, study_of

STEPS = 60  # of a run, recorded for the test
SMALL = 200  # scalar operations up to which a loop is written out where the code is to be small


class Told(NamedTuple):
    """What a prediction tells on a board."""

    code: Array


class Used(NamedTuple):
    """What an update tells on a board."""

    code: Array
    nis: Array
    dof: Array
    innovation: Array
    used: Array


class Exported(NamedTuple):
    """What was written."""

    folder: Path
    files: tuple[str, ...]
    filter: str
    scalars: Mapping[str, int]  # of each entry point, nodes of its program
    bytes: int  # of the C


def export_filter(
    name: str,
    to: Path,
    *,
    filter_name: str = "",
    fast: bool = False,
    seed: int = 0,
    settings: Sequence[str] = (),
) -> Exported:
    """Write a filter of a scenario as C99, with a test for the user's own compiler.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        to: a folder that is not there yet, or is empty.
        filter_name: by default that of the system, else the first of the scenario.
        fast: write loops out; larger, and faster where the code fits into the cache.
        seed: of the run that is recorded for the test.
        settings: "path=value" texts that change the scenario.

    Raises:
        InputError: there is no such scenario or filter, or the folder holds something.
        robins.program.ProgramError: the filter does what has no place in C yet; the message names
            the line of the model or the rule.
    """
    _float64.require()
    if to.exists() and (not to.is_dir() or any(to.iterdir())):
        raise InputError("it is there and not empty", str(to), "name a new folder with --to.")
    system, label, text = find_scenario(name)
    study = study_of(system, text, name)
    parameters = scenario.parse(study.parameters, text, (*settings, "runs=1"), source=name)
    own = parameters.filters or tuple(study.filters)
    wanted = filter_name or (system.default if system.default in study.filters else own[0])
    check_filters(label, study.filters, [wanted])
    with refusing(name):
        problem = study.problem(parameters, (wanted,), seed)
    library, record = _library(problem, wanted, label, None if fast else SMALL)
    c = library.source()
    files = {
        f"{library.name}.h": library.header(),
        f"{library.name}.c": c,
        "recorded.h": recorded_h(library, record),
        "test.c": check_c(library, record),
        "Makefile": makefile(library),
        "README.md": _readme(library, wanted, label),
    }
    _write(to, files)
    scalars = {entry.name: len(entry.program.live) for entry in library.entries}
    return Exported(to, tuple(files), wanted, scalars, len(c))


def _library(
    problem: Problem, name: str, label: str, unroll: int | None
) -> tuple[Library, Recorded]:
    """The filter as a library, and some steps of it by JAX."""
    contender = problem.contenders[name]
    filter_, model = contender.filter, contender.model
    batch, _ = next(iter(worlds(problem, 1, 1)))
    world = jax.tree_util.tree_map(lambda a: a[0], batch)
    _, case, _ = solved(filter_, model, contender.case(world), lambda step: ())
    start = case.start
    state = filter_.init(start, model.dims) if isinstance(start, Belief) else start
    given = _given(case, model)
    functions = _functions(filter_, model, given)
    first = jax.tree_util.tree_map(lambda a: a[0], given)
    entries = [
        Entry(
            entry,
            trace(functions[entry], state, *first[entry], unroll=unroll),
            ("input",) if entry == "predict" else ("reading", "about"),
            "Moves on by one step." if entry == "predict" else f"Uses a reading of {entry[7:]}.",
        )
        for entry in given
    ]
    record = _recorded(functions, state, given)
    identity = hashlib.sha256(repr([e.program.graph.op for e in entries]).encode()).hexdigest()
    about = (
        f"Filter '{name}' of {label}, by robins {__version__}; program {identity[:16]}.",
        "SI units and radians. NaN is missing, for each component of a reading.",
        *_components(problem, contender.reported),
    )
    return Library("robins", entries, state, about, _notes(problem, given)), record


def _given(case: Case, model: Model) -> dict[str, tuple[Any, ...]]:
    """What each entry point takes after the state, with a leading axis of steps."""

    def cut(tree: Any) -> Any:
        return jax.tree_util.tree_map(lambda a: np.asarray(a)[:STEPS], tree)

    given: dict[str, tuple[Any, ...]] = {"predict": (cut(case.u),)}
    for sensor in model.sensors:
        if sensor.name in case.y:
            row = cut(case.y[sensor.name]), cut(case.aux.get(sensor.name))
            given[f"update_{sensor.name}"] = row
    return given


def _functions(filter_: Filter, model: Model, names: Mapping[str, Any]) -> dict[str, Any]:
    """The entry points as functions of JAX."""

    def predict(state: Any, u: Any):
        state, prediction = filter_.predict(state, model.motion, u)
        return state, Told(prediction.code)

    def update(name: str) -> Any:
        sensor = model.sensor(name)

        def use(state: Any, y: Any, aux: Any):
            state, info = filter_.update(state, sensor, y, aux)
            return state, _told(info)

        return use

    return {n: predict if n == "predict" else update(n.removeprefix("update_")) for n in names}


def _told(info: StepInfo) -> Used:
    return Used(info.code, info.nis, info.dof, info.innovation, info.used)


def _recorded(functions: Mapping[str, Any], state: Any, given: Mapping[str, Any]) -> Recorded:
    """The steps by JAX."""
    compiled = {name: jax.jit(function) for name, function in functions.items()}
    count = min(len(a) for a in jax.tree_util.tree_leaves(given))
    states, codes = [], []
    for k in range(count):
        row = []
        for name, step in compiled.items():
            state, told = step(state, *jax.tree_util.tree_map(lambda a, k=k: a[k], given[name]))
            row.append(int(told.code))
        states.append(state)
        codes.append(row)
    stacked = jax.tree_util.tree_map(lambda *a: np.stack([np.asarray(x) for x in a]), *states)
    return Recorded(given, stacked, np.array(codes))


def _components(problem: Problem, reported: Any) -> list[str]:
    """What the components of a factor are, where they are those that are reported."""
    lines = ["factor is lower triangular, covariance P = factor factor' of the error."]
    if reported is None:
        for block in problem.blocks:
            first, last = block.where.start, block.where.stop - 1
            axes = ", ".join(block.axes)
            lines.append(
                f"  {first} to {last}: {block.name} [{block.units}], {block.frame}: {axes}"
            )
    return lines


def _notes(problem: Problem, given: Mapping[str, Any]) -> dict[tuple[str, str], str]:
    """Units and axes of readings and innovations."""
    notes = {("state", "current"): "the last prediction was taken"}
    for entry in given:
        axes = problem.sensors.get(entry.removeprefix("update_"))
        if axes is not None:
            told = f"{axes.units}, {axes.frame}: {', '.join(axes.axes)}"
            notes[f"{entry}_reading", "value"] = told
            notes[f"{entry}_result", "innovation"] = told
    return notes


def _readme(library: Library, name: str, label: str) -> str:
    """One page for who compiles it."""
    n, calls = library.name, "\n".join(f"    {library.signature(e)};" for e in library.entries)
    codes = "\n".join(f"| {int(code)} | {sentence} |" for code, sentence in SENTENCES.items())
    return f"""# Filter `{name}` of `{label}` in C

By robins {__version__}. C99, no allocation, no global state, no recursion, no library but `math.h`;
one thread may use one state, several threads several states.

    make check     compiles the library and a test, and replays recorded steps
    make stack     says how much stack each function uses

`{n}.h` names all fields; `{n}.c` needs nothing else. What the model was told (noise, axes,
constants) is in the code: export again to change it.

    void {n}_init({n}_state *state);
{calls}

Each step calls `{n}_predict`, then the update of each sensor that has a reading. A component that
is missing is NaN. Each call returns a code:

| code | meaning |
|---|---|
{codes}

The state belongs to these functions: read it, copy it, but change it by `{n}_init` and the calls
only.
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
