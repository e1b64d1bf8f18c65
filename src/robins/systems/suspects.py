"""Instruments, or motion, at fault according to a bank of hypotheses: times and probabilities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, ArrayLike

from robins.filters import Filter
from robins.filters.kalman import WRONG
from robins.results import array
from robins.systems.tables import SensorUpdates

HELD = 0.5  # probability of being wrong above which a suspect raises an alarm
SURE = 0.9  # probability below which it is only suspected
_SHOWN = 4  # most spans listed in a sentence

Wrong = Mapping[str, ArrayLike]
"""Probability that each suspect is at fault, by name; leading axis E epochs."""


def probabilities(filter_: Filter, updates: Mapping[str, SensorUpdates]) -> dict[str, Array]:
    """Probability of each suspect of a filter after its last update of each step.

    Args:
        filter_: with `Filter.suspects`.
        updates: by sensor, with their notes; any leading axes.
    """
    notes = [update.notes for update in updates.values()][-1:]
    return {
        name: jnp.asarray(noted[WRONG])[..., i]
        for noted in notes
        for i, name in enumerate(filter_.suspects)
    }


def spans(time_s: np.ndarray, which: np.ndarray) -> list[tuple[float, float]]:
    """First and last time of each run of consecutive true epochs.

    Args:
        time_s: (E,).
        which: (E,) bool.
    """
    return [(float(time_s[a]), float(time_s[b - 1])) for a, b in edges(which)]


def edges(which: np.ndarray) -> list[tuple[int, int]]:
    """First index, and one past the last, of each run of consecutive true epochs."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in change.reshape(-1, 2)]


def probability_array(
    role: str, found: Sequence[Wrong], runs: int | None = None
) -> dict[str, xr.Variable]:
    """Array of probabilities (filter, time, suspect); empty if no filter has a suspect.

    Args:
        role: "wrong" or "mean_wrong".
        found: of each filter, in order; a suspect that a filter lacks gives NaN.
        runs: number of runs that "mean_wrong" averages.
    """
    names = list(dict.fromkeys(name for of in found for name in of))
    if not names:
        return {}
    blank = np.full(np.shape(next(iter(of[names[0]] for of in found if names[0] in of))), np.nan)
    rows = [[np.asarray(of.get(name, blank), float) for name in names] for of in found]
    values = np.moveaxis(np.array(rows), 1, 2)
    if runs is None:
        return array(role, values, axes=names)
    return array(role, values, axes=names, runs=runs)


def sentences(name: str, time_s: np.ndarray, wrong: Wrong) -> list[str]:
    """Sentences on the faults that a filter finds in one run; none for a filter without suspects.

    Args:
        name: of the filter.
        time_s: (E,).
        wrong: its probabilities; NaN between the pieces of a log.
    """
    sentences = []
    for suspect, chance in wrong.items():
        chance = np.asarray(chance, float)
        held = [(a, b) for a, b in edges(chance > HELD) if not _begins_unsure(chance, a, b)]
        if held:
            found = [(float(time_s[a]), float(time_s[b - 1])) for a, b in held]
            most = max(float(np.max(chance[a:b])) for a, b in held)
            verb = f"finds {words(suspect)} wrong" if most >= SURE else f"suspects {words(suspect)}"
            longest = sorted(sorted(found, key=lambda one: one[0] - one[1])[:_SHOWN])
            shown = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in longest)
            more = f" and {len(found) - _SHOWN} shorter times" if len(found) > _SHOWN else ""
            sentences.append(f"{name} {verb}: {shown}{more}; probability up to {most:.2f}.")
    if wrong and not sentences:
        return [f"{name} finds nothing wrong with {', '.join(map(words, wrong))}."]
    return sentences


def _begins_unsure(chance: np.ndarray, begin: int, end: int) -> bool:
    """True if epochs begin:end open a piece of the log, unsure, and never rise above the first."""
    opens = begin == 0 or np.isnan(chance[begin - 1])
    return bool(opens and np.max(chance[begin:end]) <= chance[begin] < SURE)


def words(suspect: str) -> str:
    """Name of a suspect in words."""
    return suspect.replace("_", " ")
