"""Public names that moved: one table, and the module `__getattr__` (PEP 562) that reads it.

A name that is given up for another one has a row here, and its package the line
``__getattr__ = moved(__name__)``: code that uses it goes on, with a `DeprecationWarning`.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from types import FunctionType

# By package, what it had: the package that has it now, and its name there.
MOVED: dict[str, dict[str, tuple[str, str]]] = {
    "robins.linalg": {"steady_state": ("robins.filters", "steady_kalman")},
    "robins.filters": {
        "constrain": ("robins.filters.limits", "constrain"),
        "clip": ("robins.filters.limits", "clip"),
        "truncate": ("robins.filters.limits", "truncate"),
        "information_sum": ("robins.filters", "fuse"),
    },
    "robins.systems.marg": {
        "marg_filter": ("robins.systems.marg.replay", "marg_filter"),
        "causal_attitudes": ("robins.systems.marg.model", "causal_attitudes"),
        "smoothed_attitudes": ("robins.systems.marg.model", "smoothed_attitudes"),
    },
}


def moved(package: str) -> Callable[[str], FunctionType]:
    """The `__getattr__` of a package, for its names in `MOVED`.

    Args:
        package: its ``__name__``.
    """

    def attribute(name: str) -> FunctionType:
        if name not in MOVED[package]:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        place, now = MOVED[package][name]
        warnings.warn(f"{package}.{name} is now {place}.{now}", DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(place), now)

    return attribute
