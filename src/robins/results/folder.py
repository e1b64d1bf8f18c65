"""A folder that appears whole or not at all.

A writer fills a *stage*, a hidden folder beside the target, and `commit` renames it into place. The
result that was there is renamed aside first and deleted last, so at every instant one of the two is
whole on the disk. POSIX has no portable call that exchanges two folders; what a crash between the
two renames leaves behind is found by `locate` and mended by `sweep`, on the next read or write.

A living writer holds an advisory lock on its folders. The kernel drops it with the process, however
that ends, so a hidden folder whose lock is free belongs to nobody: no process numbers that could be
reused, no lock files that stay.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

_TRIES = 20  # of a commit, against other writers of the same folder
_LEFTOVER = re.compile(r"\.robins-(new|old)-([0-9a-f]{12})-[0-9a-f]{8}")


class Stage(NamedTuple):
    """A folder being filled, and where it will go."""

    path: Path
    target: Path
    lock: ExitStack | None  # closing it unlocks; None where the file system knows no locks
    parents: tuple[Path, ...]  # folders made for it, innermost first


def resolve(path: str | os.PathLike[str]) -> Path:
    """Absolute path without links, so that a linked folder is replaced where it really lies."""
    return Path(os.path.realpath(path))


def _hidden(target: Path, kind: str) -> Path:
    # The name of the target enters as a digest: it may already have the longest length allowed.
    key = hashlib.sha256(os.fsencode(target.name)).hexdigest()[:12]
    return target.parent / f".robins-{kind}-{key}-{secrets.token_hex(4)}"


def _leftovers(target: Path, kind: str) -> list[Path]:
    """Hidden folders of this target, latest first."""
    key = _LEFTOVER.fullmatch(_hidden(target, kind).name)
    found: list[tuple[int, Path]] = []
    with suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            match = _LEFTOVER.fullmatch(entry.name)
            if match and key and match.groups() == key.groups():
                with suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        found.append((entry.stat().st_mtime_ns, Path(entry.path)))
    return [path for _, path in sorted(found, reverse=True)]


def _lock(folder: Path) -> ExitStack | None:
    """Lock a folder until the stack is closed; None where the file system cannot.

    Raises:
        BlockingIOError: its writer is alive.
    """
    with ExitStack() as stack:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        stack.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            return None
        return stack.pop_all()


def locate(path: str | os.PathLike[str]) -> Path:
    """Where a result is to be read: the path itself, or its folder set aside by a cut commit."""
    target = resolve(path)
    if os.path.lexists(target):
        return target
    return next(iter(_leftovers(target, "old")), target)


def sweep(target: Path) -> None:
    """Bring back a result that a dead writer had set aside, delete what dead writers left."""
    for kind in ("old", "new"):
        for folder in _leftovers(target, kind):
            try:
                lock = _lock(folder)
            except OSError:
                continue  # alive, or gone meanwhile
            if lock is None:
                continue  # cannot be told from a living writer's: leave it
            with lock, suppress(OSError):
                if kind == "old" and not os.path.lexists(target):
                    os.rename(folder, target)
                else:
                    shutil.rmtree(folder)


def _missing(folder: Path) -> Iterator[Path]:
    while not os.path.lexists(folder):
        yield folder
        folder = folder.parent


def stage(path: str | os.PathLike[str]) -> Stage:
    """Make the hidden folder in which the content of `path` is built.

    Raises:
        OSError: it cannot be made there.
    """
    target = resolve(path)
    parents = tuple(_missing(target.parent))
    existing = parents[-1].parent if parents else target.parent
    # Asked for, because the short name of the hidden folder would not show it before `commit`.
    if len(os.fsencode(target.name)) > os.pathconf(existing, "PC_NAME_MAX"):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(target))
    folder = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        sweep(target)
        while True:
            folder = _hidden(target, "new")
            os.mkdir(folder)
            try:
                return Stage(folder, target, _lock(folder), parents)
            except (BlockingIOError, FileNotFoundError):
                # A sweep by another writer fell between its making and its locking.
                shutil.rmtree(folder, ignore_errors=True)
    except BaseException:
        _remove(folder, parents)
        raise


def _remove(folder: Path | None, parents: tuple[Path, ...]) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    for parent in parents:
        with suppress(OSError):
            os.rmdir(parent)


def discard(staged: Stage) -> None:
    """Delete the hidden folder and the parents made for it; the target stays as it was."""
    _remove(staged.path, staged.parents)
    _unlock(staged)


def commit(staged: Stage) -> None:
    """Sync the hidden folder to the disk and make it the target, in place of what was there.

    Raises:
        OSError: it could not; what was there is there again.
    """
    for root, _, names in os.walk(staged.path):
        for name in names:
            sync(os.path.join(root, name))
        sync(root)
    for attempt in range(_TRIES):
        try:
            _swap(staged)
            break
        except OSError as error:
            # Another writer took the place between our two renames: replace its result.
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST) or attempt == _TRIES - 1:
                raise
    with suppress(OSError):
        sync(staged.target.parent)
    _unlock(staged)


def _unlock(staged: Stage) -> None:
    if staged.lock is not None:
        staged.lock.close()


def _swap(staged: Stage) -> None:
    target, aside = staged.target, _hidden(staged.target, "old")
    with ExitStack() as held:
        try:
            if os.path.lexists(target):
                with suppress(OSError):
                    if lock := _lock(target):
                        held.enter_context(lock)
                with suppress(FileNotFoundError):
                    os.rename(target, aside)
            os.rename(staged.path, target)
        except BaseException:
            # Also for an interrupt: whichever rename it fell between, one whole folder is in place.
            if os.path.lexists(aside) and not os.path.lexists(target):
                os.rename(aside, target)
            raise
        finally:
            if os.path.lexists(target):
                shutil.rmtree(aside, ignore_errors=True)


def sync(path: str | os.PathLike[str]) -> None:
    """Wait until a file or folder is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
