"""What each filter of "field-vector" believes, and what it is given of a run."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins.filters import Belief, Model
from robins.rotation import Rotation, to_dcm
from robins.systems.recipes import recipe
from robins.systems.rocket.field import (
    SNAPSHOT,
    FieldState,
    GyroNoise,
    ScaledState,
    bridged,
    field_model,
)
from robins.systems.rocket.filters import FIELD_KINDS, FieldKind, make_field_filter
from robins.systems.rocket.parameters import FieldVector
from robins.systems.rocket.world import Course, World
from robins.systems.study import Case, Contender

FORGETS = 10.0  # rad: noise of a step that leaves nothing of a direction that was seen before
REPORTED = 9  # attitude in body axes, attitude about and across the field, bias
_LEAST, _MOST = 0.3, 3.0  # of the size of the field that is expected


class Numbers(NamedTuple):
    """Data of a contender, so that contenders that differ in these alone compile once."""

    sigma: Array  # (n,) initial
    field_n: Array  # (E, 3) T


def plausible(field_b: Array, expected_n: Array, full_scale_t: float | None = None) -> Array:
    """Fields (..., 3) with NaN for those that no magnetometer in order would read.

    A field of no size, or of less than 0.3 or more than 3 times the expected one, has no direction
    that could be believed; nor has one with an axis at full scale, where that is known.
    """
    size, expected = (jnp.sqrt(jnp.sum(x**2, axis=-1)) for x in (field_b, expected_n))
    fits = (size >= _LEAST * expected) & (size <= _MOST * expected)
    if full_scale_t is not None:
        fits = fits & jnp.all(jnp.abs(field_b) < full_scale_t, axis=-1)
    return jnp.where(fits[..., None], field_b, jnp.nan)


def believed_model(given: FieldVector, kind: FieldKind) -> Model:
    """Motion and sensor of a kind of filter."""
    g, step = given.gyro, given.step
    # a drift of correlation time tau walks away from where it is by this in a step
    walk = g.drift * math.sqrt(2.0 * step / g.drift_time)
    angle = FORGETS if kind.sees == SNAPSHOT else g.white * step
    noise = GyroNoise(*map(jnp.asarray, (angle, walk, step)))
    sine = jnp.asarray(math.sin(given.magnetometer.noise))
    return field_model(noise, sine, kind.sees)


def initial_sigma(given: FieldVector, kind: FieldKind) -> Array:
    """(n,) of attitude, bias and scale factors."""
    bias = math.hypot(given.gyro.bias, given.gyro.drift) if kind.sees != SNAPSHOT else 0.0
    sizes = [given.start.attitude, bias, *([given.scale_factor_sigma] if kind.scaled else [])]
    return jnp.repeat(jnp.array(sizes), 3)


def rows_of(q_nb: Array, field_n: Array, n: int) -> Array:
    """(E, 9, n) from a tangent error, whose attitude is in n, to what is reported.

    Attitude in body axes; in axes along the field, and across it by the vertical; the bias.
    """
    b = field_n / jnp.sqrt(jnp.sum(field_n**2, axis=1, keepdims=True))
    level = jnp.cross(jnp.array([[0.0, 0.0, 1.0]]), b)
    level = level / jnp.sqrt(jnp.sum(level**2, axis=1, keepdims=True))
    along = jnp.stack([b, level, jnp.cross(b, level)], axis=1)
    count = len(field_n)
    attitude = jnp.concatenate([jnp.swapaxes(to_dcm(q_nb), 1, 2), along], axis=1)
    bias = jnp.broadcast_to(jnp.eye(3), (count, 3, 3))
    rows = jnp.zeros((count, REPORTED, n))
    return rows.at[:, :6, :3].set(attitude).at[:, 6:, 3:6].set(bias)


def as_case(scaled: bool, sees: str, scale_t: float | None, n: Numbers, world: World) -> Case:
    """What a filter takes of a run; pure."""
    count = len(n.field_n)
    start, zero = Rotation(world.start_q_nb), jnp.zeros(3)
    true, bias = Rotation(world.q_nb), world.bias
    scale = jnp.broadcast_to(world.scale, (count, 3))
    state = ScaledState(start, zero, zero) if scaled else FieldState(start, zero)
    truth = ScaledState(true, bias, scale) if scaled else FieldState(true, bias)
    return Case(
        start=Belief(state, jnp.diag(n.sigma)),
        u=bridged(world.theta),
        y={sees: plausible(world.field_b, n.field_n, scale_t)} if sees else {},
        aux={sees: n.field_n} if sees else {},
        truth=truth,
        rows=rows_of(world.q_nb, n.field_n, 9 if scaled else 6),
    )


def field_contender(given: FieldVector, course: Course, name: str) -> Contender:
    """A filter with its model and its data.

    Raises:
        ValueError: there is no filter of this name.
    """
    filter_, kind = make_field_filter(name), FIELD_KINDS[name]
    numbers = Numbers(initial_sigma(given, kind), jnp.asarray(course.field_n))
    return Contender(
        filter=filter_,
        model=believed_model(given, kind),
        case=recipe(
            as_case, kind.scaled, kind.sees, given.magnetometer.full_scale, numbers=numbers
        ),
    )
