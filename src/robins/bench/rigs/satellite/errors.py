"""Errors of attitude and pointing, from the messages that passed; the same run in one program."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from robins.bench.rig import Spoken
from robins.bench.rigs.satellite.kit import Kit
from robins.bench.rigs.satellite.messages import FLAGS
from robins.bench.rigs.satellite.reference import Said, followed
from robins.bench.rigs.satellite.vehicle import padded
from robins.filters import Loop, run_closed
from robins.filters.run import Step
from robins.rotation import conjugate, multiply, to_rotvec
from robins.systems.satellite.nodes import STAR, Row, StateForm, react

ARCSEC = np.pi / 648000.0
Arrays = Mapping[str, np.ndarray]


def turn(q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """(E, 3) rotation vectors [rad] of conj(q_from) q_to, in the axes of the first."""
    return np.asarray(to_rotvec(multiply(conjugate(q_from), q_to)))


def attitude_error(flown: Arrays) -> np.ndarray:
    """(E, 3) true less estimated attitude [rad], body axes."""
    return turn(flown["estimate.q_ib"], flown["motion.q_ib"])


def flag(flown: Arrays, text: str) -> np.ndarray:
    """(E,) bool, whether a flag of the estimate was set; by its text in `FLAGS`."""
    return (flown["estimate.flags"] >> FLAGS.index(text)) & 1 == 1


def rms_arcsec(error: np.ndarray, counted: slice) -> float:
    """Root sum square of the three axes, root mean over the counted steps."""
    some = error[counted]
    some = some[np.all(np.isfinite(some), -1)]
    return float(np.sqrt(np.mean(np.sum(some**2, -1)))) / ARCSEC if len(some) else float("nan")


def peak_arcsec(error: np.ndarray, counted: slice) -> float:
    """Greatest length over the counted steps."""
    size = np.linalg.norm(error[counted], axis=-1)
    return float(np.nanmax(size)) / ARCSEC if np.any(np.isfinite(size)) else float("nan")


@lru_cache
def _reacts(react: Callable, form: StateForm) -> Callable:
    """One function for each form, so that it is compiled once."""
    return partial(react, form)


def _posterior(step: Step) -> Any:
    return step.posterior


@partial(jax.jit, static_argnames="form")
def _attitudes(form: StateForm, mean: Any) -> Any:
    return jax.vmap(form.attitude)(mean)


def inside(
    kit: Kit, steps: int | None = None, said: Sequence[Spoken] = (), react: Callable = react
) -> dict[str, np.ndarray] | None:
    """The same run inside one program, by `run_closed`, as `robins run --runs 1` does it.

    Args:
        kit: of the run.
        steps: number of first steps that are done; None: all.
        said: messages of the operator. One program cannot put computers on standby or reset them:
            the result is then None.
        react: the loop one step on, as of `robins.systems.satellite.nodes`.
    """
    if any(one.message != "reference" for one in said):
        return None
    heard = [(one.step, one.values["q_ib"], one.values["rate"]) for one in said]
    loop = Loop(
        jax.tree_util.Partial(_reacts(react, kit.form), kit.given),
        kit.vehicle,
        jax.tree_util.tree_map(lambda x: x[:steps], _rows(kit, heard)),
        {STAR: kit.due[:steps]},
    )
    done = run_closed(kit.filter, kit.model, kit.start, loop, keep=_posterior)
    mean, seen = done.steps.mean, done.readings
    momenta = np.asarray(seen.outputs["wheel_momentum"])
    return {
        # the first leaf of the state of each kind
        "motion.q_ib": np.asarray(jax.tree_util.tree_leaves(seen.truth)[0]),
        "estimate.q_ib": np.asarray(_attitudes(kit.form, mean)),
        "estimate.gyro_bias": np.asarray(kit.form.bias(mean)),
        "wheels.momentum": np.stack([padded(h) for h in momenta]),
    }


def _rows(kit: Kit, said: list[Said]) -> Row:
    """Inputs of each step, with the target attitudes that the operator sent."""
    if not said:
        return kit.rows
    q, omega, alpha = (np.stack(x) for x in zip(*followed(kit, said), strict=True))
    course = kit.rows.course._replace(
        ref_q_ib=q[:-1], ref_omega_b=omega[:-1], ref_alpha_b=alpha[:-1], ref_end_q_ib=q[1:]
    )
    return kit.rows._replace(course=course)
