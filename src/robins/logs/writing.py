"""Writing a log: under another name first, so that no half file bears the final one."""

from __future__ import annotations

import gzip
import lzma
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from robins.logs.findings import LogError

_OPENERS: dict[str, Any] = {".xz": lzma.open, ".gz": gzip.open}


def write_lines(path: str | os.PathLike[str], blocks: Iterable[str]) -> None:
    """Write text, compressed if the name ends in .xz or .gz; an earlier file stays until the end.

    Raises:
        LogError: the file cannot be written; no part of it is left behind.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # a device must not be replaced by a file
            _write(path, path.suffix, blocks)
        else:
            _write_and_rename(path, blocks)
    except OSError as error:
        why = error.strerror or str(error)
        raise LogError(
            str(path), f"cannot be written: {why}", "check the folder, its permissions and the disk"
        ) from error


def _write(path: str | Path, suffix: str, blocks: Iterable[str]) -> None:
    with _OPENERS.get(suffix, open)(path, "wt", encoding="utf-8", newline="\n") as file:
        for block in blocks:
            file.write(block)


def _write_and_rename(path: Path, blocks: Iterable[str]) -> None:
    handle, temporary = tempfile.mkstemp(prefix=".", dir=path.parent)
    os.close(handle)
    try:
        _write(temporary, path.suffix, blocks)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
