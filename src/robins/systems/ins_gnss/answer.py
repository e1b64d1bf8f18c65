"""What a replay found: time series with units, and figures of merit against the fixes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from robins.earth import Geodetic
from robins.filters import Belief, StepInfo, Tally
from robins.results import array, variable
from robins.systems.ins_gnss.parameters import Replay
from robins.systems.ins_gnss.prepare import Log
from robins.systems.ins_gnss.setup import SENSORS, state_blocks
from robins.systems.tables import (
    EULER,
    block_array,
    innovation_tables,
    place_arrays,
    update_metrics,
)

RTK_QUALITY = {1: "fix", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}


class Answer(NamedTuple):
    """What one filter says; leading axis E epochs."""

    belief: Belief
    antenna: Geodetic  # where the filter thinks the antenna is
    info: dict[str, StepInfo]  # by sensor; empty for a smoother
    log_likelihood: float
    tally: Tally | None = None  # how the steps went; None for a smoother


class Flight(NamedTuple):
    """The epochs of a replay and the fixes it is judged by."""

    log: Log
    epoch_s: np.ndarray  # (E,)
    withheld_epoch: np.ndarray  # (E,) bool
    fix_epoch: np.ndarray  # (M,) epoch of each fix, -1 where there is none


def fix_errors(flight: Flight, antenna: Geodetic) -> tuple[np.ndarray, np.ndarray]:
    """Antenna minus fix [m, NED] at the best fixes, and which of these were withheld.

    The best fixes are those of quality 1 where the receiver states a quality, else all.
    """
    g = flight.log.gnss
    use = (flight.fix_epoch >= 0) & np.isfinite(g.lat_rad) & np.isfinite(g.alt_m)
    if g.quality is not None and np.any(use):
        use = use & (g.quality == np.min(g.quality[use]))
    at = jax.tree_util.tree_map(lambda x: x[flight.fix_epoch[use]], antenna)
    fix = Geodetic(*(jnp.asarray(v[use]) for v in (g.lat_rad, g.lon_rad, g.alt_m)))
    return np.asarray(fix.local(at)), flight.log.withheld[use]


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else float("nan")


def replay_metrics(flight: Flight, answer: Answer) -> dict[str, Any]:
    """Figures of merit of one filter: distance from the fixes, with aids and in outages; NIS."""
    error, withheld = fix_errors(flight, answer.antenna)
    across = np.hypot(error[:, 0], error[:, 1])
    out: dict[str, Any] = {
        "aided_horizontal_rms_m": _rms(across[~withheld]),
        "aided_vertical_rms_m": _rms(error[~withheld, 2]),
        "aided_fixes": int(np.sum(~withheld)),
    }
    if np.any(withheld):
        out |= {
            "outage_horizontal_rms_m": _rms(across[withheld]),
            "outage_horizontal_max_m": float(np.max(across[withheld])),
            "outage_vertical_rms_m": _rms(error[withheld, 2]),
            "outage_fixes": int(np.sum(withheld)),
        }
    out |= update_metrics(answer.info)
    if answer.info:
        out["log_likelihood"] = answer.log_likelihood
    return out


def _stack(answers: dict[str, Answer], pick) -> np.ndarray:
    return np.stack([np.asarray(pick(a)) for a in answers.values()])


def replay_solution(flight: Flight, answers: dict[str, Answer], parameters: Replay) -> xr.Dataset:
    """Time series of every filter, labelled as `robins.results` lists them."""
    data: dict[str, Any] = {
        "filter": ("filter", list(answers)),
        "time": variable("time", flight.epoch_s, "s", "time since the first IMU sample"),
    }
    fields = ("lat", "lon", "alt")
    places = (_stack(answers, lambda a, f=field: getattr(a.antenna, f)) for field in fields)
    data |= place_arrays("track", places)
    data |= array("outage", flight.withheld_epoch.astype(np.int8), long_name="GNSS withheld")
    for block in state_blocks(parameters.imu.scale_states):
        sigma = _stack(answers, lambda a, b=block: a.belief.sigma[:, b.where])
        data |= block_array("sigma", block, sigma)
        if block.name not in ("attitude", "position"):
            found = _stack(answers, lambda a, b=block: _estimate(a, b.name))
            data |= block_array("estimate", block, found)
    euler = _stack(answers, lambda a: np.stack(a.belief.mean.q_nb.as_euler(), -1))
    data |= block_array("estimate", EULER, euler, "estimated roll, pitch, heading")
    data |= _fixes(flight.log)
    seen = [answer.info for answer in answers.values()]
    return xr.Dataset(data | innovation_tables(seen, SENSORS, flight.epoch_s))


def _estimate(answer: Answer, block: str) -> np.ndarray:
    field = {"velocity": "v_n"}.get(block, block)
    return np.asarray(getattr(answer.belief.mean, field))


def _fixes(log: Log) -> dict[str, Any]:
    g = log.gnss
    out: dict[str, Any] = {
        "gnss_time": variable("gnss_time", log.gnss_s, "s", "time of the fixes"),
    }
    out |= place_arrays("gnss", (g.lat_rad, g.lon_rad, g.alt_m), "{} of the fixes")
    if g.quality is not None:
        known = [q for q in RTK_QUALITY if np.any(g.quality == q)]
        out |= array(
            "gnss_quality",
            g.quality.astype(np.int32),
            flag_values=np.asarray(known, dtype=np.int32),
            flag_meanings=" ".join(RTK_QUALITY[q] for q in known),
        )
    return out
