"""What a replay found: time series with units, and figures of merit against the fixes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from robins.dataset import Dataset
from robins.earth import Geodetic
from robins.filters import Code
from robins.filters.consistency import grand_mean_nis
from robins.manifold import leaves
from robins.results import variable
from robins.systems.ins_gnss.parameters import Replay
from robins.systems.ins_gnss.replay import Navigated, Prepared, navigate, prepare
from robins.systems.ins_gnss.setup import SENSORS, SMOOTHED, state_blocks
from robins.systems.system import Outcome, Progress
from robins.systems.tables import Seen, innovation_tables

RTK_QUALITY = {1: "fix", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}


def fix_errors(prepared: Prepared, antenna: Geodetic) -> tuple[np.ndarray, np.ndarray]:
    """Antenna minus fix [m, NED] at the best fixes, and which of these were withheld.

    The best fixes are those of quality 1 where the receiver states a quality, else all.
    """
    g = prepared.gnss
    use = prepared.fix_epoch >= 0
    if g.quality is not None:
        use = use & (g.quality == np.min(g.quality[use]))
    use &= np.isfinite(g.lat_rad) & np.isfinite(g.alt_m)
    at = jax.tree_util.tree_map(lambda x: x[prepared.fix_epoch[use]], antenna)
    fix = Geodetic(*(jnp.asarray(v[use]) for v in (g.lat_rad, g.lon_rad, g.alt_m)))
    return np.asarray(fix.local(at)), prepared.withheld[use]


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else float("nan")


def replay_metrics(prepared: Prepared, answer: Navigated, smoothed: bool) -> dict[str, Any]:
    """Figures of merit of one filter: distance from the fixes, with aids and in outages; NIS."""
    error, withheld = fix_errors(prepared, answer.antenna)
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
    if smoothed:
        return out
    for sensor, info in answer.solution.steps.info.items():
        used = np.asarray(info.dof) * (np.asarray(info.code) != int(Code.REFUSED))
        if np.sum(used) == 0:
            continue
        verdict = grand_mean_nis(np.asarray(info.nis), used)
        out[f"nis_{sensor}"] = verdict.value
        out[f"nis_{sensor}_band"] = [verdict.low, verdict.high]
        out[f"refused_{sensor}"] = int(np.sum(np.asarray(info.code) == int(Code.REFUSED)))
    out["log_likelihood"] = float(answer.solution.log_likelihood)
    return out


def _stack(answers: dict[str, Navigated], pick) -> np.ndarray:
    return np.stack([np.asarray(pick(a)) for a in answers.values()])


def replay_solution(
    prepared: Prepared, answers: dict[str, Navigated], parameters: Replay
) -> xr.Dataset:
    """Time series of every filter, labelled as `robins.results` lists them."""
    ft = ("filter", "time")
    data: dict[str, Any] = {
        "lat_rad": variable(ft, _stack(answers, lambda a: a.antenna.lat), "rad", "latitude"),
        "lon_rad": variable(ft, _stack(answers, lambda a: a.antenna.lon), "rad", "longitude"),
        "alt_m": variable(ft, _stack(answers, lambda a: a.antenna.alt), "m", "height"),
        "outage": variable("time", prepared.withheld_epoch.astype(np.int8), "1", "GNSS withheld"),
    }
    coords: dict[str, Any] = {
        "filter": list(answers),
        "time": variable("time", prepared.blocks.epoch_s, "s", "time since the first IMU sample"),
    }
    for block in state_blocks(parameters.imu.scale_states):
        axis = f"axis_{block.name}"
        coords[axis] = list(block.axes)
        data[f"sigma_{block.name}"] = variable(
            (*ft, axis),
            _stack(answers, lambda a, b=block: a.belief.sigma[:, b.where]),
            block.units,
            f"standard deviation of {block.name.replace('_', ' ')}",
            block.frame,
            display_unit=block.display_unit,
        )
        if block.name == "position":
            continue
        data[f"estimate_{block.name}"] = variable(
            (*ft, axis),
            _stack(answers, lambda a, b=block: _estimate(a, b.name)),
            block.units,
            f"estimated {block.name.replace('_', ' ')}",
            block.frame,
            display_unit=block.display_unit,
        )
    data |= _fixes(prepared)
    coords["gnss_time"] = variable("gnss_time", prepared.gnss_s, "s", "time of the fixes")
    more, places = innovation_tables(_seen(answers), SENSORS, prepared.blocks.epoch_s)
    return xr.Dataset(data | more, coords | places)


def _estimate(answer: Navigated, block: str) -> np.ndarray:
    mean = answer.belief.mean
    if block == "attitude":
        return np.stack([np.asarray(a) for a in mean.q_nb.as_euler()], -1)
    field = {"velocity": "v_n"}.get(block, block)
    return np.asarray(leaves(getattr(mean, field))[0])


def _fixes(prepared: Prepared) -> dict[str, Any]:
    g = prepared.gnss
    out = {
        "gnss_lat_rad": variable("gnss_time", g.lat_rad, "rad", "latitude of the fixes"),
        "gnss_lon_rad": variable("gnss_time", g.lon_rad, "rad", "longitude of the fixes"),
        "gnss_alt_m": variable("gnss_time", g.alt_m, "m", "height of the fixes"),
    }
    if g.quality is not None:
        known = [q for q in RTK_QUALITY if np.any(g.quality == q)]
        out["gnss_quality"] = variable(
            "gnss_time",
            g.quality.astype(np.int32),
            "1",
            "quality of the fixes",
            flag_values=np.asarray(known, dtype=np.int32),
            flag_meanings=" ".join(RTK_QUALITY[q] for q in known),
        )
    return out


def _seen(answers: dict[str, Navigated]) -> dict[str, Seen]:
    """Innovations by sensor; a smoother has none, so its rows are NaN."""
    causal = [name for name in answers if not name.endswith(SMOOTHED)]
    if not causal:
        return {}

    def of(pick: Any, sensor: str) -> np.ndarray:
        rows = {
            name: np.asarray(pick(answers[name].solution.steps.info[sensor]), dtype=float)
            for name in causal
        }
        blank = np.full_like(rows[causal[0]], np.nan)
        return np.stack([rows.get(name, blank) for name in answers])

    return {
        k: Seen(
            of(lambda i: i.innovation, k),
            of(lambda i: i.sigma, k),
            of(lambda i: i.nis, k),
            of(lambda i: i.dof, k),
            of(lambda i: i.code == int(Code.REFUSED), k),
        )
        for k in answers[causal[0]].solution.steps.info
    }


def replay(
    dataset: Dataset,
    parameters: Replay,
    filters: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Outcome:
    """Navigate a log with the filters named and say how good they are.

    Args:
        dataset: IMU and GNSS of a log that the doctor has passed.
        parameters: what the files do not say.
        filters: names such as "ekf", "ukf", "ekf+rts"; by default those of the parameters.
        progress: called with the share done and what is being done.

    Raises:
        ValueError: the log cannot be navigated; the sentence says why and what to do.
    """
    tell = progress if progress is not None else (lambda share, what: None)
    wanted = tuple(filters) or parameters.filters
    tell(0.0, "aligning")
    prepared = prepare(dataset, parameters)
    tell(0.1, "filtering")
    answers = navigate(prepared, parameters, wanted)
    tell(0.8, "measuring")
    metrics = {
        name: replay_metrics(prepared, answer, name.endswith(SMOOTHED))
        for name, answer in answers.items()
    }
    counts = dict(dataset.counts)
    counts["imu_samples"] = len(dataset.imu)
    counts["gnss_fixes"] = len(prepared.gnss)
    counts["gnss_withheld"] = int(np.sum(prepared.withheld))
    counts["bridged_gaps"] = int(np.sum(np.asarray(prepared.u.noise_scale) > 1.0))
    notes = [f"Start: {prepared.start.sentence}."]
    return Outcome(
        solution=replay_solution(prepared, answers, parameters),
        metrics=metrics,
        counts=counts,
        notes=notes,
    )
