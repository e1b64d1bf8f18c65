"""Warnings on a run that is too short or too slow for its test."""

from __future__ import annotations

from collections.abc import Iterator

from robins.bench.evaluation import RunResult
from robins.bench.rig import LoadedRun
from robins.scenario import Parameters, Span


def doubts(flight: LoadedRun, result: RunResult) -> list[str]:
    """Warnings on planned events that did not happen, and on a missed clock rate.

    For a failed run, whose reason is known, only the latter.
    """
    behind = [event for event in result.events if event.kind == "behind"]
    late = [f"At {one.fields['time_s']:g} s {one.text}" for one in behind[-1:]]
    return late if result.failure else [*late, *_missed(flight, result)]


def _missed(flight: LoadedRun, result: RunResult) -> Iterator[str]:
    step_ns, setup = result.config.step_ns, flight.setup
    end_s = result.steps * step_ns * 1e-9
    for fault in setup.faults:
        what = f"The fault '{fault.kind}' at {fault.link or 'all links'}"
        hit = (kind == fault.kind and fault.link in (None, link) for kind, link in result.injected)
        if fault.begin_ns > result.steps * step_ns:
            yield _after(what, fault.begin, end_s)
        elif not any(hit):
            yield f"{what}, from {fault.begin:g} s on, met nothing: the run tests nothing of it"
    for name, span in _spans(flight.given):
        if span.begin >= end_s:
            yield _after(f"'{name}' of what flies", span.begin, end_s)
    for one in setup.says:
        if one.step(step_ns) >= result.steps:
            what = f"'{one.message}' was to be said at {one.at:g} s"
            yield f"{what}, after the end of the run at {end_s:g} s"


def _after(what: str, begin_s: float, end_s: float) -> str:
    when = f"begins at {begin_s:g} s, after the end of the run at {end_s:g} s"
    return f"{what} {when}: the run tests nothing of it"


def _spans(given: Parameters, where: str = "") -> Iterator[tuple[str, Span]]:
    """Names and spans of the planned disturbances of a scenario."""
    for name in type(given).model_fields:
        value = getattr(given, name)
        if isinstance(value, Parameters):
            yield from _spans(value, f"{where}{name}.")
        elif isinstance(value, tuple):
            yield from ((f"{where}{name}", one) for one in value if isinstance(one, Span))
