"""Several programs on one state as a library of C: a header with named fields, one file, no more.

A program takes and gives bare arrays of numbers. Here each array has the name that it has in the
model, in a struct: the state, which all entry points change, and the arguments and the result of
each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from robins.filters import Code
from robins.program.c import function, header, part
from robins.program.precision import DOUBLE, Precision
from robins.program.walk import Leaf, Program, lengths, slots
from robins.program.wrap import COLUMNS, wrapped


def template(name: str) -> str:
    """Text of a template file of this package."""
    return (files("robins.export") / name).read_text("utf-8")


EXTERN_C = '#ifdef __cplusplus\nextern "C" {\n#endif', "#ifdef __cplusplus\n}\n#endif"

# Names that no field may have: keywords of C and C++, macros of compilers and common headers.
RESERVED = frozenset(template("reserved.txt").split())

C_TYPES = {"flag": "int", "whole": "int64_t", "word": "uint32_t", "word64": "uint64_t"}
CODE = "code"  # of a result: what the entry point returns
_ARGUMENTS = {"reading": "Measurement of", "about": "Accompanying data of"}


class EntryPoint(NamedTuple):
    """One entry point, ``(state, *args) -> (state, result)``.

    Attributes:
        name: of its function, after that of the library.
        program: of `trace`.
        takes: names of its arguments after the state.
        about: a sentence of what it does.
    """

    name: str
    program: Program
    takes: tuple[str, ...]
    about: str

    @property
    def symbol(self) -> str:
        """Name of the entry as a part of names in C."""
        return symbol(self.name)


class StructField(NamedTuple):
    """An array in a struct, and where it lies in the arrays of a program."""

    name: str
    leaf: Leaf
    at: int  # offset in the reals or in all else

    @property
    def size(self) -> int:
        """Count of its numbers."""
        return int(np.prod(self.leaf.shape))

    @property
    def is_real(self) -> bool:
        """True if it lies among the reals."""
        return self.leaf.kind == "real"

    def first(self, struct: str) -> str:
        """A pointer to its first number in C."""
        return f"&{struct}->{self.name}" + "[0]" * len(self.leaf.shape)


def fields_of(leaves: Sequence[Leaf], which: int) -> list[StructField]:
    """The fields of one of the arguments or results; empty arrays have none."""
    found, taken = [], set()
    for leaf, slot in zip(leaves, slots(leaves)[0], strict=True):
        root = re.match(r"[a-z]+\[(\d+)\]", leaf.path)
        assert root is not None
        if int(root[1]) == which and slot.last > slot.first:
            name = base = identifier(leaf.path[root.end() :])
            k = 2
            while name in taken:
                name, k = f"{base}_{k}", k + 1
            taken.add(name)
            found.append(StructField(name, leaf, slot.first))
    return found


def filled(fields: Sequence[StructField], tree: PyTree) -> Iterator[tuple[StructField, np.ndarray]]:
    """Fields of a struct with their numbers; a leaf without numbers is not a field."""
    leaves = [np.asarray(x) for x in jax.tree_util.tree_leaves(tree)]
    return zip(fields, [x for x in leaves if x.size], strict=True)


def symbol(name: str) -> str:
    """Any name as a part of names in C."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def identifier(path: str) -> str:
    """A path in a pytree as a name in C: attributes and indices, less a leading ``belief``.

    A name that is reserved, or has capitals only as macros have (`I` of complex.h), ends with an
    underscore.
    """
    words = re.findall(r"[A-Za-z_]\w*|\d+", path, re.ASCII)
    words = words[1:] if words[:1] == ["belief"] else words
    name = "_".join(words) or "value"
    name = f"at_{name}" if name[0].isdigit() else name
    return f"{name}_" if name in RESERVED or name.isupper() else name


class Library(NamedTuple):
    """A filter as C.

    Attributes:
        name: prefix of all that the header names.
        entries: the entry points; all have the same state.
        start: the state to begin with.
        about: lines of comment for the head of both files.
        notes: additional comments on fields, by struct and name.
        precision: of its reals.
    """

    name: str
    entries: Sequence[EntryPoint]
    start: Any
    about: Sequence[str] = ()
    notes: dict[tuple[str, str], str] = {}  # noqa: RUF012 a default that is never changed
    precision: Precision = DOUBLE

    @property
    def state(self) -> list[StructField]:
        """Fields of the state."""
        return fields_of(self.entries[0].program.inputs, 0)

    def structs(self) -> Iterator[tuple[str, list[StructField], str]]:
        """Name, fields and a sentence of each struct of the header."""
        yield "state", self.state, "All that is carried from one call to the next."
        for entry in self.entries:
            for k, name in enumerate(entry.takes):
                if fields := fields_of(entry.program.inputs, k + 1):
                    of = f"{_ARGUMENTS.get(name, 'Input of')} {entry.name.removeprefix('update_')}."
                    yield self.argument(entry, name), fields, of
            yield f"{entry.symbol}_result", self.result(entry), f"Output of {entry.name}."

    def argument(self, entry: EntryPoint, name: str) -> str:
        """The name of the struct of an argument."""
        return f"{entry.symbol}_{name}"

    def result(self, entry: EntryPoint) -> list[StructField]:
        """Fields of the result of an entry point."""
        return fields_of(entry.program.results, 1)

    # ------------------------------------------------------------------------------ the header

    def signature(self, entry: EntryPoint) -> str:
        """The declaration of an entry point."""
        given = [
            f"const {self.name}_{self.argument(entry, name)} *{name}"
            for k, name in enumerate(entry.takes)
            if fields_of(entry.program.inputs, k + 1)
        ]
        all_ = [f"{self.name}_state *state", *given, f"{self.name}_{entry.symbol}_result *result"]
        return f"int {self.name}_{entry.symbol}({', '.join(all_)})"

    def header(self) -> str:
        """The header: types, structs, entry points.

        Raises:
            ValueError: a note is on a field that its struct does not have. Notes on a struct that
                the library does not have are left out: not every filter has every sensor.
        """
        guard = f"{self.name.upper()}_H"
        lines = [*self._head(), f"#ifndef {guard}", f"#define {guard}", "", "#include <stdint.h>"]
        lines += ["", part("finite.h"), EXTERN_C[0], ""]
        lines += [f"typedef {self.precision.kind} {self.name}_real;", "", *self._codes()]
        for name, fields, about in self.structs():
            unknown = {f for struct, f in self.notes if struct == name} - {f.name for f in fields}
            if unknown:
                raise ValueError(f"notes on fields that '{name}' does not have: {sorted(unknown)}")
            lines += [f"/* {about} */", "typedef struct {"]
            for f in fields:
                kind = f"{self.name}_real" if f.is_real else C_TYPES[f.leaf.kind]
                sizes = "".join(f"[{n}]" for n in f.leaf.shape)
                lines += _declared(
                    f"    {kind} {f.name}{sizes};", self.notes.get((name, f.name), "")
                )
            lines += [f"}} {self.name}_{name};", ""]
        lines += [
            "/* The state to begin with. */",
            f"void {self.name}_init({self.name}_state *state);",
        ]
        for entry in self.entries:
            lines += ["", f"/* {entry.about} Returns its code. */", f"{self.signature(entry)};"]
        return wrapped("\n".join([*lines, "", EXTERN_C[1], "", "#endif", ""]))

    def _codes(self) -> list[str]:
        """Result codes as an enumeration."""
        codes = [f"    {self.name.upper()}_CODE_{code.name} = {int(code)}," for code in Code]
        codes[-1] = codes[-1].rstrip(",")
        about = "Result codes: int64_t in an output, int where returned, of equal value."
        return [f"/* {about} */", "enum {", *codes, "};", ""]

    def _head(self) -> list[str]:
        about = (f" * {_comment_safe(line)}".rstrip() for line in self.about)
        return ["/*", *about, " */"] if self.about else []

    # -------------------------------------------------------------------------------- the file

    def source(self) -> str:
        """C file: the text of the scalars, the initial state, each entry point with its program."""
        lines = [f'#include "{self.name}.h"', "", self.programs("static "), *self._init()]
        for entry in self.entries:
            lines += self._entry(entry)
        return self.headed(wrapped("\n".join(lines)) + "\n")

    def headed(self, text: str) -> str:
        """A file with the comment for its head."""
        return wrapped("\n".join(self._head())) + f"\n{text}" if self.about else text

    def programs(self, linkage: str = "") -> str:
        """Self-contained C file: the scalars, and the program of each entry point on bare arrays.

        Its functions are ``of_ENTRY``, as `robins.program.function` writes them.
        """
        texts = [header(precision=self.precision)]
        for entry in self.entries:
            texts.append(function(entry.program, f"of_{entry.symbol}", linkage, self.precision))
        return "\n".join(texts)

    def _init(self) -> list[str]:
        lines = [f"void {self.name}_init({self.name}_state *state)", "{"]
        copies = []
        for f, value in filled(self.state, self.start):
            kind = "real" if f.is_real else C_TYPES[f.leaf.kind]
            entries = ", ".join(
                number(x, f.is_real, self.precision) for x in value.ravel().tolist()
            )
            at = f"at_{f.name}"
            lines.append(f"    static const {kind} {at}[{f.size}] = {{{entries}}};")
            copies.append(f"    memcpy({f.first('state')}, {at}, sizeof {at});")
        return [*lines, *copies, "}", ""]

    def _entry(self, entry: EntryPoint) -> list[str]:
        program, lines = entry.program, [self.signature(entry), "{"]
        # The program writes its results last, so that they may lie where the arguments do.
        sizes = zip(lengths(program.inputs), lengths(program.results), strict=True)
        reals, others = (max(pair) for pair in sizes)
        lines += [f"    real x[{reals}];", f"    whole k[{others}];"]
        lines += _copied(self.state, "state", inwards=True)
        for j, name in enumerate(entry.takes):
            lines += _copied(fields_of(program.inputs, j + 1), name, inwards=True)
        lines.append(f"    of_{entry.symbol}(x, k, x, k);")
        lines += _copied(fields_of(program.results, 0), "state", inwards=False)
        result = self.result(entry)
        lines += _copied(result, "result", inwards=False)
        code = next(f for f in result if f.name == CODE)
        return [*lines, f"    return (int)k[{code.at}];", "}", ""]


def _declared(text: str, note: str) -> list[str]:
    """A field and its note: behind it where there is room, else before it."""
    if not note:
        return [text]
    comment = f"/* {_comment_safe(note)} */"
    both = f"{text} {comment}"
    return [both] if len(both) <= COLUMNS else [f"    {comment}", text]


def _comment_safe(comment: str) -> str:
    """Text made safe for a C comment: it neither ends the comment nor begins another."""
    return comment.replace("*/", "* /").replace("/*", "/ *")


def number(value: float | int | np.generic, real: bool, precision: Precision = DOUBLE) -> str:
    """C literal of a number, exact to the bit."""
    return precision.number(value) if real else str(int(value))


def _copied(fields: Sequence[StructField], struct: str, inwards: bool) -> list[str]:
    """Lines of C that copy between a struct and the arrays x and k of a program."""
    lines = []
    for f in fields:
        if f.is_real:
            there, size = f"x + {f.at}", f"{f.size} * sizeof(real)"
            to, source = (there, f.first(struct)) if inwards else (f.first(struct), there)
            lines.append(f"    memcpy({to}, {source}, {size});")
            continue
        here = f"({f.first(struct)})[i]" if f.leaf.shape else f"{struct}->{f.name}"
        there = f"k[{f.at} + i]" if f.leaf.shape else f"k[{f.at}]"
        kind = C_TYPES[f.leaf.kind]
        move = f"{there} = (whole){here};" if inwards else f"{here} = ({kind}){there};"
        loop = f"for (int i = 0; i < {f.size}; ++i) {{ {move} }}" if f.leaf.shape else move
        lines.append(f"    {loop}")
    return lines
