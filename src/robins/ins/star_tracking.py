"""Which stars are seen, when the attitude is nearly known: the one that is near, if it is alone.

A sensor that has found its attitude need not search the sky again: the last attitude, carried on
by the gyros, says where each star of the catalogue must be. Here a direction takes the star within
a tolerance of it, unless a second star or a second direction lays claim to the same place; nothing
is guessed. All is pure JAX and of fixed size, for use inside a loop.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from robins import _float64  # noqa: F401
from robins.earth.star_index import StarIndex, near
from robins.rotation import rotate


def track_stars(
    index: StarIndex,
    vectors_b: Float[Array, "n 3"],
    q_ib: Float[Array, "4"],
    boresight_b: Float[Array, "3"],
    tolerance_rad: Any,
) -> Int[Array, "n"]:
    """Match directions with stars of the catalogue.

    Args:
        index: of the catalogue, its reach half the field of view at least, plus the error of q_ib.
        vectors_b: directions seen, unit vectors in body axes; NaN: none.
        q_ib: attitude as far as known, body to inertial.
        boresight_b: middle of the field, unit vector in body axes.
        tolerance_rad: a star may be off by so much: some sigmas of the noise and of q_ib [rad]. It
            should be well below the distance of neighbouring stars.

    Returns:
        (n,) place of each star in the catalogue; -1: none, or none without doubt.
    """
    unit = jnp.asarray(index.unit_i)
    members = near(index, rotate(q_ib, boresight_b))
    there = ~jnp.isnan(vectors_b[:, 0])
    seen = rotate(q_ib, jnp.where(there[:, None], vectors_b, 0.0))
    cosine = jnp.einsum("ni,ki->nk", seen, unit[members])  # zero where nothing was seen
    close = (cosine > jnp.cos(jnp.asarray(tolerance_rad, float))) & (members >= 0)[None, :]
    alone = (jnp.sum(close, 1) == 1) & ~jnp.any(close & (jnp.sum(close, 0) > 1)[None, :], 1)
    return jnp.where(alone, members[jnp.argmax(close, 1)], -1)
