"""Shares of the variance of an error that come from each uncertain parameter.

Let Y = f(p_1 .. p_d) be an error and the parameters independent. With X ~ p_i all of them but p_i,

    first order  S_i  = Var(E(Y | p_i)) / Var(Y)        what would go if p_i were known
    total        ST_i = E(Var(Y | X ~ p_i)) / Var(Y)    what would stay if all others were known

(Sobol 2001, Math. Comput. Simulation 55). S_i <= ST_i; the total has the interactions with other
parameters too. Both are estimated by Saltelli et al. (2010, Comput. Phys. Commun. 181), as in
SciPy, from two samples A and B of n points and for each parameter A with its column of B.

Here the world varies and the filter does not: it assumes the scenario as written. The numbers that
vary are data of one program, which is possible because records of parameters accept tracers of JAX
in place of numbers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from scipy import stats

from robins.campaign.machine import one_by_one
from robins.campaign.many_runs import ManyRuns
from robins.campaign.monte_carlo import blocks_of, one_record
from robins.errors import require
from robins.filters import Belief
from robins.filters.model import Data
from robins.results import array
from robins.scenario import Parameters
from robins.systems.study import Contender, StateBlock, Study, View

RESAMPLES = 999  # of the bootstrap
LEVEL = 0.95  # of its bounds
ROUNDING = 1e-9  # an RMS that varies by less, relative, does not vary
DECADE = 10.0  # ends that differ by more than this factor are drawn by their logarithm

Path = tuple[str | int, ...]  # names of fields and numbers of items, from the parameters down


# -------------------------------------------------------------------------- numbers that vary


class ParameterRange(NamedTuple):
    """Range of the numbers of one parameter key, such as those of three axes."""

    paths: tuple[Path, ...]
    low: tuple[float, ...]  # SI
    high: tuple[float, ...]

    @property
    def by_logarithm(self) -> bool:
        """True if the logarithm is uniform: the ends have one sign and differ more than tenfold."""
        pairs = zip(self.low, self.high, strict=True)
        return all(a * b > 0.0 and max(a / b, b / a) > DECADE * (1.0 + 1e-9) for a, b in pairs)

    @property
    def law(self) -> str:
        """Name of the distribution."""
        return "log-uniform" if self.by_logarithm else "uniform"

    def at(self, share: Any) -> dict[Path, Any]:
        """Numbers at a fraction, from 0 to 1, of the range."""
        ends = zip(self.paths, self.low, self.high, strict=True)
        return {path: interpolated(share, a, b, self.by_logarithm) for path, a, b in ends}


def interpolated(share: Data, low: float, high: float, by_logarithm: bool) -> Data:
    """Number at a fraction, from 0 to 1, between its ends."""
    return low * (high / low) ** share if by_logarithm else low + (high - low) * share


def between(low: Any, high: Any) -> ParameterRange:
    """Range between two sets of parameters.

    Raises:
        ValueError: nothing differs, or something that is not a number.
    """
    found = list(_differing(low, high, ()))
    require(found, "its two ends are the same")
    return ParameterRange(*(tuple(one) for one in zip(*found, strict=True)))


def _differing(low: Any, high: Any, path: Path) -> Iterator[tuple[Path, float, float]]:
    if isinstance(low, Parameters) and type(low) is type(high):
        for name in type(low).model_fields:
            yield from _differing(getattr(low, name), getattr(high, name), (*path, name))
    elif isinstance(low, tuple) and isinstance(high, tuple) and len(low) == len(high):
        for k, pair in enumerate(zip(low, high, strict=True)):
            yield from _differing(*pair, (*path, k))
    elif isinstance(low, float) and isinstance(high, float):
        if low != high:
            yield path, low, high
    elif low != high:
        raise ValueError("is no quantity that can take any value between its ends")


def with_numbers(given: Any, numbers: Mapping[Path, Any]) -> Any:
    """Parameters with other numbers, which may be traced and are not checked."""
    if () in numbers:
        return numbers[()]
    inner: dict[str | int, dict[Path, Any]] = {}
    for (head, *rest), value in numbers.items():
        inner.setdefault(head, {})[tuple(rest)] = value
    if isinstance(given, tuple):
        return tuple(with_numbers(x, inner[k]) if k in inner else x for k, x in enumerate(given))
    return given.model_copy(
        update={
            str(name): with_numbers(getattr(given, str(name)), rest) for name, rest in inner.items()
        }
    )


# ----------------------------------------------------------------------------- points and runs


class SensitivityRuns(NamedTuple):
    """A filter in worlds whose numbers vary between their ends."""

    study: Study
    given: Any  # the parameters as written: what the filter believes
    course: Any  # laid out by these
    view: View
    contender: Contender
    seed: int
    ranges: tuple[ParameterRange, ...]

    def run(self, shares: Array, index: Array) -> tuple[Array, Array]:
        """One run at one point; pure.

        Args:
            shares: (d,) of each parameter, from 0 to 1.
            index: number of the run.

        Returns:
            (blocks,) mean over the epochs that count of the squared length of the error, infinite
            where the filter diverged, as in `robins.campaign.Statistics`; and a number that
            changes with the initial belief of the filter.
        """
        numbers: dict[Path, Any] = {}
        for k, one in enumerate(self.ranges):
            numbers |= one.at(shares[k])
        world = self.study.simulate(
            with_numbers(self.given, numbers), self.course, self.seed, index
        )
        record = one_record(blocks_of(self.view), self.contender, world, over=one_by_one)
        error, sigma = record["error"], record["sigma"]
        found = jnp.all(jnp.isfinite(error)) & jnp.all(jnp.isfinite(sigma))
        counted = error[self.view.count_from : self.view.count_to]
        squares = [jnp.mean(jnp.sum(counted[:, b.where] ** 2, 1)) for b in self.view.blocks]
        believed = _believed(self.contender.case(world).start)
        return jnp.where(found, jnp.stack(squares), jnp.inf), believed


def _believed(start: Any) -> Array:
    """Sum of the log variances of a belief, which any standard deviation in any unit changes."""
    if not isinstance(start, Belief):
        return jnp.zeros(())
    size = jnp.sum(jnp.asarray(start.factor, float) ** 2, axis=-1)
    return jnp.sum(jnp.where(size > 0.0, jnp.log(jnp.where(size > 0.0, size, 1.0)), 0.0))


def changes_belief(believed: np.ndarray) -> list[bool]:
    """True for each parameter that changes the initial belief of the filter.

    Args:
        believed: (d + 2, n, runs), as of `simulate_points` at the points of `sobol_points`.
    """
    return [not np.allclose(one, believed[0], rtol=1e-9, atol=1e-12) for one in believed[2:]]


def courses_differ(before: Any, course: Any, after: Any) -> bool:
    """True if two courses differ in anything that can be compared.

    Args:
        before: a course.
        course: of the same parameters, laid out again: differences from it do not count.
        after: of other parameters.
    """
    first, again, other = (list(_parts(x)) for x in (before, course, after))
    if len(first) != len(other):
        return True
    each = zip(first, again, other, strict=True)
    return any(_alike(a, b) and not _alike(a, c) for a, b, c in each)


def _parts(x: Data) -> Iterator[Data]:
    """The leaves of a pytree, and of the dataclasses among them."""
    for leaf in jax.tree_util.tree_leaves(x):
        if dataclasses.is_dataclass(leaf) and not isinstance(leaf, type):
            yield from _parts([getattr(leaf, f.name) for f in dataclasses.fields(leaf)])
        else:
            yield leaf


def _alike(a: Data, b: Data) -> bool:
    if isinstance(a, np.ndarray | np.generic | jax.Array | float | int):
        return bool(np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f"))
    return type(a) is type(b) and bool(a == b)


def untraceable(budget: SensitivityRuns) -> list[int]:
    """Indices of the parameters whose worlds JAX cannot trace, each varied alone."""

    def fails(one: ParameterRange) -> bool:
        alone = budget._replace(ranges=(one,))
        try:
            jax.eval_shape(alone.run, jax.ShapeDtypeStruct((1,), float), jnp.asarray(0))
        except jax.errors.JAXTypeError:
            return True
        return False

    return [k for k, one in enumerate(budget.ranges) if fails(one)]


def simulate_points(
    budget: SensitivityRuns,
    shares: np.ndarray,
    runs: int,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Simulate all runs at all points.

    Args:
        budget: what is run.
        shares: (points, d).
        runs: number of runs, with the same random numbers at all points.
        progress: called with the share done.

    Returns:
        (points, runs, blocks) and (points, runs), as of `SensitivityRuns.run`; parts that JAX
        computed.

    Raises:
        jax.errors.JAXTypeError: a world cannot be traced; see `untraceable`.
    """
    run = ManyRuns(budget.run)
    return *run(list(shares), np.arange(runs), progress), run.notes


# --------------------------------------------------------------------------------- the indices


def sobol_points(d: int, samples: int, seed: int) -> np.ndarray:
    """(d + 2, samples, d) points in the unit cube: A, B, and A with each column of B.

    A and B are halves of a scrambled Sobol sequence in 2 d dimensions (Saltelli et al. 2010).

    Args:
        d: parameters.
        samples: a power of two, which the sequence is balanced for.
        seed: of the scrambling.
    """
    # scipy 1.14 has no `rng` yet; later ones take either name
    rng = np.random.default_rng(seed)
    drawn = stats.qmc.Sobol(2 * d, seed=rng).random(samples)  # pyright: ignore[reportCallIssue]
    A, B = drawn[:, :d], drawn[:, d:]
    mixed = np.repeat(A[None], d, axis=0)
    for i in range(d):
        mixed[i, :, i] = B[:, i]
    return np.concatenate([A[None], B[None], mixed])


class Indices(NamedTuple):
    """Indices (s, d) of each output and parameter, with 95 % bounds; NaN: no variance."""

    first: np.ndarray  # (s, d)
    first_low: np.ndarray
    first_high: np.ndarray
    total: np.ndarray
    total_low: np.ndarray
    total_high: np.ndarray


def indices(squares: np.ndarray, seed: int, resamples: int = RESAMPLES) -> Indices:
    """Sobol indices of the RMS over runs, at the points of `sobol_points`.

    The bounds are of a percentile bootstrap that resamples points and runs, so they show how far
    chance in either may have moved an index.

    Args:
        squares: (d + 2, n, runs, s) mean squares of each run.
        seed: of the bootstrap.
        resamples: their number.
    """
    _, n, runs, _ = squares.shape
    rng = np.random.default_rng(seed)
    rms = np.sqrt(np.mean(squares, axis=2))
    least, most = np.min(rms, axis=(0, 1)), np.max(rms, axis=(0, 1))
    known = np.isfinite(most) & (most > (1.0 + ROUNDING) * least)
    found = np.full((6, squares.shape[3], squares.shape[0] - 2), np.nan)
    if not np.any(known):
        return Indices(*found)
    some = np.ascontiguousarray(np.moveaxis(squares[..., known], 2, -1))  # runs last, to be summed
    drawn = []
    for _ in range(resamples):
        weight = np.bincount(rng.integers(runs, size=runs), minlength=runs) / runs
        drawn.append(_estimate(np.sqrt(some @ weight)[:, rng.integers(n, size=n)]))
    tails = 0.5 * (1.0 - LEVEL), 0.5 * (1.0 + LEVEL)
    bounds = np.quantile(np.array(drawn), tails, axis=0)  # (2, first and total, s, d)
    for k, value in enumerate(_estimate(rms[..., known])):
        found[3 * k : 3 * k + 3, known] = value, bounds[0, k], bounds[1, k]
    return Indices(*found)


def _estimate(f: np.ndarray) -> np.ndarray:
    """(2, s, d) first and total order, of outputs (d + 2, n, s)."""
    twice = np.concatenate([f, f], axis=2)  # scipy drops axes of one, and fails with two of them
    of = {"f_A": twice[0].T, "f_B": twice[1].T, "f_AB": np.moveaxis(twice[2:], -1, 1)}
    found = stats.sobol_indices(func=of, n=f.shape[1])
    both = (np.reshape(x, (-1, len(f) - 2)) for x in (found.first_order, found.total_order))
    return np.stack([x[: f.shape[2]] for x in both])


def labelled(
    name: str,
    ends: Sequence[tuple[str, str, str]],
    points: np.ndarray,
    squares: np.ndarray,
    blocks: Sequence[StateBlock],
    found: Indices,
) -> xr.Dataset:
    """Arrays of a result: indices of each block, RMS errors and shares of all points.

    Args:
        name: of the filter.
        ends: name of each parameter, and both ends as texts.
        points: (d + 2, n, d), of `sobol_points`.
        squares: (d + 2, n, runs, s) mean squares of each run.
        blocks: s of them.
        found: their indices.
    """
    data: dict[str, Any] = {"parameter": ("parameter", [key for key, _, _ in ends])}
    about = {"of_filter": name, "samples": points.shape[1], "runs": squares.shape[2]}
    rms = np.sqrt(np.mean(squares, axis=2)).reshape(-1, len(blocks))
    for k, b in enumerate(blocks):
        for field in Indices._fields:
            more = about if field == "first" else {}
            data |= array(f"sobol_{field}", getattr(found, field)[k], b.name, **more)
        shown = {"unit": b.units, "display_unit": b.display_unit}
        data |= array("sobol_rms", rms[:, k], b.name, **shown)
    texts = "; ".join(f"{low} to {high}" for _, low, high in ends)
    return xr.Dataset(data | array("sobol_share", points.reshape(len(rms), -1), ends=texts))
