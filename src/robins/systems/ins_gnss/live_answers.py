"""Answers of a live navigation, and the vector of numbers that they are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Code, Filter, FilterState, Model
from robins.filters.kalman import WRONG
from robins.filters.run import Step
from robins.systems.ins_gnss.robust import navigation
from robins.systems.parts import ImuBlock
from robins.systems.streaming import Flag

_WIDTH = 19  # of the vector: attitude, velocity, place and nine sigmas


class MeasurementOutcome(NamedTuple):
    """Outcome of a measurement in the filter."""

    code: Code
    nis: float  # normalised innovation squared
    dof: int  # components that were measured


class Navigation(NamedTuple):
    """The answer to a sample or a fix: the state of the IMU; NaN while `STARTING`."""

    time_ns: int
    q_nb: np.ndarray  # (4,) forward-right-down to north-east-down, scalar first
    v_n: np.ndarray  # (3,) m/s
    lat_rad: float
    lon_rad: float
    alt_m: float
    sigma: np.ndarray  # (9,) attitude [rad], velocity [m/s], position [m], each NED
    flags: Flag
    # probability that each suspect of a bank is wrong, after the last fix or standstill
    wrong: Mapping[str, float] = {}
    seen: Mapping[str, MeasurementOutcome] = {}  # by sensor, in the last step of the filter


def predicted(filter_: Filter, model: Model, state: FilterState, u: ImuBlock) -> jax.Array:
    """Mean and standard deviations after a block, in one vector."""
    return _vector(filter_.predict(state, model.motion, u)[1].belief)


def _vector(belief: Belief) -> jax.Array:
    x = navigation(belief.mean)
    p = x.position
    place = jnp.stack([p.lat, p.lon, p.alt])
    return jnp.concatenate([x.q_nb.wxyz, x.v_n, place, belief.sigma[:9]])


def kept(step: Step) -> jax.Array:
    """The same after what was measured, what became of that, and what a bank finds wrong."""
    last = [info.notes[WRONG] for info in step.info.values() if WRONG in info.notes][-1:]
    seen = [
        jnp.stack([jnp.asarray(x, float) for x in (info.code, info.nis, info.dof)])
        for _, info in sorted(step.info.items())
    ]
    return jnp.concatenate([_vector(step.posterior), *seen, *last])


def answer_of(
    time_ns: int,
    x: np.ndarray,
    flags: Flag,
    sensors: Sequence[str] = (),
    suspects: Sequence[str] = (),
) -> Navigation:
    """The answer that a vector of `predicted` or `kept` is.

    Args:
        time_ns: its stamp.
        x: the vector.
        flags: of the answer.
        sensors: of `kept`, by name in their order there.
        suspects: of a bank.
    """
    lat, lon, alt = x[7:10].tolist()
    rows, rest = np.split(x[_WIDTH:], [3 * len(sensors)])
    seen = {
        name: MeasurementOutcome(Code(int(code)), nis, int(dof))
        for name, (code, nis, dof) in zip(sensors, rows.reshape(-1, 3).tolist(), strict=True)
    }
    wrong = dict(zip(suspects, rest.tolist(), strict=False))
    return Navigation(time_ns, x[:4], x[4:7], lat, lon, alt, x[10:_WIDTH], flags, wrong, seen)


def outliers_of(answer: Navigation) -> list[str]:
    """Sensors whose measurement a filter refused, or a bank took for wrong, in its last step."""
    return [
        name
        for name, one in answer.seen.items()
        if one.code == Code.REFUSED or (one.dof > 0 and answer.wrong.get(name, 0.0) > 0.5)
    ]
