"""A folder that appears whole or not at all.

A writer fills a *stage*, a hidden folder next to the target, and `commit` renames it into place.
The result that was there is renamed aside first and deleted last, so at every instant one of the
two is whole on the disk. POSIX has no portable call that exchanges two folders; what a crash
between the two renames leaves behind is found by `locate` and repaired by `sweep`, on the next read
or write.  A living writer holds advisory locks: on a small file next to the target, so that there
is one writer of a result at a time, and on its folders. The kernel drops them with the process,
however that ends, so a file or hidden folder whose lock is free belongs to no writer, and the next
writer removes it. The content of the file is for people, nothing trusts it.

A file system may know no locks (some network ones). Then two writers do not see each other, and the
result of the one that is done last stands, whole.
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

_TRIES = 20  # of a commit, against other writers of the same folder, where there are no locks
_LEFTOVER = re.compile(r"\.robins-(new|old)-([0-9a-f]{12})-[0-9a-f]{8}")


class TargetBusyError(BlockingIOError):
    """Another writer has the target."""


class StagedFolder(NamedTuple):
    """A folder being filled, and where it will go."""

    path: Path
    target: Path
    locks: ExitStack  # closing it lets the target go, and the folder
    parents: tuple[Path, ...]  # folders made for it, innermost first


def resolve(path: str | os.PathLike[str]) -> Path:
    """Absolute path without links, so that a linked folder is replaced where it really lies."""
    return Path(os.path.realpath(path))


def _hidden(target: Path, kind: str) -> Path:
    return target.parent / f".robins-{kind}-{_key(target)}-{secrets.token_hex(4)}"


def _key(target: Path) -> str:
    """The name of the target as a digest: it may already have the longest length allowed."""
    return hashlib.sha256(os.fsencode(target.name)).hexdigest()[:12]


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


def _claim(target: Path) -> ExitStack:
    """Claim a target as its only writer until the stack is closed.

    Raises:
        TargetBusyError: another one is.
    """
    path = target.parent / f".robins-lock-{_key(target)}"
    while True:
        with ExitStack() as stack:
            # Network file systems lock only what is open for writing.
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            stack.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                who = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
                raise TargetBusyError(errno.EAGAIN, who or "another process", str(target)) from None
            except OSError:  # no locks here
                stack.callback(_unlink, path)
                return stack.pop_all()
            if not _is_at(descriptor, path):
                continue  # its last holder removed it between our two calls
            stack.callback(_unlink, path)  # before it is let go
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
    """Path of a result to read: the path itself, or its folder set aside by a cut commit."""
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
        TargetBusyError: another writer builds one.
        OSError: it cannot be made there.
    """
    target = resolve(path)
    parents = tuple(_missing(target.parent))
    existing = parents[-1].parent if parents else target.parent
    # Checked, because the short name of the hidden folder would not show it before `commit`.
    if len(os.fsencode(target.name)) > os.pathconf(existing, "PC_NAME_MAX"):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(target))
    folder, locks = None, ExitStack()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        locks.enter_context(_claim(target))
        sweep(target)
        while True:
            folder = _hidden(target, "new")
            os.mkdir(folder)
            try:
                if lock := _lock(folder):
                    locks.enter_context(lock)
                return StagedFolder(folder, target, locks, parents)
            except (BlockingIOError, FileNotFoundError):
                # A sweep by another writer fell between its making and its locking.
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
    """Sync the hidden folder to the disk and make it the target, in place of what was there.

    The target is let go by `discard`, which then has nothing to delete.

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


def _swap(staged: StagedFolder) -> None:
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
