"""What replays and campaigns share: labelled time series, and why to doubt what came out."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import numpy as np

from robins.filters import StepWarning, Tally, doubts
from robins.results import variable
from robins.systems.system import SensorAxes


class Seen(NamedTuple):
    """What the filters saw of one sensor; leading axes are filter and epoch, NaN where nothing."""

    innovation: np.ndarray  # (F, E, m)
    sigma: np.ndarray  # (F, E, m)
    nis: np.ndarray  # (F, E)
    dof: np.ndarray  # (F, E)
    refused: np.ndarray  # (F, E)


def innovation_tables(
    seen: Mapping[str, Seen], axes: Mapping[str, SensorAxes], epoch_s: np.ndarray
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Variables and coordinates of a solution, at the epochs where each sensor spoke.

    Args:
        seen: by sensor.
        axes: by sensor, units and names of the innovation's components.
        epoch_s: (E,) time of each epoch.
    """
    data: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    for sensor, s in seen.items():
        spoke = np.any(np.isfinite(s.innovation), axis=(0, 2))
        if not np.any(spoke):
            continue
        time, axis, words = f"{sensor}_time", f"axis_{sensor}", sensor.replace("_", " ")
        units, frame, labels, shown = axes[sensor]
        display = {"display_unit": shown} if shown else {}
        coords[time] = variable(time, epoch_s[spoke], "s", f"time of {words}")
        coords[axis] = list(labels)
        ft, fta = ("filter", time), ("filter", time, axis)
        rows = {
            f"innovation_{sensor}": (fta, s.innovation, units, f"innovation of {words}", frame),
            f"innovation_sigma_{sensor}": (fta, s.sigma, units, f"expected {words}", frame),
            f"nis_{sensor}": (ft, s.nis, "1", f"NIS of {words}"),
            f"nis_dof_{sensor}": (ft, s.dof, "1", f"degrees of freedom of {words}"),
            f"refused_{sensor}": (ft, s.refused, "1", f"{words} refused by a rule"),
        }
        for name, (dims, values, *words_) in rows.items():
            attrs = display if len(dims) == 3 else {}
            data[name] = variable(dims, values[:, spoke], *words_, **attrs)
    return data, coords


@contextmanager
def doubts_told_at_the_end() -> Iterator[None]:
    """Runs in here do not warn: what they would say is among the warnings of the outcome."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StepWarning)
        yield


def together(tallies: Sequence[Tally | None]) -> Tally | None:
    """The tallies of all pieces of a log, as one with a leading axis."""
    some = [tally for tally in tallies if tally is not None]
    return jax.tree_util.tree_map(lambda *x: np.stack(x), *some) if some else None


def replay_warnings(
    tallies: Mapping[str, Tally],
    causes: str,
    bounds: Collection[str] = (),
    assumed: Collection[str] = (),
) -> list[str]:
    """Why a reader should doubt a replay, and the likely causes; empty where nothing is wrong.

    Args:
        tallies: by filter, of all pieces of the log.
        causes: the sentence on what is mostly behind it in this system.
        bounds: filters that state bounds, not standard deviations.
        assumed: sensors that nobody built, such as "the wheels do not slip": their noise is a
            guess on the cautious side, so that small innovations say nothing.
    """
    found = [
        f"{name}: {sentence}."
        for name, tally in tallies.items()
        for sentence in doubts(tally, bounds=name in bounds, assumed=assumed)
    ]
    return [*found, causes] if found else []
