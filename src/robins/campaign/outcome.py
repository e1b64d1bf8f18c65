"""A campaign's answer: every filter of a problem, on the same random numbers, as one outcome."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr

from robins.campaign.monte_carlo import CHUNK, chunks
from robins.campaign.statistics import Statistics
from robins.filters import Code
from robins.results import variable
from robins.systems.system import Outcome, Problem
from robins.systems.tables import Seen, innovation_tables


def simulate(
    problem: Problem,
    runs: int,
    chunk: int = CHUNK,
    progress: Callable[[float, str], None] | None = None,
) -> Outcome:
    """Run every filter of a problem over the same runs and compare them.

    Args:
        problem: what to simulate.
        runs: how many runs of each filter.
        chunk: runs per batch.
        progress: called with the share done in 0..1 and what is being done.
    """
    tell = progress if progress is not None else (lambda share, what: None)
    found: dict[str, Statistics] = {}
    names = list(problem.contenders)
    for i, name in enumerate(names):
        tell(i / len(names), f"{name}: compiling")

        def step(done: int, i=i, name=name):
            tell((i + done / runs) / len(names), f"{name}: {done} of {runs} runs")

        statistics = Statistics(problem.blocks, problem.count_from)
        for record in chunks(problem, name, runs, chunk, progress=step):
            statistics.add(record)
        found[name] = statistics
    metrics = {name: problem.metrics(s) for name, s in found.items()}
    return Outcome(
        solution=campaign_solution(problem, found),
        metrics=metrics,
        claims=problem.claims(metrics),
        counts=_counts(found),
    )


def _counts(found: dict[str, Statistics]) -> dict[str, int]:
    """Updates by outcome, and runs that diverged, over all filters."""
    out: dict[str, int] = {}
    for name, s in found.items():
        if s.diverged:
            out[f"{name}_diverged_runs"] = s.diverged
        for sensor, tally in s.codes.items():
            for code, number in tally.items():
                if code not in (Code.DONE, Code.MISSING):
                    out[f"{name}_{sensor}_{Code(code).name.lower()}"] = number
    return out


def _stack(found: dict[str, Statistics], pick: Callable[[Statistics], Any]) -> np.ndarray:
    return np.stack([np.asarray(pick(s), dtype=float) for s in found.values()])


def campaign_solution(problem: Problem, found: dict[str, Statistics]) -> xr.Dataset:
    """Statistics of all filters over time, and the first run as an example."""
    ft = ("filter", "time")
    runs = next(iter(found.values())).runs
    data: dict[str, Any] = {str(k): v for k, v in problem.context.data_vars.items()}
    coords: dict[str, Any] = {str(k): v for k, v in problem.context.coords.items()}
    coords["filter"] = list(found)
    coords["time"] = variable("time", problem.epoch_s, "s", "time since the start")
    for b in problem.blocks:
        axis, words = f"axis_{b.name}", b.name.replace("_", " ")
        coords[axis] = list(b.axes)

        def add(kind: str, text: str, pick, b=b, axis=axis, **attrs):
            data[f"{kind}_{b.name}"] = variable(
                (*ft, axis),
                _stack(found, lambda s: pick(s)[:, b.where]),
                b.units,
                text,
                b.frame,
                display_unit=b.display_unit,
                **attrs,
            )

        add("error", f"error of {words}, first run", lambda s: s.first_run["error"])
        add("sigma", f"stated sigma of {words}, first run", lambda s: s.first_run["sigma"])
        add("rms", f"RMS error of {words}", lambda s: s.rms, runs=runs)
        add("mean_sigma", f"stated sigma of {words}", lambda s: s.sigma, runs=runs)
    n = next(iter(found.values())).n
    data["anees"] = variable(
        ft,
        _stack(found, lambda s: s.anees()),
        "1",
        "ANEES",
        runs=runs,
        degrees_of_freedom=n,
        normalised=1,
    )
    data |= problem.shown({name: s.first_run["mean"] for name, s in found.items()})
    more, places = innovation_tables(_seen(found), problem.sensors, problem.epoch_s)
    return xr.Dataset(data | more, coords | places)


def _seen(found: dict[str, Statistics]) -> dict[str, Seen]:
    """Innovations of the first run, by sensor."""
    sensors = next(iter(found.values())).first_run["innovation"]

    def of(kind: str, sensor: str) -> np.ndarray:
        return _stack(found, lambda s: s.first_run[kind][sensor])

    return {
        k: Seen(
            of("innovation", k),
            of("innovation_sigma", k),
            of("nis", k),
            of("dof", k),
            of("code", k) == int(Code.REFUSED),
        )
        for k in sensors
    }
