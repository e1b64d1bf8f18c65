"""What a live navigation answers, and the vector of numbers that it is made of."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters.run import Step
from robins.systems.ins_gnss.robust import navigation
from robins.systems.parts import Block
from robins.systems.streaming import Flag


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


def predicted(filter_: Any, model: Any, state: Any, u: Block) -> jax.Array:
    """Mean and standard deviations after a block, in one vector."""
    return _vector(filter_.predict(state, model.motion, u)[1].belief)


def _vector(belief: Any) -> jax.Array:
    x = navigation(belief.mean)
    p = x.position
    place = jnp.stack([p.lat, p.lon, p.alt])
    return jnp.concatenate([x.q_nb.wxyz, x.v_n, place, belief.sigma[:9]])


def kept(step: Step) -> jax.Array:
    """The same after what was measured."""
    return _vector(step.posterior)


def answer_of(time_ns: int, x: np.ndarray, flags: Flag) -> Navigation:
    """The answer that such a vector is."""
    lat, lon, alt = x[7:10].tolist()
    return Navigation(time_ns, x[:4], x[4:7], lat, lon, alt, x[10:], flags)
