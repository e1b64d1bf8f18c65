"""Reader of results: a result is complete and unchanged, or refused with the reason."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import xarray as xr

from robins.foreign import decoding
from robins.results import dataframe, folder, manifest, solution, summary
from robins.results.errors import ResultError, result_error
from robins.results.summary import Json


class Result(NamedTuple):
    """A result read back."""

    path: Path
    manifest: dict[str, Json]
    summary: dict[str, Json]
    solution: xr.Dataset | None  # None for a result without time series

    @property
    def figures(self) -> dict[str, Path]:
        """Pictures by name."""
        return {Path(name).stem: self.path / name for name in self.summary["files"]["figures"]}

    @property
    def report(self) -> Path | None:
        """The page, if there is one."""
        name = self.summary["files"].get("report")
        return self.path / name if name else None

    def to_dataframe(
        self, filter: str | None = None, clock: str = "time", *, si: bool = False
    ) -> pd.DataFrame:
        """The time series on one clock as a table; see `robins.results.to_dataframe`.

        Raises:
            ResultError: the result has no time series.
            ValueError: there is no such filter or clock.
        """
        if self.solution is None:
            raise ResultError(self.path, "has no time series", "name the result of a run")
        return dataframe.to_dataframe(self.solution, filter, clock, si=si)


def read(path: str | os.PathLike[str]) -> Result:
    """Read a result folder and verify every file in it.

    Files in the folder that the manifest does not list are ignored.

    Raises:
        ResultError: there is no result, it is incomplete or damaged, or of an unknown version.
    """
    where = folder.locate(path)
    if not where.exists():
        raise ResultError(path, "does not exist", "name a folder robins wrote")
    if not where.is_dir():
        raise ResultError(path, "is not a folder", "name a folder robins wrote")
    made = manifest.load(where, path)
    manifest.verify(where, made, path)
    try:
        text = (where / "summary.json").read_bytes()
        dataset = solution.read(where / "solution.nc") if "solution.nc" in made["files"] else None
    except OSError as error:
        raise result_error(path, "read the result", error) from error
    shown = Path(path) if where == folder.resolve(path) else where
    damaged = "summary.json is damaged"
    with decoding(lambda why: ResultError(path, f"{damaged} ({why})", "make the result again")):
        content = summary.loads(text)
    if not isinstance(content, dict) or not isinstance(content.get("files"), dict):
        raise ResultError(path, f"{damaged}: it lists no files", "make the result again")
    return Result(shown, made, content, dataset)
