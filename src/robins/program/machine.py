"""The machine: programs of scalars carried out by an interpreter, with no compiler in between.

`machine.cc` is built with a wheel: for one run at a time, and for many for each generation of
processors. Where it is not there, in a checkout, it is compiled once and kept in the user's cache.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from robins.program.c import part
from robins.program.lanes import Scan
from robins.program.native import CPP, MACHINE_FLAGS, Step, build
from robins.program.tape import Tape, address
from robins.program.trace import Program

FOLDER = Path(__file__).parent
ONE = "one"  # for one run at a time
# Of the processors for which a machine of many runs is built, by `robins_generation`.
GENERATIONS = {0: (), 1: ("-march=x86-64",), 3: ("-march=x86-64-v3",), 4: ("-march=x86-64-v4",)}


class Machine:
    """An interpreter.

    Attributes:
        library: its functions.
        width: runs at a time.
        codes: numbers of its instructions, by name.
        flag: a flag that is set, which for many runs is a mask.
    """

    def __init__(self, path: Path):
        """Load a library that `machine.cc` became."""
        self.library = ctypes.CDLL(str(path))
        self.library.robins_codes.restype = ctypes.c_char_p
        self.library.robins_bytes.restype = ctypes.c_int64
        names = self.library.robins_codes().decode().rstrip(",").split(",")
        self.codes = {name: code for code, name in enumerate(names)}
        self.width = self.library.robins_width()
        self.flag = 1 if self.width == 1 else -1

    def tape(self, program: Program) -> Tape:
        """A program as instructions of this machine."""
        return Tape(program, self.codes, self.flag)

    def registers(self, tape: Tape) -> np.ndarray:
        """Memory in which a tape computes, with its constants; one thread at a time may use it."""
        size = self.library.robins_bytes(tape.address) // 8
        memory = np.zeros(size + 8, np.int64)
        aligned = memory[-memory.ctypes.data % 64 // 8 :]
        self.library.robins_prepare(tape.address, address(aligned))
        return aligned


def machine_of_one() -> Machine:
    """The machine that carries out one run.

    Raises:
        BuildError: it did not come with robins, and there is no compiler to build it.
    """
    return _machine(ONE)


def machine_of_many() -> Machine:
    """The machine that carries out many runs at a time, for this processor.

    Raises:
        BuildError: it did not come with robins, and there is no compiler to build it.
    """
    return _machine(str(machine_of_one().library.robins_generation()))


@lru_cache
def _machine(kind: str) -> Machine:
    built = FOLDER / f"machine_{kind}.so"
    if built.exists():
        return Machine(built)
    flags = ("-DONE_RUN",) if kind == ONE else GENERATIONS[int(kind)]
    return Machine(build(text("machine.cc"), (*MACHINE_FLAGS, *flags), CPP))


def text(name: str) -> str:
    """A file of C of this room, with those that it includes."""
    return re.sub(r'^#include "(.*)"$', lambda found: text(found[1]), part(name), flags=re.M)


def step_of_one(program: Program) -> Callable[[], Step]:
    """Steps of a program on the machine; each has registers of its own.

    Raises:
        BuildError: as for `machine_of_one`.
    """
    machine = machine_of_one()
    tape = machine.tape(program)

    def step() -> Step:
        registers = machine.registers(tape)

        def call(*pointers: ctypes.c_void_p) -> None:
            machine.library.robins_step(tape.address, address(registers), *pointers)

        return call

    return step


def many_of(program: Program) -> tuple[Scan, int]:
    """Rounds of a program on the machine, and how many runs it takes at a time.

    Raises:
        BuildError: as for `machine_of_many`.
    """
    machine = machine_of_many()
    tape = machine.tape(program)

    def scan(rounds: ctypes.c_void_p) -> int:
        registers = machine.registers(tape)
        return machine.library.robins_scan(rounds, tape.address, address(registers))

    return scan, machine.width
