"""A magnetometer: the field in sensor axes, with hard and soft iron, disturbances and noise.

The output of `observe_field` in the Earth's field B at the attitude q_nb is

    z = clip(round(M (C_sb (C_bn (T B + d_n) + d_b)) + h + v))

with T a rotation of the field, d_n a field added in navigation axes (a magnet in the room), d_b one
added in body axes (a magnet carried for a while), C_sb the mounting, M the soft iron, scale factors
and non-orthogonality, h the hard iron and v white noise. `ins.magnetometer_calibration` estimates
M and h while the sensor is rotated.

`observe_magnetic_attitude` is the "magnetic attitude" of papers in which a magnetometer reports
roll, pitch and heading. No such sensor exists: one vector determines two angles; the third needs
another source, with whose error its own is correlated.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.errors import require
from robins.filters.belief import Number
from robins.manifold import wrap
from robins.rotation import conjugate, from_rotvec, normalise, rotate
from robins.sim import _arguments

_ROUNDING_S = 1e-6  # a sample within this of the edge of a burst is on it


def observe_field(
    key: Array,
    q_nb: _arguments.Listed,
    field_n: _arguments.Listed,
    sigma_t: _arguments.Listed,
    present: _arguments.Listed,
    *,
    turn: _arguments.Listed | None = None,
    added_n_t: _arguments.Listed | None = None,
    added_b_t: _arguments.Listed | None = None,
    q_bs: _arguments.Listed | None = None,
    soft_iron: Number | None = None,
    hard_iron_t: _arguments.Listed | None = None,
    range_t: Number | None = None,
    quantum_t: Number | None = None,
) -> Float[Array, "epochs 3"]:
    """Measured field [T] in sensor axes, which are the body's unless ``q_bs`` is given.

    The normal numbers depend on the key alone. Pure JAX, so it maps over keys.

    Args:
        key: of the run, `Component.MAGNETOMETER` of `robins.sim.random.stream`.
        q_nb: (E, 4) true attitude, scalar first.
        field_n: (E, 3) or (3,) true field [T] in navigation axes.
        sigma_t: of white noise [T]: a number, (3,) one for each axis, or (E,) one for each epoch.
        present: (E,) bool, True where there is a sample; NaN elsewhere.
        turn: (E, 3) rad, navigation axes, see `field_bursts`: the field is rotated by the length of
            the vector, about its component perpendicular to the field.
        added_n_t: (E, 3) or (3,) field [T] added in navigation axes.
        added_b_t: (E, 3) or (3,) field [T] added in body axes.
        q_bs: (4,) from sensor axes to body axes.
        soft_iron: (3, 3) matrix M, sensor axes; None: the identity.
        hard_iron_t: (3,) offset h [T], sensor axes.
        range_t: full scale [T], at which each axis saturates.
        quantum_t: resolution [T], to which each axis is rounded.

    Raises:
        ValueError: shapes that do not fit together, a negative sigma, a range or quantum that is
            not positive.
    """
    there = _arguments.presence(present)
    count = len(there)
    q = _arguments.rows("q_nb", q_nb, count, 4)
    field = _vectors("field_n", field_n, count)
    if turn is not None:
        field = _rotated(field, _arguments.rows("turn", turn, count, 3))
    if added_n_t is not None:
        field = field + _vectors("added_n_t", added_n_t, count)
    z = rotate(conjugate(q), field)
    if added_b_t is not None:
        z = z + _vectors("added_b_t", added_b_t, count)
    if q_bs is not None:
        z = rotate(conjugate(normalise(_arguments.rows("q_bs", q_bs, 4))), z)
    if soft_iron is not None:
        z = z @ _arguments.rows("soft_iron", soft_iron, 3, 3).T
    if hard_iron_t is not None:
        z = z + _arguments.rows("hard_iron_t", hard_iron_t, 3)[None]
    z = z + _sigma(sigma_t, count) * jax.random.normal(key, (count, 3))
    return jnp.where(there[:, None], _converted(z, range_t, quantum_t), jnp.nan)


def _converted(z: Array, range_t: Number | None, quantum_t: Number | None) -> Array:
    """Output of the A/D converter: rounded and saturated."""
    if quantum_t is not None:
        _arguments.number("quantum_t", quantum_t, 0.0, above=True)
        z = quantum_t * jnp.round(z / quantum_t)
    if range_t is not None:
        _arguments.number("range_t", range_t, 0.0, above=True)
        z = jnp.clip(z, -range_t, range_t)
    return z


def observe_magnetic_attitude(
    key: Array,
    euler_rad: Number,
    sigma_rad: _arguments.Listed,
    disturbance_rad: _arguments.Listed | None = None,
    present: _arguments.Listed | None = None,
) -> Float[Array, "epochs 3"]:
    """Roll, pitch, heading [rad] of the fictitious "magnetic attitude" sensor of papers.

    Each angle has white noise and the disturbance added and is wrapped to [-pi, pi).

    Args:
        key: of the run, `Component.MAGNETOMETER` of `robins.sim.random.stream`.
        euler_rad: (E, 3) true roll, pitch, heading.
        sigma_rad: standard deviation, a number or one for each angle.
        disturbance_rad: (E, 3) added, e.g. of `angle_bursts`.
        present: (E,) bool, True where there is a sample; NaN elsewhere. None: always.

    Raises:
        ValueError: shapes that do not fit together, or a negative sigma.
    """
    count = len(jnp.asarray(euler_rad, float))
    true = _arguments.rows("euler_rad", euler_rad, count, 3)
    there = _arguments.presence(jnp.ones(count, bool) if present is None else present)
    require(len(there) == count, f"present must have shape ({count},)", there.shape)
    sigma = _arguments.vector("sigma_rad", sigma_rad, 3, low=0.0)
    measured = true + sigma[None] * jax.random.normal(key, (count, 3))
    if disturbance_rad is not None:
        measured = measured + _arguments.rows("disturbance_rad", disturbance_rad, count, 3)
    return jnp.where(there[:, None], wrap(measured), jnp.nan)


def angle_bursts(
    key: Array,
    time_s: Number,
    size_rad: Number,
    every_s: Number,
    length_s: Number,
    first_s: _arguments.Listed | None = None,
) -> Float[Array, "epochs 3"]:
    """Bursts of disturbance of three angles [rad]: of a fixed size, signs drawn by angle and burst.

    Zero between the bursts. A burst covers the samples from its beginning (included) to its end
    (excluded); one as long as a sampling interval is one sample.

    Args:
        key: of the run.
        time_s: (E,) times of the samples.
        size_rad: of the disturbance, a number or one for each angle.
        every_s: from the beginning of a burst to that of the next; infinity: one burst only.
        length_s: duration of a burst; infinity: it never ends.
        first_s: beginning of the first; None: after ``every_s``.

    Raises:
        ValueError: a period or length that is not positive.
    """
    active, number = bursts(time_s, every_s, length_s, first_s)
    size = _arguments.vector("size_rad", size_rad, 3)
    signs = jax.vmap(lambda k: jax.random.rademacher(jax.random.fold_in(key, k), (3,), float))
    return jnp.where(active[:, None], size[None] * signs(number), 0.0)


def field_bursts(
    key: Array,
    time_s: Number,
    size_rad: Number,
    every_s: Number,
    length_s: Number,
    first_s: _arguments.Listed | None = None,
) -> Float[Array, "epochs 3"]:
    """Rotations of the field (E, 3) [rad] for `observe_field`, one axis drawn for each burst.

    The vectors have the length ``size_rad`` and a random direction; only its component
    perpendicular to the field, uniform on its circle, is used. Other arguments: see `angle_bursts`.

    Raises:
        ValueError: a period or length that is not positive.
    """
    active, number = bursts(time_s, every_s, length_s, first_s)
    _arguments.number("size_rad", size_rad)
    drawn = jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(key, k), (3,)))(number)
    length = jnp.sqrt(jnp.sum(drawn * drawn, 1, keepdims=True))
    return jnp.where(active[:, None], size_rad * drawn / length, 0.0)


def bursts(time_s, every_s, length_s, first_s) -> tuple[Array, Array]:
    """Membership of each sample in a burst (E,), and the number of the last burst started (E,)."""
    time = jnp.asarray(time_s, float)
    require(time.ndim == 1, "time_s must have shape (E,)", time.shape)
    _arguments.number("every_s", every_s, 0.0, above=True, endless=True)
    _arguments.number("length_s", length_s, 0.0, above=True, endless=True)
    since = time - (every_s if first_s is None else first_s) + _ROUNDING_S
    number = jnp.maximum(jnp.floor(since / every_s), 0.0)
    begun = jnp.where(number > 0.0, number, 1.0) * every_s  # avoids 0 times infinity
    phase = since - jnp.where(number > 0.0, begun, 0.0)
    return (phase >= 0.0) & (phase < length_s), number.astype(jnp.uint32)


def _rotated(field: Array, turn: Array) -> Array:
    size_sq = jnp.sum(field * field, -1, keepdims=True)
    along = jnp.sum(turn * field, -1, keepdims=True) / jnp.where(size_sq > 0.0, size_sq, 1.0)
    across = turn - along * field
    across_sq, turn_sq = (jnp.sum(v * v, -1, keepdims=True) for v in (across, turn))
    # Along the field there is no axis; without rotation the square root has no derivative.
    turns = across_sq > 0.0
    ratio = jnp.sqrt(jnp.where(turns, turn_sq, 1.0) / jnp.where(turns, across_sq, 1.0))
    return rotate(from_rotvec(jnp.where(turns, ratio * across, 0.0)), field)


def _vectors(name: str, value: _arguments.Listed, count: int) -> Array:
    x = jnp.asarray(value, float)
    return (
        jnp.broadcast_to(x, (count, 3)) if x.shape == (3,) else _arguments.rows(name, x, count, 3)
    )


def _sigma(sigma_t: Number, count: int) -> Array:
    """Standard deviations (E, 3) or (1, 3) [T]."""
    sigma = jnp.asarray(sigma_t, float)
    if sigma.shape in ((), (3,)):
        return _arguments.vector("sigma_t", sigma_t, 3, low=0.0)[None]
    _arguments.number("sigma_t", sigma_t, 0.0)
    return jnp.broadcast_to(_arguments.rows("sigma_t", sigma, count)[:, None], (count, 3))
