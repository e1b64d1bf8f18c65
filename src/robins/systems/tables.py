"""What replays and campaigns share: labelled time series, and why to doubt what came out."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import numpy as np

from robins.filters import StepWarning, Tally, doubts
from robins.results import array, variable
from robins.systems.system import Output, SensorAxes, StateBlock

EULER = StateBlock("euler", slice(0, 3), "rad", "deg", "FRD to NED", ("roll", "pitch", "heading"))


class Seen(NamedTuple):
    """What the filters saw of one sensor; leading axes are filter and epoch, NaN where nothing."""

    innovation: np.ndarray  # (F, E, m)
    sigma: np.ndarray  # (F, E, m)
    nis: np.ndarray  # (F, E)
    dof: np.ndarray  # (F, E)
    refused: np.ndarray  # (F, E)


def block_array(
    role: str, block: StateBlock | Output, values: Any, long_name: str = "", **attrs: Any
) -> dict[str, Any]:
    """An array of a block of the state, or of an output, in its units and frame."""
    shown = {"display_unit": block.display_unit, "axes": block.axes}
    about = {"unit": block.units, "long_name": long_name, "frame": block.frame}
    return array(role, values, block.name, **about, **shown, **attrs)


def place_arrays(
    role: str, places: Iterable[Any], name: str = "{}", dims: str | None = None
) -> dict[str, Any]:
    """Latitude, longitude [rad] and height [m] of a track, a reference or fixes.

    `name` is their long name, where {} stands for which of the three it is.
    """
    made: dict[str, Any] = {}
    which = (("lat_rad", "latitude"), ("lon_rad", "longitude"), ("alt_m", "height"))
    for (of, words), values in zip(which, places, strict=True):
        about = {"unit": of.rpartition("_")[2], "long_name": name.format(words), "dims": dims}
        made |= array(role, values, of, **about)
    return made


def innovation_tables(
    seen: Mapping[str, Seen], axes: Mapping[str, SensorAxes], epoch_s: np.ndarray
) -> dict[str, Any]:
    """Arrays and coordinates of a solution, at the epochs where each sensor spoke.

    Args:
        seen: by sensor.
        axes: by sensor, units and names of the innovation's components.
        epoch_s: (E,) time of each epoch.
    """
    data: dict[str, Any] = {}
    for sensor, s in seen.items():
        spoke = np.any(np.isfinite(s.innovation), axis=(0, 2))
        if not np.any(spoke):
            continue
        time, (units, frame, labels, shown) = f"{sensor}_time", axes[sensor]
        about: dict[str, Any] = {"unit": units, "frame": frame, "axes": labels}
        about |= {"display_unit": shown} if shown else {}
        words = sensor.replace("_", " ")
        data[time] = variable(time, epoch_s[spoke], "s", f"time of {words}")
        data |= array("innovation", s.innovation[:, spoke], sensor, **about)
        data |= array("innovation_sigma", s.sigma[:, spoke], sensor, **about)
        data |= array("nis", s.nis[:, spoke], sensor)
        data |= array("nis_dof", s.dof[:, spoke], sensor)
        data |= array("refused", s.refused[:, spoke], sensor)
    return data


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
