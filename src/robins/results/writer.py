"""Writer of results: fills a hidden folder, which is renamed into place when it is complete."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from time import monotonic, sleep

import xarray as xr

from robins.results import folder, manifest, solution, summary
from robins.results.errors import ResultError, result_error
from robins.results.summary import Json

SOLUTION, SUMMARY, REPORT, FIGURES = "solution.nc", "summary.json", "report.html", "figures"
_POLL_S = 0.2
_OF_THE_DESKTOP = {".DS_Store", "Thumbs.db", "desktop.ini"}  # files that the desktop creates


class ResultWriter:
    """A result being written; use it as a context manager.

    Leaving the context normally makes the result appear under its name, in place of an earlier one;
    leaving it by an exception, Ctrl-C included, leaves the earlier one and nothing else.

        with ResultWriter("results/walk", scenario_text=text) as writer:
            writer.save_solution(dataset)
            writer.save_summary(summary)

    Args:
        path: the folder; missing parents are made. A folder that robins did not write, or that
            another writer holds, is refused at once, before anything is computed.
        scenario_text: the scenario as it was read, with the changes of the command line.
        device: that computed it, e.g. "cpu" or the name of an accelerator.
        command: the command line or call that reproduces the result.
        timeout_s: time to wait for another writer of the folder before it is refused.

    Raises:
        ResultError: the path cannot or must not be written to; also from every method.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        scenario_text: str = "",
        device: str = "cpu",
        command: str = "",
        timeout_s: float = 0.0,
    ):
        self.path = Path(path)
        self.scenario_text, self.device, self.command = scenario_text, device, command
        self.summary: dict[str, Json] | None = None
        self.solution: xr.Dataset | None = None
        self._began = monotonic()
        self._moved: list[Path] = []
        if not timeout_s:  # else another writer may be replacing it; `commit` checks
            _check_replaceable(self.path)
        self._stage = _staged(self.path, timeout_s)

    def save_solution(self, dataset: xr.Dataset) -> None:
        """Store the time series as `solution.nc`; `robins.results` lists what it holds.

        Raises:
            ValueError: an array lacks its units, name or frame.
        """
        solution.check(dataset)
        self._write(SOLUTION, solution.pack(dataset))
        self.solution = dataset

    def save_summary(self, values: Mapping[str, Json]) -> None:
        """Set the contents of `summary.json`; `files` is filled in, `seconds` if it is not given.

        Raises:
            TypeError, ValueError: a documented key is missing or wrong, or there are others.
        """
        self.summary = summary.checked({"seconds": self.seconds} | dict(values))

    @property
    def seconds(self) -> float:
        """Time since the writer was made."""
        return round(monotonic() - self._began, 3)

    def save_report(self, html: str) -> None:
        """Store the page as `report.html`."""
        self.save_file(REPORT, html.encode())

    def save_file(self, name: str, content: bytes | Path) -> None:
        """Store any other file, e.g. the trajectory in another program's format.

        Args:
            name: inside the folder.
            content: of the file; or the path of a file to move in, kept until the result is done.

        Raises:
            ValueError: the name leads out of the folder or is reserved.
        """
        parts = PurePosixPath(name).parts
        if not parts or PurePosixPath(name).is_absolute() or ".." in parts:
            raise ValueError(f"{name!r} does not lie inside a result folder")
        if name in (SOLUTION, SUMMARY, manifest.NAME):
            raise ValueError(f"{name} is written by robins itself")
        if isinstance(content, Path):
            self._moved.append(content)
        self._write(name, content)

    def _write(self, name: str, content: bytes | Path) -> None:
        path = self._stage.path / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Path):
                shutil.copyfile(content, path)  # piece by piece: a record may be larger than memory
            else:
                path.write_bytes(content)
        except OSError as error:
            raise result_error(self.path, f"write {name}", error) from error

    def commit(self) -> Path:
        """Put the result in place; the last call.

        Raises:
            ResultError: no summary was saved, or the disk failed; the earlier result is in place.
        """
        if self.summary is None:
            raise ResultError(self.path, "has no summary", "call save_summary before the commit")
        self.summary["files"] = self._files()
        self._write(SUMMARY, summary.dumps(self.summary).encode())
        made = manifest.make(
            self._stage.path,
            scenario=self.summary["scenario"],
            scenario_text=self.scenario_text,
            seed=self.summary["seed"],
            device=self.device,
            command=self.command,
        )
        self._write(manifest.NAME, summary.dumps(made).encode())
        _check_replaceable(self.path)
        try:
            folder.commit(self._stage)
        except OSError as error:
            raise result_error(self.path, "put the result in its place", error) from error
        for path in self._moved:
            path.unlink(missing_ok=True)
        self.discard()
        return self.path

    def _files(self) -> dict[str, Json]:
        """Files of the folder, by kind, as paths inside it."""
        here = self._stage.path
        names = sorted(p.relative_to(here).as_posix() for p in here.rglob("*") if p.is_file())
        own = {"solution": SOLUTION, "report": REPORT}
        files: dict[str, Json] = {"summary": SUMMARY, "manifest": manifest.NAME}
        files |= {kind: name for kind, name in own.items() if name in names}
        files["figures"] = [name for name in names if name.startswith(f"{FIGURES}/")]
        known = {SUMMARY, manifest.NAME, *own.values(), *files["figures"]}
        files["other"] = [name for name in names if name not in known]
        return files

    def discard(self) -> None:
        """Remove what was written so far; the earlier result stays as it was."""
        folder.discard(self._stage)

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            if error is None:
                self.commit()
        finally:
            self.discard()  # nothing is left to do after a commit


def _staged(path: Path, timeout_s: float) -> folder.StagedFolder:
    """Stage a result once no other writer holds its folder.

    Raises:
        ResultError: another writer still holds it after that time, or it cannot be made.
    """
    until = monotonic() + timeout_s
    while True:
        try:
            return folder.stage(path)
        except folder.TargetBusyError as busy:
            if monotonic() >= until:
                raise ResultError(
                    path,
                    f"is being written by {busy.strerror}",
                    "wait for it to end, or choose another folder (--out)",
                ) from None
            sleep(_POLL_S)
        except OSError as error:
            raise result_error(path, "make the result folder", error) from error


def _check_replaceable(path: Path) -> None:
    """Refuse to replace a folder that robins did not write."""
    target = folder.resolve(path)
    elsewhere = "choose a new folder"
    with suppress(FileNotFoundError):
        if target == Path.cwd():
            raise ResultError(path, "is the folder you are in", "choose a folder inside it")
        if target in Path.cwd().parents:
            raise ResultError(path, "holds the folder you are in", elsewhere)
    if not os.path.lexists(target):
        return
    if not target.is_dir():
        raise ResultError(path, "is a file, not a folder", elsewhere)
    if os.path.ismount(target):
        raise ResultError(path, "is a mount point", "choose a folder inside it")
    try:
        held = {p.relative_to(target).as_posix() for p in target.rglob("*") if not p.is_dir()}
        if not any(target.iterdir()):
            return
    except OSError as error:
        raise result_error(path, "look into the folder", error) from error
    if manifest.NAME not in held:
        raise ResultError(path, "holds files that are not a result of robins", elsewhere)
    listed = manifest.listed(target)
    if listed is None:
        raise ResultError(path, f"its {manifest.NAME} is not one of robins", elsewhere)
    foreign = {name for name in held if PurePosixPath(name).name not in _OF_THE_DESKTOP}
    if foreign := sorted(foreign - listed):
        raise ResultError(
            path,
            f"holds {foreign[0]!r}, which robins did not write, and replacing would delete it",
            "move that file away or choose a new folder",
        )
