"""Programs of scalars carried out by an interpreter, without compiling them.

The interpreter itself (`interpreter.cc`), for one run at a time or for many on this processor, lies
in the wheel; else it is compiled when it is first used, in some seconds, and kept in the user's
cache.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

import numpy as np

from robins.program.c import part
from robins.program.flags import INTERPRETER_FLAGS, OF_KIND, ONE
from robins.program.lanes import Scan
from robins.program.native import CPP, Step, address, build_once
from robins.program.refusal import BuildError
from robins.program.tape import Tape
from robins.program.walk import Program


class Interpreter:
    """A loaded interpreter of tapes.

    Attributes:
        library: its functions.
        width: runs at a time.
        codes: numbers of instructions, by name.
        flag: value of a flag that is set: 1, or -1 (a mask) for many runs.
    """

    def __init__(self, path: Path):
        """Load it from a library."""
        self.library = ctypes.CDLL(str(path))
        self.library.robins_codes.restype = ctypes.c_char_p
        self.library.robins_bytes.restype = ctypes.c_int64
        names = self.library.robins_codes().decode().rstrip(",").split(",")
        self.codes = {name: code for code, name in enumerate(names)}
        self.width = self.library.robins_width()
        self.flag = 1 if self.width == 1 else -1

    def tape(self, program: Program) -> Tape:
        """Translate a program."""
        return Tape(program, self.codes, self.flag)

    def rounds(self, tape: Tape) -> tuple[Scan, int]:
        """Rounds of a tape, and how many runs they take at a time."""

        def scan(rounds: ctypes.c_void_p) -> int:
            registers = self._memory(tape)
            return self.library.robins_scan(rounds, tape.address, address(registers))

        return scan, self.width

    def steps(self, tape: Tape) -> Callable[[], Step]:
        """Factory of step functions for a tape, each with its own registers."""

        def step() -> Step:
            registers = self.registers(tape)

            def call(*pointers: ctypes.c_void_p) -> None:
                self.library.robins_step(tape.address, address(registers), *pointers)

            return call

        return step

    def registers(self, tape: Tape) -> np.ndarray:
        """Memory for steps of a tape, with its constants; one thread at a time may use it."""
        memory = self._memory(tape)
        self.library.robins_prepare(tape.address, address(memory))
        return memory

    def _memory(self, tape: Tape) -> np.ndarray:
        size = self.library.robins_bytes(tape.address) // 8
        memory = np.empty(size + 8, np.int64)
        return memory[-memory.ctypes.data % 64 // 8 :]


def interpreter_of_one() -> Interpreter:
    """Load the interpreter of one run.

    Raises:
        BuildError: it is not in the cache, and there is no compiler to build it.
    """
    return _loaded(ONE)


def interpreter_of_many() -> Interpreter:
    """Load the interpreter of many runs at a time, for this processor.

    Raises:
        BuildError: it is not in the cache, and there is no compiler to build it.
    """
    return _loaded(str(interpreter_of_one().library.robins_generation()))


@lru_cache
def _loaded(kind: str) -> Interpreter:
    path = Path(str(files("robins.program"))) / "built" / f"{kind}.so"
    if not path.is_file():  # only a wheel has it
        path = build_once(text("interpreter.cc"), (*INTERPRETER_FLAGS, *OF_KIND[kind]), CPP)
    try:
        return Interpreter(path)
    except OSError as error:  # a folder mounted without execution, another C library
        raise BuildError(f"the interpreter cannot be loaded: {error}", str(path)) from None


def text(name: str) -> str:
    """Text of a C file of this package, its includes expanded."""
    return re.sub(r'^#include "(.*)"$', lambda found: text(found[1]), part(name), flags=re.M)


def interpreted_step(program: Program) -> Callable[[], Step]:
    """Steps of a program by the interpreter; each has registers of its own.

    Raises:
        BuildError: as for `interpreter_of_one`.
    """
    interpreter = interpreter_of_one()
    return interpreter.steps(interpreter.tape(program))


def interpreted_rounds(program: Program) -> tuple[Scan, int]:
    """Rounds of a program by the interpreter, and how many runs it takes at a time.

    Raises:
        BuildError: as for `interpreter_of_many`.
    """
    interpreter = interpreter_of_many()
    return interpreter.rounds(interpreter.tape(program))
