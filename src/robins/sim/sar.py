"""A synthetic aperture radar matched to a map: fixes of horizontal position and heading.

Errors are normal, and a share of the samples, drawn independently, is in gross error in all three
components. A gross error is noise ``outlier_factor`` times as large (the contaminated normal
distribution), or an additional ``outlier_offset`` in sigmas, or both.

    SarErrorModel(outlier_share=0.1)                                          # 5 sigma noise
    SarErrorModel(outlier_share=0.1, outlier_factor=1.0, outlier_offset=5.0)  # 5 sigma off

Numbers are drawn with unit deviation for every sample, so a change of the model and missing
samples leave the draws of the others unchanged.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from robins import _float64  # noqa: F401
from robins.earth import Geodetic
from robins.filters.belief import Number
from robins.manifold import wrap
from robins.sim import _arguments

# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is.
_NOISE, _STRUCK, _OFFSET = 0, 1, 2


class SarErrorModel(NamedTuple):
    """Errors of the radar; the defaults are the published ones, without outliers."""

    sigma_m: Any = 25.0  # white error of position, a number or (2,) north, east
    heading_sigma_rad: Any = math.radians(1.0)  # white error of heading
    outlier_share: Any = 0.0  # share of the samples in gross error
    outlier_factor: Any = 5.0  # ratio of their noise to that of good samples; 1: none
    outlier_offset: Any = 0.0  # further gross error in sigmas: of position along a random
    # direction, of heading to either side


class SarFix(NamedTuple):
    """Fix of the radar; NaN where there is none, and always for the height."""

    position: Any  # Geodetic (E,), alt NaN
    heading_rad: Any  # (E,) clockwise from north, in [-pi, pi)


def observe_sar(
    model: SarErrorModel,
    key: jax.Array,
    position: Geodetic,
    heading_rad: Number,
    present: _arguments.Listed,
) -> SarFix:
    """Fixes of a run from its true motion.

    Args:
        model: the error model.
        key: of the run, `Component.SAR` of `robins.sim.random.stream`.
        position: (E,) true positions, not at a pole.
        heading_rad: (E,) true heading.
        present: (E,) bool, True where there is a fix.

    Raises:
        ValueError: shapes that do not fit together, a negative sigma, factor or offset, or a share
            beyond 0 to 1.
    """
    there = _arguments.presence(present)
    count = len(there)
    heading = _arguments.rows("heading_rad", heading_rad, count)
    place = Geodetic(
        _arguments.rows("position.lat", position.lat, count),
        _arguments.rows("position.lon", position.lon, count),
        _arguments.rows("position.alt", position.alt, count),
    )
    sigma_m = _arguments.vector("sigma_m", model.sigma_m, 2, low=0.0)
    _arguments.number("heading_sigma_rad", model.heading_sigma_rad, 0.0)
    _arguments.number("outlier_share", model.outlier_share, 0.0, 1.0)
    _arguments.number("outlier_factor", model.outlier_factor, 0.0)
    _arguments.number("outlier_offset", model.outlier_offset, 0.0)

    noise = jax.random.normal(jax.random.fold_in(key, _NOISE), (count, 3))
    struck = jax.random.uniform(jax.random.fold_in(key, _STRUCK), (count,)) < model.outlier_share
    unit = _directions(jax.random.fold_in(key, _OFFSET), count)
    gross = noise * model.outlier_factor + unit * model.outlier_offset
    error = jnp.where(struck[:, None], gross, noise)
    metres = jnp.concatenate([sigma_m[None] * error[:, :2], jnp.zeros((count, 1))], 1)
    seen = place.retract(metres)
    heading = wrap(heading + model.heading_sigma_rad * error[:, 2])

    def as_measured(x):
        return jnp.where(there, x, jnp.nan)

    no_height = jnp.full_like(seen.alt, jnp.nan)
    return SarFix(
        Geodetic(as_measured(seen.lat), as_measured(seen.lon), no_height), as_measured(heading)
    )


def _directions(key, count):
    """(count, 3): north and east of a random horizontal unit vector, and a random sign."""
    draw = jax.random.uniform(key, (count, 2))
    angle = 2.0 * jnp.pi * draw[:, 0]
    side = jnp.where(draw[:, 1] < 0.5, -1.0, 1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), side], 1)
