"""The nine states as the paper has them: errors of a SINS, moved by (40) and fed back.

The SINS navigates beside the filter, which estimates how wrong it is; once a step the estimate is
taken off the SINS and the errors begin anew at zero. It is the total-state form of `model` written
differently, so it serves as its check; the paper's local filters are not built on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins import _float64  # noqa: F401
from robins.earth import Geodetic
from robins.filters import Belief, Code, Model, Motion, Rule, Sensor
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav
from robins.ins.mechanise import step as navigate
from robins.rotation import Rotation, conjugate, rotate
from robins.systems.airship.error_model import corrected, error_between, sins_at, step
from robins.systems.airship.model import walk


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fed:
    """A SINS and its errors x = (phi, dv, dlon, dlat, dalt), computed minus true; ENU, SI."""

    sins: Nav
    x: Any  # (9,)

    dim = 9

    def retract(self, delta: Array) -> Fed:
        """Add to the errors."""
        return Fed(self.sins, self.x + delta)

    def local(self, other: Fed) -> Array:
        """Errors of this SINS, were the other state true, less those it has here."""
        return error_between(self.sins, other.nav) - self.x

    @property
    def nav(self) -> Nav:
        """The SINS less its errors."""
        return corrected(self.sins, self.x)


def _step(fed: Fed, block: Increments) -> Fed:
    """The SINS over the block, and its errors by (40) about the middle of it."""
    before, after = fed.sins, navigate(fed.sins, block)
    half = Rotation.from_rotvec(0.5 * block.theta)
    p, q = before.position, after.position
    middle = Nav(
        before.q_nb @ half,
        0.5 * (before.v_n + after.v_n),
        Geodetic(0.5 * (p.lat + q.lat), p.lon, 0.5 * (p.alt + q.alt)),
    )
    force_b = rotate(conjugate(half.wxyz), block.dv / block.dt)
    return Fed(after, step(fed.x, sins_at(middle, force_b), block.dt))


def _noise(spread: Array, metres: Array, fed: Fed, block: Increments) -> Array:
    """As of the total state; longitude and latitude in radians."""
    per_metre = jnp.concatenate([jnp.ones(6), 1.0 / metres[::-1], jnp.ones(1)])
    return per_metre[:, None] * walk(spread[0], spread[1], block.dt)


def error_states(
    gyro_noise: ArrayLike, accel_noise: ArrayLike, metres: ArrayLike, looks: tuple[Sensor, ...]
) -> Model:
    """The nine errors as `Fed`; input of a step: one increment. Wants the rule `feedback`.

    Args:
        gyro_noise: believed, rad/sqrt(s).
        accel_noise: believed, m/s/sqrt(s).
        metres: (2,) in a radian of latitude, longitude.
        looks: from `robins.systems.airship.model.sensors`.
    """
    spread = jnp.stack([jnp.asarray(gyro_noise), jnp.asarray(accel_noise)])
    return Model(Motion(_step, Partial(_noise, spread, jnp.asarray(metres))), looks)


def feedback() -> Rule:
    """Take the estimated errors off the SINS, once a step when all its measurements are in."""

    def settle(memory: Any, belief: Belief):
        nav = belief.mean.nav
        return memory, Belief(Fed(nav, jnp.zeros(9)), belief.factor), int(Code.DONE)

    return Rule(settle=settle, name="feedback")
