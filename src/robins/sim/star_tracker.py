"""A star sensor: attitude with white noise, as a rotation or as angles.

`observe_attitude` is the physical one: the error is a small turn about the axes of the sensor,
about its boresight commonly some ten times as large as about the two others. `observe_euler` puts
the noise on pitch, roll and heading, as papers do that state one accuracy for the three; level, and
with the same sigma for all, both are alike to first order.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.manifold import wrap
from robins.rotation import from_rotvec, multiply, normalise, rotate, to_euler
from robins.sim import _given


def observe_attitude(
    key: Array, q_nb: Any, sigma_rad: Any, present: Any, q_bs: Any = None
) -> Float[Array, "epochs 4"]:
    """Measured q_nb: the true attitude after a small turn of the sensor about its own axes.

    ``q_measured = q_nb q_bs exp(e) q_bs^-1`` with e the error, a rotation vector in sensor axes.

    Args:
        key: of the run, `Component.STAR_SENSOR` of `robins.sim.random.stream`.
        q_nb: (E, 4) true attitude, scalar first.
        sigma_rad: standard deviation of the error, a number or one for each axis of the sensor.
        present: (E,) bool, whether there is a sample; NaN where not.
        q_bs: (4,) from sensor axes to body axes; None: they are the same.

    Raises:
        ValueError: shapes that do not fit together, or a negative sigma.
    """
    there, true, error = _drawn(key, q_nb, sigma_rad, present)
    if q_bs is not None:
        error = rotate(normalise(_given.rows("q_bs", q_bs, 4)), error)
    measured = multiply(true, from_rotvec(error))
    return jnp.where(there[:, None], measured, jnp.nan)


def observe_euler(key: Array, q_nb: Any, sigma_rad: Any, present: Any) -> Float[Array, "epochs 3"]:
    """Measured pitch, roll, heading [rad] of the body, each with white noise.

    The angles are those of `robins.rotation.to_euler`, in another order. Roll and heading are
    wrapped to [-pi, pi); a pitch near the vertical is not turned over by its noise.

    Args:
        key: of the run, `Component.STAR_SENSOR` of `robins.sim.random.stream`.
        q_nb: (E, 4) true attitude, scalar first.
        sigma_rad: standard deviation, a number or one each for pitch, roll, heading.
        present: (E,) bool, whether there is a sample; NaN where not.

    Raises:
        ValueError: shapes that do not fit together, or a negative sigma.
    """
    there, true, error = _drawn(key, q_nb, sigma_rad, present)
    roll, pitch, heading = to_euler(true)
    angles = pitch + error[:, 0], wrap(roll + error[:, 1]), wrap(heading + error[:, 2])
    return jnp.where(there[:, None], jnp.stack(angles, 1), jnp.nan)


def _drawn(key, q_nb, sigma_rad, present):
    there = _given.presence(present)
    count = len(there)
    true = _given.rows("q_nb", q_nb, count, 4)
    sigma = _given.vector("sigma_rad", sigma_rad, 3, low=0.0)
    return there, true, sigma[None] * jax.random.normal(key, (count, 3))
