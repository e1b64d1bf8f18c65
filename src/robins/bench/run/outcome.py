"""The outcome of a run on the bench: figures for scripts, sentences for people, arrays to draw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from robins.bench.live.feed import latest
from robins.bench.run import telemetry
from robins.bench.run.session import Ran
from robins.bench.run.setup import Flight, counted_from
from robins.bench.run.telemetry import ARCSEC, Flown, flag
from robins.results import Outcome, array, variable
from robins.results.summary import dumps, plain

RECORD, ACCOUNT = "record.mcap", "bench.json"

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


def outcome(flight: Flight, ran: Ran, loop: Flown | None, record: Path | None) -> Outcome:
    """All that a result folder says of the run.

    Args:
        flight: what was asked for.
        ran: what came of it.
        loop: the same run inside one program; None where there is none to compare with.
        record: what went over the lines, to be moved into the folder.
    """
    told = figures(flight, ran, loop)
    names = ("attitude_rms_arcsec", "attitude_peak_arcsec")
    names += ("pointing_rms_arcsec", "pointing_peak_arcsec", "cycles_per_s")
    files: dict[str, bytes | Path] = {ACCOUNT: dumps(plain(told)).encode()}
    last_lines = []
    if record is not None:
        files[RECORD] = record
        last_lines = [
            f"Record: {{out}}/{RECORD}   (opens in MCAP viewers too)",
            f"Next:   robins bench replay {{out}}/{RECORD} --node adm",
        ]
    return Outcome(
        solution(flight, ran) if ran.steps else None,
        {flight.setup.filter: {name: told[name] for name in names}},
        counts={k: v for k, v in told["counts"].items() if v},
        files=files,
        notes=notes(flight, told),
        warnings=told["warnings"],
        scenario=f"bench/{flight.name}",
        seed=flight.setup.seed,
        parameters=flight.text or f'bench = "satellite"\nflies = "{flight.setup.flies}"\n',
        tables=[text(told, ran)],
        last_lines=last_lines,
        for_scripts=ACCOUNT,
        failure=told["failure"],
    )


def text(told: dict[str, Any], ran: Ran) -> str:
    """The figures for a terminal: errors, the wire, how late parts were, what happened."""
    lines = [
        f"{name.replace('_', ' '):<16}{told[f'{name}_arcsec']:10.2f} arcsec"
        for name in ("attitude_rms", "attitude_peak", "pointing_rms", "pointing_peak")
    ]
    wire = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in told["counts"].items() if v)
    lines += [f"{'wire':<16}{wire}\n", ran.latencies.table()]
    lines += [
        f"  {event['time_s']:9.2f} s  {event['text']}"
        for event in told["events"]
        if event["kind"] != "missed"
    ]
    return "\n".join(lines)


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
    heard = np.flatnonzero(np.isfinite(f.innovation[:, 0]))
    bias = np.asarray(ran.kit.rows.gyro_bias)[: ran.steps]
    wheels = f.wheel_h[:, : len(ran.kit.vehicle.craft.wheel_h)]
    body: dict[str, Any] = {"unit": "rad", "frame": "body", "axes": _AXES, "display_unit": "arcsec"}
    rate = body | {"unit": "rad/s", "display_unit": "arcsec/s"}
    arrays: dict[str, Any] = {
        "filter": ("filter", [flight.setup.filter]),
        "time": variable("time", f.time_s, "s", "time since the start"),
    }

    def add(role: str, values: np.ndarray, of: str, **about: Any) -> None:
        arrays.update(array(role, values[None], of, **about))

    add("error", telemetry.attitude_error(f), "attitude", **body)
    add("sigma", f.sigma[:, :3], "attitude", **body)
    add("estimate", f.bias, "gyro_bias", **rate)
    add("error", bias - f.bias, "gyro_bias", **rate)
    add("sigma", f.sigma[:, 3:], "gyro_bias", **rate)
    add(
        "value",
        telemetry.turn(reference_q_ib(ran), f.q_ib),
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
        arrays["star_time"] = variable("star_time", f.time_s[heard], "s", "time since the start")
        add("innovation", f.innovation[heard], "star", **body)
        add("innovation_sigma", f.innovation_sigma[heard], "star", **body)
        add("refused", flag(f, "star refused")[heard].astype(np.int8), "star")
    return xr.Dataset(arrays | lateness(ran))


def lateness(ran: Ran) -> dict[str, Any]:
    """Histogram of how late steps began, where they had deadlines."""
    counted = ran.latencies.summary()["histogram"]
    if not any(counted["counts"]):
        return {}
    steps = array("lateness_steps", np.array(counted["counts"]))
    return steps | array("lateness_edge", np.array(counted["edges_us"], float))


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
