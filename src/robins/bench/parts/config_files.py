"""Transfer of a config to processes: all map one file with its arrays into memory, read only.

So the inputs of a long run are in memory once, however many parts read them, and only the pages
already read. Anything that pickles can be sent (PEP 574: arrays are stored outside the pickle).

The file is in a temporary folder that its bench holds a lock on. The kernel releases the lock with
the process, however it ends, and the next bench removes the files of dead ones.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import pickle
import shutil
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_END = struct.Struct("<Q")  # offset of the pickle, which follows the arrays
_ALIGNED = 64  # bytes
_PREFIX, _LOCKED = "robins-parts-", "locked"


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Make a folder that only this user can open, for as long as the context lasts."""
    _sweep()
    with contextlib.ExitStack() as stack:
        path = Path(tempfile.mkdtemp(prefix=_PREFIX))
        stack.callback(shutil.rmtree, path, ignore_errors=True)
        with contextlib.suppress(OSError):  # a file system without locks: the folder is never swept
            stack.enter_context(_locked(path))
            (path / _LOCKED).touch()
        yield path


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock a folder.

    Raises:
        OSError: another process has locked it, it is gone, or it cannot be locked.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _sweep() -> None:
    """Remove the folders of this user's benches that were killed."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            # a folder without the mark has been made and is about to be locked
            if path.lstat().st_uid == os.getuid() and (path / _LOCKED).exists():
                with _locked(path):
                    shutil.rmtree(path, ignore_errors=True)


def put(config: Any, path: Path) -> None:
    """Write a config to a file.

    Raises:
        OSError: it cannot be written.
    """
    arrays: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(config, protocol=5, buffer_callback=arrays.append)
    places: list[tuple[int, int]] = []
    with path.open("wb") as file:
        for array in arrays:
            file.write(bytes(-file.tell() % _ALIGNED))
            begin = file.tell()
            file.write(array.raw())
            places.append((begin, file.tell()))
        at = file.tell()
        file.write(pickle.dumps((places, pickled)) + _END.pack(at))


def take(path: Path) -> Any:
    """Map a config from a file; its arrays are read only.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        held = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    (at,) = _END.unpack(held[-_END.size :])
    places, pickled = pickle.loads(held[at : -_END.size])
    return pickle.loads(pickled, buffers=[held[begin:end] for begin, end in places])
