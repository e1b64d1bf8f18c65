"""Runs of a filter by its entry points: inputs of a board, and the results of JAX."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.campaign.machine import first_worlds
from robins.campaign.monte_carlo import complete_case
from robins.filters import Belief, Code, Filter, FilterState, Model
from robins.filters.kalman import WRONG
from robins.filters.model import Data
from robins.filters.trees import select
from robins.manifold import State
from robins.systems.study import Case, Problem


class PredictionResult(NamedTuple):
    """Result of a prediction on a board."""

    code: Array


class UpdateResult(NamedTuple):
    """Result of an update on a board."""

    code: Array
    nis: Array
    dof: Array
    innovation: Array
    sigma: Array | np.ndarray
    used: Array
    wrong: Array | tuple[()] = ()  # of a bank, the probability that each suspect is wrong


Arguments = dict[str, tuple[Data, ...]]  # of each entry point, after the state
EntryFunction = Callable[..., tuple[FilterState, PredictionResult | UpdateResult]]


class BoardRun(NamedTuple):
    """Simulated run with the inputs given to a board.

    Attributes:
        case: with the truth and all that the filter is given, also where it ran in closed loop.
        start: the state of the filter that it begins with.
        given: of each entry point, in the order in which a step calls them, its arguments after the
            state, with a leading axis of steps.
    """

    case: Case
    start: FilterState
    given: Arguments

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(jax.tree_util.tree_leaves(self.given)[0])

    def cut(self, steps: int) -> BoardRun:
        """The same run, cut to its first steps."""
        given = jax.tree_util.tree_map(lambda a: a[:steps], self.given)
        return self._replace(given=given)

    def row(self, k: int) -> Arguments:
        """Inputs of one step."""
        return jax.tree_util.tree_map(lambda a: a[k], self.given)


def board_runs(problem: Problem, name: str, count: int) -> list[BoardRun]:
    """First runs of a problem, with the inputs of one of its filters."""
    contender = problem.contenders[name]
    model, found = contender.model, []
    batch = first_worlds(problem, count)
    for k in range(count):
        world = jax.tree_util.tree_map(lambda a, k=k: a[k], batch)
        case = complete_case(contender.filter, model, contender.case(world))
        start = case.start
        state = contender.filter.init(start, model.dims) if isinstance(start, Belief) else start
        state = jax.tree_util.tree_map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), state)
        found.append(BoardRun(case, state, _given(case, model)))
    return found


def _given(case: Case, model: Model) -> Arguments:
    arrays = partial(jax.tree_util.tree_map, np.asarray)
    given: Arguments = {"predict": (arrays(case.u),)}
    for sensor in model.sensors:
        if sensor.name in case.y:
            row = arrays(case.y[sensor.name]), arrays(case.aux.get(sensor.name))
            given[f"update_{sensor.name}"] = row
    return given


def entry_functions(
    filter_: Filter, model: Model, names: Collection[str]
) -> dict[str, EntryFunction]:
    """The entry points as functions of JAX, ``(state, *args) -> (state, result)``."""

    def predict(state: FilterState, u: Data):
        state, prediction = filter_.predict(state, model.motion, u)
        return state, PredictionResult(prediction.code)

    def update(name: str) -> EntryFunction:
        sensor = model.sensor(name)

        def use(state: FilterState, y: Data, aux: Data):
            state, info = filter_.update(state, sensor, y, aux)
            result = info.code, info.nis, info.dof, info.innovation, info.sigma, info.used
            return state, UpdateResult(*result, info.notes.get(WRONG, ()))

        return use

    return {n: predict if n == "predict" else update(n.removeprefix("update_")) for n in names}


def reset_function(filter_: Filter, start: FilterState) -> EntryFunction:
    """The entry point `reset`, ``(state, belief) -> (state, result)``.

    `Filter.reset` begins from the initial state, so that nothing learned since is left, not even of
    a state that is no longer finite. The entries of the factor above the diagonal are ignored. A
    belief that is not finite is refused.
    """

    def reset(state: FilterState, belief: Belief):
        given = belief._replace(factor=jnp.tril(belief.factor))
        are_finite = jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree_util.tree_leaves(given)])
        taken = jnp.all(are_finite)
        code = jnp.where(taken, int(Code.DONE), int(Code.NOT_FINITE))
        return select(taken, filter_.reset(start, given), state), PredictionResult(code)

    return reset


Calls = dict[str, tuple[State, State]]  # of each entry point what it returns, state and result
Kept = TypeVar("Kept")


def ends(calls: Calls) -> tuple[State, Array]:
    """The state after a step, and the codes (entry points,)."""
    return list(calls.values())[-1][0], jnp.stack([result.code for _, result in calls.values()], -1)


def by_jax(
    functions: Mapping[str, EntryFunction], run: BoardRun, kept: Callable[[Calls], Kept]
) -> Kept:
    """Kept values of the calls of each step, with a leading axis of steps; NumPy."""

    def step(state: State, row: State):
        calls: Calls = {}
        for name, function in functions.items():
            calls[name] = state, _ = function(state, *row[name])
        return state, kept(calls)

    made = jax.jit(lambda state, rows: jax.lax.scan(step, state, rows)[1])(run.start, run.given)
    return jax.tree_util.tree_map(np.asarray, made)
