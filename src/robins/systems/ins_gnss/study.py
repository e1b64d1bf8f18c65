"""Study "drive": filters and their assumptions, report and claims."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from jax.tree_util import Partial

from robins import units
from robins.errors import require_known
from robins.filters import Filter, adaptive, cubature, kalman, taylor, unscented
from robins.filters.rules import gate
from robins.results import array
from robins.systems.ins_gnss.model import IMU, SENSORS, ins_gnss_model, state_blocks
from robins.systems.ins_gnss.parameters import Drive, InsGnssImu
from robins.systems.ins_gnss.world import InsGnssCourse, as_believed, belief_of, lay_out, simulate
from robins.systems.judgement import Metric, consistency, consistency_claims
from robins.systems.parts import refuse_unsettled
from robins.systems.study import Contender, StateBlock, Study, View
from robins.systems.tables import place_arrays, track_arrays

FILTERS = {
    "ekf": lambda rules: kalman(taylor(), rules),
    "ekf-joseph": lambda rules: kalman(taylor(), rules, form="joseph"),
    "ukf": lambda rules: kalman(unscented(), rules),
    "ckf": lambda rules: kalman(cubature(), rules),
}
SMOOTHERS = {f"{name}+rts": name for name in FILTERS}
"""Smoothers of recorded logs: name -> name of the filter whose run it smooths."""

# a bank over the process noise; nothing is gated, and nothing can be smoothed
ADAPTIVE = "adaptive"
NAMES = (*FILTERS, ADAPTIVE, *SMOOTHERS)

CLAIMS = consistency_claims(
    {
        "sigma": "On no state the RMS error is proven, at 99 % confidence, to differ from the "
        "filter's sigma by more than 5 %; value: the largest difference proven",
        "anees": "ANEES of all states is inside its 95 % band at 90 % of the epochs or more",
        "nis": "The grand mean NIS of every sensor is inside its 99.9 % band",
    }
)
"""Claims on the worst of the filters."""


def make_filter(name: str, gate_probability: float = 0.0) -> Filter:
    """Filter by name, gated unless the probability is zero; "adaptive" is never gated.

    Raises:
        ValueError: there is no filter of this name.
    """
    if name == ADAPTIVE:
        return adaptive(parts={IMU: slice(None)})
    require_known("filter", name, FILTERS, "this system, where each may end in +rts")
    return FILTERS[name]((gate(gate_probability),) if gate_probability > 0.0 else ())


def believed_imu(drive: Drive) -> InsGnssImu:
    """Inertial sensors as assumed by the filters: noise scaled by sqrt(`believed.q_factor`)."""
    factor = float(np.sqrt(drive.believed.q_factor))
    scaled = ("gyro_noise", "accel_noise", "gyro_bias_walk", "accel_bias_walk")
    return drive.imu.model_copy(
        update={name: tuple(factor * x for x in getattr(drive.imu, name)) for name in scaled}
    )


def contender(drive: Drive, course: InsGnssCourse, name: str) -> Contender:
    """A filter with its model, by name.

    Raises:
        ValueError: it is a smoother, or there is no filter of this name.
    """
    if name in SMOOTHERS:
        raise ValueError(f"{name}: campaigns compare causal filters; `robins replay` smooths a log")
    model = ins_gnss_model(believed_imu(drive), drive.gnss, drive.aids)
    case = Partial(as_believed, belief_of(drive, course))
    return Contender(make_filter(name, drive.update.gate), model, case)


def view(drive: Drive, course: InsGnssCourse) -> View:
    """Report of all states, the true path, and the track of each filter in the first run.

    Raises:
        ValueError: `settle` is not before the end of the run.
    """
    epoch_s, blocks = course.epoch_s, state_blocks(drive.imu.scale_states)
    refuse_unsettled("settle", drive.settle, float(epoch_s[-1]) + 1e-9)
    p = course.truth.position
    context = place_arrays("reference", (p.lat, p.lon, p.alt), "true {}")
    context |= array("outage", course.outage.astype(np.int8), long_name="GNSS withheld")
    return View(
        epoch_s=epoch_s,
        blocks=blocks,
        sensors=SENSORS,
        metrics=partial(_metrics, course.outage, blocks),
        context=xr.Dataset(context),
        shown=lambda means: track_arrays(mean.position for mean in means.values()),
        count_from=int(np.searchsorted(epoch_s, drive.settle)),
        faults={},  # no faults: sensor errors are drawn from the filters' model
    )


def _metrics(
    outage: np.ndarray, blocks: Sequence[StateBlock], statistics: Any
) -> dict[str, Metric]:
    """RMS errors over runs and epochs, with and without GNSS; consistency; diverged runs."""
    rms = statistics.rms[statistics.count_from :]
    aided = ~outage[statistics.count_from :]
    where = {b.name: b.where for b in blocks}

    def pooled(columns: slice | list[int], epochs: np.ndarray = aided) -> float:
        return float(np.sqrt(np.mean(np.sum(rms[epochs][:, columns] ** 2, axis=1))))

    north = where["position"].start
    horizontal, vertical = [north, north + 1], [north + 2]
    gyro_bias, accel_bias = pooled(where["gyro_bias"]), pooled(where["accel_bias"])
    out: dict[str, Any] = {
        "horizontal_rms_m": pooled(horizontal),
        "vertical_rms_m": pooled(vertical),
        "velocity_rms_mps": pooled(where["velocity"]),
        "tilt_rms_arcmin": units.convert(pooled([0, 1]), "rad", "arcmin"),
        "heading_rms_arcmin": units.convert(pooled([2]), "rad", "arcmin"),
        "gyro_bias_rms_deg_per_h": units.convert(gyro_bias, "rad/s", "deg/h"),
        "accel_bias_rms_mg": units.convert(accel_bias, "m/s^2", "mg"),
    }
    if np.any(~aided):
        out["outage_horizontal_rms_m"] = pooled(horizontal, ~aided)
        worst = np.sum(rms[~aided][:, horizontal] ** 2, axis=1)
        out["outage_horizontal_worst_rms_m"] = float(np.sqrt(np.max(worst)))
    return out | consistency(statistics) | {"diverged_runs": statistics.diverged}


# smoothers are listed so that a campaign that requests one gets an error pointing to the replay
DRIVE = Study(Drive, NAMES, simulate, contender, view, lay_out, CLAIMS)
