"""Closed loops of the satellite's scenarios, and what its filters make of them."""

import math
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from in_lanes import each

from robins import scenario
from robins.campaign.machine import first_worlds
from robins.filters import run_closed
from robins.filters.analysis.consistency import normalised_sq
from robins.manifold import local
from robins.systems.satellite import SYSTEM
from robins.systems.study import Problem

RUNS, MANY = 8, 24  # of `make test`, and of the specification, by `make certify`
ARCSEC = math.pi / 648000.0


class Found(NamedTuple):
    """Results of runs, in arcsec; (runs, E, ...)."""

    error: np.ndarray  # (.., 3) of attitude determination, body axes
    nees: np.ndarray  # (..) of the attitude, by its three components
    sigma: np.ndarray  # (.., 3) stated of the attitude
    pointing: np.ndarray  # (.., 3)
    wheel_momentum: np.ndarray  # (.., W) N m s
    used: np.ndarray  # (..) bool, whether the star sensor was used
    time_s: np.ndarray
    counted: slice

    @property
    def attitude(self) -> float:
        return float(np.sqrt(3.0 * np.mean(self.error[:, self.counted] ** 2)))

    @property
    def points(self) -> float:
        return float(np.sqrt(3.0 * np.mean(self.pointing[:, self.counted] ** 2)))

    @property
    def spread(self) -> float:
        each = np.sqrt(3.0 * np.mean(self.error[:, self.counted] ** 2, axis=(1, 2)))
        return float(np.std(each, ddof=1))


def parsed(name: str, settings: tuple[str, ...] = ()) -> Any:
    text = SYSTEM.scenarios[name].read_text()
    study = SYSTEM.studies["attitude-loop"]
    return scenario.parse(study.parameters, text, settings, source=name)


def problem(name: str, filters: tuple[str, ...], settings: tuple[str, ...] = ()) -> Problem:
    study = SYSTEM.studies["attitude-loop"]
    return study.problem(parsed(name, settings), filters, 0)


def _judging(contender: Any):
    def one(world):
        it = contender.case(world)

        def keep(step):
            return step.posterior, step.info["star"].used

        closed = run_closed(contender.filter, contender.model, it.start, it.loop, keep)
        given = closed.readings

        def judged(row):
            belief, truth, rows = row
            error, factor = local(belief.mean, truth), belief.factor
            if rows is not None:
                error, factor = rows @ error, rows @ factor
            sigma = jnp.sqrt(jnp.sum(factor**2, axis=1))
            return error[:3], normalised_sq(error[:3], factor[:3]) / 3.0, sigma[:3]

        posterior, used = closed.steps
        found = jax.lax.map(judged, (posterior, given.truth, given.rows))
        return *found, given.outputs, jnp.any(used, axis=-1)

    return one


@cache
def flights(name: str, runs: int, settings: tuple[str, ...]) -> Any:
    """Worlds of a packaged scenario, changed; leading axis: runs."""
    return first_worlds(problem(name, ("mekf",), settings), runs)


@cache
def flown(name: str, filter_: str, runs: int, settings: tuple[str, ...] = ()) -> Found:
    """Results of a filter on runs of a packaged scenario, changed."""
    p = problem(name, (filter_,), settings)
    judged = each(_judging(p.contenders[filter_]))(flights(name, runs, settings))
    error, nees, sigma, outputs, used = judged
    size = [np.asarray(x) / ARCSEC for x in (error, sigma, outputs["pointing"])]
    return Found(
        size[0],
        np.asarray(nees),
        size[1],
        size[2],
        np.asarray(outputs["wheel_momentum"]),
        np.asarray(used),
        p.epoch_s,
        slice(p.count_from, None),
    )
