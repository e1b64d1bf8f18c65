"""What the alignment of a recorded pair found: figures with their sigmas, and time series."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from robins import units
from robins.dataset import Trajectory
from robins.filters import Belief, StepInfo, Tally
from robins.results import array, variable
from robins.systems.study import SensorAxes, StateBlock
from robins.systems.tables import (
    EULER,
    block_array,
    innovation_tables,
    place_arrays,
    update_metrics,
)
from robins.systems.transfer_alignment.product import ATTITUDE, POSITION, VELOCITY

_NED, _FRD = ("north", "east", "down"), ("forward", "right", "down")
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcmin", "NED", _NED),
    StateBlock("velocity", slice(3, 6), "m/s", "m/s", "NED", _NED),
    StateBlock("position", slice(6, 9), "m", "m", "NED", _NED),
    StateBlock("gyro_bias", slice(9, 12), "rad/s", "deg/h", "FRD of the slave", _FRD),
    StateBlock("accel_bias", slice(12, 15), "m/s^2", "mg", "FRD of the slave", _FRD),
    StateBlock("mounting", slice(15, 18), "rad", "arcmin", "FRD of the slave", _FRD),
    StateBlock("flexure", slice(18, 21), "rad", "arcmin", "FRD of the master", _FRD),
)
SENSORS = {
    ATTITUDE: SensorAxes("rad", "NED", _NED),
    VELOCITY: SensorAxes("m/s", "NED", _NED),
    POSITION: SensorAxes("m", "NED", _NED),
}
_FOUND = {"mounting": "arcmin", "gyro_bias": "deg_per_h", "accel_bias": "mg"}
_UNKNOWN = 0.7  # of the sigma at the start; what keeps more of it was hardly seen
_LARGE_RAD = np.deg2rad(5.0)


class Answer(NamedTuple):
    """What one filter says; leading axis E epochs."""

    belief: Belief
    info: Mapping[str, StepInfo]  # by sensor
    start: Belief
    log_likelihood: float
    bounds: bool  # its sigmas are bounds of an H-infinity filter
    tally: Tally  # how the steps went


class Recorded(NamedTuple):
    """What was recorded, on the clock of the epochs."""

    epoch_s: np.ndarray  # (E,)
    master: Trajectory  # NED/FRD
    master_s: np.ndarray  # (M,)


def estimate(mean: Any, block: str) -> np.ndarray | None:
    """(..., 3) what a mean holds of a block that is a vector; None where it has no such states."""
    fields = {
        "velocity": mean.ins.v_n,
        "gyro_bias": mean.ins.gyro_bias,
        "accel_bias": mean.ins.accel_bias,
        "mounting": mean.mounting_rad,
        "flexure": mean.flexure_rad,
    }
    value = fields.get(block)
    return None if value is None else np.asarray(value)


def sigma(belief: Belief, block: StateBlock) -> np.ndarray | None:
    """(..., 3) standard deviations of a block; None where there are no such states."""
    here = np.asarray(belief.sigma)[..., block.where]
    return here if here.shape[-1] == 3 else None


def metrics_of(answer: Answer) -> dict[str, Any]:
    """Mounting, biases and attitude at the end with their sigmas; NIS by sensor."""
    out: dict[str, Any] = {}
    for block in BLOCKS:
        ending = "arcmin" if block.name == "attitude" else _FOUND.get(block.name)
        spread = sigma(answer.belief, block)
        if ending is None or spread is None:
            continue
        convert = (block.units, block.display_unit)
        value = estimate(answer.belief.mean, block.name)
        if value is not None:
            out[f"{block.name}_{ending}"] = units.convert(value[-1], *convert).tolist()
        out[f"{block.name}_sigma_{ending}"] = units.convert(spread[-1], *convert).tolist()
    out |= update_metrics(answer.info, answer.bounds)
    return out | {"log_likelihood": answer.log_likelihood}


def remarks(name: str, answer: Answer) -> list[str]:
    """Sentences on what the motion did not show, and on a mounting far from the nominal one."""
    said = []
    for block in BLOCKS:
        before, after = sigma(answer.start, block), sigma(answer.belief, block)
        if block.name not in _FOUND or before is None or after is None:
            continue
        hidden = [
            a for a, s, t in zip(block.axes, before, after[-1], strict=True) if t > _UNKNOWN * s > 0
        ]
        if hidden:
            said.append(
                f"{name}: {block.name.replace('_', ' ')} {', '.join(hidden)} was hardly observed; "
                "its sigma is near what it was before. Another manoeuvre would show it."
            )
    mounting = estimate(answer.belief.mean, "mounting")
    size = 0.0 if mounting is None else float(np.linalg.norm(mounting[-1]))
    if size > _LARGE_RAD:
        said.append(
            f"{name}: the slave sits {np.degrees(size):.1f} deg from its nominal mounting. Models "
            "of first order do not hold beyond 5 deg; this one keeps whole rotations, but a better "
            "nominal mounting makes it converge sooner."
        )
    return said


def solution_of(recorded: Recorded, answers: Mapping[str, Answer]) -> xr.Dataset:
    """Time series of every filter, labelled as `robins.results` lists them."""

    def stack(pick) -> np.ndarray:
        return np.stack([np.asarray(pick(a)) for a in answers.values()])

    place = stack(lambda a: np.stack([*_place(a.belief.mean.ins.position)]))
    master, mt = recorded.master, "master_time"
    data: dict[str, Any] = {
        "filter": ("filter", list(answers)),
        "time": variable("time", recorded.epoch_s, "s", "time since the slave's first sample"),
        mt: variable(mt, recorded.master_s, "s", "time of the master's records"),
    }
    data |= place_arrays("track", np.moveaxis(place, 1, 0), "{} of the slave")
    blank = np.full((len(recorded.epoch_s), 3), np.nan)
    for block in BLOCKS:
        for role, rows in (
            ("sigma", [sigma(a.belief, block) for a in answers.values()]),
            ("estimate", [estimate(a.belief.mean, block.name) for a in answers.values()]),
        ):
            if any(row is not None for row in rows):
                values = np.stack([blank if row is None else row for row in rows])
                data |= block_array(role, block, values)
    euler = stack(lambda a: np.stack(a.belief.mean.ins.q_nb.as_euler(), -1))
    data |= block_array("estimate", EULER, euler, "estimated roll, pitch, heading of the slave")
    data |= array("bounds", np.array([a.bounds for a in answers.values()], dtype=np.int8))
    path = (master.lat_rad, master.lon_rad, master.alt_m)
    data |= place_arrays("reference", path, "{} of the master", dims=mt)
    seen = [answer.info for answer in answers.values()]
    return xr.Dataset(data | innovation_tables(seen, SENSORS, recorded.epoch_s))


def _place(position: Any) -> tuple[Any, Any, Any]:
    return position.lat, position.lon, position.alt
