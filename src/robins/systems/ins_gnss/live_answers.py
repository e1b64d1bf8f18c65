"""What a live navigation answers, and the vector of numbers that it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters.kalman import WRONG
from robins.filters.run import Step
from robins.systems.ins_gnss.robust import navigation
from robins.systems.parts import Block
from robins.systems.streaming import Flag

_WIDTH = 19  # of the vector: attitude, velocity, place and nine sigmas


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


def predicted(filter_: Any, model: Any, state: Any, u: Block) -> jax.Array:
    """Mean and standard deviations after a block, in one vector."""
    return _vector(filter_.predict(state, model.motion, u)[1].belief)


def _vector(belief: Any) -> jax.Array:
    x = navigation(belief.mean)
    p = x.position
    place = jnp.stack([p.lat, p.lon, p.alt])
    return jnp.concatenate([x.q_nb.wxyz, x.v_n, place, belief.sigma[:9]])


def kept(step: Step) -> jax.Array:
    """The same after what was measured, and what a bank finds wrong."""
    last = [info.notes[WRONG] for info in step.info.values() if WRONG in info.notes][-1:]
    return jnp.concatenate([_vector(step.posterior), *last])


def answer_of(
    time_ns: int, x: np.ndarray, flags: Flag, suspects: tuple[str, ...] = ()
) -> Navigation:
    """The answer that such a vector is, of a filter with these suspects."""
    lat, lon, alt = x[7:10].tolist()
    wrong = dict(zip(suspects, x[_WIDTH:].tolist(), strict=False))
    return Navigation(time_ns, x[:4], x[4:7], lat, lon, alt, x[10:_WIDTH], flags, wrong)
