"""What a filter is given of a run: its kind is compiled, its numbers are data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jax.tree_util import Partial


def recipe(function: Callable[..., Any], *kinds: Any, numbers: Any) -> Partial:
    """``function(*kinds, numbers, world)`` as a function of the world alone.

    Kinds (names, flags, None) choose what is compiled; numbers are data. Recipes of one function
    and equal kinds share what was compiled (`robins.filters.sameness`).
    """

    def of_kind(numbers: Any, world: Any) -> Any:
        return function(*kinds, numbers, world)

    return Partial(of_kind, numbers)
