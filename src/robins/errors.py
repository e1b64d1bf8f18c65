"""Errors of robins when it cannot use its input, or cannot fulfil a request."""

from __future__ import annotations

import difflib
import importlib
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

T = TypeVar("T")


class RobinsError(Exception):
    """Base class of all errors of robins: one sentence, ``where: what; fix``.

    Most are also a ValueError, for callers that catch those.

    Attributes:
        what: what is wrong.
        where: file and line, folder, option or part; empty where `what` names it.
        fix: what to do about it; empty where `what` contains it.
        bad_input: true if the input is wrong; false if the operation failed, as on a full disk.
    """

    bad_input: bool = True

    def __init__(
        self, what: str, where: object = "", fix: str = "", *, bad_input: bool | None = None
    ):
        self.what, self.where, self.fix = what, str(where), fix
        if bad_input is not None:  # else as the class has it
            self.bad_input = bad_input
        super().__init__(str(self))

    def __str__(self) -> str:
        sentence = f"{self.where}: {self.what}" if self.where else self.what
        return f"{sentence.removesuffix('.')}; {self.fix}" if self.fix else sentence


_NOTHING = object()


def require(holds: object, sentence: str, got: object = _NOTHING) -> None:
    """Refuse an argument unless a condition holds: ``sentence, got ...``, if `got` is given.

    Raises:
        ValueError: the condition does not hold.
    """
    if not holds:
        raise ValueError(sentence if got is _NOTHING else f"{sentence}, got {got}")


def require_kind(given: T, kinds: type | tuple[type, ...], whose: str, fix: str = "") -> None:
    """Refuse an argument that is not of one of the given types.

    Raises:
        TypeError: ``whose takes a Dataset, got an ImuTable; fix``.
    """
    if not isinstance(given, kinds):
        known = [k.__name__ for k in (kinds if isinstance(kinds, tuple) else (kinds,))]
        among = " or ".join([", ".join(known[:-1]), known[-1]] if known[1:] else known)
        sentence = f"{whose} takes {among}, got {type(given).__name__}"
        raise TypeError(f"{sentence}; {fix}" if fix else sentence)


def hint(word: str, among: Iterable[str]) -> str:
    """End of a sentence about an unknown word: the nearest known one, if any."""
    near = difflib.get_close_matches(word, list(among), 1)
    return f"; did you mean '{near[0]}'?" if near else "."


def require_known(kind: str, name: str, among: Iterable[str], where: str = "this study") -> None:
    """Refuse an unknown name.

    Raises:
        ValueError: the name is unknown; the message names the nearest known one, and all.
    """
    known = list(among)
    require(
        name in known,
        f"no {kind} '{name}' in {where}{hint(name, known)} It has {', '.join(known)}",
    )


# ----------------------------------------------------------------------------- names that moved

# By package, its former names: the package that has each now, its name there, and the first
# release with it there, if that is not `FIRST`.
MOVED: dict[str, dict[str, tuple[str, ...]]] = {
    "robins.linalg": {"steady_state": ("robins.filters", "steady_kalman")},
    "robins.filters": {
        "Closed": ("robins.filters", "ClosedLoopRun"),
        "Family": ("robins.filters", "ModeFamily"),
        "Late": ("robins.filters", "DelayedMeasurement"),
        "constrain": ("robins.filters.limits", "constrain"),
        "information_sum": ("robins.filters", "fuse"),
    },
    "robins.filters.analysis": {"worded": ("robins.filters.analysis", "direction_in_words")},
    "robins.bench.rig": {
        old: ("robins.bench.evaluation", name)
        for old, name in (
            *(("Alarms", "Alarms"), ("Offer", "Offer"), ("Judged", "RunFigures")),
            *(("Spoken", "OperatorEvent"), ("Told", "Alert"), ("View", "PageView")),
        )
    },
    "robins.systems.marg": {
        "first_look": ("robins.systems.marg", "initial_alignment"),
        "Replay": ("robins.systems.marg", "MargReplay"),
        "marg_filter": ("robins.systems.marg.filters", "marg_filter"),
        "causal_attitudes": ("robins.systems.marg.model", "causal_attitudes"),
        "smoothed_attitudes": ("robins.systems.marg.model", "smoothed_attitudes"),
    },
    "robins.systems.gnss": {"Replay": ("robins.systems.gnss", "GnssReplay")},
    "robins.systems.ins_gnss": {"Replay": ("robins.systems.ins_gnss", "InsGnssReplay")},
    "robins.cli": {"Status": ("robins.cli", "ExitStatus")},
    "robins.bench.ports": {"Line": ("robins.bench.ports", "SerialLine")},
    "robins.bench.live": {"Live": ("robins.bench.live", "LivePage")},
    "robins.sim": {"Motion": ("robins.sim", "MotionProfile")},
    "robins.bench.broker": {
        "Table": ("robins.bench.broker", "FaultTable"),
        "Said": ("robins.bench.broker", "DeviceFault"),
        "Piece": ("robins.bench.broker", "LineOutput"),
    },
    "robins.bench": {
        "Judged": ("robins.bench", "RunFigures"),
        "View": ("robins.bench", "PageView"),
    },
    "robins.bench.run": {"Ran": ("robins.bench.run", "RunResult")},
    "robins.report": {"Origin": ("robins.report", "ReportOrigin")},
    "robins.results": {
        "keeping": ("robins.results", "keep_on_error"),
        "silent": ("robins.results", "ignore_progress"),
    },
}


FIRST = "0.2"
KEPT = 2  # minor releases in which an old name keeps working


def _minor(release: str) -> tuple[int, int]:
    """First two numbers of a release; 0 for one that is missing."""
    major, minor, *_ = *map(int, re.findall(r"\d+", release)), 0, 0
    return major, minor


def moved(package: str) -> Callable[[str], Callable]:
    """Make the `__getattr__` of a package (PEP 562), for its names in `MOVED`.

    Such a name keeps working for `KEPT` minor releases, with a `DeprecationWarning` that states the
    new place; after them, and for any other name, an `AttributeError` is raised.

    Args:
        package: its ``__name__``.
    """

    def attribute(name: str) -> Callable:
        here = sys.modules[package]
        if name not in (rows := MOVED.get(package, {})):
            near = hint(name, [*vars(here).get("__all__", ()), *rows]).rstrip(".")
            raise AttributeError(f"module {package!r} has no attribute {name!r}{near}")
        place, now, *since = rows[name]
        sentence = f"{package}.{name} is now {place}.{now}"
        major, minor = _minor(since[0] if since else FIRST)
        if _minor(sys.modules["robins"].__version__) >= (major, minor + KEPT):
            raise AttributeError(sentence)
        last = f"the old name works before robins {major}.{minor + KEPT}"
        warnings.warn(f"{sentence}; {last}", DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(place), now)

    return attribute


def lazy(package: str, places: Mapping[str, str]) -> Callable:
    """Make the `__getattr__` of a package whose names are imported when they are first used.

    Args:
        package: its ``__name__``.
        places: by name "module:attribute", or "module" where the attribute has the same name;
            other names are treated as `moved` does.
    """
    other = moved(package)

    def attribute(name: str):
        if name not in places:
            return other(name)
        module, _, own = places[name].partition(":")
        found = getattr(importlib.import_module(module), own or name)
        setattr(sys.modules[package], name, found)
        return found

    return attribute


def places(package: str, files: Mapping[str, str]) -> dict[str, str]:
    """Places for `lazy`, of the names that each file of a package defines, with blanks between."""
    return {name: f"{package}.{file}" for file, names in files.items() for name in names.split()}
