"""Flights of the airship's scenarios, and what its filters make of them; each computed once."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from in_lanes import each

from robins import scenario
from robins.campaign.machine import first_worlds
from robins.filters import Code, run
from robins.filters.analysis.consistency import nees
from robins.manifold import local
from robins.systems.airship import SYSTEM
from robins.systems.airship.instruments import SAR
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import AirshipWorld
from robins.systems.study import Problem

RUNS, MANY = 8, 20  # of `make test`, and of the specification, by `make certify`
STUDY = SYSTEM.studies["navigation"]
TO_THE_END = ('imu.rate="10 Hz"', 'duration="800 s"')  # of what counts: 200 to 800 s


class Found(NamedTuple):
    """Errors of a filter: true minus estimated attitude, velocity, position in ENU."""

    error: np.ndarray  # (runs, E, 9)
    nees: np.ndarray  # (runs, E) over all states of the filter, by their number
    counted: slice

    def mean(self, first: int) -> float:
        """Mean length of two level components from this one on; over runs and time."""
        level = self.error[:, self.counted, first : first + 2]
        return float(np.mean(np.linalg.norm(level, axis=2)))

    @property
    def position_m(self) -> float:
        """Mean horizontal error."""
        return self.mean(6)

    @property
    def velocity_m_s(self) -> float:
        """Mean error of horizontal velocity."""
        return self.mean(3)

    @property
    def nees_all_states(self) -> float:
        """One for a filter that knows how wrong it is."""
        return float(np.mean(self.nees[:, self.counted]))

    def horizontal_rms_m(self, epoch: int) -> float:
        """Over the runs, at the end of an epoch."""
        return float(np.sqrt(np.mean(np.sum(self.error[:, epoch, 6:8] ** 2, axis=1))))


class Flights(NamedTuple):
    """Runs of a scenario."""

    name: str
    settings: tuple[str, ...]
    batch: AirshipWorld  # leading axis: runs

    def problem(self, *filters: str) -> Problem:
        """The scenario with these filters."""
        return problem(self.name, self.settings, filters)

    def found(self, name: str) -> Found:
        """Results of a filter on these runs."""
        problem = self.problem(name)
        error, square = _program(self.name, self.settings, name)(self.batch)
        counted = slice(problem.count_from, problem.count_to)
        return Found(error, square, counted)


def parsed(name: str, settings: tuple[str, ...] = TO_THE_END) -> Airship:
    """Parameters of a packaged scenario, changed."""
    return scenario.parse(Airship, SYSTEM.scenarios[name].read_text(), settings, source=name)


@cache
def problem(name: str, settings: tuple[str, ...], filters: tuple[str, ...]) -> Problem:
    """A packaged scenario, changed, with these filters."""
    return STUDY.problem(parsed(name, settings), filters, seed=0)


@cache
def flights(name: str, settings: tuple[str, ...] = TO_THE_END, runs: int = RUNS) -> Flights:
    """Runs of a packaged scenario."""
    return Flights(name, settings, first_worlds(problem(name, settings, ()), runs))


def beginning(batch: AirshipWorld, epochs: int) -> AirshipWorld:
    """First epochs of runs."""
    count = batch.wind.shape[1]
    return jax.tree.map(lambda x: x[:, :epochs] if x.shape[1:2] == (count,) else x, batch)


def without_radar(batch: AirshipWorld, begin: int, end: int) -> AirshipWorld:
    """Neither radar nor barometer at the ends of these epochs."""
    gone = np.zeros(batch.wind.shape[1], bool)
    gone[begin:end] = True
    return told_by_radar(batch, lambda x, at: jnp.where(gone[at], jnp.nan, x))


def told_by_radar(batch: AirshipWorld, changed: Callable[[Any, Any], Any]) -> AirshipWorld:
    """Changed reports of radar and barometer: arrays (runs, E, ...), and the lag of the epochs."""
    before = batch.readings[SAR]
    after = jax.tree.map(lambda x: changed(x, (None, slice(None), *[None] * (x.ndim - 2))), before)
    return batch._replace(readings=batch.readings | {SAR: after})


def traced(problem: Problem, name: str, world: Any) -> tuple[Any, Any]:
    """Shapes of the error of one run and of its square, without compiling."""
    return jax.eval_shape(_judging(problem.contenders[name]), world)


def _judging(contender: Any):
    """Error of a filter in one run, (E, 9), and its square by what it states, (E,)."""
    reported = jnp.asarray(contender.reported)

    def one(world):
        it = contender.case(world)
        posterior, prediction = run(
            *(contender.filter, contender.model, it.start, it.y, it.u, it.aux),
            keep=lambda s: (s.posterior, s.prediction),
        ).steps

        def judged(row):
            belief, truth = row
            size = float(belief.factor.shape[-1])
            return reported @ local(belief.mean, truth), nees(belief, truth) / size

        error, square = jax.lax.map(judged, (posterior, it.truth))
        stuck = jnp.cumsum(prediction.code != int(Code.DONE)) > 0
        return jnp.where(stuck[:, None], jnp.nan, error), square

    return one


@cache
def _program(name: str, settings: tuple[str, ...], filter_: str):
    return each(_judging(problem(name, settings, (filter_,)).contenders[filter_]))


@cache
def found(name: str, filter_: str, runs: int = MANY) -> Found:
    """Results of a filter on a packaged scenario."""
    return flights(name, runs=runs).found(filter_)
