"""Common tables of replays and campaigns: updates of sensors, and labelled time series."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike

from robins.earth import Geodetic
from robins.filters import Code
from robins.filters.run import Step
from robins.results import Variables, array, variable
from robins.systems.study import Output, SensorAxes, StateBlock

EULER = StateBlock("euler", slice(0, 3), "rad", "deg", "FRD to NED", ("roll", "pitch", "heading"))


class SensorUpdates(NamedTuple):
    """Kept part of the `StepInfo` of one sensor's updates; leading axis E epochs."""

    innovation: Any  # (E, m)
    sigma: Any  # (E, m)
    nis: Any  # (E,)
    dof: Any  # (E,)
    code: Any  # (E,)
    notes: Mapping[str, Any] = {}


def updates(step: Step, notes: Collection[str] = ()) -> dict[str, SensorUpdates]:
    """Kept part of a step, by sensor, with the named notes of its rules."""
    return {
        k: SensorUpdates(
            *(i.innovation, i.sigma, i.nis, i.dof, i.code),
            {name: i.notes[name] for name in notes if name in i.notes},
        )
        for k, i in step.info.items()
    }


def block_array(
    role: str, block: StateBlock | Output, values: ArrayLike, long_name: str = "", **attrs: Any
) -> Variables:
    """An array of a block of the state, or of an output, in its units and frame."""
    shown = {"display_unit": block.display_unit, "axes": block.axes}
    about = {"unit": block.units, "long_name": long_name, "frame": block.frame}
    return array(role, values, block.name, **about, **shown, **attrs)


def place_arrays(
    role: str, places: Iterable[ArrayLike], name: str = "{}", dims: str | None = None
) -> Variables:
    """Latitude, longitude [rad] and height [m] of a track, a reference or fixes.

    `name` is their long name; {} becomes "latitude", "longitude" or "height".
    """
    made: dict[str, Any] = {}
    which = (("lat_rad", "latitude"), ("lon_rad", "longitude"), ("alt_m", "height"))
    for (of, words), values in zip(which, places, strict=True):
        about = {"unit": of.rpartition("_")[2], "long_name": name.format(words), "dims": dims}
        shown = {"display_unit": "deg"} if about["unit"] == "rad" else {}
        made |= array(role, values, of, **about, **shown)
    return made


def track_arrays(places: Iterable[Geodetic], name: str = "{}") -> Variables:
    """Estimated positions of each filter: a `Geodetic` of each, leading axis E epochs."""
    rows = zip(*((place.lat, place.lon, place.alt) for place in places), strict=True)
    return place_arrays("track", map(np.stack, rows), name)


def attitude_array(q_nb: ArrayLike, frame: str, time: str = "time", words: str = "") -> Variables:
    """Attitude q_nb of each filter (F, E, 4), along a time axis; see `results.ROLES`.

    Args:
        q_nb: unit quaternions, Hamilton, scalar first.
        frame: source and target axes, such as "FRD to NED".
        time: name of the time axis.
        words: long name, if not that of the role.
    """
    about: dict[str, Any] = {"frame": frame, "axes": ("w", "x", "y", "z"), "long_name": words}
    about["convention"] = "Hamilton, scalar first: v_n = q v_b conj(q)"
    return array("attitude", q_nb, dims=f"filter {time} axis_q_nb", **about)


def innovation_tables(
    seen: Sequence[Mapping[str, SensorUpdates]], axes: Mapping[str, SensorAxes], epoch_s: np.ndarray
) -> Variables:
    """Innovations of a solution, with coordinates, at the epochs of each sensor's measurements.

    Args:
        seen: updates by filter and sensor. A filter without a sensor (a smoother has none) has
            NaN there, and no refusals.
        axes: by sensor, units and names of the innovation's components.
        epoch_s: (E,) time of each epoch.
    """
    data: dict[str, Any] = {}
    for sensor in dict.fromkeys(sensor for of in seen for sensor in of):
        kept = SensorUpdates._fields[:5]
        innovation, spread, nis, dof, code = (_every(seen, sensor, what) for what in kept)
        spoke = np.any(np.isfinite(innovation), axis=(0, 2))
        if not np.any(spoke):
            continue
        time, (units, frame, labels, shown) = f"{sensor}_time", axes[sensor]
        about: dict[str, Any] = {"unit": units, "frame": frame, "axes": labels}
        about |= {"display_unit": shown} if shown else {}
        words = sensor.replace("_", " ")
        data[time] = variable(time, epoch_s[spoke], "s", f"time of {words}")
        data |= array("innovation", innovation[:, spoke], sensor, **about)
        data |= array("innovation_sigma", spread[:, spoke], sensor, **about)
        data |= array("nis", nis[:, spoke], sensor)
        data |= array("nis_dof", dof[:, spoke], sensor)
        data |= array("refused", code[:, spoke] == Code.REFUSED, sensor)
    return data


def _every(seen: Sequence[Mapping[str, SensorUpdates]], sensor: str, what: str) -> np.ndarray:
    """A field of a sensor's updates, stacked over the filters; NaN for a filter without it."""
    rows = [getattr(of[sensor], what) if sensor in of else None for of in seen]
    blank = np.full(np.shape(next(row for row in rows if row is not None)), np.nan)
    return np.stack([blank if row is None else np.asarray(row, dtype=float) for row in rows])
