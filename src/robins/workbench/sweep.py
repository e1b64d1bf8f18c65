"""A campaign for each value of a parameter, or of two, as one result."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from robins import units
from robins.campaign.gather import gather
from robins.campaign.machine import available_cores
from robins.campaign.plan import CampaignPlan
from robins.campaign.statistics import Statistics, rms_with_bounds
from robins.campaign.store import Store, open_store
from robins.report.numbers import csv_of
from robins.results import Outcome, Progress, array, ignore_progress
from robins.systems.study import StateBlock
from robins.workbench.campaign import (
    SWEEP,
    CampaignStatus,
    Where,
    campaign_report,
    campaign_status,
    fields_of,
    plan_campaign,
    problem_of,
    ready,
    sweep_of,
)
from robins.workbench.errors import InputError
from robins.workbench.workers import fill

MOST = 400  # most points of a sweep
_QUANTITY = re.compile(r"\s*([-+0-9.eE]+)\s*(.*?)\s*")


class SweptParameter(NamedTuple):
    """A parameter and its values."""

    key: str
    values: tuple[str, ...]

    @property
    def coordinate(self) -> tuple[list[float] | list[str], str]:
        """Numbers and their common unit; or the texts, and no unit."""
        parts = [_QUANTITY.fullmatch(value) for value in self.values]
        try:
            found = [(float(p[1]), p[2]) for p in parts if p]
        except ValueError:
            found = []
        shared = {unit for _, unit in found}
        if len(found) < len(parts) or len(shared) > 1:
            return list(self.values), ""
        return [number for number, _ in found], shared.pop() or "1"


def swept_parameter(text: str) -> SweptParameter:
    """Read ``key=a,b,c``.

    Raises:
        InputError: it is not of this form, or names a value twice.
    """
    key, equals, rest = text.partition("=")
    values = tuple(value.strip() for value in rest.split(","))
    if not equals or not key.strip() or not all(values):
        fix = 'write --vary "slave.gyro_bias=1 deg/h,10 deg/h" or the like.'
        raise InputError("is not key=a,b,c", f"--vary {text}", fix)
    if len(set(values)) < len(values):
        raise InputError("has a value twice", f"--vary {text}", "name each once.")
    return SweptParameter(key.strip(), values)


class SweepPoint(NamedTuple):
    """One choice of values, and the folder of its campaign."""

    place: tuple[int, ...]
    settings: tuple[str, ...]
    where: str


def points(where: Where, vary: Sequence[SweptParameter]) -> Iterator[SweepPoint]:
    """All points; the last parameter varies fastest."""
    for place in itertools.product(*(range(len(v.values)) for v in vary)):
        settings = tuple(f"{v.key}={v.values[k]}" for v, k in zip(vary, place, strict=True))
        yield SweepPoint(place, settings, f"{where}/{name_of(place)}")


def name_of(place: Sequence[int]) -> str:
    """The folder of a point in that of its sweep."""
    return f"points/{'-'.join(map(str, place))}"


def sweep(
    name: str,
    where: Where,
    *,
    vary: Sequence[str],
    workers: int | None = None,
    machine: str = "",
    settings: Sequence[str] = (),
    progress: Progress = ignore_progress,
    **options: Any,
) -> Outcome:
    """Run a scenario for each value of one or two parameters, with the same random numbers.

    Each point is a campaign in a folder of its own, so that a sweep goes on where it was stopped,
    and more runs compute only what is new.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        where: a folder, or an address of object storage.
        vary: one or two texts ``key=a,b,c``.
        workers: processes; by default one per core.
        machine: as for `plan_campaign`.
        settings: "path=value" texts that change the scenario at all points.
        progress: called with the fraction done and the current activity.
        **options: runs, seed and filters, as for `plan_campaign`.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be run.
        robins.errors.RobinsError: a worker failed, or the store cannot be used.
    """
    chosen = [swept_parameter(text) for text in vary]
    every = list(points(where, chosen))
    if len(chosen) not in (1, 2) or len({v.key for v in chosen}) < len(chosen):
        raise InputError("a sweep is over one parameter or two", "--vary", "give it once or twice.")
    if len(every) > MOST:
        raise InputError(f"has {len(every)} points, more than {MOST}", "--vary", "name fewer.")
    campaigns: list[tuple[str, CampaignPlan]] = []
    for k, point in enumerate(every):
        progress(0.1 * k / len(every), f"planning {', '.join(point.settings)}")
        more = (*settings, *point.settings)
        plan = plan_campaign(point.where, name, settings=more, machine=machine, **options)
        campaigns.append((point.where, plan))
    content = {"vary": list(vary), "points": [name_of(point.place) for point in every]}
    open_store(where).put(SWEEP, json.dumps(content).encode(), overwrite=True)

    def filling(share: float, what: str) -> None:
        progress(0.1 + 0.9 * share, what)

    fill(where, campaigns, workers or available_cores(), filling)
    return _outcome(chosen, every)


def status(where: Where) -> CampaignStatus | dict[str, CampaignStatus]:
    """Progress of a campaign, or of those of a sweep by the settings of its points."""
    every = _sweep_request(where)
    if every is None:
        return campaign_status(where)
    return {", ".join(point.settings): campaign_status(point.where) for point in every[1]}


def report(where: Where) -> Outcome:
    """Outcome of the finished runs of a campaign, or of all campaigns of a sweep.

    Raises:
        InputError: there is no run of some filter.
    """
    every = _sweep_request(where)
    return campaign_report(where) if every is None else _outcome(*every)


def _sweep_request(where: Where) -> tuple[list[SweptParameter], list[SweepPoint]] | None:
    """Varied parameters of a folder's sweep, and its points; None where there is one campaign."""
    sweep = sweep_of(where)
    if sweep is None:
        return None
    chosen = [swept_parameter(text) for text in sweep[0][:2]]
    return chosen, list(points(where, chosen))


_FIGURES = ("rms", "low", "high", "stated")


def _figures(found: Statistics, block: StateBlock) -> list[float]:
    """RMS length of the error of a block over runs and epochs, its 95 % bounds, and the root of the
    mean variance that the filter states; in SI.
    """
    squares = np.sum(found.run_rms[:, block.where] ** 2, axis=1)
    stated = np.sum(found.sigma[found.counted, block.where] ** 2, axis=1)
    return [*map(float, rms_with_bounds(squares)), float(np.sqrt(np.mean(stated)))]


def _outcome(vary: Sequence[SweptParameter], every: Sequence[SweepPoint]) -> Outcome:
    """The errors of all filters at all points."""
    plans = {point: ready(point.where)[1] for point in every}
    plan = plans[every[0]]
    blocks = problem_of(plan).blocks
    sizes = (*(len(v.values) for v in vary), 1)[:2]
    shape = (len(plan.filters), *sizes)
    figures = {b.name: np.full((*shape, len(_FIGURES)), np.nan) for b in blocks}
    rows: list[list[Any]] = []
    lost: dict[str, int] = dict.fromkeys(plan.filters, 0)
    for point in every:
        store: Store = open_store(point.where)
        found = gather(store, plans[point], problem_of(plans[point])).found
        for f, filter_ in enumerate(plan.filters):
            one = found[filter_]
            if not one.runs:
                raise InputError(f"has no run of '{filter_}' yet", point.where, "run it again.")
            lost[filter_] += one.diverged
            for b in blocks:
                figure = _figures(one, b)
                figures[b.name][(f, *(*point.place, 0)[:2])] = figure
                shown = [units.convert(x, b.units, b.display_unit) for x in figure]
                values = [v.values[k] for v, k in zip(vary, point.place, strict=True)]
                rows.append([filter_, *values, b.name, b.display_unit, *shown, one.runs])
    head = ["filter", *(v.key for v in vary), "block", "unit", *_FIGURES, "runs"]
    first = problem_of(plan)
    return Outcome(
        solution=_solution(plan, vary, blocks, figures),
        metrics={
            filter_: {
                f"{b.name}_rms_{units.as_ending(b.display_unit)}": [
                    float(units.convert(x, b.units, b.display_unit))
                    for x in figures[b.name][f, ..., 0].ravel()
                ]
                for b in blocks
            }
            | {"diverged_runs": lost[filter_]}
            for f, filter_ in enumerate(plan.filters)
        },
        files={"sweep.csv": csv_of([head, *rows])},
        notes=[
            f"{len(every)} points of {plan.runs} runs; lists of metrics go through "
            f"{' and '.join(v.key for v in vary)}, the last first.",
            *first.notes,
        ],
        **fields_of(plan),
        last_lines=["Table:  {out}/sweep.csv   all points, with 95 % bounds"],
    )


def _solution(
    plan: CampaignPlan,
    vary: Sequence[SweptParameter],
    blocks: Sequence[StateBlock],
    figures: dict[str, np.ndarray],
) -> xr.Dataset:
    data: dict[str, Any] = {"filter": ("filter", list(plan.filters))}
    for k, one in enumerate([*vary, SweptParameter("", ("",))][:2], 1):
        numbers, unit = one.coordinate
        about = {"units": unit, "long_name": one.key} if unit else {"long_name": one.key}
        data[f"sweep_{k}"] = xr.Variable(f"sweep_{k}", numbers, about)
    for b in blocks:
        about = {"unit": b.units, "display_unit": b.display_unit}
        for place, role in enumerate(_FIGURES):
            more: dict[str, Any] = {"runs": plan.runs} if role == "rms" else {}
            values = figures[b.name][..., place]
            data |= array(f"sweep_{role}", values, b.name, **about, **more)
    return xr.Dataset(data)
