"""Snapshot file of a live object's complete state, to continue bit for bit after a restart.

The file is an npz: numbered arrays, and a text in JSON with the name and version of the format, the
class that wrote it, its parameters as TOML, the plain values between the arrays, and a digest of
all of it. It is written under another name, synced and renamed. Nothing in it is executed.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robins.foreign import arrays_of, decoding
from robins.results.errors import ResultError, result_error
from robins.results.folder import sync

State = Any  # numbers, texts and arrays, in tuples, lists and mappings by name
FORMAT, VERSION = "robins-live", 2
_LARGEST = 1 << 30  # bytes of a file


class Snapshot(NamedTuple):
    """Contents of a file."""

    parameters: str  # TOML
    state: State  # as it was given to `write`, tuples as tuples, arrays as NumPy's


def write(path: str | os.PathLike[str], kind: str, parameters: str, state: State) -> None:
    """Write a snapshot; on failure an earlier file stays as it was.

    Args:
        path: of the file.
        kind: name of the class.
        parameters: TOML text.
        state: dictionaries with texts as keys, lists, tuples, None, texts, numbers and arrays.

    Raises:
        ResultError: the file cannot be written.
        TypeError: the state holds something else.
    """
    arrays: list[np.ndarray] = []
    body = {"kind": kind, "parameters": parameters, "state": _frozen(state, arrays)}
    header = {"format": FORMAT, "version": VERSION, **body, "digest": _digest(body, arrays)}
    packed = io.BytesIO()
    named: dict[str, State] = {f"a{k}": a for k, a in enumerate(arrays)}
    np.savez(packed, told=np.frombuffer(json.dumps(header).encode(), np.uint8), **named)
    target = Path(os.path.realpath(path))
    aside = target.with_name(f".robins-live-{secrets.token_hex(6)}")
    try:
        with aside.open("xb") as file:
            file.write(packed.getvalue())
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, target)
        with suppress(OSError):
            sync(target.parent)
    except OSError as error:
        raise result_error(target, "write the state", error) from error
    finally:
        with suppress(OSError):
            aside.unlink()


def read(path: str | os.PathLike[str], kind: str) -> Snapshot:
    """Read a snapshot written by the class `kind`.

    Raises:
        ResultError: the file cannot be read, is not a snapshot, is damaged, or is of another
            version or class.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(_LARGEST + 1)
    except OSError as error:
        raise result_error(path, "read the state", error) from error
    header, arrays = _unpacked(content, path)
    if header.get("version") != VERSION:
        what = (
            f"it is of version {header.get('version')} of the format, this robins reads {VERSION}"
        )
        raise ResultError(path, what, "use the robins that wrote it, or start again")
    body = {key: header.get(key) for key in ("kind", "parameters", "state")}
    if header.get("digest") != _digest(body, arrays):
        raise ResultError(path, "it is damaged", "start again, or restore an older one")
    if header["kind"] != kind:
        fix = f"load it with {header['kind']}.load"
        raise ResultError(path, f"it holds a {header['kind']}, not a {kind}", fix)
    return Snapshot(header["parameters"], _thawed(header["state"], arrays))


def _unpacked(
    content: bytes, path: str | os.PathLike[str]
) -> tuple[dict[str, State], list[np.ndarray]]:
    def refuse(why: str) -> ResultError:
        what = f"it is damaged or no file of a live state ({why})"
        return ResultError(path, what, "start again, or restore an older one")

    if len(content) > _LARGEST:
        raise refuse(f"more than {_LARGEST >> 20} MiB")
    packed = arrays_of(content, refuse)
    with decoding(refuse):
        header = json.loads(packed.pop("told").tobytes())
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise refuse("it is of another format")
    with decoding(refuse):
        return header, [packed[f"a{k}"] for k in range(len(packed))]


def _digest(body: Mapping[str, State], arrays: list[np.ndarray]) -> str:
    seen = hashlib.sha256(json.dumps(body, sort_keys=True).encode())
    for a in arrays:
        seen.update(f"{a.dtype.str}{a.shape}".encode())
        seen.update(np.ascontiguousarray(a).tobytes())
    return seen.hexdigest()


def _frozen(value: State, arrays: list[np.ndarray]) -> State:
    """Value in plain JSON, with an array replaced by its number in `arrays`."""
    if value is None or isinstance(value, bool | str) or type(value) in (int, float):
        return value
    if isinstance(value, dict):
        return {"dict": {key: _frozen(v, arrays) for key, v in value.items()}}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_frozen(v, arrays) for v in value]}
    kept = np.asarray(value)
    if kept.dtype.kind not in "fiub":
        raise TypeError(f"a state cannot hold {type(value).__name__}")
    arrays.append(kept)
    return {"array": len(arrays) - 1}


def _thawed(value: State, arrays: list[np.ndarray]) -> State:
    if not isinstance(value, dict):
        return value
    ((kind, inner),) = value.items()
    if kind == "array":
        return arrays[inner]
    if kind == "dict":
        return {key: _thawed(v, arrays) for key, v in inner.items()}
    items = [_thawed(v, arrays) for v in inner]
    return items if kind == "list" else tuple(items)
