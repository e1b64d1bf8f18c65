"""Rounds in lanes: a program called again and again, for several runs at a time, rows in C.

A round takes what is carried, what stays, and a row of each array that goes along; it gives what is
carried on, and a row of each array that is made. The body of a `scan` is one.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from robins.program.c import function, header
from robins.program.kinds import array_of, is_key, numbers_of
from robins.program.library import counts
from robins.program.native import CPP, LANE_FLAGS, build
from robins.program.trace import Leaf, Program, positive_zeros

KINDS = {"f8": 0, "b1": 1, "i4": 2, "i8": 3, "u4": 4, "u8": 5}  # of arrays, as `scan.h` counts them


# Behind the program, whose counts of numbers are NX, NK (taken) and NY, NM (given).
SCAN = """
extern "C" int robins_scan(const scan *s)
{
    real x[NX], y[NY];
    whole k[NK], m[NM];
    return scanned<LANES>(s, robins_step, x, k, y, m);
}
extern "C" int robins_lanes(void) { return LANES; }
"""


class Rows(ctypes.Structure):
    """An array of all runs, or of the first, as `scan.h` takes and gives it."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("runs", ctypes.c_int64),
        ("run", ctypes.c_int64),
        ("round", ctypes.c_int64),
        ("size", ctypes.c_int32),
        ("kind", ctypes.c_int32),
    )


class Scan(ctypes.Structure):
    """What a scan is told, as `scan.h` has it."""

    _fields_ = (
        ("runs", ctypes.c_int64),
        ("rounds", ctypes.c_int64),
        ("backwards", ctypes.c_int32),
        ("carried", ctypes.c_int32),
        ("fixed", ctypes.c_int32),
        ("taken", ctypes.c_int32),
        ("given", ctypes.c_int32),
        ("in", ctypes.c_void_p),
        ("out", ctypes.c_void_p),
    )


class Given(NamedTuple):
    """What rounds are given."""

    array: np.ndarray  # a leading axis of runs, if they differ in it; then, in rows, of rounds
    batched: bool


class Rounds:
    """A program with rounds around it, compiled; called with arrays of all runs.

    Attributes:
        program: of one round: carried, staying, a row; to carried and a row.
        lanes: how many runs at a time, as this machine's processor can.
    """

    def __init__(self, program: Program, length: int, carried: int, stays: int, backwards=False):
        """Compile.

        Args:
            program: of one round.
            length: how many rounds.
            carried: so many of its first arguments, and of its first results, are carried.
            stays: so many after these are the same in all rounds.
            backwards: from the last row to the first.

        Raises:
            BuildError: there is no compiler, or it refuses the program.
        """
        self.program, self.length, self.backwards = program, length, backwards
        self.carried, self.stays = carried, stays
        self._scan = self._compiled(program)

    def _compiled(self, program: Program) -> Callable[[Any], int]:
        """The function of C that takes a `Scan`."""
        library = ctypes.CDLL(str(build(_text(program), LANE_FLAGS, CPP)))
        self.lanes = library.robins_lanes()
        return library.robins_scan

    def holds_for(self, begin: Sequence[Given]) -> bool:
        """Whether runs begin with the zeros that the program takes for granted."""
        zeros = self.program.zeros
        return all(bool(np.all(zero_in_all(begin[k])[mask])) for k, mask in zeros.items())

    def __call__(
        self, runs: int, given: Sequence[Given], named: Collection[int] = ()
    ) -> list[np.ndarray]:
        """What is carried in the end, and the rows made, with a leading axis of runs.

        Args:
            runs: how many.
            given: what is carried, what stays, rows.
            named: numbers of the results that are kept of the first run only.

        Raises:
            MemoryError: there is none for the rows of some rounds.
        """
        inputs, results = self.program.inputs, self.program.results
        arrays = [
            np.ascontiguousarray(numbers_of(g.array), _dtype(leaf.dtype))
            for g, leaf in zip(given, inputs, strict=True)
        ]
        made = [
            np.empty(
                (
                    1 if k in named else runs,
                    *((self.length,) if k >= self.carried else ()),
                    *leaf.shape,
                ),
                _dtype(leaf.dtype),
            )
            for k, leaf in enumerate(results)
        ]
        first = self.carried + self.stays
        taken = [
            _rows(a, g.batched, k >= first, leaf)
            for k, (a, g, leaf) in enumerate(zip(arrays, given, inputs, strict=True))
        ]
        out = [
            _rows(a, True, k >= self.carried, leaf)
            for k, (a, leaf) in enumerate(zip(made, results, strict=True))
        ]
        scan = Scan(
            runs,
            self.length,
            self.backwards,
            self.carried,
            self.stays,
            len(taken) - first,
            len(out) - self.carried,
            ctypes.cast((Rows * max(len(taken), 1))(*taken), ctypes.c_void_p),
            ctypes.cast((Rows * max(len(out), 1))(*out), ctypes.c_void_p),
        )
        if self._scan(ctypes.byref(scan)):
            raise MemoryError(f"no memory for rounds of {runs} runs")
        return [
            array_of(a, leaf.dtype) if is_key(leaf.dtype) else a
            for a, leaf in zip(made, results, strict=True)
        ]


def zero_in_all(given: Given) -> np.ndarray:
    """Which entries of an array are zero in all runs."""
    zero = positive_zeros(numbers_of(given.array))
    return np.asarray(np.all(zero, axis=0)) if given.batched else zero


def _dtype(dtype: Any) -> np.dtype:
    """Of an array of C: a key is one number."""
    return np.dtype(np.uint64) if is_key(dtype) else np.dtype(dtype)


def _rows(a: np.ndarray, batched: bool, by_round: bool, leaf: Leaf) -> Rows:
    size = int(np.prod(leaf.shape))
    run = a.strides[0] if batched and a.size else 0
    kind = KINDS[f"{a.dtype.kind}{a.dtype.itemsize}"]
    return Rows(
        a.ctypes.data,
        len(a) if batched else 1,
        run,
        size * a.itemsize if by_round else 0,
        size,
        kind,
    )


def _text(program: Program) -> str:
    """The program for lanes, and the rounds around it."""
    sizes = *counts(program.inputs), *counts(program.results)
    names = ("NX", "NK", "NY", "NM")
    defined = "\n".join(f"#define {n} {size}" for n, size in zip(names, sizes, strict=True))
    rounds = (files("robins.program") / "scan.h").read_text("utf-8")
    step = function(program, linkage="static ")
    return f"#include <stdlib.h>\n{header('lanes.h')}\n{step}\n{defined}\n{rounds}\n{SCAN}"
