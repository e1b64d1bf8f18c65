"""Errors of attitude and pointing, from the messages that passed; the same run in one program."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import jax
import numpy as np

from robins.bench.rigs.satellite.kit import Kit, as_numpy
from robins.bench.rigs.satellite.messages import FLAGS
from robins.bench.rigs.satellite.vehicle import padded
from robins.filters import Loop, run_closed
from robins.rotation import conjugate, multiply, to_rotvec
from robins.systems.satellite.nodes import STAR, react

ARCSEC = np.pi / 648000.0
Arrays = Mapping[str, np.ndarray]


def turn(q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """(E, 3) rotation vectors [rad] of conj(q_from) q_to, in the axes of the first."""
    return np.asarray(to_rotvec(multiply(conjugate(q_from), q_to)))


def attitude_error(flown: Arrays) -> np.ndarray:
    """(E, 3) true less estimated attitude [rad], body axes."""
    return turn(flown["estimate.q_ib"], flown["motion.q_ib"])


def reference_q_ib(kit: Kit) -> np.ndarray:
    """(E, 4) the wanted attitude at the end of each step."""
    return np.asarray(kit.rows.course.ref_end_q_ib)


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


def inside(kit: Kit, react: Callable = react) -> dict[str, np.ndarray]:
    """The same run inside one program, by `run_closed`, as `robins run --runs 1` does it."""
    loop = Loop(
        jax.tree_util.Partial(partial(react, kit.form), kit.given),
        kit.vehicle,
        kit.rows,
        {STAR: kit.due},
    )
    done = run_closed(kit.filter, kit.model, kit.start, loop, keep=lambda step: step.posterior)
    mean, said = done.steps.mean, done.readings
    momenta = np.asarray(said.outputs["wheel_momentum"])
    return {
        # the first leaf of the state of each kind
        "motion.q_ib": np.asarray(jax.tree_util.tree_leaves(said.truth)[0]),
        "estimate.q_ib": np.asarray(as_numpy(jax.jit(jax.vmap(kit.form.attitude))(mean))),
        "estimate.gyro_bias": np.asarray(kit.form.bias(mean)),
        "wheels.momentum": np.stack([padded(h) for h in momenta]),
    }
