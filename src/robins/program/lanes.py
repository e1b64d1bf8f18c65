"""Loops in SIMD lanes: a program called once a round, for several runs at a time.

A round takes the carry, arguments that stay, and a row of each input array; it gives the next carry
and a row of each output array. The body of a `scan` is one.

Compilers call this vectorisation of the outer loop, or one program on many lanes of SIMD (Pharr &
Mark 2012). An example: ``x = a x + u[k]`` for four runs. Its loop over k stays a loop, and each
scalar of a round becomes a vector of one entry a run:

    x  = [x0 x1 x2 x3]                    carried
    uk = [u0[k] u1[k] u2[k] u3[k]]        a row of an input array
    x  = [a a a a] * x + uk               two instructions for four runs

Operations of a lane are those of the run alone, so a run has the same bits in any lane and batch.
Lanes without a run repeat the last one.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import numpy as np

from robins.program.c import function, header, part
from robins.program.flags import LANE_FLAGS
from robins.program.kinds import is_key, numbers_of
from robins.program.native import CPP, build
from robins.program.trace import positive_zeros
from robins.program.walk import Leaf, Program, lengths

KINDS = {"f8": 0, "b1": 1, "i4": 2, "i8": 3, "u4": 4, "u8": 5}  # of arrays, as numbered in `scan.h`


Given = tuple[np.ndarray | jax.Array, bool]  # an array, and whether it has a leading axis of runs
Scan = Callable[[ctypes.c_void_p], int]  # a function of C that takes a `scan` of `scan.h`
RoundsEngine = Callable[[Program], tuple[Scan, int]]  # rounds, and how many runs at a time


def compiled_rounds(program: Program) -> tuple[Scan, int]:
    """Rounds of a program, compiled, and how many runs they take at a time.

    Raises:
        BuildError: there is no compiler, or it refuses the program.
    """
    library = ctypes.CDLL(str(build(_text(program), LANE_FLAGS, CPP)))
    return library.robins_scan, library.robins_lanes()


class CompiledRounds:
    """A loop of rounds around a program, called with arrays of all runs.

    Attributes:
        program: of one round: (carry, staying, row) -> (carry, row).
        lanes: runs at a time, by the vector width of this machine's processor.
    """

    def __init__(
        self,
        program: Program,
        length: int,
        carried: int,
        stays: int,
        backwards: bool = False,
        engine: RoundsEngine = compiled_rounds,
    ):
        """Prepare the rounds.

        Args:
            program: of one round.
            length: number of rounds.
            carried: number of its first arguments, and of its first results, that are carried.
            stays: number of arguments after these that are the same in all rounds.
            backwards: from the last row to the first.
            engine: `compiled_rounds`, or `interpreted_rounds`.

        Raises:
            BuildError: there is no compiler, or it refuses the program.
        """
        self.program, self.length, self.backwards = program, length, backwards
        self.carried, self.stays = carried, stays
        self._scan, self.lanes = engine(program)

    def hand_over(self, engine: RoundsEngine) -> None:
        """Change the engine of the program; calls under way finish with the old one."""
        self._scan, self.lanes = engine(self.program)

    def holds_for(self, begin: Sequence[Given]) -> bool:
        """True if runs begin with the zeros that the program assumes."""
        zeros = self.program.zeros
        return all(bool(np.all(zero_in_all(begin[k])[mask])) for k, mask in zeros.items())

    def __call__(
        self, runs: int, given: Sequence[Given], named: Collection[int] = ()
    ) -> list[np.ndarray]:
        """Final carry, and the rows made, with a leading axis of runs.

        A key is a whole number there, as `robins.program.kinds.numbers_of` makes it.

        Args:
            runs: number of runs.
            given: carry, constants, rows.
            named: indices of the results that are kept of the first run only.

        Raises:
            MemoryError: there is too little memory for the rows of the rounds.
        """
        inputs, results = self.program.inputs, self.program.results
        arrays = [
            np.ascontiguousarray(numbers_of(array), _dtype(leaf.dtype))
            for (array, _), leaf in zip(given, inputs, strict=True)
        ]
        made = []
        for k, leaf in enumerate(results):
            rows = (self.length,) if k >= self.carried else ()
            shape = 1 if k in named else runs, *rows, *leaf.shape
            made.append(np.empty(shape, _dtype(leaf.dtype)))
        first = self.carried + self.stays
        taken = [
            _rows(a, batched, k >= first, leaf)
            for k, (a, (_, batched), leaf) in enumerate(zip(arrays, given, inputs, strict=True))
        ]
        out = [
            _rows(a, True, k >= self.carried, leaf)
            for k, (a, leaf) in enumerate(zip(made, results, strict=True))
        ]
        both = [np.array(some or [[0] * 6], np.int64) for some in (taken, out)]
        counts = self.carried, self.stays, len(taken) - first, len(out) - self.carried
        pointers = [a.ctypes.data for a in both]
        scan = np.array([runs, self.length, self.backwards, *counts, *pointers], np.int64)
        if self._scan(ctypes.c_void_p(scan.ctypes.data)):
            raise MemoryError(f"no memory for rounds of {runs} runs")
        return made


def zero_in_all(given: Given) -> np.ndarray:
    """Mask of the entries of an array that are zero in all runs."""
    array, batched = given
    zero = positive_zeros(numbers_of(array))
    return np.asarray(np.all(zero, axis=0)) if batched else zero


def _dtype(dtype: Any) -> np.dtype:
    """Type of an array of C: a key is one number."""
    return np.dtype(np.uint64) if is_key(dtype) else np.dtype(dtype)


def _rows(a: np.ndarray, batched: bool, by_round: bool, leaf: Leaf) -> tuple[int, ...]:
    """An array of all runs, or of the first, as `rows` of `scan.h`."""
    size = int(np.prod(leaf.shape))
    run = a.strides[0] if batched and a.size else 0
    kind = KINDS[f"{a.dtype.kind}{a.dtype.itemsize}"]
    runs, by = len(a) if batched else 1, size * a.itemsize if by_round else 0
    return a.ctypes.data, runs, run, by, size, kind


def _text(program: Program) -> str:
    """C++ text of a program in lanes, and of the rounds around it."""
    sizes = *lengths(program.inputs), *lengths(program.results)
    names = ("NX", "NK", "NY", "NM")
    defined = "\n".join(f"#define {n} {size}" for n, size in zip(names, sizes, strict=True))
    step = function(program, linkage="static ")
    rounds = f"{part('scan.h')}\n{part('lane_rounds.h')}"
    return f"#include <stdlib.h>\n{header('lanes.h')}\n{step}\n{defined}\n{rounds}"
