"""Atomic writing of a folder: it appears complete or not at all.

A writer fills a *stage*, a hidden folder next to the target, and `commit` renames it into place.
The result that was there is renamed aside first and deleted last, so at every instant one of the
two is whole on the disk. POSIX has no portable call that exchanges two folders; what a crash
between the two renames leaves behind is found by `locate` and repaired by `sweep`, on the next read
or write.  A living writer holds advisory locks: on a small file next to the target, so that there
is one writer of a result at a time, and on its folders. The kernel drops them with the process,
however that ends, so a file or hidden folder whose lock is free belongs to no writer, and the next
writer removes it. The content of the file is for people only; no code relies on it.

Some network file systems have no locks. Then two writers do not see each other, and the result of
the one that finishes last remains, complete.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

_TRIES = 20  # of a commit against other writers of the same folder, without locks
_LEFTOVER = re.compile(r"\.robins-(new|old)-([0-9a-f]{12})-[0-9a-f]{8}")


class TargetBusyError(BlockingIOError):
    """Another writer holds the target."""


class StagedFolder(NamedTuple):
    """A folder being filled, and where it will go."""

    path: Path
    target: Path
    locks: ExitStack  # closing it releases the target and the folder
    parents: tuple[Path, ...]  # folders made for it, innermost first


def resolve(path: str | os.PathLike[str]) -> Path:
    """Absolute path without links, so that a linked folder is replaced at its real place."""
    return Path(os.path.realpath(path))


def _hidden_name(target: Path, kind: str) -> Path:
    return target.parent / f".robins-{kind}-{_key(target)}-{secrets.token_hex(4)}"


def _key(target: Path) -> str:
    """Digest of the target's name, which may already have the greatest length allowed."""
    return hashlib.sha256(os.fsencode(target.name)).hexdigest()[:12]


def _leftovers(target: Path, kind: str) -> list[Path]:
    """Hidden folders of this target, latest first."""
    key = _LEFTOVER.fullmatch(_hidden_name(target, kind).name)
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
        BlockingIOError: another writer holds the lock.
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


def _claim(target: Path) -> ExitStack:
    """Claim a target as its only writer until the stack is closed.

    Raises:
        TargetBusyError: another writer holds it.
    """
    path = target.parent / f".robins-lock-{_key(target)}"
    while True:
        with ExitStack() as stack:
            # Network file systems lock only files that are open for writing.
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            stack.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                who = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
                raise TargetBusyError(errno.EAGAIN, who or "another process", str(target)) from None
            except OSError:  # file system without locks
                stack.callback(_unlink, path)
                return stack.pop_all()
            if not _is_at(descriptor, path):
                continue  # its last holder removed it between our two calls
            stack.callback(_unlink, path)  # before the lock is released
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
            return stack.pop_all()


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _unlink(path: Path) -> None:
    with suppress(OSError):
        os.unlink(path)


def locate(path: str | os.PathLike[str]) -> Path:
    """Path of a result to read: the path, or the folder set aside by an interrupted commit."""
    target = resolve(path)
    if os.path.lexists(target):
        return target
    return next(iter(_leftovers(target, "old")), target)


def sweep(target: Path) -> None:
    """Restore a result that a dead writer had set aside, and delete leftovers of dead writers."""
    for kind in ("old", "new"):
        for folder in _leftovers(target, kind):
            try:
                lock = _lock(folder)
            except OSError:
                continue  # its writer is alive, or it is gone meanwhile
            if lock is None:
                continue  # cannot be distinguished from a living writer's: leave it
            with lock, suppress(OSError):
                if kind == "old" and not os.path.lexists(target):
                    os.rename(folder, target)
                else:
                    shutil.rmtree(folder)


def _missing(folder: Path) -> Iterator[Path]:
    while not os.path.lexists(folder):
        yield folder
        folder = folder.parent


def stage(path: str | os.PathLike[str]) -> StagedFolder:
    """Make the hidden folder in which the content of `path` is built.

    Raises:
        TargetBusyError: another writer holds the target.
        OSError: it cannot be made there.
    """
    target = resolve(path)
    parents = tuple(_missing(target.parent))
    existing = parents[-1].parent if parents else target.parent
    # Checked now: the hidden folder has a short name, and `commit` would be too late.
    if len(os.fsencode(target.name)) > os.pathconf(existing, "PC_NAME_MAX"):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(target))
    folder, locks = None, ExitStack()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        locks.enter_context(_claim(target))
        sweep(target)
        while True:
            folder = _hidden_name(target, "new")
            os.mkdir(folder)
            try:
                if lock := _lock(folder):
                    locks.enter_context(lock)
                return StagedFolder(folder, target, locks, parents)
            except (BlockingIOError, FileNotFoundError):
                # Another writer swept it away between its making and its locking.
                shutil.rmtree(folder, ignore_errors=True)
    except BaseException:
        _remove(folder, locks, parents)
        raise


def _remove(folder: Path | None, locks: ExitStack, parents: tuple[Path, ...]) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    locks.close()
    for parent in parents:
        with suppress(OSError):
            os.rmdir(parent)


def discard(staged: StagedFolder) -> None:
    """Delete the hidden folder and the parents made for it; the target stays as it was."""
    _remove(staged.path, staged.locks, staged.parents)


def commit(staged: StagedFolder) -> None:
    """Sync the hidden folder to the disk and rename it to the target, replacing an earlier one.

    The target is released by `discard`, which then has nothing to delete.

    Raises:
        OSError: it failed; the earlier target is in place again.
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
            # Another writer put its result there between our two renames: replace it.
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST) or attempt == _TRIES - 1:
                raise
    with suppress(OSError):
        sync(staged.target.parent)


def _swap(staged: StagedFolder) -> None:
    target, aside = staged.target, _hidden_name(staged.target, "old")
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
            # Also for an interrupt: wherever it came, one complete folder is in place.
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
