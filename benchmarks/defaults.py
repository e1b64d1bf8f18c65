"""The default filter of every system against the best of those that were told.

    python benchmarks/defaults.py [SYSTEM/SCENARIO ...] [--runs 50] [--seeds 0] [--named]
        [--troubles] [--keep scores.json] [--out table.md]

Without a name, every simulated scenario. A row says the RMS error of what the scenario is about
(attitude, or position), over epochs and runs that count, of the default filter over that of the
best other filter, and the NEES of that block for a component: one where the filter knows how wrong
it is. Others are all that the scenario names itself, and

    told       the model of "adaptive" as it stands, in one Kalman filter, with the scale of its
               process noise that turned out best on these very runs; of transfer alignment also
               one that is told the flexure it meets

With --troubles a table more, of what no scenario has: each is done to the simulated world from the
middle of the run on, here and not in robins.

    bias step     the gyros' bias moves by ten times its stated sigma
    scale error   what the gyros report is 0.3 % too much
    loud          records have 30 times their noise, for 20 s
    lost axis     one component of each record is missing
    soft, fast    a structure flexes by 20' in 6 s, or by 3' in 0.4 s (transfer alignment)

It takes hours for all; nothing is fetched. What is found is kept in a file, filter by filter, so
that an interrupted table goes on where it was, and a filter that has changed is computed again
where its lines are deleted there. A name, few runs and a small --chunk make it short.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import tomllib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from robins.cli.cache import enable

enable()  # programs are kept between calls; before JAX is imported

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins import manifold, scenario, units
from robins.campaign.monte_carlo import record, worlds
from robins.filters import Model, Motion, kalman
from robins.filters.rules import huber
from robins.rotation import Rotation
from robins.systems import catalogue
from robins.systems.finding import find_system
from robins.systems.study import Case, Contender, Problem
from robins.systems.transfer_alignment.product.parameters import PairAssumptions
from robins.systems.transfer_alignment.product.study import product_contender
from robins.systems.transfer_alignment.velocity_attitude.study import of_product

ABOUT = {"airship": "position", "ins-gnss": "position", "gnss": "position"}  # else attitude
SCALES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)


class Score(NamedTuple):
    """Figures of a filter on the runs of a scenario."""

    error: float  # RMS length, display unit
    nees: float  # of a component


# --------------------------------------------------------------------------------- who is told


def _scaled_step(motion: Motion, scale: Array, x: Any, u: Any):
    return motion.step(x, u)


def _scaled_noise(motion: Motion, scale: Array, x: Any, u: Any):
    return scale * motion.noise_factor(x, u)


def _scaled_linear(motion: Motion, scale: Array, x: Any, u: Any):
    assert motion.linear is not None
    new, F, noise = motion.linear(x, u)
    return new, F, scale * noise


def told(base: Contender, scale: float) -> Contender:
    """One Kalman filter with Huber's rule, on a model whose process noise is scaled."""
    motion, s = base.model.motion, jnp.asarray(scale)
    linear = None if motion.linear is None else Partial(_scaled_linear, motion, s)
    louder = Motion(Partial(_scaled_step, motion, s), Partial(_scaled_noise, motion, s), linear)
    return replace(base, filter=TOLD, model=Model(louder, base.model.sensors))


TOLD = kalman(rules=[huber(0.999)])


def told_structure(given: Any) -> Contender:
    """The product filter that believes in the flexure that is there, or in none."""
    structure = given.flexure if any(given.flexure.sigma) else None
    if given.study == "velocity-attitude":
        return of_product(given, "product", PairAssumptions(flexure=structure))
    believed = given.believed.model_copy(update={"flexure": structure})
    return product_contender(given, "product", believed)


# ----------------------------------------------------------------------------------- troubles


def _late(count: int) -> Array:
    return jnp.arange(count) >= count // 2


def _turned(u: Any, change: Callable[[Array, Array], Array]) -> Any:
    """The input of a motion with other turns: ``change(theta, dt)`` from the middle on."""
    if hasattr(u, "increments"):
        return u._replace(increments=_turned(u.increments, change))
    late = _late(u.theta.shape[0]).reshape(-1, *([1] * (u.theta.ndim - 1)))
    dt = jnp.broadcast_to(jnp.asarray(u.dt)[..., None], u.theta.shape)
    return u._replace(theta=jnp.where(late, change(u.theta, dt), u.theta))


_BIASES = slice(9, 12)  # of the gyros


def bias_step(case: Case, base: Contender, dt_s: float) -> Case:
    """Ten sigma of the stated bias of the gyros."""
    step = 10.0 * jnp.sqrt(jnp.sum(case.start.factor[_BIASES] ** 2, axis=1))
    return case._replace(u=_turned(case.u, lambda theta, dt: theta + step * dt))


def scale_error(case: Case, base: Contender, dt_s: float) -> Case:
    """0.3 %."""
    return case._replace(u=_turned(case.u, lambda theta, dt: 1.003 * theta))


def loud(case: Case, base: Contender, dt_s: float) -> Case:
    """30 times the noise on top of what is there, for 20 s."""
    out, key = {}, jax.random.key(20)
    for k, (name, y) in enumerate(case.y.items()):
        sensor, aux, truth = base.model.sensor(name), case.aux.get(name), case.truth
        count = jax.tree_util.tree_leaves(y)[0].shape[0]
        index = jnp.arange(count)
        inside = (index >= count // 2) & (index < count // 2 + round(20.0 / dt_s))
        # a run has its own: its initial error is as good as a number
        own = jax.random.fold_in(jax.random.fold_in(key, k), _number_of(case))
        white = 30.0 * inside[:, None] * jax.random.normal(own, (count, sensor.dim))

        def one(y, x, a, w, sensor=sensor):
            return manifold.retract(y, sensor.noise_factor(x, a) @ w)

        axes = (0, 0, None if aux is None else 0, 0)
        out[name] = jax.vmap(one, axes)(y, truth, aux, white)
    return case._replace(y=out)


def _number_of(case: Case) -> Array:
    """A number that differs from run to run."""
    first = jax.tree_util.tree_leaves(case.u)[1]
    bits = jax.lax.bitcast_convert_type(jnp.sum(jnp.asarray(first, float)), jnp.int64)
    return jnp.abs(bits) % (2**31 - 1)


def lost_axis(case: Case, base: Contender, dt_s: float) -> Case:
    """The first component of each record that is a vector; whole attitudes stay."""
    return case._replace(y={name: _without_axis(y) for name, y in case.y.items()})


def _without_axis(y: Any) -> Any:
    if isinstance(y, Rotation):
        return y
    leaves, shape = jax.tree_util.tree_flatten(y)
    late = _late(leaves[0].shape[0])
    if leaves[0].ndim > 1:
        leaves[0] = leaves[0].at[:, 0].set(jnp.where(late, jnp.nan, leaves[0][:, 0]))
    else:
        leaves[0] = jnp.where(late, jnp.nan, leaves[0])
    return shape.unflatten(leaves)


TROUBLES = {
    "bias step": bias_step,
    "scale error": scale_error,
    "loud": loud,
    "lost axis": lost_axis,
}
STRUCTURES = {
    "soft": ("flexure.sigma=20 arcmin", "flexure.time=6 s"),
    "fast": ("flexure.sigma=3 arcmin", "flexure.time=0.4 s"),
}
# of each system, a scenario without trouble of its own
TROUBLED = ("airship/s1", "ins-gnss/drive", "transfer-alignment/aircraft")


def _spoilt(trouble: Callable[..., Case], dt_s: float, base: Contender, world: Any) -> Case:
    return trouble(base.case(world), base, dt_s)


def spoilt(problem: Problem, trouble: Callable[..., Case]) -> Problem:
    """The same problem with trouble in what its filters with states for biases are given."""
    dt_s = float(problem.epoch_s[1] - problem.epoch_s[0])
    world = jax.eval_shape(problem.simulate, jnp.asarray(0))
    cases = {
        name: replace(c, case=Partial(lambda world, c=c: _spoilt(trouble, dt_s, c, world)))
        for name, c in problem.contenders.items()
        if jax.eval_shape(c.case, world).start.factor.shape[0] >= _BIASES.stop
    }
    return replace(problem, contenders=cases)


# -------------------------------------------------------------------------------------- tables


def every() -> Iterator[str]:
    """All simulated scenarios."""
    for system in catalogue.summaries():
        yield from (f"{system}/{name}" for name in catalogue.listed(system))


def problem_of(
    where: str, seed: int, changes: tuple[str, ...] = (), scales: tuple[float, ...] = SCALES
) -> Problem:
    """A scenario with the filters it names, the default and those that are told."""
    system, name = where.split("/")
    found = find_system(system)
    text = found.scenarios[name].read_text()
    study = found.studies[tomllib.loads(text).get("study") or next(iter(found.studies))]
    given = scenario.parse(study.parameters, text, list(changes), source=name)
    kin = [name for name in KIN if name in study.filters]
    names = tuple(dict.fromkeys([*given.filters, *kin, found.default]))
    problem = study.problem(given, names, seed)
    more = {}
    if system not in ("satellite", "gnss"):  # whose filters are told by their names
        aligns = "product" in study.filters and system == "transfer-alignment"
        base = told_structure(given) if aligns else problem.contenders[found.default]
        more = {f"told, noise times {s:g}": told(base, s) for s in scales}
    return replace(problem, contenders={**problem.contenders, **more})


KIN = ("product", "kf-flexure")  # told filters that not every scenario of their study names


class Kept:
    """Scores in a JSON file, by what they are of."""

    def __init__(self, path: Path | None) -> None:
        self.path, self.scores = path, {}
        if path is not None and path.is_file():
            self.scores = {k: Score(*v) for k, v in json.loads(path.read_text()).items()}

    def get(self, key: str, compute: Callable[[], Score]) -> Score:
        """A score, computed where it is not known yet."""
        if key not in self.scores:
            self.scores[key] = compute()
            if self.path is not None:
                lines = json.dumps(self.scores, indent=0, sort_keys=True)
                part = self.path.with_suffix(".part")
                part.write_text(lines, encoding="utf-8")
                part.replace(self.path)
        return self.scores[key]


def score(problem: Problem, name: str, block: str, batches: list[tuple[Any, int]]) -> Score:
    """Figures of one filter on worlds that all filters share."""
    where = next(b for b in problem.blocks if b.name == block)
    at = slice(problem.count_from, problem.count_to)
    square: list[float] = []
    nees: list[float] = []
    for batch, count in batches:
        found = record(problem, name, batch, count)
        error = found["error"][:, at, where.where]
        square.extend(np.mean(np.sum(error**2, axis=2), axis=1))
        nees.extend(np.mean(found["block_nees"][block][:, at], axis=1) / len(where.axes))
    rms = np.sqrt(np.mean(square))
    return Score(float(units.convert(rms, where.units, where.display_unit)), float(np.mean(nees)))


def row(where: str, trouble: str, problem: Problem, size: tuple[int, int], seed: int, kept: Kept):
    """A line of the table."""
    system, (runs, chunk) = where.split("/")[0], size
    block, default = ABOUT.get(system, "attitude"), find_system(system).default
    unit = next(b.display_unit for b in problem.blocks if b.name == block)
    batches = cache(lambda: list(worlds(problem, runs, chunk)))
    found = {
        name: kept.get(
            f"{where} | {trouble} | seed {seed} | {runs} runs | {name}",
            lambda name=name: score(problem, name, block, batches()),
        )
        for name in problem.contenders
    }
    ours = found.pop(default)
    best = min(found, key=lambda name: np.nan_to_num(found[name].error, nan=np.inf))
    over = ours.error / found[best].error
    cells = [where, trouble, str(seed), f"{ours.error:.3g} {unit}", best]
    cells += [f"{found[best].error:.3g}", f"{over:.2f}", f"{ours.nees:.2f}"]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description="The default filter against the best told one.")
    parser.add_argument("scenarios", nargs="*", help="system/scenario; all where none is named")
    parser.add_argument("--runs", type=int, default=50, help="of each scenario")
    parser.add_argument("--chunk", type=int, default=25, help="runs at a time")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the random numbers")
    parser.add_argument("--named", action="store_true", help="no scales of the process noise")
    parser.add_argument("--troubles", action="store_true", help="what no scenario has")
    parser.add_argument("--keep", type=Path, help="file of what is found, to go on from")
    parser.add_argument("--out", type=Path, help="file for the table")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    kept = Kept(arguments.keep)
    head = "| scenario | trouble | seed | default | best told | its error | ratio | NEES |"
    lines = [head, "|" + "---|" * 8]
    print("\n".join(lines), flush=True)

    size = arguments.runs, arguments.chunk

    def say(where: str, trouble: str, problem: Problem, seed: int) -> None:
        lines.append(row(where, trouble, problem, size, seed, kept))
        print(lines[-1], flush=True)

    for seed in arguments.seeds:
        for where in arguments.scenarios or (TROUBLED if arguments.troubles else every()):
            problem = problem_of(where, seed, scales=() if arguments.named else SCALES)
            if not arguments.troubles:
                say(where, "", problem, seed)
                continue
            for name, trouble in TROUBLES.items():
                say(where, name, spoilt(problem, trouble), seed)
            if where.startswith("transfer-alignment"):
                for name, changes in STRUCTURES.items():
                    say(where, name, problem_of(where, seed, changes), seed)
    if arguments.out is not None:
        arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
