"""One shard: the statistics of a filter over a chunk of runs, as one sealed file.

It is an `.npz` that NumPy opens, with a SHA-256 of all that it holds.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from robins.campaign.statistics import Statistics
from robins.errors import RobinsError
from robins.foreign import arrays_of, decoding

_ABOUT = "about"
_COUNTS = ("runs", "diverged", "n")


class DamagedShardError(RobinsError):
    """A shard whose content differs from what was written."""


def pack(about: Mapping[str, Any], statistics: Statistics) -> bytes:
    """A shard as bytes.

    Args:
        about: identification of the shard, plain data.
        statistics: of a chunk; the record of its first run is included if it is there.
    """
    arrays: dict[str, Any] = dict(tables(statistics))
    arrays |= {
        f"example {k:04}": np.asarray(x)
        for k, x in enumerate(jax.tree_util.tree_leaves(statistics.example))
    }
    header = {**about, **{name: int(getattr(statistics, name)) for name in _COUNTS}}
    header["sha256"] = _seal(header, arrays)
    file = io.BytesIO()
    np.savez(file, **{_ABOUT: np.array(json.dumps(header, sort_keys=True))}, **arrays)
    return file.getvalue()


def tables(statistics: Statistics) -> dict[str, np.ndarray]:
    """All arrays of statistics, by name."""
    found = {f"sum {name}": np.asarray(x) for name, x in statistics.sums.items()}
    found |= {f"bins {name}": x for name, x in statistics.bins.items()}
    return found | {f"each {name}": np.concatenate(x) for name, x in statistics.each.items()}


def unpack(content: bytes, into: Statistics, example: PyTree = None) -> dict[str, PyTree]:
    """Read a shard.

    Args:
        content: as `pack` made it.
        into: statistics of no runs, which are filled.
        example: the tree of the record of a run, to be filled with its leaves; None: leave them.

    Returns:
        Its identification.

    Raises:
        DamagedShardError: the content is cut or changed.
    """
    arrays = arrays_of(content, DamagedShardError)
    with decoding(DamagedShardError):
        header = json.loads(str(arrays.pop(_ABOUT, "{}")))
    if not isinstance(header, dict) or header.pop("sha256", None) != _seal(header, arrays):
        raise DamagedShardError("its checksum does not fit")
    for name in _COUNTS:
        if not isinstance(header.get(name), int):
            raise DamagedShardError(f"it does not state {name!r}")
        setattr(into, name, header[name])
    leaves, tables = [], {"sum": into.sums, "bins": into.bins}
    for name in sorted(arrays):
        kind, _, what = name.partition(" ")
        if kind in tables:
            tables[kind][what] = arrays[name]
        elif kind == "each":
            into.each[what] = [arrays[name]]
        else:
            leaves.append(arrays[name])
    if leaves and example is not None:
        tree = jax.tree_util.tree_structure(example)
        if tree.num_leaves != len(leaves):
            raise DamagedShardError(f"its record has {len(leaves)} arrays, not {tree.num_leaves}")
        into.example = jax.tree_util.tree_unflatten(tree, leaves)
    return header


def digest(found: Mapping[str, Statistics]) -> str:
    """SHA-256 of the statistics of all filters: equal if and only if all bits are."""
    sha = hashlib.sha256()
    for name in sorted(found):
        one = found[name]
        sha.update(
            _seal({"filter": name} | {k: getattr(one, k) for k in _COUNTS}, tables(one)).encode()
        )
    return sha.hexdigest()


def _seal(about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    sha = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in sorted(arrays):
        x = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {x.dtype.str} {x.shape}\n".encode())
        sha.update(x.tobytes())
    return sha.hexdigest()
