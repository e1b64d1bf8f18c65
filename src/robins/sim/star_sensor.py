"""A star sensor in orbit, and the camera behind it.

`star_errors` and `read_star` are the sensor as a data sheet states it: attitude with white noise,
about the boresight commonly some times as large as across it, and a low-frequency error from
warping and from stars that cross the field. All errors of a run are drawn beforehand, so a closed
loop only turns its attitude by the next of them. (`robins.sim.star_tracker` observes a motion that
is known beforehand.)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.rotation import from_rotvec, multiply, normalise, rotate
from robins.sim import _given

# Folded into the key of the sensor; part of the file format, as `Component` is.
_NOISE, _PHASE = 0, 1


def star_errors(
    key: Array,
    sigma_rad: Any,
    frame_s: Any,
    count: int,
    low_frequency_rad: Any = 0.0,
    low_frequency_period_s: Any = 600.0,
) -> Float[Array, "{count} 3"]:
    """Errors of ``count`` frames, rotation vectors [rad] in sensor axes: white noise and a sine.

    The numbers drawn do not depend on the sizes of the errors. Pure JAX, so it maps over keys.

    Args:
        key: of the run, `Component.STAR_SENSOR` of `robins.sim.random.stream`.
        sigma_rad: of the white noise of a frame, a number or one for each axis; boresight z.
        frame_s: time from frame to frame [s].
        count: frames.
        low_frequency_rad: amplitude of the sine, a number or one for each axis; each axis has a
            phase of its own, drawn.
        low_frequency_period_s: its period [s], a number or one for each axis.

    Raises:
        ValueError: no frame, or a number out of its range.
    """
    _given.count_of("count", count)
    _given.number("frame_s", frame_s, 0.0, above=True)
    sigma = _given.vector("sigma_rad", sigma_rad, 3, low=0.0)
    size = _given.vector("low_frequency_rad", low_frequency_rad, 3, low=0.0)
    period = _given.vector("low_frequency_period_s", low_frequency_period_s, 3, low=0.0, above=True)
    # By frame number, so that a longer run begins with the shorter one.
    root = jax.random.fold_in(key, _NOISE)
    keys = jax.vmap(lambda number: jax.random.fold_in(root, number))(jnp.arange(count))
    noise = jax.vmap(lambda one: jax.random.normal(one, (3,)))(keys)
    turns = jax.random.uniform(jax.random.fold_in(key, _PHASE), (3,))
    time = jnp.arange(float(count)) * jnp.asarray(frame_s, float)
    phase = 2.0 * np.pi * (time[:, None] / period[None] + turns[None])
    return sigma[None] * noise + size[None] * jnp.sin(phase)


def read_star(
    q_ib: Float[Array, "4"], error: Float[Array, "3"], q_bs: Any = None
) -> Float[Array, "4"]:
    """Measured q_ib: the true attitude after a small turn of the sensor about its own axes.

    ``q_measured = q_ib q_bs exp(e) q_bs^-1``, so the true attitude is ``q_measured exp(-q_bs e)``.

    Args:
        q_ib: true attitude, body to inertial, scalar first.
        error: e of the frame [rad], sensor axes, a row of `star_errors`.
        q_bs: (4,) from sensor axes to body axes; None: they are the same.

    Raises:
        ValueError: a q_bs of another shape.
    """
    if q_bs is not None:
        error = rotate(normalise(_given.rows("q_bs", q_bs, 4)), error)
    return normalise(multiply(q_ib, from_rotvec(error)))
