"""A test of an exported library with the user's own compiler: recorded steps, replayed.

`make check` in the folder compiles library and test, replays the recorded inputs, and compares the
state after each step and every code with those of JAX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from robins.program.library import C_TYPES, Entry, Field, Library, fields_of, number

TOLERANCE = 1e-9  # of the largest number that a field has in the record

MAKEFILE = """\
# make check   compiles {name}.c and a test of it, and runs the test on recorded steps
# make stack   says how much stack each function uses (gcc, clang)
CC ?= cc
CFLAGS ?= -std=c99 -O2 -ffp-contract=off -Wall -Wextra -Wconversion -Wpedantic

.PHONY: check stack clean

check: test
\t./test

test: test.c recorded.h {name}.c {name}.h
\t$(CC) $(CFLAGS) -o test test.c {name}.c -lm

stack: {name}.c {name}.h
\t$(CC) $(CFLAGS) -fstack-usage -c {name}.c
\tcut -f 1,2 {name}.su

clean:
\trm -f test {name}.o {name}.su
"""


class Recorded(NamedTuple):
    """Steps of a filter.

    Attributes:
        given: of each entry point, in the order in which a step calls them, its arguments after the
            state, with a leading axis of steps.
        states: after each step.
        codes: (steps, entry points).
    """

    given: Mapping[str, Sequence[Any]]
    states: Any
    codes: np.ndarray


def makefile(library: Library) -> str:
    """The Makefile of the folder."""
    return MAKEFILE.format(name=library.name)


def recorded_h(library: Library, record: Recorded) -> str:
    """The record as C."""
    steps = len(record.codes)
    lines = [f"#define STEPS {steps}", f"#define TOLERANCE {TOLERANCE!r}", ""]
    for entry, name, fields, leaves in _tables(library, record):
        for f, leaf in zip(fields, leaves, strict=True):
            lines += _table(f"{entry.name}_{name}_{f.name}", f, leaf)
    kept = [f for f in library.state if f.is_real]
    states = [np.asarray(x) for x in jax.tree_util.tree_leaves(record.states)]
    reals = [x for x in states if x.dtype == np.float64 and x[0].size]
    for f, leaf in zip(kept, reals, strict=True):
        lines += _table(f"state_{f.name}", f, leaf)
        size = np.max(np.abs(leaf), initial=0.0, where=np.isfinite(leaf))
        lines.append(f"static const double size_{f.name} = {float(size)!r};")
    rows = ", ".join("{" + ", ".join(map(str, map(int, row))) + "}" for row in record.codes)
    lines.append(f"static const int codes[STEPS][{record.codes.shape[1]}] = {{{rows}}};")
    return "\n".join([*lines, ""])


def _tables(library: Library, record: Recorded):
    """Entry, argument, fields and arrays of all that is given."""
    for entry in library.entries:
        for j, (name, given) in enumerate(
            zip(entry.takes, record.given[entry.name], strict=True), start=1
        ):
            leaves = [np.asarray(x) for x in jax.tree_util.tree_leaves(given)]
            some = [x for x in leaves if x[0].size]
            yield entry, name, fields_of(entry.program.inputs, j), some


def _table(name: str, f: Field, leaf: np.ndarray) -> list[str]:
    kind = "double" if f.is_real else C_TYPES[f.leaf.kind]
    rows = [
        "    {" + ", ".join(number(x, f.is_real) for x in row.ravel().tolist()) + "}"
        for row in leaf
    ]
    head = f"static const {kind} {name}[STEPS][{f.size}] = {{"
    return [head, ",\n".join(rows), "};"]


def check_c(library: Library, record: Recorded) -> str:
    """The test."""
    name = library.name
    lines = [
        f'#include "{name}.h"',
        *("#include <math.h>", "#include <stdio.h>", "#include <string.h>"),
        *('#include "recorded.h"', ""),
        "static double worst = 0.0;",
        "",
        "static void compare(const double *found, const double *expected, int n, double size)",
        "{",
        "    for (int i = 0; i < n; ++i) {",
        "        const double off = fabs(found[i] - expected[i]);",
        "        const double part = size > 0.0 ? off / size : off;",
        "        if (!(part <= worst) && !(isnan(found[i]) && isnan(expected[i]))) {",
        "            worst = isnan(part) ? INFINITY : part;",
        "        }",
        "    }",
        "}",
        "",
        "int main(void)",
        "{",
        f"    static {name}_state state;",
        "    int wrong = 0;",
        f"    {name}_init(&state);",
        "    for (int t = 0; t < STEPS; ++t) {",
    ]
    for k, entry in enumerate(library.entries):
        lines += _called(library, entry, k)
    for f in library.state:
        if f.is_real:
            first = f.first("(&state)").replace("(&state)->", "state.")
            told = f"{first}, state_{f.name}[t], {f.size}, size_{f.name}"
            lines.append(f"        compare({told});")
    lines += [
        "    }",
        "    const int good = wrong == 0 && worst <= TOLERANCE;",
        '    printf("%d steps: %d codes differ, numbers differ by %.1e of a field at most: %s\\n",',
        '           STEPS, wrong, worst, good ? "passed" : "FAILED");',
        "    return good ? 0 : 1;",
        "}",
        "",
    ]
    return "\n".join(lines)


def _called(library: Library, entry: Entry, k: int) -> list[str]:
    """One call of an entry point on the row of a step."""
    name, lines, given = library.name, ["        {"], []
    for j, argument in enumerate(entry.takes, start=1):
        if fields := fields_of(entry.program.inputs, j):
            given.append(argument)
            lines.append(f"            {name}_{library.argument(entry, argument)} {argument};")
            for f in fields:
                first = f.first("it").replace("it->", f"{argument}.")
                table = f"{entry.name}_{argument}_{f.name}[t]"
                lines.append(f"            memcpy({first}, {table}, sizeof {table});")
    lines.append(f"            {name}_{entry.name}_result result;")
    told = ", ".join(["&state", *(f"&{a}" for a in given), "&result"])
    lines.append(f"            wrong += {name}_{entry.name}({told}) != codes[t][{k}];")
    return [*lines, "        }"]
