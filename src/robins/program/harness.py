"""A test of an exported library with the user's own compiler: recorded steps, replayed.

`make check` in the folder compiles library and test, replays the recorded inputs, and compares the
state after each step and every code with those of JAX. Entry points that are no part of a step are
called once, after the last one. It also prints a checksum of the bits of all states, by which two
compilers or two machines are compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from robins.program.library import C_TYPES, Entry, Field, Library, fields_of, number
from robins.program.precision import DOUBLE, SINGLE, Precision

TOLERANCE = 1e-9  # of the size of a field; of a library of doubles

MAKEFILE = """\
# make check   compiles {name}.c and a test of it, and runs the test on recorded steps
# make stack   says how much stack each function uses (gcc, clang)
CC ?= cc
CFLAGS ?= -std=c99 -O2 -ffp-contract=off -Wall -Wextra -Wconversion -Wpedantic -Wdouble-promotion

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

# The word that holds the bits of a real, that of any NaN, and how it is printed: newlib's small
# printf knows nothing wider than a long.
BITS = {
    DOUBLE: {
        "word": "uint64_t",
        "nan": "0x7ff8000000000000u",
        "printed": '"%08lx%08lx\\n", (unsigned long)(word >> 32),\n'
        + " " * 15
        + "(unsigned long)(word & 0xffffffffu)",
    },
    SINGLE: {
        "word": "uint32_t",
        "nan": "0x7fc00000u",
        "printed": '"%08lx\\n", (unsigned long)word',
    },
}

BEGIN = """\
#include "{name}.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
#include "recorded.h"

static double worst = 0.0; /* difference, in parts of a field */
static int beyond = 0;     /* numbers that differ by more than they may */
static uint64_t bits = 14695981039346656037u;

static void compare(const {name}_real *found, const double *expected, int n, double size,
                    double tolerance)
{{
    for (int i = 0; i < n; ++i) {{
        const double here = (double)found[i];
        const double off = fabs(here - expected[i]);
        const double part = size > 0.0 ? off / size : off;
        const int same = isnan(here) && isnan(expected[i]);
        {word} word = {nan};
        if (!isnan(here)) {{ memcpy(&word, &found[i], sizeof word); }}
        bits = (bits ^ word) * 1099511628211u;
#ifdef PRINT_BITS
        printf({printed});
#endif
        if (!same && !(part <= worst)) {{ worst = isnan(part) ? (double)INFINITY : part; }}
        if (!same && !(part <= tolerance)) {{ ++beyond; }}
    }}
}}

int main(void)
{{
    static {name}_state state;
    int wrong = 0;
    {name}_init(&state);
    for (int t = 0; t < STEPS + ENDS; ++t) {{"""

END = """\
    }
    const int good = wrong <= CODES_OFF && beyond == 0;
    printf("%d steps: %d codes differ, numbers differ by %.1e of a field at most: %s\\n",
           STEPS, wrong, worst, good ? "passed" : "FAILED");
    printf("bits of all states: %08lx%08lx\\n", (unsigned long)(bits >> 32),
           (unsigned long)(bits & 0xffffffffu));
    if (sizeof RUINED > 1) {
        printf("FAILED: %s\\n", RUINED);
    }
    return good && sizeof RUINED == 1 ? 0 : 1;
}
"""


class Recorded(NamedTuple):
    """Steps of a filter.

    Attributes:
        given: of each entry point, in the order in which a step calls them, its arguments after the
            state, with a leading axis of steps.
        states: after each step, and after each call of `ends`.
        codes: (steps, entry points).
        tolerances: of fields of the state, in parts of its size, the largest number that it has;
            `TOLERANCE` of the others.
        codes_off: how many codes may differ.
        sizes: of fields of the state, the least size by which a difference is judged, where the
            numbers of the field may be nothing but rounding.
        ends: of each entry point that is called once after the last step, its arguments after the
            state; its code is 0.
        ruined: why the library is not to be used, however well it was compiled; its test says so
            and fails.
    """

    given: Mapping[str, Sequence[Any]]
    states: Any
    codes: np.ndarray
    tolerances: Mapping[str, float] = {}
    codes_off: int = 0
    sizes: Mapping[str, float] = {}
    ends: Mapping[str, Sequence[Any]] = {}
    ruined: str = ""


def makefile(library: Library) -> str:
    """The Makefile of the folder."""
    return MAKEFILE.format(name=library.name)


def recorded_h(library: Library, record: Recorded) -> str:
    """The record as C."""
    steps = len(record.codes)
    lines = [
        f"#define STEPS {steps}",
        f"#define ENDS {len(record.ends)} /* calls after the last step */",
        f"#define CODES_OFF {record.codes_off} /* that may differ */",
        f'#define RUINED "{record.ruined}" /* why the library is not to be used */',
        "",
    ]
    for entry, name, fields, leaves in _tables(library, record):
        for f, leaf in zip(fields, leaves, strict=True):
            lines += _table(f"{entry.name}_{name}_{f.name}", f, leaf, library.precision)
    kept = [f for f in library.state if f.is_real]
    states = [np.asarray(x) for x in jax.tree_util.tree_leaves(record.states)]
    reals = [x for x in states if x.dtype == np.float64 and x[0].size]
    for f, leaf in zip(kept, reals, strict=True):
        lines += _table(f"state_{f.name}", f, leaf, DOUBLE)
        least = record.sizes.get(f.name, 0.0)
        size = np.max(np.abs(leaf), initial=least, where=np.isfinite(leaf))
        lines.append(f"static const double size_{f.name} = {float(size)!r};")
        allowed = record.tolerances.get(f.name, TOLERANCE)
        lines.append(f"static const double tolerance_{f.name} = {float(allowed)!r};")
    rows = ", ".join("{" + ", ".join(map(str, map(int, row))) + "}" for row in record.codes)
    lines.append(f"static const int codes[STEPS][{record.codes.shape[1]}] = {{{rows}}};")
    return "\n".join([*lines, ""])


def _tables(library: Library, record: Recorded):
    """Entry, argument, fields and arrays of all that is given; leading axis of calls."""
    once = jax.tree_util.tree_map(lambda x: np.asarray(x)[None], dict(record.ends))
    all_given = {**record.given, **once}
    for entry in library.entries:
        for j, (name, given) in enumerate(
            zip(entry.takes, all_given[entry.name], strict=True), start=1
        ):
            leaves = [np.asarray(x) for x in jax.tree_util.tree_leaves(given)]
            some = [x for x in leaves if x[0].size]
            yield entry, name, fields_of(entry.program.inputs, j), some


def _table(name: str, f: Field, leaf: np.ndarray, precision: Precision) -> list[str]:
    kind = precision.kind if f.is_real else C_TYPES[f.leaf.kind]
    rows = [
        "    {" + ", ".join(number(x, f.is_real, precision) for x in row.ravel().tolist()) + "}"
        for row in leaf
    ]
    head = f"static const {kind} {name}[{len(leaf)}][{f.size}] = {{"
    return [head, ",\n".join(rows), "};"]


def check_c(library: Library, record: Recorded) -> str:
    """The test."""
    name = library.name
    lines = [BEGIN.format(name=name, **BITS[library.precision])]
    steps = [entry for entry in library.entries if entry.name in record.given]
    ends = [entry for entry in library.entries if entry.name in record.ends]
    for k, entry in enumerate(steps):
        lines += _called(library, entry, "t < STEPS", "t", f"codes[t][{k}]")
    for k, entry in enumerate(ends):
        lines += _called(library, entry, f"t == STEPS + {k}", "0", "0")
    for f in library.state:
        if f.is_real:
            first = f.first("(&state)").replace("(&state)->", "state.")
            told = f"{first}, state_{f.name}[t], {f.size}, size_{f.name}, tolerance_{f.name}"
            lines.append(f"        compare({told});")
    return "\n".join([*lines, END])


def _called(library: Library, entry: Entry, when: str, row: str, code: str) -> list[str]:
    """One call of an entry point on a row of what is given, and the code that it should give."""
    name, lines, given = library.name, [f"        if ({when}) {{"], []
    for j, argument in enumerate(entry.takes, start=1):
        if fields := fields_of(entry.program.inputs, j):
            given.append(argument)
            lines.append(f"            {name}_{library.argument(entry, argument)} {argument};")
            for f in fields:
                first = f.first("it").replace("it->", f"{argument}.")
                table = f"{entry.name}_{argument}_{f.name}[{row}]"
                lines.append(f"            memcpy({first}, {table}, sizeof {table});")
    lines.append(f"            {name}_{entry.name}_result result;")
    told = ", ".join(["&state", *(f"&{a}" for a in given), "&result"])
    lines.append(f"            wrong += {name}_{entry.name}({told}) != {code};")
    return [*lines, "        }"]
