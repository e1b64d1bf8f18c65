"""A test of an exported library with the user's own compiler: recorded steps, replayed.

`make check` in the folder compiles library and test, replays the recorded inputs, and compares
every output of every call with that of JAX: all fields of the state, the initial one included, and
all fields of the result. Entry points that are not part of a step are called once, after the last
one. It also prints a checksum of the bits of all reals, by which two compilers or two machines are
compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from string import Template
from typing import Any, NamedTuple

import jax
import numpy as np

from robins.export.library import (
    C_TYPES,
    CODE,
    EntryPoint,
    Library,
    StructField,
    fields_of,
    filled,
    number,
    template,
)
from robins.program.precision import DOUBLE, SINGLE, Precision
from robins.program.wrap import wrapped

TOLERANCE = 1e-9  # of the size of a field; of a library of doubles

# Word that holds the bits of a real, the bits that stand for any NaN, and their printing: newlib's
# small printf supports nothing wider than a long.
BITS = {
    DOUBLE: {
        "word": "uint64_t",
        "nan": "0x7ff8000000000000u",
        "printed": '"%08lx%08lx %.17g\\n", (unsigned long)(word >> 32),\n'
        + " " * 15
        + "(unsigned long)(word & 0xffffffffu), size",
    },
    SINGLE: {
        "word": "uint32_t",
        "nan": "0x7fc00000u",
        "printed": '"%08lx %.17g\\n", (unsigned long)word, size',
    },
}

COUNTED = ("    wrong += off;", "}", "")

Key = tuple[str, str]  # struct ("state", "predict_result") and field, as in the notes of a library


class RecordedSteps(NamedTuple):
    """Recorded steps of a filter.

    Attributes:
        given: of each entry point, in the order in which a step calls them, its arguments after the
            state, with a leading axis of steps.
        made: of each entry point what its calls returned, the state and the result, with a leading
            axis of calls.
        tolerances: of fields, relative to the largest number in each; `TOLERANCE` for the others.
        codes_off: number of calls that may return another code, count or flag.
        sizes: of fields, the least size by which a difference is judged, where the numbers of the
            field may be nothing but rounding.
        ends: of each entry point that is called once after the last step, its arguments after the
            state.
        ruined: reason not to use the library, however it is compiled; its test prints it and fails.
    """

    given: Mapping[str, Sequence[Any]]
    made: Mapping[str, tuple[Any, Any]]
    tolerances: Mapping[Key, float] = {}
    codes_off: int = 0
    sizes: Mapping[Key, float] = {}
    ends: Mapping[str, Sequence[Any]] = {}
    ruined: str = ""


def makefile(library: Library) -> str:
    """The Makefile of the folder."""
    return template("check.mk").format(name=library.name)


def recorded_h(library: Library, record: RecordedSteps) -> str:
    """The record as C."""
    steps = len(jax.tree_util.tree_leaves(record.given)[0])
    lines = [
        f"#define STEPS {steps}",
        f"#define CODES_OFF {record.codes_off} /* calls that may differ in a code or a count */",
        f"#define RUINED {json.dumps(record.ruined)} /* why the library is not to be used */",
        "",
    ]
    for table, f, leaf in _given(library, record):
        lines += _table(table, f, leaf, library.precision)
    sizes: dict[Key, float] = {}
    for table, key, f, leaf in _made(library, record):
        lines += _table(table, f, leaf, DOUBLE)
        if f.is_real:
            least = sizes.get(key, record.sizes.get(key, 0.0))
            sizes[key] = np.max(np.abs(leaf), initial=least, where=np.isfinite(leaf))
    for key, size in sizes.items():
        allowed, name = record.tolerances.get(key, TOLERANCE), "_".join(key)
        lines.append(f"static const double size_{name} = {float(size)!r};")
        lines.append(f"static const double tolerance_{name} = {number(allowed, True)};")
    return "\n".join([*lines, ""])


def _given(
    library: Library, record: RecordedSteps
) -> Iterator[tuple[str, StructField, np.ndarray]]:
    """Table, field and numbers of all arguments; leading axis of calls."""
    once = jax.tree_util.tree_map(lambda x: np.asarray(x)[None], dict(record.ends))
    given = {**record.given, **once}
    for entry in library.entries:
        pairs = zip(entry.takes, given[entry.name], strict=True)
        for j, (argument, tree) in enumerate(pairs, start=1):
            struct = library.argument(entry, argument)
            for f, leaf in filled(fields_of(entry.program.inputs, j), tree):
                yield f"{struct}_{f.name}", f, leaf


def _made(
    library: Library, record: RecordedSteps
) -> Iterator[tuple[str, Key, StructField, np.ndarray]]:
    """Table, key, field and numbers of all outputs; leading axis of calls."""
    start = jax.tree_util.tree_map(lambda x: np.asarray(x)[None], library.start)
    for f, leaf in filled(library.state, start):
        yield f"init_state_{f.name}", ("state", f.name), f, leaf
    for entry in library.entries:
        state, result = record.made[entry.name]
        for f, leaf in filled(library.state, state):
            yield f"{entry.symbol}_state_{f.name}", ("state", f.name), f, leaf
        struct = f"{entry.symbol}_result"
        for f, leaf in filled(library.result(entry), result):
            yield f"{struct}_{f.name}", (struct, f.name), f, leaf


def _table(name: str, f: StructField, leaf: np.ndarray, precision: Precision) -> list[str]:
    kind = precision.kind if f.is_real else C_TYPES[f.leaf.kind]
    rows = [
        "    {" + ", ".join(number(x, f.is_real, precision) for x in row.ravel().tolist()) + "}"
        for row in leaf
    ]
    head = f"static const {kind} {name}[{len(leaf)}][{f.size}] = {{"
    return [head, ",\n".join(rows), "};"]


def check_c(library: Library, record: RecordedSteps) -> str:
    """C text of the test."""
    name = library.name
    lines = [f"static void call_init({name}_state *state, int t)", "{", "    int off = 0;"]
    lines += [f"    {name}_init(state);", *_compared("init", library.state, "state"), *COUNTED]
    for entry in library.entries:
        lines += _called(library, entry)
    lines += ["int main(void)", "{", f"    static {name}_state state;", "    call_init(&state, 0);"]
    lines += ["    for (int t = 0; t < STEPS; ++t) {"]
    calls = {entry.name: f"call_{entry.symbol}(&state," for entry in library.entries}
    lines += [f"        {call} t);" for entry, call in calls.items() if entry not in record.ends]
    lines += ["    }", *(f"    {calls[entry]} 0);" for entry in record.ends)]
    bits, calls = BITS[library.precision], "\n".join(lines)
    return wrapped(Template(template("check.c")).substitute(name=name, calls=calls, **bits))


def _called(library: Library, entry: EntryPoint) -> list[str]:
    """C function that calls an entry point with a row of the record and compares its outputs."""
    name, e, given = library.name, entry.symbol, []
    lines = [f"static void call_{e}({name}_state *state, int t)", "{"]
    for j, argument in enumerate(entry.takes, start=1):
        if fields := fields_of(entry.program.inputs, j):
            given.append(argument)
            struct = library.argument(entry, argument)
            lines.append(f"    {name}_{struct} {argument};")
            for f in fields:
                table = f"{struct}_{f.name}[t]"
                lines.append(f"    memcpy(&{argument}.{f.name}, {table}, sizeof {table});")
    lines += [f"    {name}_{e}_result result;", "    memset(&result, 0x5a, sizeof result);"]
    arguments = ", ".join(["state", *(f"&{a}" for a in given), "&result"])
    lines.append(f"    const int code = {name}_{e}({arguments});")
    lines.append(f'    int off = differ("{e}/code", code != {e}_result_{CODE}[t][0]);')
    lines += _compared(e, library.result(entry), "result")
    lines += _compared(e, library.state, "state")
    return [*lines, *COUNTED]


def _compared(entry: str, fields: Sequence[StructField], struct: str) -> list[str]:
    """C lines that compare the fields of a struct with a row of the record."""
    lines = []
    for f in fields:
        table = f"{entry}_{struct}_{f.name}[t]"
        text = f'"{entry}/{struct}.{f.name}"'
        found = f.first(struct) if struct == "state" else f.first(struct).replace("->", ".")
        key = f"state_{f.name}" if struct == "state" else f"{entry}_{struct}_{f.name}"
        if f.is_real:
            scale = f"{f.size}, size_{key}, tolerance_{key}"
            lines.append(f"    compare({text}, {found}, {table}, {scale});")
        else:
            lines.append(f"    off |= differ({text}, memcmp({found}, {table}, sizeof {table}));")
    return lines
