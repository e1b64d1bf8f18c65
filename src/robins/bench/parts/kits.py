"""A kit on its way to processes: its arrays lie in a file that all of them map, read only.

So what a long run is driven by is in memory once, however many parts look at it, and only as far
as they have come. Anything that pickles can be sent (PEP 574: arrays travel beside the pickle).
"""

from __future__ import annotations

import mmap
import pickle
import struct
from pathlib import Path
from typing import Any

_END = struct.Struct("<Q")  # where the pickle begins, behind the arrays
_ALIGNED = 64  # bytes


def put(kit: Any, path: Path) -> None:
    """Write a kit to a file.

    Raises:
        OSError: it cannot be written.
    """
    arrays: list[pickle.PickleBuffer] = []
    whole = pickle.dumps(kit, protocol=5, buffer_callback=arrays.append)
    places: list[tuple[int, int]] = []
    with path.open("wb") as file:
        for array in arrays:
            file.write(bytes(-file.tell() % _ALIGNED))
            begin = file.tell()
            file.write(array.raw())
            places.append((begin, file.tell()))
        at = file.tell()
        file.write(pickle.dumps((places, whole)) + _END.pack(at))


def take(path: Path) -> Any:
    """A kit from a file; its arrays cannot be written to.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        held = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    (at,) = _END.unpack(held[-_END.size :])
    places, whole = pickle.loads(held[at : -_END.size])
    return pickle.loads(whole, buffers=[held[begin:end] for begin, end in places])
