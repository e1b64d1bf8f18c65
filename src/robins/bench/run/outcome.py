"""What a run on the bench comes to: figures for scripts, sentences for people, arrays to draw."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from robins.bench.live.latest import latest
from robins.bench.run import telemetry
from robins.bench.run.session import Ran
from robins.bench.run.setup import Flight, counted_from
from robins.bench.run.telemetry import ARCSEC, Flown, flag
from robins.results import variable

_EVENTS = 200  # told; all are in the record
_AXES = ("x", "y", "z (boresight)")


def reference_q_ib(ran: Ran) -> np.ndarray:
    """(E, 4) the wanted attitude at the end of each step."""
    return np.asarray(ran.kit.rows.course.ref_end_q_ib)[: len(ran.flown.time_s)]


def figures(flight: Flight, ran: Ran, loop: Flown | None) -> dict[str, Any]:
    """Figures for scripts.

    Args:
        flight: what was asked for.
        ran: what came of it.
        loop: the same run inside one program; None where there is none to compare with.
    """
    flown, counted = ran.flown, slice(counted_from(flight, ran.steps), None)
    attitude = telemetry.attitude_error(flown)
    pointing = telemetry.turn(reference_q_ib(ran), flown.q_ib)
    health = ran.health.values()
    summary = ran.latencies.summary()
    lateness = summary["cycle"]["lateness_us"]
    return {
        "scenario": flight.name,
        "flies": flight.setup.flies,
        "filter": flight.setup.filter,
        "seed": flight.setup.seed,
        "clock": flight.setup.clock,
        "steps": ran.steps,
        "seconds": ran.seconds,
        "cycles_per_s": ran.steps / ran.seconds if ran.seconds > 0.0 else 0.0,
        "max_abs_difference_in_process": None
        if loop is None or ran.steps == 0
        else telemetry.difference(flown, loop),
        "lateness_us": {k: lateness[k] for k in ("p50", "p99", "max")},
        "missed": summary["missed"],
        "counts": {
            "frames": sum(h.frames for h in health),
            "wrong_frames": sum(h.wrong for h in health),
            "lost_frames": sum(h.lost for h in health),
            "repeated_frames": sum(h.repeated for h in health),
            "late_frames": sum(h.late for h in health),
            "refused_frames": sum(h.refused for h in health),
            "refused_measurements": int(np.sum(flag(flown, "star refused"))),
            "quaternions_of_wrong_length": int(
                np.sum(flag(flown, "star of a length other than one"))
            ),
            "steps_without_gyro": int(np.sum(flag(flown, "gyro held"))),
            "steps_in_safe_mode": int(np.sum(flag(flown, "safe: do not steer by this"))),
            "silent_parts": sum(ran.silent.values()),
            "processes_died": ran.deaths,
        },
        "attitude_rms_arcsec": telemetry.rms_arcsec(attitude, counted),
        "attitude_peak_arcsec": telemetry.peak_arcsec(attitude, counted),
        "attitude_end_arcsec": float(np.linalg.norm(attitude[-1])) / ARCSEC if ran.steps else None,
        "pointing_rms_arcsec": telemetry.rms_arcsec(pointing, counted),
        "pointing_peak_arcsec": telemetry.peak_arcsec(pointing, counted),
        "injected": {f"{kind} at {link}": n for (kind, link), n in ran.injected.items()},
        "failure": ran.failure,
        "warnings": warnings(ran, attitude[counted]),
        "latencies": summary,
        "links": {name: dict(vars(h)) for name, h in ran.health.items()},
        "events": [
            {"time_s": e.fields["time_s"], "kind": e.kind, "text": e.text}
            for e in latest(ran.events, lambda event: event.kind, _EVENTS)
        ],
    }


def summary(flight: Flight, told: dict[str, Any]) -> dict[str, Any]:
    """The same as the summary of a result folder."""
    names = ("attitude_rms_arcsec", "attitude_peak_arcsec")
    names += ("pointing_rms_arcsec", "pointing_peak_arcsec", "cycles_per_s")
    return {
        "scenario": f"bench/{flight.name}",
        "seed": flight.setup.seed,
        "runs": 1,
        "filters": {flight.setup.filter: {name: told[name] for name in names}},
        "claims": [],
        "counts": {k: v for k, v in told["counts"].items() if v},
        "warnings": told["warnings"],
    }


def warnings(ran: Ran, error: np.ndarray) -> list[str]:
    """Why a reader should doubt the figures.

    Args:
        ran: the run.
        error: (E, 3) of the attitude, over the counted steps; NaN where it is not known.
    """
    out = [
        f"'{name}': {h.refused} frames were refused, which cannot be what they say"
        for name, h in ran.health.items()
        if h.refused
    ]
    if unknown := int(np.sum(~np.all(np.isfinite(error), axis=-1))):
        out.append(
            f"The error of the attitude is not known in {unknown} of the {len(error)} steps that "
            "count, and the figures are those of the others"
        )
    return out


def solution(flight: Flight, ran: Ran) -> xr.Dataset:
    """Time series of the run, as `robins.results` names them."""
    f = ran.flown
    dims = ("filter", "time", "axis_attitude")
    bias_dims = ("filter", "time", "axis_gyro_bias")
    heard = np.flatnonzero(np.isfinite(f.innovation[:, 0]))
    bias = np.asarray(ran.kit.rows.gyro_bias)[: ran.steps]
    pointing = telemetry.turn(reference_q_ib(ran), f.q_ib)
    wheels = len(ran.kit.vehicle.craft.wheel_h)
    arcsec, rate = {"display_unit": "arcsec"}, {"display_unit": "arcsec/s"}
    body = {"frame": "body"}

    def of(dims: tuple[str, ...], values: np.ndarray, unit: str, name: str, **more: Any) -> Any:
        return variable(dims, values[None], unit, name, **more)

    arrays = {
        "error_attitude": of(
            dims, telemetry.attitude_error(f), "rad", "attitude error", **body, **arcsec
        ),
        "sigma_attitude": of(
            dims, f.sigma[:, :3], "rad", "stated sigma of attitude", **body, **arcsec
        ),
        "estimate_gyro_bias": of(bias_dims, f.bias, "rad/s", "estimated gyro bias", **body, **rate),
        "error_gyro_bias": of(
            bias_dims, bias - f.bias, "rad/s", "error of the gyro bias", **body, **rate
        ),
        "sigma_gyro_bias": of(
            bias_dims, f.sigma[:, 3:], "rad/s", "stated sigma of the gyro bias", **body, **rate
        ),
        "value_pointing": of(
            ("filter", "time", "axis_pointing"),
            pointing,
            "rad",
            "pointing error",
            frame="reference",
            comment="Where the craft points against where it should.",
            **arcsec,
        ),
        "value_wheel_momentum": of(
            ("filter", "time", "axis_wheel"),
            f.wheel_h[:, :wheels],
            "N m s",
            "momentum of the wheels",
            frame="wheel axes",
        ),
    }
    coords = {
        "filter": [flight.setup.filter],
        "time": variable("time", f.time_s, "s", "time since the start"),
        "axis_attitude": list(_AXES),
        "axis_gyro_bias": list(_AXES),
        "axis_pointing": ["x", "y", "z"],
        "axis_wheel": [f"wheel {k}" for k in range(wheels)],
    }
    if len(heard):
        star = ("filter", "star_time", "axis_star")
        arrays |= {
            "innovation_star": of(star, f.innovation[heard], "rad", "innovation", **body, **arcsec),
            "innovation_sigma_star": of(
                star, f.innovation_sigma[heard], "rad", "its sigma", **body, **arcsec
            ),
            "refused_star": of(
                star[:2], flag(f, "star refused")[heard].astype(np.int8), "1", "star refused"
            ),
        }
        coords |= {
            "star_time": variable("star_time", f.time_s[heard], "s", "time since the start"),
            "axis_star": list(_AXES),
        }
    return xr.Dataset(arrays | lateness(ran), coords)


def lateness(ran: Ran) -> dict[str, Any]:
    """Histogram of how late steps began, where they had deadlines."""
    counted = ran.latencies.summary()["histogram"]
    if not any(counted["counts"]):
        return {}
    edges = np.array(counted["edges_us"], float)
    return {
        "lateness_steps": variable(
            "lateness_bin", np.array(counted["counts"]), "1", "steps that began so late"
        ),
        "lateness_edge": variable("lateness_edge_number", edges, "us", "edges of the bins"),
    }


def notes(flight: Flight, told: dict[str, Any]) -> list[str]:
    """What the figures say, in sentences."""
    out = []
    off = told["max_abs_difference_in_process"]
    if told["failure"]:
        out.append(f"The run failed: {told['failure']}.")
    if off is not None and not told["injected"]:
        same = "bit for bit the same as" if off == 0.0 else f"up to {off:.3g} off"
        out.append(f"Over the wire the run was {same} the run inside one program.")
    elif off is not None:
        out.append(
            f"The faults moved the run by up to {off:.3g} from the run inside one program without."
        )
    rate = told["cycles_per_s"]
    if flight.setup.clock == "realtime":
        late = told["lateness_us"]
        out.append(
            f"Real time, {told['missed']} of {told['steps']} deadlines missed; steps began "
            f"{late['p50']:.0f} us late (median), {late['p99']:.0f} us (99 %), "
            f"{late['max']:.0f} us (worst)."
        )
    else:
        out.append(f"Lock-step, {rate:.0f} steps a second.")
    return out
