"""The covariance bound of a problem: what its sensors allow, without a filter or data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, PyTree

from robins.campaign.machine import with_stack
from robins.campaign.many_runs import ManyRuns
from robins.campaign.monte_carlo import complete_case, contender, reported_rows
from robins.errors import require
from robins.filters import Belief
from robins.filters.analysis.bound import bound_along, linearised, used_sensors
from robins.filters.analysis.observability import (
    NOTHING,
    bits,
    direction_in_words,
    observability_along,
    spectrum,
    unobservable,
)
from robins.filters.model import Data
from robins.manifold import State, dim, is_element
from robins.program.interpreter import interpreted_rounds
from robins.program.stages import StagedFunction
from robins.results import array, variable
from robins.systems.study import Case, Contender, Problem, StateBlock
from robins.systems.tables import block_array

_AT_ONCE = 128  # runs: histories of the information of each are held
FEW = 1.0  # eigenvalue of the Gramian below which the prior holds more on a direction
_FEWEST, _MOST = 3, 6  # directions that are reported


def bound(problem: Problem, name: str, runs: int = 1, without: Sequence[str] = ()) -> xr.Dataset:
    """The covariance bound for the model of a contender, along simulated true trajectories.

    Args:
        problem: what to simulate.
        name: contender whose model and start are taken; its filter plays no part, but for steering
            the vehicle where the problem is a closed loop.
        runs: number of trajectories; variances are averaged over them.
        without: sensors to leave out altogether.

    Returns:
        ``bound_BLOCK`` (time, axis_BLOCK), one standard deviation; ``bound_prior_BLOCK``
        (axis_BLOCK) before the first step; ``bound_unaided_BLOCK`` with no sensor and
        ``bound_without_BLOCK`` (sensor, time, axis_BLOCK) without one of them;
        ``bound_left_BLOCK`` (axis_BLOCK), sigma of the initial state after all measurements over
        its prior, without process noise. Of the first run ``information`` (state, time), the bits
        gained about the start, see `robins.filters.observability`; ``gramian`` (direction), the
        least eigenvalues, with a coordinate that describes each direction in words; and
        ``gramian_rank``. The attribute ``filter`` is the name.

    Raises:
        ValueError: there is no such contender or sensor, none is left, or the bound is not finite.
    """
    c = contender(problem, name)
    try:
        use = used_sensors(c.model, without)
    except KeyError as error:
        raise ValueError(f"filter '{name}' has {error.args[0]}") from None
    names = [s.name for s in c.model.sensors]
    one_less = use & ~np.eye(len(use), dtype=bool)
    subsets = jnp.asarray(np.concatenate([[use], [np.zeros_like(use)], one_less]))

    def bounded(_: Data, number: Array) -> dict[str, Data]:
        return _bounded(c, subsets, problem.simulate(number))

    first, variance, prior = _of_all(ManyRuns(bounded), runs)
    L, D = first["L"], first["D"]
    sigma, prior = np.sqrt(variance), np.sqrt(prior)
    if not (np.all(np.isfinite(sigma)) and np.all(np.isfinite(L))):
        raise ValueError(
            f"the bound of filter '{name}' is not finite: its model cannot be linearised along the "
            "true states, or something in it grows without bound and is not seen"
        )
    shown = [i for i in range(len(names)) if first["spoke"][i] and use[i]]
    require(shown, f"no sensor of filter '{name}' is left that measures: it has {names}")
    rows = np.eye(len(D)) if first["rows"] is None else first["rows"]
    left = _share_left(rows, L[-1], D)
    data = _sigmas(problem, sigma, prior, left, [names[i] for i in shown], shown)
    data |= _information(*_states(problem.blocks, rows, first["mean"]), L, D)
    labels = {"filter": name, "runs": runs, "without": ", ".join(without)}
    return xr.Dataset(data, attrs=labels)


def _of_all(bounded: ManyRuns, runs: int) -> tuple[dict[str, Data], np.ndarray, np.ndarray]:
    """Results of `_bounded` for the first run, and means of its variance and prior over all."""
    require(runs > 0, "there must be runs", runs)
    first: dict[str, Data] = {}
    variance = prior = np.zeros(())
    for begin in range(0, runs, _AT_ONCE):
        found = bounded([()], np.arange(begin, min(begin + _AT_ONCE, runs)))
        first = first or jax.tree_util.tree_map(lambda x: x[0, 0], found)
        variance = variance + np.sum(found["variance"][0], axis=0)
        prior = prior + np.sum(found["prior"][0], axis=0)
    return first, variance / runs, prior / runs


def bound_sigma(problem: Problem, name: str, world: PyTree, machine: str = "vm") -> np.ndarray:
    """(E, r) standard deviations of the reported components, which no filter can go below.

    Args:
        problem: whose components they are.
        name: the contender whose model and start are believed.
        world: one run, as the problem simulates it.
        machine: "jax", or another for the interpreter; what that cannot do, or all where it cannot
            be built, JAX computes.
    """
    c = contender(problem, name)

    def variances(world: Data) -> Array:
        it = complete_case(c.filter, c.model, c.case(world))
        line = linearised(c.model, _start(it), it.truth, it.y, it.u, it.aux)
        rows, _ = reported_rows(c.reported, it)
        return _reported(rows, bound_along(line, _start(it).factor).factor)

    if machine == "jax":
        return np.sqrt(np.asarray(jax.jit(variances)(world)))
    staged = StagedFunction(variances, jax.eval_shape(lambda: world), engine=interpreted_rounds)
    one = jax.tree_util.tree_map(lambda x: x[None], world)
    return np.sqrt(with_stack(lambda: staged(one)[0]))


def _share_left(rows: np.ndarray, L: np.ndarray, D: np.ndarray) -> np.ndarray:
    """(r,) posterior over prior sigma of the reported initial state; NaN if known."""
    begun = np.linalg.norm(rows * D, axis=1)
    known = begun == 0.0
    share = np.linalg.norm(rows @ (D[:, None] * L), axis=1) / np.where(known, 1.0, begun)
    return np.where(known, np.nan, share)


def _start(case: Case) -> Belief:
    """The belief a case begins with, also where it holds the state of a filter."""
    return getattr(case.start, "belief", case.start)


def _reported(rows: Array | None, factor: Array) -> Array:
    """(..., r) variances of the reported components."""
    mapped = factor if rows is None else rows @ factor
    return jnp.sum(mapped**2, axis=-1)


def _bounded(c: Contender, subsets: Array, world: Data) -> dict[str, Data]:
    """Bound of one run, and its parts.

    Args:
        c: whose model and start are believed.
        subsets: (V, S) of the sensors.
        world: the run, as the problem simulates it.

    Returns:
        variance (V, E, r) by subset; prior (r,) variances; mean of the start; L (E, n, n) factors
        of (I + W)^-1 with the Gramian W of the first subset, and D (n,) its units; spoke (S,) true
        for sensors that ever measured anything; rows (r, n) the reported combinations of the start,
        or None.
    """
    it = complete_case(c.filter, c.model, c.case(world))
    start = jax.tree_util.tree_map(jnp.asarray, _start(it))
    line = linearised(c.model, start, it.truth, it.y, it.u, it.aux)
    rows, _ = reported_rows(c.reported, it)
    first = None if rows is None else rows if rows.ndim == 2 else rows[0]

    def of(use: Array) -> Array:
        return _reported(rows, bound_along(line, start.factor, use).factor)

    spoke = [jnp.array(False) if s is None else jnp.any(s.present) for s in line.sights]
    return {
        "variance": jax.vmap(of)(subsets),
        "prior": _reported(first, start.factor),
        "mean": start.mean,
        "L": observability_along(line, start.sigma, subsets[0]),
        "D": start.sigma,
        "spoke": jnp.stack(spoke),
        "rows": first,
    }


def _sigmas(
    problem: Problem,
    sigma: np.ndarray,
    prior: np.ndarray,
    left: np.ndarray,
    names: list[str],
    shown: list[int],
) -> dict[str, Any]:
    """Standard deviations by block, and their coordinates."""
    time = variable("time", problem.epoch_s, "s", "time since the start")
    data: dict[str, Any] = {"time": time, "sensor": ("sensor", names)}
    for b in problem.blocks:
        for role, values in (
            ("bound", sigma[0]),
            ("bound_prior", prior),
            ("bound_unaided", sigma[1]),
            ("bound_without", sigma[2:][shown]),
        ):
            data |= block_array(role, b, values[..., b.where])
        data |= array("bound_left", left[b.where], b.name, frame=b.frame)
    return data


def _states(
    blocks: Sequence[StateBlock], rows: np.ndarray, mean: State
) -> tuple[list[str], np.ndarray]:
    """Names of the tangent components, and the sign with which they are reported.

    A component takes the name of the axis that reports it alone, others that of their field.
    """
    names, sign = _named(mean), np.ones(rows.shape[1])
    for b in blocks:
        for row, axis in zip(rows[b.where], b.axes, strict=True):
            (at,) = np.nonzero(row)
            if len(at) == 1:
                names[at[0]] = f"{b.name.replace('_', ' ')} {axis}"
                sign[at[0]] = np.sign(row[at[0]])
    return names, sign


def _named(mean: State) -> list[str]:
    """Names of the tangent components by the fields of the state, or by their numbers."""
    names: list[str] = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(mean, is_leaf=is_element)[0]:
        size = dim(leaf)
        field = getattr(path[-1], "name", getattr(path[-1], "key", None)) if path else None
        for i in range(size):
            number = f" {i + 1}" if size > 1 else ""
            named = isinstance(field, str)
            names.append(
                f"{field.replace('_', ' ')}{number}" if named else f"state {len(names) + 1}"
            )
    return names


def _information(names: list[str], sign: np.ndarray, L: np.ndarray, D: np.ndarray):
    """Information in bits by state and time, and the least observable directions, in words."""
    (open_,) = np.nonzero(D > 0.0)  # a state known from the start gains no information
    labels = [names[i] for i in open_]
    values, vectors = spectrum(L[-1][np.ix_(open_, open_)])
    rank = int(np.sum(values >= NOTHING))
    hidden = unobservable(values, vectors)
    rest = vectors[:, hidden.shape[1] :]
    most = min(max(_FEWEST, int(np.sum(values < FEW))), _MOST)
    shown = (sign[open_, None] * np.concatenate([hidden, rest], axis=1))[:, :most]
    words = [f"{i + 1}: {direction_in_words(v, labels)}" for i, v in enumerate(shown.T)]
    data: dict[str, Any] = {"state": ("state", labels), "direction": ("direction", words)}
    data |= array("information", bits(L[:, open_]).T)
    data |= array("gramian", values[: len(words)], nothing=NOTHING)
    return data | array("gramian_rank", rank)
