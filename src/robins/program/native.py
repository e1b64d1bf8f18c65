"""Programs as functions of Python, and C compiled on this machine, cached by content."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from robins.program.c import to_c
from robins.program.flags import FASTER, FASTER_IN_GCC, FLAGS, SHARED
from robins.program.kinds import array_of, numbers_of
from robins.program.refusal import BuildError, ProgramError
from robins.program.trace import UNROLL, trace
from robins.program.walk import Leaf, Program, slots

NO_COMPILER = (
    "install one (Debian: `apt install g++`; anywhere: `pip install 'robins[compiler]'`), "
    "or name it in CC (of C++: CXX)"
)


class Language(NamedTuple):
    """Language of compiled texts: C for single numbers, C++ (``?:`` on vectors) for lanes."""

    suffix: str
    variable: str  # of the environment, that names the compiler
    names: tuple[str, ...]  # of compilers
    zig: str


C = Language(".c", "CC", ("cc", "gcc", "clang"), "cc")
CPP = Language(".cc", "CXX", ("c++", "g++", "clang++"), "c++")


def compiler(language: Language = C) -> tuple[str, ...]:
    """Command of a compiler: CC or CXX, else the system's, else that of `ziglang`.

    Raises:
        BuildError: there is none.
    """
    if words := shlex.split(os.environ.get(language.variable, "")):
        if shutil.which(words[0]) is None:
            raise BuildError(f"there is no program '{words[0]}'", language.variable, NO_COMPILER)
        return tuple(words)
    for name in language.names:
        if (found := shutil.which(name)) is not None:
            return (found,)
    if importlib.util.find_spec("ziglang") is not None:
        return (sys.executable, "-P", "-m", "ziglang", language.zig)
    raise BuildError("there is no C compiler on this machine", "", NO_COMPILER)


@lru_cache
def _version(command: tuple[str, ...]) -> str:
    return subprocess.run([*command, "--version"], capture_output=True, text=True).stdout


def is_gcc(command: tuple[str, ...]) -> bool:
    """True if a compiler is that of GNU, by whatever name it is called."""
    return "Free Software Foundation" in _version(command)


@lru_cache
def _processor() -> str:
    """Features of this processor, as the system reports: a cache may be shared by machines."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return f"{platform.machine()} {platform.processor()}"


def cache_folder() -> Path:
    """Folder of compiled libraries: the user's cache, else one that this process makes."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "robins" / "native"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder if os.access(folder, os.W_OK) else _own_folder()


@lru_cache
def _own_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="robins-native-"))


def build(text: str, flags: tuple[str, ...] = FLAGS, language: Language = C) -> Path:
    """Shared library of a text, cached by text, compiler and flags.

    Where the flags hold `FASTER`, gcc is given `FASTER_IN_GCC` too.

    Raises:
        BuildError: there is no compiler, or it refuses the text; contains its message.
    """
    command = compiler(language)
    if set(FASTER) <= set(flags) and is_gcc(command):
        flags = (*flags, *FASTER_IN_GCC)
    made_for = _processor() if "-march=native" in flags else ""
    library = _named(text, *command, _version(command), *flags, made_for)
    sys.audit("robins.build", library.name)
    return library if library.exists() else _compiled(library, command, text, flags, language)


def build_once(text: str, flags: tuple[str, ...], language: Language) -> Path:
    """Shared library of a text, cached by text and flags, whatever compiled it.

    Raises:
        BuildError: it is not there, and there is no compiler, or it refuses the text.
    """
    library = _named(text, platform.machine(), *flags)
    sys.audit("robins.build_once", library.name)
    if library.exists():
        return library
    return _compiled(library, compiler(language), text, flags, language)


def _named(*words: str) -> Path:
    name = hashlib.sha256("\0".join(words).encode()).hexdigest()[:24]
    return cache_folder() / f"{name}.so"


def _compiled(
    library: Path, command: tuple[str, ...], text: str, flags: tuple[str, ...], language: Language
) -> Path:
    with tempfile.TemporaryDirectory(dir=library.parent) as own:
        source, made = Path(own) / f"program{language.suffix}", Path(own) / library.name
        source.write_text(text, "utf-8")
        line = [*command, *flags, *SHARED, str(source), "-o", str(made), "-lm"]
        done = subprocess.run(line, capture_output=True, text=True)
        if done.returncode:
            output = "\n".join(done.stderr.strip().splitlines()[:5])
            raise BuildError(f"the compiler does not accept a program: {output}", command[0])
        made.replace(library)  # of two processes that build the same, either's will do
    return library


Step = Callable[..., Any]  # of addresses (x, k, y, m), as `robins.program.c.function` has them
Engine = Callable[[Program], Callable[[], Step]]  # each step has memory of its own


def compiled_step(program: Program, flags: tuple[str, ...] = FLAGS) -> Callable[[], Step]:
    """Steps of a program as the C compiler compiles it.

    Raises:
        BuildError: there is no compiler, or it refuses the program.
    """
    step = ctypes.CDLL(str(build(to_c(program), flags))).robins_step
    step.restype = None
    return lambda: step


class Native:
    """A program as a function of Python: takes and gives what the traced function did.

    Its results are arrays of NumPy. One call takes some microseconds a leaf; a loop of millions of
    steps belongs in C, see `robins.program.to_c`.
    """

    def __init__(self, program: Program, engine: Engine = compiled_step):
        self.program = program
        self._step = engine(program)()
        self._x, self._k, self._given = _laid_out(program.inputs)
        self._y, self._m, self._made = _laid_out(program.results)
        self._zeros = [
            (self._given[k], mask, program.inputs[k].path)
            for k, mask in program.zeros.items()
            if mask.any()
        ]
        self._buffers = [address(a) for a in (self._x, self._k, self._y, self._m)]

    def __call__(self, *args: PyTree) -> PyTree:
        """The function on pytrees of numbers.

        Raises:
            ProgramError: the arguments are not of the structure or the shapes that were traced.
        """
        leaves, tree = jax.tree_util.tree_flatten(args)
        if tree != self.program.structure[0]:
            raise ProgramError(
                f"arguments of another structure than was traced: {tree}",
                fix="trace the function with arguments like these",
            )
        for leaf, view, value in zip(self.program.inputs, self._given, leaves, strict=True):
            if np.shape(value) != leaf.shape:
                raise ProgramError(
                    f"{np.shape(value)} was given where {leaf.shape} was traced", leaf.path
                )
            view[...] = numbers_of(value) if leaf.kind == "word64" else value
        for view, mask, path in self._zeros:
            if np.any(view[mask]):
                what = "a number is not zero that is zero in all states that follow from the first"
                fix = "trace the step with a state like this one, or use `trace`"
                raise ProgramError(what, path, fix)
        self._step(*self._buffers)
        made = [
            array_of(view, leaf.dtype) if leaf.kind == "word64" else view.astype(leaf.dtype)
            for leaf, view in zip(self.program.results, self._made, strict=True)
        ]
        return jax.tree_util.tree_unflatten(self.program.structure[1], made)


def address(array: np.ndarray) -> ctypes.c_void_p:
    """Address of an array, for C."""
    return ctypes.c_void_p(array.ctypes.data)


def _laid_out(leaves: list[Leaf]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Memory for the reals and for all else of some leaves, and the view of each into it."""
    found, reals, others = slots(leaves)
    memory = np.zeros(max(reals, 1)), np.zeros(max(others, 1), dtype=np.int64)
    return *memory, [slot.view(*memory) for slot in found]


def native(
    function: Callable[..., PyTree],
    *args: PyTree,
    unroll: int | None = UNROLL,
    engine: Engine = compiled_step,
) -> Native:
    """Trace a function with arguments, and return its program as a function.

    Args:
        function: a pure function of JAX.
        args: arguments of the shapes and types that it will be given.
        unroll: as in `trace`.
        engine: `compiled_step`, or `interpreted_step`.

    Raises:
        ProgramError: the function does something that has no place in a program.
        BuildError: there is no compiler, or it refuses the program.
    """
    return Native(trace(function, *args, unroll=unroll), engine)
