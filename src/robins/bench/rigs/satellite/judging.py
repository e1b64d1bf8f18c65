"""Figures of merit of a run of the satellite, and its time series."""

from __future__ import annotations

from typing import Any

import numpy as np

from robins.bench.rig import Judged
from robins.bench.rigs.satellite.errors import (
    ARCSEC,
    attitude_error,
    flag,
    peak_arcsec,
    rms_arcsec,
    turn,
)
from robins.bench.rigs.satellite.reference import reference_q_ib
from robins.bench.run.session import Ran
from robins.bench.run.setup import Flight, counted_from
from robins.results import array, variable

UNFIT = "safe: do not steer by this"
_AXES = ("x", "y", "z (boresight)")


def judge(flight: Flight, ran: Ran) -> Judged:
    """Errors of attitude determination and of pointing, over the steps that count.

    Those of the determination are of the estimates that it does not itself call unfit for use.
    """
    flown, counted = ran.flown, slice(counted_from(flight, ran.steps), None)
    attitude, unfit = attitude_error(flown), flag(flown, UNFIT)
    stated = np.where(unfit[:, None], np.nan, attitude)
    wanted = reference_q_ib(ran.kit, flown, len(flown.time_s))
    pointing = turn(wanted, flown["motion.q_ib"])
    metrics = {
        "attitude_rms_arcsec": rms_arcsec(stated, counted),
        "attitude_peak_arcsec": peak_arcsec(stated, counted),
        "pointing_rms_arcsec": rms_arcsec(pointing, counted),
        "pointing_peak_arcsec": peak_arcsec(pointing, counted),
        "attitude_end_arcsec": float(np.linalg.norm(stated[-1])) / ARCSEC,
    }
    return Judged(
        metrics,
        {
            "refused_measurements": int(np.sum(flag(flown, "star refused"))),
            "quaternions_of_wrong_length": int(
                np.sum(flag(flown, "star of a length other than one"))
            ),
            "designs_not_passed": int(np.sum(flag(flown, "last gain kept: no new one passed"))),
            "steps_without_gyro": int(np.sum(flag(flown, "gyro held"))),
            "steps_in_safe_mode": int(np.sum(unfit)),
        },
        warnings(attitude[counted], unfit[counted]),
        arrays(ran, attitude, pointing),
        [
            f"{name.removesuffix('_arcsec').replace('_', ' '):<16}{value:10.2f} arcsec"
            for name, value in list(metrics.items())[:4]
        ],
    )


def warnings(error: np.ndarray, unfit: np.ndarray) -> list[str]:
    """Reasons to doubt the figures.

    Args:
        error: (E, 3) of the attitude, over the counted steps; NaN where it is not known.
        unfit: (E,) true where the estimate was marked as not to be steered by.
    """
    known = np.all(np.isfinite(error), axis=-1)
    unusable = (
        ("The error of the attitude is not known", np.sum(~known)),
        ("The estimate was marked as not to be steered by", np.sum(known & unfit)),
    )
    rest = f"of the {len(error)} steps that count, and the figures are those of the others"
    return [f"{what} in {steps} {rest}" for what, steps in unusable if steps]


def arrays(ran: Ran, attitude: np.ndarray, pointing: np.ndarray) -> dict[str, Any]:
    """Time series of the run, as `robins.results` names them."""
    f = ran.flown
    sigma, bias, innovation = (
        f["estimate.sigma"],
        f["estimate.gyro_bias"],
        f["innovation.innovation"],
    )
    heard = np.flatnonzero(np.isfinite(innovation[:, 0]))
    true_bias = np.asarray(ran.kit.rows.gyro_bias)[: ran.steps]
    wheels = f["wheels.momentum"][:, : len(ran.kit.vehicle.craft.wheel_h)]
    body: dict[str, Any] = {"unit": "rad", "frame": "body", "axes": _AXES, "display_unit": "arcsec"}
    rate = body | {"unit": "rad/s", "display_unit": "arcsec/s"}
    out: dict[str, Any] = {}

    def add(role: str, values: np.ndarray, of: str, **about: Any) -> None:
        out.update(array(role, values[None], of, **about))

    add("error", attitude, "attitude", **body)
    add("sigma", sigma[:, :3], "attitude", **body)
    add("estimate", bias, "gyro_bias", **rate)
    add("error", true_bias - bias, "gyro_bias", **rate)
    add("sigma", sigma[:, 3:], "gyro_bias", **rate)
    add(
        "value",
        pointing,
        "pointing",
        long_name="pointing error",
        comment="Where the craft points against where it should.",
        **body | {"frame": "reference", "axes": ("x", "y", "z")},
    )
    add(
        "value",
        wheels,
        "wheel_momentum",
        unit="N m s",
        long_name="momentum of the wheels",
        frame="wheel axes",
        axes=[f"wheel {k}" for k in range(wheels.shape[1])],
        dims="filter time axis_wheel",
    )
    if len(heard):
        out["star_time"] = variable("star_time", f.time_s[heard], "s", "time since the start")
        add("innovation", innovation[heard], "star", **body)
        add("innovation_sigma", f["innovation.sigma"][heard], "star", **body)
        add("refused", flag(f, "star refused")[heard].astype(np.int8), "star")
    return out
