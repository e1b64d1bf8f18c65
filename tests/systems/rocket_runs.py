"""Flights of the rocket's scenarios, and what its filters make of them; each computed once."""

from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from in_lanes import each

from robins import scenario
from robins.campaign.machine import first_worlds
from robins.filters import run
from robins.filters.analysis.consistency import normalised_sq
from robins.manifold import local
from robins.systems.rocket import SYSTEM
from robins.systems.rocket.world import PEAK_S, RocketWorld
from robins.systems.study import Problem

RUNS, MANY = 8, 20  # of `make test`, and of the specification, by `make certify`
SHORT = ('duration="150 s"',)  # of the angles; of the field it takes the whole flight


class Found(NamedTuple):
    """Errors of a filter as they are reported, in degrees."""

    error: np.ndarray  # (runs, E, r)
    nees: np.ndarray  # (runs, E) of the attitude, by its three components
    time_s: np.ndarray  # (E,)
    every_s: float  # of the disturbances, infinite if there are none
    length_s: float

    def rms(self, where: np.ndarray, of: slice = slice(0, 3)) -> float:
        return float(np.sqrt(np.mean(self.error[:, where, of] ** 2)))

    @property
    def counted(self) -> np.ndarray:
        return self.time_s > 30.0 + 1e-9

    @property
    def attitude(self) -> float:
        return self.rms(self.counted)

    @property
    def quiet(self) -> float:
        since = np.mod(self.time_s + 1e-9, self.every_s) - self.length_s
        return self.rms(self.counted & (since > 10.0))

    @property
    def peak(self) -> float:
        begun = np.arange(self.every_s, self.time_s[-1] - PEAK_S, self.every_s)
        size = np.abs(self.error[..., :3])
        soon = [
            np.max(size[:, (self.time_s > t - 1e-6) & (self.time_s < t + PEAK_S)], axis=1)
            for t in begun
        ]
        return float(np.mean(soon))

    @property
    def about(self) -> float:
        return self.rms(self.counted, slice(3, 4))

    @property
    def across(self) -> float:
        return float(np.sqrt(2.0) * self.rms(self.counted, slice(4, 6)))

    @property
    def nees_attitude(self) -> float:
        return float(np.mean(self.nees[:, self.counted]))


def parsed(name: str, settings: tuple[str, ...] = ()) -> Any:
    """Parameters of a packaged scenario, changed, and the study it is of."""
    text = SYSTEM.scenarios[name].read_text()
    study = SYSTEM.studies[scenario.mapping_of(text)["study"]]
    return scenario.parse(study.parameters, text, settings, source=name), study


@cache
def problem(name: str, settings: tuple[str, ...], filters: tuple[str, ...] = ()) -> Problem:
    """A packaged scenario, changed, with these filters."""
    given, study = parsed(name, settings)
    return study.problem(given, filters, 1)


@cache
def flights(name: str, settings: tuple[str, ...], runs: int) -> RocketWorld:
    """Runs of a packaged scenario, changed; leading axis: runs."""
    return first_worlds(problem(name, settings), runs)


def _judging(contender: Any):
    def one(world):
        it = contender.case(world)
        steps = run(
            *(contender.filter, contender.model, it.start, it.y, it.u, it.aux),
            keep=lambda s: s.posterior,
        ).steps

        def judged(row):
            belief, truth, rows = row
            error, factor = local(belief.mean, truth), belief.factor
            if rows is not None:
                error, factor = rows @ error, rows @ factor
            return error, normalised_sq(error[:3], factor[:3]) / 3.0

        return jax.lax.map(judged, (steps, it.truth, it.rows))

    return one


@cache
def found(name: str, filter_: str, runs: int = MANY) -> Found:
    """Results of a filter on flights of a scenario."""
    settings = SHORT if name.startswith("a") else ()
    p, burst = problem(name, settings, (filter_,)), parsed(name)[0].magnetometer.disturbance
    error, square = each(_judging(p.contenders[filter_]))(flights(name, settings, runs))
    every, length = (np.inf, 0.0) if burst is None else (burst.every, burst.length)
    return Found(np.degrees(error), square, p.epoch_s, every, length)
