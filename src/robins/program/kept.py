"""Tapes in the user's cache or in a wheel, by a digest of all that they depend on.

That is robins' own code and the structure of the equations (primitives, parameters, shapes and
numbers, but neither names nor source lines); or, before anything is traced, the names of functions
of robins and their arguments (`names.by_name`). File names in the cache also contain the versions
of JAX, NumPy and SciPy, which trace and fold; those in a wheel serve all versions.
"""

from __future__ import annotations

import contextlib
import enum
import hashlib
import json
import re
import tempfile
import time
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from functools import lru_cache
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax.extend import core as jex
from jaxtyping import PyTree

from robins.program.interpreter import Interpreter, interpreter_of_many
from robins.program.kinds import Variable, is_key, numbers_of
from robins.program.lanes import RoundsEngine
from robins.program.names import Tree, as_json, by_name, of_json
from robins.program.native import cache_folder
from robins.program.nodes import Graph
from robins.program.primitives.control import called
from robins.program.tape import Tape
from robins.program.walk import Leaf, Program

T = TypeVar("T")
WORTH = 1_000  # fewest nodes of a program that is kept
IN_WHEEL = Path(str(files("robins.program"))) / "tapes"  # those of the live filters, by a release
_BEGAN_S = time.time()  # about when the code of this process was read
DAMAGED = OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error


def cached_program(
    parts: Iterable[Any], write: Callable[[], Program], interpreter: Interpreter
) -> tuple[Program, Tape, int]:
    """A program, its tape and its number of nodes; from the cache, else written.

    A program from the cache has its arguments, results and zeros, but neither nodes nor outputs;
    the structure of its results is data of `names.as_json`.

    Args:
        parts: all that the program depends on: jaxprs, arrays, numbers, texts.
        write: writes the program.
        interpreter: executes the tape.

    Raises:
        ProgramError: it cannot be made.
    """
    is_known = _code() is not None
    name = digest([*parts, list(interpreter.codes), interpreter.flag])
    path = cache_folder() / f"{name}.{_packages()}.npz"
    for there in (path, IN_WHEEL / f"{name}.npz") if is_known else ():
        with contextlib.suppress(*DAMAGED):
            return _read(there)
    program = write()
    tape, nodes = interpreter.tape(program), len(program.live)
    if is_known and nodes >= WORTH:
        with contextlib.suppress(OSError):  # a full disk, a folder that is gone
            _write(path, program, tape, nodes)
    return program, tape, nodes


def cached_rounds(
    parts: Iterable[Any], write: Callable[[], Program]
) -> tuple[Program, RoundsEngine, int]:
    """Program as of `cached_program`, engine of the interpreter of many runs, node count.

    Raises:
        ProgramError: it cannot be made.
        BuildError: there is no interpreter.
    """
    interpreter = interpreter_of_many()
    program, tape, nodes = cached_program(parts, write, interpreter)
    return program, lambda _: interpreter.rounds(tape), nodes


def _write(path: Path, program: Program, tape: Tape, nodes: int) -> None:
    leaves = [
        [(leaf.shape, "" if is_key(leaf.dtype) else str(leaf.dtype), leaf.kind) for leaf in some]
        for some in (program.inputs, program.results)
    ]
    arrays: dict[str, Any] = {f"array{k}": a for k, a in enumerate(tape.arrays)}
    arrays |= {f"zero{k}": mask for k, mask in program.zeros.items()}
    tree = program.structure[1]
    results = [] if tree is None else list(map(as_json, tree.children()))
    about = {"leaves": leaves, "nodes": nodes, "tree": results}
    arrays["about"] = json.dumps(about)
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
    program = Program(Graph(), inputs, [], results, (None, about["tree"]), zeros=zeros)
    return program, tape, about["nodes"]


def cached_by_name(
    what: str, key: Hashable, write: Callable[[], Program], interpreter: Interpreter
) -> tuple[Program, Tape]:
    """A program and its tape, from the cache or made.

    They are kept if the key can be written as text (`names.by_name`).

    Args:
        what: the kind of the program.
        key: all that the program depends on.
        write: writes the program.
        interpreter: executes the tape.

    Raises:
        ProgramError: it cannot be made.
    """
    try:
        text = by_name(key)
    except LookupError:
        program = write()
        return program, interpreter.tape(program)
    program, tape, _ = cached_program([what, text], write, interpreter)
    return program, tape


def cached_value(
    known: OrderedDict[Hashable, T], key: Hashable, make: Callable[[], T], most: int
) -> T:
    """Cached value of a key, computed if missing; beyond `most` entries the oldest is dropped."""
    if key not in known:
        known[key] = make()
        if len(known) > most:
            known.popitem(last=False)
    known.move_to_end(key)
    return known[key]


def second_result(program: Program, function: Callable[..., PyTree], *args: PyTree) -> Tree:
    """Structure of the second result of a program; traced where a program of the cache lacks it.

    Args:
        program: that of the function.
        function: returns a pair.
        args: its arguments.
    """
    tree = program.structure[1]
    if isinstance(tree, jax.tree_util.PyTreeDef):
        return tree.children()[1]
    known = None if tree[1] is None else of_json(tree[1])
    if known is not None:
        return known
    return jax.tree_util.tree_structure(jax.eval_shape(function, *args)[1])


@lru_cache
def _packages() -> str:
    """Versions of the packages that trace programs and fold their numbers."""
    return "-".join(metadata.version(package) for package in ("jax", "numpy", "scipy"))


@lru_cache
def _code() -> str | None:
    """A digest of robins, and of what its programs depend on.

    None where the code of this process is unknown: its files are missing, or changed since it
    began.
    """
    found, newest = hashlib.sha256(), 0.0
    kinds = (".py", ".h", ".cc", ".COF")
    for file in sorted(Path(str(files("robins"))).rglob("*.*")):
        if file.suffix in kinds:
            newest = max(newest, file.stat().st_mtime)
            found.update(file.read_bytes())
    return found.hexdigest() if 0.0 < newest <= _BEGAN_S else None


def digest(parts: Iterable[Any]) -> str:
    """A digest of jaxprs, arrays, numbers and texts, nested in any way."""
    draws = jax.config.values["jax_threefry_partitionable"]  # which a jaxpr does not contain
    texts: list[str | bytes] = [f"{_code()} {draws}"]
    _feed(texts, list(parts), {}, {})
    return _digest_of(texts)


def _digest_of(texts: list[str | bytes]) -> str:
    whole = b"".join(t.encode() if isinstance(t, str) else t for t in texts)
    return hashlib.sha256(whole).hexdigest()[:32]


def _feed(
    to: list[str | bytes], value: Any, names: dict[Variable, int], jaxprs: dict[int, str]
) -> None:
    """Add texts of a value.

    Args:
        to: texts so far.
        value: jaxpr, array, number or text, nested in any way.
        names: numbers of the variables so far.
        jaxprs: digests of the jaxprs so far, by id: many occur more than once.
    """
    match value:
        case jex.ClosedJaxpr():
            _feed(to, value.consts, {}, jaxprs)
            _feed(to, value.jaxpr, {}, jaxprs)
        case jex.Jaxpr():
            if (found := jaxprs.get(id(value))) is None:
                found = jaxprs[id(value)] = _digest_of(_equations(value, jaxprs))
            to.append(found)
        case jex.Literal():
            _feed(to, numbers_of(value.val), names, jaxprs)
            to.append(_text_of(value.aval))
        case jex.Var():
            to.append(f"v{names[value]}")
        case np.ndarray() | np.generic() | jax.Array():
            array = np.ascontiguousarray(numbers_of(value))
            to += [f"{array.dtype.str}{np.shape(array)}", array.tobytes()]
        case Mapping():
            for key in sorted(value):
                to.append(f"{key}:")
                _feed(to, value[key], names, jaxprs)
        case enum.Enum():
            to.append(str(value))
        case list() | tuple() if not hasattr(value, "_fields"):
            to.append(f"[{len(value)}")
            for one in value:
                _feed(to, one, names, jaxprs)
        case _:
            # Functions among the parameters (JAX's generators and batching rules) make no node;
            # their names alone distinguish them.
            text = re.sub(r" at 0x[0-9a-f]+", "", repr(value))
            to.append(f"{type(value).__name__} {text};")


def _equations(jaxpr: jex.Jaxpr, jaxprs: dict[int, str]) -> list[str | bytes]:
    """Texts of a jaxpr, its variables by their numbers."""
    to: list[str | bytes] = []
    names: dict[Any, int] = {}

    def number(variables: Iterable[Variable]) -> None:
        for v in variables:
            names[v] = len(names)
            to.append(f"v{names[v]}:{_text_of(v.aval)};")

    number([*jaxpr.constvars, *jaxpr.invars])
    for e in jaxpr.eqns:
        call = called(e)
        to.append(f"{'call' if call else e.primitive.name}(")
        _feed(to, call or e.params, {}, jaxprs)
        _feed(to, e.invars, names, jaxprs)
        number(e.outvars)
    _feed(to, jaxpr.outvars, names, jaxprs)
    return to


@lru_cache
def _text_of(aval: Hashable) -> str:
    return str(aval)
