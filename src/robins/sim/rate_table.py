"""A three-axis rate table that carries a gyro and follows rate commands with a lag.

Each axis follows its commanded rate c with a first-order lag, within limits of its rate and
acceleration:

    w' = clip((c - w)/lag, -a, a),    |c| <= limit of rate.

Under a constant command, w and its integral have a closed form, exact at any step: a ramp of slope
a while the lag alone would require more, then an exponential. The attitude turns by the integral
and the fourth-order Magnus term for a rate whose direction changes (Hairer, Lubich & Wanner 2006,
"Geometric Numerical Integration", sec. IV.7).

The axes are those of the payload, as if the gimbals were driven to turn it about them: gimbal
kinematics, gimbal lock included, are not modelled.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.rotation import from_rotvec, multiply, normalise
from robins.sim import _arguments

_GAUSS = np.sqrt(3.0) / 6.0  # of a step, from its middle to its two Gauss points


class RateTable(NamedTuple):
    """Lag and limits of the table, by axis; made and checked by `rate_table`."""

    lag_s: Any  # (3,)
    rate_limit_rad_s: Any  # (3,)
    acceleration_limit_rad_s2: Any  # (3,)


class TableState(NamedTuple):
    """State of the table."""

    q_ib: Any  # (4,) payload to inertial, scalar first
    rate_b: Any  # (3,) rad/s


def rate_table(
    lag_s: _arguments.Listed = 0.02,
    rate_limit_rad_s: _arguments.Listed = np.inf,
    acceleration_limit_rad_s2: _arguments.Listed = np.inf,
) -> RateTable:
    """Make a `RateTable` after checking its numbers, one for all axes or three; infinity: no limit.

    Raises:
        ValueError: a lag or limit that is not positive, or another shape.
    """
    positive = {"low": 0.0, "above": True}
    limits = {
        "rate_limit_rad_s": rate_limit_rad_s,
        "acceleration_limit_rad_s2": acceleration_limit_rad_s2,
    }
    return RateTable(
        _arguments.vector("lag_s", lag_s, 3, **positive),
        *(_arguments.vector(name, x, 3, endless=True, **positive) for name, x in limits.items()),
    )


def table_state(
    q_ib: _arguments.Listed = (1.0, 0.0, 0.0, 0.0), rate_b: _arguments.Listed = 0.0
) -> TableState:
    """The state of a given attitude and rate [rad/s].

    Raises:
        ValueError: not a unit quaternion, or a rate that is not finite.
    """
    return TableState(
        _arguments.unit_quaternion("q_ib", q_ib), _arguments.vector("rate_b", rate_b, 3)
    )


def step(
    table: RateTable, state: TableState, command_b: Float[Array, "3"], dt_s: Number
) -> tuple[TableState, Float[Array, "4"]]:
    """The state a step later, and its attitude q_ib.

    Exact for a constant command over the step; the attitude to the fourth order in
    ``dt_s`` where the direction of the rate changes.

    Args:
        table: lag and limits.
        state: state at the beginning of the step.
        command_b: (3,) commanded rate [rad/s], payload axes.
        dt_s: length of the step, positive.
    """
    most = table.rate_limit_rad_s
    goal = jnp.clip(command_b, -most, most)
    rate, angle = _response(table, goal, state.rate_b, dt_s)
    early, late = (
        _response(table, goal, state.rate_b, share * dt_s)[0]
        for share in (0.5 - _GAUSS, 0.5 + _GAUSS)
    )
    turn = angle + 0.5 * _GAUSS * dt_s**2 * jnp.cross(early, late)
    q = normalise(multiply(state.q_ib, from_rotvec(turn)))
    return TableState(q, rate), q


def _response(table: RateTable, goal: Array, rate: Array, t: Number) -> tuple[Array, Array]:
    """Rate [rad/s] and angle turned [rad] at a time t > 0 after a command was given."""
    lag, most = table.lag_s, table.acceleration_limit_rad_s2
    way = goal - rate
    # Length of the ramp, until the lag alone requires no more than the limit.
    excess = way - jnp.clip(way, -most * lag, most * lag)
    done = jnp.clip(excess, -most * t, most * t)
    ramp = jnp.minimum(t, jnp.abs(excess) / most)
    after = way - done
    fading = -jnp.expm1(-(t - ramp) / lag)
    short = ramp * (way - 0.5 * done) + after * lag * fading
    return goal - after * (1.0 - fading), goal * t - short
