"""Tapes kept in the user's cache, by the structure of the equations that they were made of.

A digest is of primitives, parameters, shapes and numbers, not of names or of where code stands, and
of the files of this room, which decide what a tape is.
"""

from __future__ import annotations

import contextlib
import enum
import hashlib
import json
import re
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

from robins.program.interpreter import interpreter_of_many
from robins.program.kinds import is_key, numbers_of
from robins.program.lanes import RoundsEngine
from robins.program.native import cache_folder
from robins.program.nodes import Graph
from robins.program.primitives.control import called
from robins.program.tape import Tape
from robins.program.trace import Leaf, Program

WORTH = 1_000  # nodes of a program that is kept
DAMAGED = OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error


def kept(parts: Iterable[Any], write: Callable[[], Program]) -> tuple[Program, RoundsEngine, int]:
    """A program, its rounds by the interpreter, and how many nodes it has; from the cache or made.

    A program from the cache has its arguments, results and zeros, but neither nodes nor outputs.

    Args:
        parts: all that the program is made of: jaxprs, arrays, numbers, texts.
        write: makes it.

    Raises:
        ProgramError: it cannot be made.
        BuildError: there is no interpreter.
    """
    interpreter = interpreter_of_many()
    path = cache_folder() / f"{digest([*parts, list(interpreter.codes), interpreter.flag])}.npz"
    with contextlib.suppress(*DAMAGED):
        program, tape, nodes = _read(path)
        return program, lambda _: interpreter.rounds(tape), nodes
    program = write()
    tape, nodes = interpreter.tape(program), len(program.live)
    if nodes >= WORTH:
        with contextlib.suppress(OSError):  # a full disk, a folder that is gone
            _write(path, program, tape, nodes)
    return program, lambda _: interpreter.rounds(tape), nodes


def _write(path: Path, program: Program, tape: Tape, nodes: int) -> None:
    leaves = [
        [(leaf.shape, "" if is_key(leaf.dtype) else str(leaf.dtype), leaf.kind) for leaf in some]
        for some in (program.inputs, program.results)
    ]
    arrays: dict[str, Any] = {f"array{k}": a for k, a in enumerate(tape.arrays)}
    arrays |= {f"zero{k}": mask for k, mask in program.zeros.items()}
    arrays["about"] = json.dumps({"leaves": leaves, "nodes": nodes})
    with tempfile.TemporaryDirectory(dir=path.parent) as own:
        made = Path(own) / path.name
        np.savez_compressed(made, sizes=tape.sizes, **arrays)
        made.replace(path)


def _read(path: Path) -> tuple[Program, Tape, int]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
        about = json.loads(str(found["about"]))
        tape = Tape.of([found[f"array{k}"] for k in range(4)], found["sizes"])
        zeros = {int(k[4:]): found[k] for k in found.files if k.startswith("zero")}
    inputs, results = (
        [
            Leaf(tuple(shape), np.dtype(name) if name else jax.dtypes.prng_key, kind, "")
            for shape, name, kind in some
        ]
        for some in about["leaves"]
    )
    program = Program(Graph(), inputs, [], results, (None, None), zeros=zeros)
    return program, tape, about["nodes"]


@lru_cache
def _version() -> str:
    """A digest of the code that makes tapes."""
    found = hashlib.sha256()
    for folder in ("", "primitives"):
        for file in sorted((files("robins.program") / folder).iterdir(), key=lambda f: f.name):
            if file.name.endswith((".py", ".h", ".cc")):
                found.update(file.read_bytes())
    for package in ("jax", "numpy", "scipy"):  # the last two fold constants
        found.update(metadata.version(package).encode())
    return found.hexdigest()


def digest(parts: Iterable[Any]) -> str:
    """A digest of jaxprs, arrays, numbers and texts, nested in any way."""
    found = hashlib.sha256(_version().encode())
    _feed(found, list(parts), {})
    return found.hexdigest()[:32]


def _feed(to: Any, value: Any, names: dict[Any, int]) -> None:
    """Add a value to a digest; names: numbers of the variables so far."""
    match value:
        case jex.ClosedJaxpr():
            _feed(to, value.consts, {})
            _feed(to, value.jaxpr, {})
        case jex.Jaxpr():
            inner: dict[Any, int] = {}
            for v in (*value.constvars, *value.invars):
                _named(to, v, inner)
            for e in value.eqns:
                call = called(e)
                to.update(f"{'call' if call else e.primitive.name}(".encode())
                _feed(to, call or e.params, {})
                _feed(to, e.invars, inner)
                for v in e.outvars:
                    _named(to, v, inner)
            _feed(to, value.outvars, inner)
        case jex.Literal():
            _feed(to, numbers_of(value.val), names)
            to.update(str(value.aval).encode())
        case jex.Var():
            to.update(f"v{names[value]}".encode())
        case np.ndarray() | np.generic() | jax.Array():
            array = np.ascontiguousarray(numbers_of(value))
            to.update(f"{array.dtype}{np.shape(array)}".encode())
            to.update(array.tobytes())
        case Mapping():
            for key in sorted(value):
                to.update(f"{key}:".encode())
                _feed(to, value[key], names)
        case enum.Enum():
            to.update(str(value).encode())
        case list() | tuple() if not hasattr(value, "_fields"):
            to.update(f"[{len(value)}".encode())
            for one in value:
                _feed(to, one, names)
        case _:
            # Functions among the parameters, of JAX's generators and rules of batching, make no
            # node; they are told apart by name alone.
            text = re.sub(r" at 0x[0-9a-f]+", "", repr(value))
            to.update(f"{type(value).__name__} {text};".encode())


def _named(to: Any, v: Any, names: dict[Any, int]) -> None:
    names[v] = len(names)
    to.update(f"v{names[v]}:{v.aval};".encode())
