"""Cost of single precision for a filter: its runs in floats, against doubles and the truth.

The library is compiled on this machine and gets the inputs of the filter, rounded to floats. Its
output is compared with double precision number by number, and both with the simulated truth.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike, DTypeLike

from robins import units
from robins.campaign.monte_carlo import Blocks, blocks_of, reported_rows
from robins.export.library import Library, StructField, filled
from robins.export.runs import BoardRun, Calls, Kept
from robins.filters import Belief, FilterState
from robins.filters.analysis.consistency import normalised_sq
from robins.manifold import State, local
from robins.program import FLAGS, Program, build
from robins.program.walk import counts, slots
from robins.systems.study import Contender, Problem

NONE: Mapping[str, float] = {}
LITTLE, MUCH = 1.01, 1.1  # growth of an RMS or NEES: negligible up to LITTLE, ruin above MUCH
MARGIN, LEAST = 4.0, 1e-6  # of tolerances over differences: other compilers round differently
SEVERAL = 0.01  # share of changed codes above which the filter is ruined too

# Code that is called some thousand times is not worth optimising; its bits are the same.
QUICK = tuple("-O0" if flag == "-O2" else flag for flag in FLAGS)


class BlockCost(NamedTuple):
    """Error of a block against the truth, over the steps that count.

    Attributes:
        name: of the block.
        unit: of the RMS.
        rms: root mean square of the components, in double precision.
        rms_single: the same in single precision.
        nees: normalised error squared over the number of components; 1 is consistent.
        nees_single: the same in single precision.
    """

    name: str
    unit: str
    rms: float
    rms_single: float
    nees: float
    nees_single: float

    @property
    def growth(self) -> float:
        """Factor of single precision on the RMS, or on the NEES if that moves further."""
        with np.errstate(all="ignore"):
            factor = np.divide(self.rms_single, self.rms)
            ratio = np.divide(self.nees_single, self.nees)
            found = float(max(factor, ratio, 1.0 / ratio)) if np.isfinite(self.nees) else factor
        return float(found) if np.isfinite(self.rms_single) else math.inf


class PrecisionCost(NamedTuple):
    """Cost of single precision.

    Attributes:
        runs: number of runs compared.
        steps: of each.
        fields: of each field of the state, the largest difference over the largest number.
        blocks: errors against the truth.
        codes: number of codes compared.
        codes_off: number of those that differ.
        finite: whether the state is finite wherever that of double precision is.
    """

    runs: int
    steps: int
    fields: Mapping[str, float]
    blocks: Sequence[BlockCost]
    codes: int
    codes_off: int
    finite: bool

    @property
    def bearable(self) -> bool:
        """True if the state is finite, and errors and codes change little (`MUCH`, `SEVERAL`)."""
        grows = max((b.growth for b in self.blocks), default=1.0)
        return self.finite and grows <= MUCH and self.codes_off <= SEVERAL * self.codes

    @property
    def verdict(self) -> str:
        """Sentence that sums up the cost."""
        if not self.finite:
            return "Single precision RUINS this filter: its state does not stay finite."
        worst = max(self.blocks, key=lambda b: b.growth)
        moved = (
            f"{worst.name}: RMS {worst.rms:.4g} becomes {worst.rms_single:.4g} {worst.unit}, "
            f"NEES {worst.nees:.3g} becomes {worst.nees_single:.3g}"
        )
        if worst.growth > MUCH:
            return f"Single precision RUINS this filter: {moved}."
        if not self.bearable:
            share = self.codes_off / self.codes
            return f"Single precision RUINS this filter: {share:.1%} of its codes are others."
        if worst.growth > LITTLE:
            return f"Single precision costs something: {moved}."
        return "Single precision costs nothing that shows in the errors."

    def as_data(self) -> dict[str, Any]:
        """Figures for scripts; None where one is not finite."""

        def sound(x: float) -> float | None:
            return x if math.isfinite(x) else None

        return {
            **{k: getattr(self, k) for k in ("runs", "steps", "codes", "codes_off", "finite")},
            "bearable": self.bearable,
            "verdict": self.verdict,
            "fields": {name: sound(x) for name, x in self.fields.items()},
            "blocks": [
                {k: sound(v) if isinstance(v, float) else v for k, v in b._asdict().items()}
                for b in self.blocks
            ],
        }

    def table(self) -> str:
        """The blocks and the fields as tables in Markdown."""
        rows = [
            "| error | unit | RMS, double | RMS, single | NEES, double | NEES, single |",
            "|---|---|---|---|---|---|",
        ]
        rows += [
            f"| {b.name} | {b.unit} | {b.rms:.4g} | {b.rms_single:.4g} | {b.nees:.4g} "
            f"| {b.nees_single:.4g} |"
            for b in self.blocks
        ]
        rows += ["", "| field of the state | largest difference, parts of the field |", "|---|---|"]
        rows += [f"| {name} | {part:.1e} |" for name, part in self.fields.items()]
        return "\n".join(rows)


def in_floats(
    library: Library, runs: Sequence[BoardRun], kept: Callable[[Calls], Kept]
) -> list[Kept]:
    """Kept values of all calls of the library, compiled here; leading axis of steps, doubles.

    Raises:
        BuildError: there is no compiler.
    """
    loaded = ctypes.CDLL(str(build(library.programs(), QUICK)))
    made = (kept(_one(loaded, library, run)) for run in runs)
    return [jax.tree_util.tree_map(np.asarray, one) for one in made]


def _one(loaded: ctypes.CDLL, library: Library, run: BoardRun) -> Calls:
    dtype, calls = library.precision.dtype, []
    start = [np.asarray(x)[None] for x in jax.tree_util.tree_leaves(run.start)]
    state = [rows[0] for rows in _flat(start, dtype, 1)]
    own = [a.size for a in state]
    for entry in library.entries:
        if entry.name not in run.given:
            continue  # it is no part of a step
        made = counts(entry.program.results)
        sizes = zip(counts(entry.program.inputs), made, strict=True)
        x, k = (np.zeros(max(n), kind) for n, kind in zip(sizes, (dtype, np.int64), strict=True))
        function = getattr(loaded, f"of_{entry.symbol}")
        function.restype = None
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (x, k, x, k)]
        rows = _flat(jax.tree_util.tree_leaves(run.given[entry.name]), dtype, run.steps)
        kept = [np.zeros((run.steps, n), a.dtype) for n, a in zip(made, (x, k), strict=True)]
        calls.append((entry, function, pointers, (x, k), rows, kept))
    for t in range(run.steps):
        for _, function, pointers, memory, rows, kept in calls:
            for space, carried, row, size in zip(memory, state, rows, own, strict=True):
                space[:size] = carried
                space[size : size + row.shape[1]] = row[t]
            function(*pointers)
            state = [space[:size].copy() for space, size in zip(memory, own, strict=True)]
            for whole, space in zip(kept, memory, strict=True):
                whole[t] = space[: whole.shape[1]]
    return {entry.name: _as_tree(kept, entry.program) for entry, *_, kept in calls}


def _flat(leaves: Sequence[ArrayLike], dtype: DTypeLike, steps: int) -> list[np.ndarray]:
    """Two arrays with a leading axis of steps: the reals of all leaves, and all else."""
    arrays = [np.asarray(x) for x in leaves]
    parts = []
    for real, kind in ((True, dtype), (False, np.int64)):
        mine = [a for a in arrays if (a.dtype == np.float64) == real]
        with np.errstate(over="ignore"):
            flat = [a.reshape(steps, -1).astype(kind) for a in mine]
        parts.append(np.concatenate([np.zeros((steps, 0), kind), *flat], axis=1))
    return parts


def _as_tree(kept: Sequence[np.ndarray], program: Program) -> tuple[State, State]:
    """Results of all calls of a program as it gives them, in doubles."""
    found = []
    for slot in slots(program.results)[0]:
        part = kept[not slot.is_real][:, slot.first : slot.last]
        found.append(part.reshape(len(part), *slot.shape).astype(slot.dtype))
    return jax.tree_util.tree_unflatten(program.structure[1], found)


Made = tuple[FilterState, np.ndarray | Array]  # states and codes of a run


def differences(
    fields: Sequence[StructField], doubles: State, singles: State, least: Mapping[str, float] = NONE
) -> dict[str, float]:
    """Largest relative difference of each field of reals in the states or results of a run.

    It is relative to the largest number of the field, at least to its ``least``.
    """
    found = {}
    for (f, a), (_, b) in zip(filled(fields, doubles), filled(fields, singles), strict=True):
        if f.is_real:
            size = np.max(np.abs(a), initial=least.get(f.name, 0.0), where=np.isfinite(a))
            with np.errstate(invalid="ignore"):
                off = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
            part = np.max(np.where(np.isnan(off), np.inf, off), initial=0.0)
            found[f.name] = float(part / size if size > 0.0 else part)
    return found


def cost(
    problem: Problem,
    contender: Contender,
    library: Library,
    runs: Sequence[BoardRun],
    doubles: Sequence[Made],
    singles: Sequence[Made],
) -> PrecisionCost:
    """Compare single with double precision over the given runs."""
    fields: dict[str, float] = {}
    for (wide, _), (narrow, _) in zip(doubles, singles, strict=True):
        for name, part in differences(library.state, wide, narrow).items():
            fields[name] = max(part, fields.get(name, 0.0))
    errors = [
        [
            _errors(problem, contender, run, states)
            for run, (states, _) in zip(runs, made, strict=True)
        ]
        for made in (doubles, singles)
    ]
    blocks = []
    for block in problem.blocks:
        figures = []
        for made in errors:
            error = np.concatenate([e[:, block.where] for e, _ in made])
            nees = np.concatenate([n[block.name] for _, n in made]) / error.shape[1]
            rms = units.convert(np.sqrt(np.mean(error**2)), block.units, block.display_unit)
            figures.append((float(rms), float(np.mean(nees))))
        (rms, nees), (rms_single, nees_single) = figures
        block_figures = block.name, block.display_unit, rms, rms_single, nees, nees_single
        blocks.append(BlockCost(*block_figures))
    codes = [np.array([c for _, c in made]) for made in (doubles, singles)]
    return PrecisionCost(
        runs=len(runs),
        steps=codes[0].shape[1],
        fields=fields,
        blocks=blocks,
        codes=codes[0].size,
        codes_off=int(np.sum(codes[0] != codes[1])),
        finite=all(map(math.isfinite, fields.values())),
    )


def _errors(
    problem: Problem, contender: Contender, run: BoardRun, states: FilterState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(E, r) reported error over the steps that count, and of each block its (E,) NEES."""
    rows, along = reported_rows(contender.reported, run.case)
    error, nees = _judged(blocks_of(problem), along, states.belief, run.case.truth, rows)
    counted = slice(problem.count_from, problem.count_to)
    return np.asarray(error)[counted], {k: np.asarray(v)[counted] for k, v in nees.items()}


@partial(jax.jit, static_argnames=("blocks", "along"))
def _judged(blocks: Blocks, along: int | None, belief: Belief, truth: State, rows: Array | None):
    """Error and NEES by block, with a leading axis of steps."""

    def one(belief: Belief, truth: State, rows: Array | None):
        error, factor = local(belief.mean, truth), belief.factor
        error, factor = (error, factor) if rows is None else (rows @ error, rows @ factor)
        return error, {n: normalised_sq(error[a:b], factor[a:b]) for n, a, b in blocks}

    return jax.vmap(one, (0, 0, along))(belief, truth, rows)
