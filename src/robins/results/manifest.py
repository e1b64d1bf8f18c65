"""`manifest.json`: the origin of a result, and the checksums that show it is whole."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

from robins import __version__
from robins.foreign import decoding
from robins.results.errors import ResultError, result_error
from robins.results.summary import Json, dumps, loads, plain

SCHEMA_VERSION = 1
NAME = "manifest.json"

_PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "xarray", "h5netcdf", "matplotlib")
_REMAKE = "make the result again"


def digest(path: Path) -> dict[str, Json]:
    """Size and SHA-256 of a file."""
    with open(path, "rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
        return {"sha256": found, "size": os.fstat(file.fileno()).st_size}


def _seal(manifest: Mapping[str, Json]) -> str:
    """Checksum of the manifest itself, so that even a flipped bit in a seed is detected."""
    rest = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(dumps(rest).encode()).hexdigest()


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    found = [("robins", __version__), ("python", platform.python_version())]
    for name in _PACKAGES:
        try:
            found.append((name, metadata.version(name)))
        except metadata.PackageNotFoundError:
            continue
    return tuple(found)


def versions() -> dict[str, str]:
    """Versions of robins, Python and the packages the numbers depend on, as far as installed."""
    return dict(_versions())


def make(
    folder: Path, *, scenario: str, scenario_text: str, seed: int, device: str, command: str
) -> dict[str, Json]:
    """Manifest of all files in a folder."""
    files = {
        path.relative_to(folder).as_posix(): digest(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    scenario_text = plain(scenario_text)
    manifest = {
        "schema": SCHEMA_VERSION,
        "scenario": {
            "name": scenario,
            "text": scenario_text,
            "sha256": hashlib.sha256(scenario_text.encode()).hexdigest(),
        },
        "seed": seed,
        "command": plain(command),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "platform": platform.platform(),
        "device": plain(device),
        "files": files,
        "complete": True,
    }
    return manifest | {"sha256": _seal(manifest)}


def load(folder: Path, shown: str | os.PathLike[str]) -> dict[str, Json]:
    """Read a manifest and check that it is complete and of a known version.

    Raises:
        ResultError: it is not; the message names the path `shown`.
    """
    try:
        text = (folder / NAME).read_bytes()
    except FileNotFoundError:
        raise ResultError(
            shown, f"is not a result of robins: it has no {NAME}", "name a folder robins wrote"
        ) from None
    except OSError as error:
        raise result_error(shown, f"read {NAME}", error) from error
    with decoding(lambda why: ResultError(shown, f"{NAME} is damaged ({why})", _REMAKE)):
        manifest = loads(text)
    if not isinstance(manifest, dict) or not isinstance(manifest.get("schema"), int):
        raise ResultError(shown, f"{NAME} is not one of robins", "name a folder robins wrote")
    if manifest["schema"] != SCHEMA_VERSION:
        raise ResultError(
            shown,
            f"has schema version {manifest['schema']}, this robins reads {SCHEMA_VERSION}",
            "read it with the version of robins that wrote it",
        )
    # Compared as text too: the loss of the last line break alone is still damage.
    if manifest.get("sha256") != _seal(manifest) or text != dumps(manifest).encode():
        raise ResultError(shown, f"{NAME} is damaged: its checksum does not fit", _REMAKE)
    if manifest.get("complete") is not True:
        raise ResultError(shown, "is not complete", _REMAKE)
    files = manifest.get("files")
    listed = files.values() if isinstance(files, dict) else [None]
    if not all(isinstance(one, dict) and {"size", "sha256"} <= set(one) for one in listed):
        raise ResultError(shown, f"{NAME} is damaged: it lists no files", _REMAKE)
    return manifest


def listed(folder: Path) -> set[str] | None:
    """Names of the files of a result, even of a damaged one; None for something else's folder."""
    try:
        manifest = loads((folder / NAME).read_bytes())
    except (OSError, ValueError):
        return None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("schema"), int):
        return None
    files = manifest.get("files")
    return {NAME, *files} if isinstance(files, dict) else None


def verify(folder: Path, manifest: Mapping[str, Json], shown: str | os.PathLike[str]) -> None:
    """Compare every file with its checksum.

    Raises:
        ResultError: a file is missing, cut or changed.
    """
    for name, expected in manifest["files"].items():
        try:
            found = digest(folder / name)
        except FileNotFoundError:
            raise ResultError(shown, f"{name} is missing", _REMAKE) from None
        except OSError as error:
            raise result_error(shown, f"read {name}", error) from error
        if found["size"] != expected["size"]:
            sizes = f"{found['size']} bytes instead of {expected['size']}"
            raise ResultError(shown, f"{name} is damaged: it has {sizes}", _REMAKE)
        if found["sha256"] != expected["sha256"]:
            raise ResultError(shown, f"{name} is damaged: its checksum does not fit", _REMAKE)
