"""Outcome of a run on the bench: figures for scripts, sentences for people, arrays to plot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from robins.bench.broker.link import BenchError
from robins.bench.evaluation import MessageSeries, RunFigures, RunResult, arrays_of
from robins.bench.live.feed import JsonObject, latest
from robins.bench.ports.port import program
from robins.bench.rig import LoadedRun
from robins.bench.run.setup import calling
from robins.bench.run.telemetry import difference
from robins.bench.run.untested import doubts
from robins.results import Outcome, array, variable
from robins.results.summary import dumps, plain

RECORD, ACCOUNT = "record.mcap", "bench.json"

_EVENTS = 200  # listed; all are in the record


def run_figures(flight: LoadedRun, result: RunResult) -> RunFigures:
    """Evaluation of the run by its rig; empty for a run without a step.

    Raises:
        BenchError: the rig cannot evaluate it; names the line that failed.
    """
    if not result.steps:
        return RunFigures()
    with calling(flight.rig, "judge", "or leave it out: then all numbers are drawn"):
        return flight.rig.judge(flight, result)


def in_one_program(flight: LoadedRun, result: RunResult) -> Mapping[str, np.ndarray] | None:
    """Same run inside one program; None: such a run cannot be compared.

    Raises:
        BenchError: the rig cannot compute it; names the line that failed.
    """
    rig, setup = flight.rig, flight.setup
    on_lines = all(map(program, setup.ports.values()))
    if setup.clock != "lockstep" or not (result.steps and on_lines):
        return None
    with calling(rig, "inside", "or leave it out: then no run is compared with it"):
        return rig.inside(
            result.config, result.steps, *([result.operator_events] if rig.console else [])
        )


def figures(
    flight: LoadedRun, result: RunResult, said: RunFigures, inside: Mapping[str, np.ndarray] | None
) -> JsonObject:
    """Figures for scripts.

    Args:
        flight: the setup of the run.
        result: its results.
        said: its evaluation by the rig.
        inside: the same run inside one program; None where there is none to compare with.
    """
    health = result.health.values()
    summary = result.latencies.summary()
    lateness = summary["cycle"]["lateness_us"]
    return {
        "scenario": flight.name,
        "flies": flight.setup.flies,
        "filter": flight.setup.filter,
        "seed": flight.setup.seed,
        "clock": flight.setup.clock,
        "steps": result.steps,
        "seconds": result.seconds,
        "cycles_per_s": result.steps / result.seconds if result.seconds > 0.0 else 0.0,
        "max_abs_difference_in_process": None
        if inside is None or result.steps == 0
        else difference(result.series, inside),
        "lateness_us": {k: lateness[k] for k in ("p50", "p99", "max")},
        "missed": summary["missed"],
        "counts": {
            "frames": sum(h.frames for h in health),
            "wrong_frames": sum(h.wrong for h in health),
            "lost_frames": sum(h.lost for h in health),
            "repeated_frames": sum(h.repeated for h in health),
            "late_frames": sum(h.late for h in health),
            "early_frames": sum(h.early for h in health),
            "sequence_jumps": sum(h.jumps for h in health),
            "refused_frames": sum(h.refused for h in health),
            **said.counts,
            "silent_parts": sum(result.silent.values()),
            "processes_died": result.deaths,
        },
        **said.metrics,
        "injected": {f"{kind} at {link}": n for (kind, link), n in result.injected.items()},
        "failure": result.failure,
        "warnings": [*refusals(result), *doubts(flight, result), *said.warnings],
        "latencies": summary,
        "links": {name: dict(vars(h)) for name, h in result.health.items()},
        "events": [
            {"time_s": e.fields["time_s"], "kind": e.kind, "text": e.text}
            for e in latest(result.events, lambda event: event.kind, _EVENTS)
        ],
    }


def outcome(flight: LoadedRun, result: RunResult, record: Path | None) -> Outcome:
    """Contents of the result folder of a run.

    Args:
        flight: the setup of the run.
        result: its results.
        record: the traffic of the lines, to be moved into the folder.
    """
    failures = [result.failure]
    if not (result.steps or result.failure):
        failures = ["it was stopped before its first step"]
    said, inside = RunFigures(arrays=arrays_of(flight.rig.noted, result.series)), None
    # Both may be the user's own code; if it fails, the run itself is still shown.
    try:
        inside = in_one_program(flight, result)
    except BenchError as error:
        failures.append(str(error))
    try:
        said = run_figures(flight, result)
    except BenchError as error:
        failures.append(str(error))
    result = result._replace(failure="; ".join(filter(None, failures)))
    account = figures(flight, result, said, inside)
    files: dict[str, bytes | Path] = {ACCOUNT: dumps(plain(account)).encode()}
    last_lines = []
    if record is not None:
        files[RECORD] = record
        again = f"Next:   robins bench replay {{out}}/{RECORD} --node {flight.rig.example}"
        last_lines = [f"Record: {{out}}/{RECORD}   (opens in MCAP viewers too)"]
        last_lines += [again] * bool(result.steps)
    rig = flight.rig.address or flight.rig.name
    flies = f'flies = "{flight.setup.flies}"\n' if flight.setup.flies else ""
    name = flight.setup.filter or flight.rig.name
    return Outcome(
        solution(name, result.series, said, result) if result.steps else None,
        {name: {**said.metrics, "cycles_per_s": account["cycles_per_s"]}},
        counts={k: v for k, v in account["counts"].items() if v},
        files=files,
        notes=notes(flight, account),
        warnings=account["warnings"],
        scenario=f"bench/{flight.name}",
        seed=flight.setup.seed,
        parameters=flight.text or f'bench = "{rig}"\n{flies}',
        tables=[text(account, said, result)],
        last_lines=last_lines,
        for_scripts=ACCOUNT,
        failure=account["failure"],
    )


def text(account: JsonObject, said: RunFigures, result: RunResult) -> str:
    """Text for a terminal: figures of merit, health of the lines, lateness of parts, events."""
    wire = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in account["counts"].items() if v)
    lines = [*said.lines, f"{'wire':<16}{wire}\n", result.latencies.table()]
    lines += [
        f"  {event['time_s']:9.2f} s  {event['text']}"
        for event in account["events"]
        if event["kind"] != "missed"
    ]
    return "\n".join(lines)


def refusals(result: RunResult) -> list[str]:
    """Sentences on refused frames, by link."""
    return [
        f"'{name}': {h.refused} frames were refused, which cannot be what they say"
        for name, h in result.health.items()
        if h.refused
    ]


def solution(name: str, series: MessageSeries, said: RunFigures, result: RunResult) -> xr.Dataset:
    """Time series of the run, as `robins.results` names them."""
    arrays: dict[str, Any] = {
        "filter": ("filter", [name]),
        "time": variable("time", series.time_s, "s", "time since the start"),
    }
    return xr.Dataset({**arrays, **said.arrays, **lateness(result)})


def lateness(result: RunResult) -> dict[str, xr.Variable]:
    """Histogram of the lateness of steps; empty in lock-step."""
    counted = result.latencies.summary()["histogram"]
    if not any(counted["counts"]):
        return {}
    steps = array("lateness_steps", np.array(counted["counts"]))
    return steps | array("lateness_edge", np.array(counted["edges_us"], float))


def notes(flight: LoadedRun, account: JsonObject) -> list[str]:
    """Sentences that sum up the figures."""
    out = []
    off = account["max_abs_difference_in_process"]
    if account["failure"]:
        out.append(f"The run failed: {account['failure']}.")
    if off is not None and not account["injected"]:
        same = "bit for bit the same as" if off == 0.0 else f"up to {off:.3g} off"
        out.append(f"Over the wire the run was {same} the run inside one program.")
    elif off is not None:
        out.append(
            f"The faults moved the run by up to {off:.3g} from the run inside one program without."
        )
    rate = account["cycles_per_s"]
    if flight.setup.clock == "realtime":
        late = account["lateness_us"]
        out.append(
            f"Real time, {account['missed']} of {account['steps']} deadlines missed; steps began "
            f"{late['p50']:.0f} us late (median), {late['p99']:.0f} us (99 %), "
            f"{late['max']:.0f} us (worst)."
        )
    else:
        out.append(f"Lock-step, {rate:.0f} steps a second.")
    return out
