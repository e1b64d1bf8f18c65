"""Store of a campaign's results: objects that are put once and read by any worker.

An object appears whole or not at all, and the first one under a name stays. So workers need no
coordination: if two compute the same object, the second copy is dropped.
"""

from __future__ import annotations

import errno
import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import time

from robins.errors import RobinsError
from robins.foreign import decoding
from robins.results.folder import sync

_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS}
_NO_FOLDER = {errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP}  # of the name given
GOES_ON = "the same command goes on."
_PARTIAL = ".partial"  # what is being written
_OLD_S = 3600.0  # what is older was left by a writer that died


class FolderStore:
    """Objects as files of a folder: written under another name, synced, linked into place.

    A slash in the name of an object separates its group from the rest.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self.where = str(path)

    def put(self, name: str, content: bytes, *, overwrite: bool = False) -> bool:
        """Store an object atomically unless it exists; True if it was stored.

        Args:
            name: of the object.
            content: all of it.
            overwrite: take the place of what is there.

        Raises:
            RobinsError: the disk is full, or it cannot be written.
        """
        target = self.path / name
        if not overwrite and target.exists():
            return False
        partial = self.path / _PARTIAL / f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex}"
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            partial.parent.mkdir(exist_ok=True)
            try:
                with open(partial, "wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                if overwrite:
                    os.replace(partial, target)
                placed = overwrite or _link(partial, target)
                sync(target.parent)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as error:
            raise self._cannot(f"write {name}", error) from error
        return placed

    def get(self, name: str) -> bytes | None:
        """Content of an object; None if it does not exist."""
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._cannot(f"read {name}", error) from error

    def names(self, group: str) -> set[str]:
        """Names of the objects of a group, without the group."""
        try:
            return {entry.name for entry in os.scandir(self.path / group)}
        except FileNotFoundError:
            return set()
        except OSError as error:
            raise self._cannot(f"list {group}", error) from error

    def drop(self, name: str) -> None:
        """Remove an object if it exists."""
        (self.path / name).unlink(missing_ok=True)

    def sweep(self) -> None:
        """Remove incomplete files left by writers that died."""
        for left in self.names(_PARTIAL):
            path = self.path / _PARTIAL / left
            with suppress(OSError):
                if time() - path.stat().st_mtime > _OLD_S:
                    path.unlink()

    def _cannot(self, what: str, error: OSError) -> RobinsError:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        fix = "make room" if full else "make the folder readable and writable"
        fix = f"{fix}; what is there is whole, and {GOES_ON}"
        given = error.errno in _NO_FOLDER
        return RobinsError(
            f"cannot {what}: {error.strerror or error}",
            self.where,
            "name the folder of a campaign, or a new one." if given else fix,
            bad_input=given,
        )


def _link(partial: Path, target: Path) -> bool:
    """Link a complete file to its name unless the name is taken."""
    try:
        os.link(partial, target)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        os.replace(partial, target)  # an object that is there has the same content
    return True


class ObjectStore:
    """Objects in S3-compatible, Azure or Google storage, by `obstore` (extra ``objects``)."""

    def __init__(self, url: str):
        try:
            import obstore
        except ModuleNotFoundError:
            raise RobinsError(
                "object storage needs the extra 'objects'", url, "pip install 'robins[objects]'."
            ) from None
        self.where, self._obstore = url, obstore
        fix = "check address and rights."
        with decoding(lambda why: RobinsError(f"cannot be opened: {why}", url, fix)):
            self._store = obstore.store.from_url(url)

    def put(self, name: str, content: bytes, *, overwrite: bool = False) -> bool:
        """Put an object; see `FolderStore`."""
        mode = "overwrite" if overwrite else "create"
        taken = self._obstore.exceptions.AlreadyExistsError
        with suppress(taken), self._named_errors(f"write {name}"):
            self._obstore.put(self._store, name, content, mode=mode)
            return True
        return False

    def get(self, name: str) -> bytes | None:
        """Read an object; see `FolderStore`."""
        with suppress(FileNotFoundError), self._named_errors(f"read {name}"):
            return bytes(self._obstore.get(self._store, name).bytes())
        return None

    def names(self, group: str) -> set[str]:
        """List a group; see `FolderStore`."""
        with self._named_errors(f"list {group}"):
            found = (one for some in self._obstore.list(self._store, group) for one in some)
            return {one["path"].removeprefix(f"{group}/") for one in found}

    def drop(self, name: str) -> None:
        """Remove an object; see `FolderStore`."""
        with suppress(FileNotFoundError), self._named_errors(f"remove {name}"):
            self._obstore.delete(self._store, name)

    def sweep(self) -> None:
        """Do nothing: object storage never shows half-written objects."""

    @contextmanager
    def _named_errors(self, what: str) -> Iterator[None]:
        """Turn errors of the storage into a `RobinsError` with the failed action, unless an object
        exists or is missing.
        """
        errors = self._obstore.exceptions
        try:
            yield
        except (FileNotFoundError, errors.AlreadyExistsError):
            raise
        except errors.BaseError as error:
            first = (str(error).strip().splitlines() or [""])[0]
            fix = "check address and rights."
            raise RobinsError(
                f"cannot {what}: {first}", self.where, fix, bad_input=False
            ) from error


Store = FolderStore | ObjectStore


def open_store(where: str | os.PathLike[str]) -> Store:
    """A folder, or for an address such as ``s3://bucket/campaign`` object storage.

    Raises:
        RobinsError: the storage cannot be opened, or the package for it is missing.
    """
    return ObjectStore(str(where)) if "://" in str(where) else FolderStore(where)
