"""The machine: programs of scalars carried out by an interpreter, with no compiler.

`machine.cc` is built with the package, once for one run at a time and, for many, once for each
generation of processors. What is here loads it and runs tapes on it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from robins.program.lanes import Rounds
from robins.program.tape import Assembled
from robins.program.trace import Program

FOLDER = Path(__file__).parent


class Machine:
    """An interpreter, loaded.

    Attributes:
        width: runs at a time.
        codes: numbers of instructions, by name.
        flag: what a flag is that is set.
    """

    def __init__(self, path: Path):
        """Load a library that `machine.cc` became."""
        self.library = ctypes.CDLL(str(path))
        self.library.robins_codes.restype = ctypes.c_char_p
        self.library.robins_bytes.restype = ctypes.c_int64
        names = self.library.robins_codes().decode().rstrip(",").split(",")
        self.codes = {name: k for k, name in enumerate(names)}
        self.width = self.library.robins_width()
        self.flag = 1 if self.width == 1 else -1

    def assemble(self, program: Program) -> Assembled:
        """A program as a tape."""
        return Assembled(program, self.codes, self.flag)

    def memory(self, tape: Assembled) -> np.ndarray:
        """Registers of a tape, with its constants."""
        raw = np.zeros(self.library.robins_bytes(ctypes.byref(tape.tape)) // 8 + 8, np.int64)
        aligned = raw[-raw.ctypes.data % 64 // 8 :]
        self.library.robins_prepare(ctypes.byref(tape.tape), pointer(aligned))
        return aligned

    def step(self, tape: Assembled) -> Callable[..., None]:
        """A step of one run, ``(x, k, y, m)``, with registers of its own."""
        memory = self.memory(tape)
        step = self.library.robins_step
        step.restype = None
        found = partial(step, ctypes.byref(tape.tape), pointer(memory))
        found.__dict__["keep"] = tape, memory
        return found


def pointer(array: np.ndarray) -> Any:
    """The address of an array for C."""
    return ctypes.c_void_p(array.ctypes.data)


@lru_cache
def machine(kind: str) -> Machine:
    """The interpreter of a kind: "one", or a generation of processors."""
    return Machine(FOLDER / f"machine_{kind}.so")


class Interpreted(Rounds):
    """Rounds of a program on the machine, without a compiler."""

    def _compiled(self, program: Program) -> Callable[[Any], int]:
        here = machine("x86-64-v3")
        tape = here.assemble(program)
        self.lanes = here.width
        self.tape = tape

        def scan(told: Any) -> int:
            memory = here.memory(tape)
            return here.library.robins_scan(told, ctypes.byref(tape.tape), pointer(memory))

        return scan
