"""Errors of writing and reading results."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from robins.errors import RobinsError

_FIXES = {
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some of your quota or write elsewhere",
    errno.EFBIG: "raise the file size limit (`ulimit -f`) or write elsewhere",
    errno.EACCES: "choose a folder you may write to",
    errno.EPERM: "choose a folder you may write to",
    errno.EROFS: "choose a folder you may write to",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOTDIR: "choose a path whose parents are folders",
    errno.EEXIST: "choose a path whose parents are folders",
}


class ResultError(RobinsError):
    """A result folder was refused, or could not be read or written.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: str | os.PathLike[str], what: str, fix: str):
        self.path = Path(path)
        super().__init__(what, self.path, fix)


def result_error(path: str | os.PathLike[str], doing: str, error: Exception) -> ResultError:
    """The `ResultError` for a failure of the file system or of a library that writes files."""
    code = error.errno if isinstance(error, OSError) else None
    why = (error.strerror if isinstance(error, OSError) else None) or str(error)
    fix = _FIXES.get(code, "check the disk and the permissions") if code else "check the disk"
    made = ResultError(path, f"cannot {doing}: {why or type(error).__name__}", fix)
    made.bad_input = not isinstance(error, OSError)
    return made
