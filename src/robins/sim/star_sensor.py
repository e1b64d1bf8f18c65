"""A star sensor in orbit, and the camera behind it.

`star_errors` and `read_star` are the sensor as a data sheet states it: attitude with white noise,
usually several times as large about the boresight as across it, and a low-frequency error from
thermal distortion and from stars that cross the field. All errors of a run are drawn in advance, so
a closed loop only rotates its attitude by the next one. `observe_euler` adds white noise to pitch,
roll and heading of a known motion, as in papers that state one accuracy for each.

`StarCamera` and `photograph` simulate the image: the stars of a catalogue in the field of view,
each with its own error, some missed, and false stars. `measure_attitude` is the whole sensor: the
image, the identification of its stars, the attitude by QUEST with its covariance, NaN where there
are too few stars. The steps of both are also available: `visible_stars` is the sky without errors,
as a star simulator shows it to a sensor; `expose` is its image; `solve` is the attitude.
Aberration, motion blur of a long exposure and merging double stars are not simulated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from robins import _float64  # noqa: F401
from robins.earth.stars import StarIndex, Stars, index_stars, near
from robins.filters.belief import Number
from robins.filters.values import kind, value
from robins.ins.star_identification import track_stars
from robins.ins.vector_attitude import quest
from robins.manifold import wrap
from robins.rotation import conjugate, from_rotvec, multiply, normalise, rotate, to_euler
from robins.sim import _arguments

# Folded into the key of the sensor; part of the file format, as `Component` is.
_NOISE, _PHASE = 0, 1
# Folded into the key of a frame of the camera; three numbers of each kind a row, false stars last.
_NORMAL, _UNIFORM = 0, 1

ARCSEC = np.pi / 648e3
"""A second of arc [rad]."""


def star_errors(
    key: Array,
    sigma_rad: _arguments.Listed,
    frame_s: Number,
    count: int,
    low_frequency_rad: _arguments.Listed = 0.0,
    low_frequency_period_s: Number = 600.0,
) -> Float[Array, "{count} 3"]:
    """Errors of ``count`` frames, rotation vectors [rad] in sensor axes: white noise and a sine.

    The numbers drawn do not depend on the sizes of the errors. Pure JAX, so it maps over keys.

    Args:
        key: of the run, `Component.STAR_SENSOR` of `robins.sim.random.stream`.
        sigma_rad: white noise of a frame, a number or one for each axis; boresight z.
        frame_s: time from frame to frame [s].
        count: number of frames.
        low_frequency_rad: amplitude of the sine, a number or one for each axis; each axis has a
            phase of its own, drawn.
        low_frequency_period_s: its period [s], a number or one for each axis.

    Raises:
        ValueError: no frame, or a number out of its range.
    """
    _arguments.count_of("count", count)
    _arguments.number("frame_s", frame_s, 0.0, above=True)
    sigma = _arguments.vector("sigma_rad", sigma_rad, 3, low=0.0)
    size = _arguments.vector("low_frequency_rad", low_frequency_rad, 3, low=0.0)
    period = _arguments.vector(
        "low_frequency_period_s", low_frequency_period_s, 3, low=0.0, above=True
    )
    # Drawn by frame number, so that a longer run begins with the shorter one.
    root = jax.random.fold_in(key, _NOISE)
    keys = jax.vmap(lambda number: jax.random.fold_in(root, number))(jnp.arange(count))
    noise = jax.vmap(lambda one: jax.random.normal(one, (3,)))(keys)
    turns = jax.random.uniform(jax.random.fold_in(key, _PHASE), (3,))
    time = jnp.arange(float(count)) * jnp.asarray(frame_s, float)
    phase = 2.0 * np.pi * (time[:, None] / period[None] + turns[None])
    return sigma[None] * noise + size[None] * jnp.sin(phase)


def read_star(
    q_ib: Float[Array, "4"], error: Float[Array, "3"], q_bs: _arguments.Listed | None = None
) -> Float[Array, "4"]:
    """Measured q_ib: the true attitude after a small rotation about the sensor axes.

    ``q_measured = q_ib q_bs exp(e) q_bs^-1``, so the true attitude is ``q_measured exp(-q_bs e)``.

    Args:
        q_ib: true attitude, body to inertial, scalar first.
        error: e of the frame [rad], sensor axes, a row of `star_errors`.
        q_bs: (4,) from sensor axes to body axes; None: they are the same.

    Raises:
        ValueError: a q_bs of another shape.
    """
    if q_bs is not None:
        error = rotate(normalise(_arguments.rows("q_bs", q_bs, 4)), error)
    return normalise(multiply(q_ib, from_rotvec(error)))


@value
class StarCamera:
    """A camera that reports directions of stars; boresight z.

    The error of a direction has a sigma in each of two angles. For stars of a magnitude m fainter
    than ``sigma_magnitude`` it grows as 10^(growth (m - sigma_magnitude)), with a growth of 0.2
    where shot noise of the star dominates, 0.4 where background noise does.
    """

    field_rad: Any = np.pi / 9.0  # full angle of the round field of view, 20 deg
    magnitude_limit: Any = 6.0  # fainter stars are not seen
    sigma_rad: Any = 20.0 * ARCSEC  # of a bright star
    sigma_magnitude: Any = 4.0
    sigma_growth: Any = 0.0
    magnitude_sigma: Any = 0.0  # of the reported magnitude
    missed: Any = 0.0  # probability that a star in the field is not reported
    q_bs: Any = (1.0, 0.0, 0.0, 0.0)  # sensor axes to body axes
    # greatest number of stars reported, the brightest
    most_stars: int = kind(default=40)
    # directions without a star, anywhere in the field
    false_stars: int = kind(default=0)


class StarImage(NamedTuple):
    """Stars in one frame of a camera, brightest first; M = most_stars + false_stars rows."""

    vectors_b: Any  # (M, 3) unit vectors, body axes; NaN: none
    sigma_rad: Any  # (M,) of each of the two angles of a direction
    magnitude: Any  # (M,) as reported; NaN: none
    star: Any  # (M,) int, the true index in the catalogue; -1: none or false


def index_for(camera: StarCamera, stars: Stars, margin_rad: float = np.radians(0.5)) -> StarIndex:
    """Index of the stars that a camera can see, for searches inside a compiled loop.

    Args:
        camera: the camera, which is checked here.
        stars: the catalogue, from `robins.earth.stars`.
        margin_rad: margin of a cell's list beyond the field, for uncertain attitudes [rad].

    Raises:
        ValueError: a figure of the camera out of its range, or a catalogue without a star that is
            bright enough.
    """
    half_turn = np.pi / 2.0
    _arguments.number("field_rad", camera.field_rad, 0.0, half_turn - 2.0 * margin_rad, above=True)
    _arguments.number("magnitude_limit", camera.magnitude_limit)
    _arguments.number("sigma_rad", camera.sigma_rad, 0.0, 0.1, above=True)
    _arguments.number("sigma_magnitude", camera.sigma_magnitude)
    _arguments.number("sigma_growth", camera.sigma_growth, 0.0, 1.0)
    _arguments.number("magnitude_sigma", camera.magnitude_sigma, 0.0)
    _arguments.number("missed", camera.missed, 0.0, 1.0)
    length = np.linalg.norm(_arguments.rows("q_bs", camera.q_bs, 4))
    _arguments.number("q_bs must be a unit quaternion: its length", length, 0.999, 1.001)
    _arguments.count_of("most_stars", camera.most_stars)
    _arguments.number("false_stars", camera.false_stars, 0.0)
    bright = np.asarray(stars.magnitude) < camera.magnitude_limit
    if not np.any(bright):
        raise ValueError(
            f"no star of the catalogue is brighter than magnitude_limit {camera.magnitude_limit}"
        )
    seen = Stars(*(np.asarray(x)[bright] for x in stars))
    return index_stars(seen, 0.5 * float(camera.field_rad) + margin_rad)


class StarField(NamedTuple):
    """Stars in the field of a camera without errors, brightest first; N rows."""

    vectors_s: Any  # (N, 3) unit vectors, sensor axes
    magnitude: Any  # (N,)
    star: Any  # (N,) int, index in the catalogue; -1: none, the other columns are then undefined


def visible_stars(
    index: StarIndex,
    q_is: Float[Array, "4"],
    camera: StarCamera,
    most: int | None = None,
    margin_rad: float = 0.0,
) -> StarField:
    """The stars in the field of a camera, without any error.

    Args:
        index: of the stars, from `index_for`.
        q_is: attitude of the camera, sensor to inertial.
        camera: the camera.
        most: N, the number of brightest stars returned; None: as many as the camera reports.
        margin_rad: margin beyond the edge of the field [rad], at most that of the index.
    """
    members = near(index, rotate(q_is, jnp.array([0.0, 0.0, 1.0])))
    vectors_s = rotate(conjugate(q_is), jnp.asarray(index.unit_i)[members])
    there = StarField(vectors_s, jnp.asarray(index.magnitude)[members], members)
    return _in_field(there, camera, camera.most_stars if most is None else most, margin_rad)


def turned(shown: StarField, camera: StarCamera, turn_rad: Float[Array, "3"]) -> StarField:
    """Stars in the field after a small rotation of the camera [rad], sensor axes.

    Equal, to rounding, to `visible_stars` for the rotated camera, if the margin of ``shown``
    exceeds the rotation.
    """
    vectors_s = rotate(conjugate(from_rotvec(turn_rad)), shown.vectors_s)
    return _in_field(shown._replace(vectors_s=vectors_s), camera, camera.most_stars)


def _in_field(
    there: StarField, camera: StarCamera, most: int, margin_rad: float = 0.0
) -> StarField:
    """The ``most`` brightest stars within the field of view and the magnitude limit."""
    cos_edge = jnp.cos(0.5 * jnp.asarray(camera.field_rad, float) + margin_rad)
    seen = (there.star >= 0) & (there.vectors_s[:, 2] > cos_edge)
    seen = seen & (there.magnitude < camera.magnitude_limit)
    # The lists are brightest first, so the first visible stars are the brightest.
    (first,) = jnp.nonzero(seen, size=most, fill_value=-1)
    star = jnp.where(first >= 0, there.star[first], -1)
    return StarField(there.vectors_s[first], there.magnitude[first], star)


def photograph(
    key: Array,
    index: StarIndex,
    q_ib: Float[Array, "4"],
    camera: StarCamera,
    turn_rad: _arguments.Listed | None = None,
) -> StarImage:
    """Simulated image of a camera. Pure JAX: it maps over keys, attitudes and sizes of errors.

    Args:
        key: of the frame.
        index: of the stars, from `index_for`.
        q_ib: true attitude of the body.
        camera: the camera.
        turn_rad: (3,) an error common to all stars, such as a low-frequency one from
            `star_errors`: the image is taken at the attitude that `read_star` returns for it.
            None: no such error.
    """
    q_is = multiply(q_ib, normalise(_arguments.rows("q_bs", camera.q_bs, 4)))
    if turn_rad is not None:
        q_is = multiply(q_is, from_rotvec(jnp.asarray(turn_rad, float)))
    return expose(key, visible_stars(index, q_is, camera), camera)


def expose(key: Array, shown: StarField, camera: StarCamera) -> StarImage:
    """Image of the stars in the field: each with its error, some missed, false ones added.

    Args:
        key: of the frame.
        shown: stars in the field, ``camera.most_stars`` rows from `visible_stars` or `turned`.
        camera: the camera.
    """
    q_bs = normalise(_arguments.rows("q_bs", camera.q_bs, 4))
    rows = camera.most_stars + camera.false_stars

    normal = jax.random.normal(jax.random.fold_in(key, _NORMAL), (rows, 3))
    uniform = jax.random.uniform(jax.random.fold_in(key, _UNIFORM), (rows, 3))
    caught = uniform[: camera.most_stars, 0] >= camera.missed
    star = jnp.where(caught, shown.star, -1)

    # False stars are uniform over the field, with the magnitudes of real ones, see `synthetic`.
    cos_edge = jnp.cos(0.5 * jnp.asarray(camera.field_rad, float))
    where = uniform[camera.most_stars :]
    z, azimuth = 1.0 - where[:, 0] * (1.0 - cos_edge), 2.0 * np.pi * where[:, 1]
    across = jnp.sqrt(1.0 - z**2)
    false_s = jnp.stack([across * jnp.cos(azimuth), across * jnp.sin(azimuth), z], 1)
    false_magnitude = camera.magnitude_limit + jnp.log10(1.0 - where[:, 2]) / 0.4888

    there = jnp.concatenate([star >= 0, jnp.ones(camera.false_stars, bool)])
    star = jnp.concatenate([star, jnp.full(camera.false_stars, -1)])
    magnitude = jnp.concatenate([shown.magnitude, false_magnitude])
    fainter = jnp.maximum(magnitude - camera.sigma_magnitude, 0.0)
    sigma = camera.sigma_rad * 10.0 ** (camera.sigma_growth * fainter)
    noise = sigma[:, None] * normal[:, :2]
    vectors_s = _deflected(jnp.concatenate([shown.vectors_s, false_s]), noise)
    reported = magnitude + camera.magnitude_sigma * normal[:, 2]

    order = jnp.argsort(jnp.where(there, reported, jnp.inf))
    here = there[order]
    vectors_b = rotate(q_bs, vectors_s[order])
    return StarImage(
        jnp.where(here[:, None], vectors_b, jnp.nan),
        sigma[order],
        jnp.where(here, reported[order], jnp.nan),
        star[order],
    )


def measure_attitude(
    key: Array,
    index: StarIndex,
    q_ib: Float[Array, "4"],
    camera: StarCamera,
    turn_rad: _arguments.Listed | None = None,
    q_ib_prior: _arguments.Listed | None = None,
    tolerance_rad: _arguments.Listed | None = None,
) -> tuple[Float[Array, "4"], Float[Array, "3 3"], Int[Array, ""]]:
    """A frame of a star sensor: photograph, identify the stars, QUEST. Pure JAX.

    Args:
        key: of the frame.
        index: of the stars, from `index_for`.
        q_ib: true attitude of the body.
        camera: the camera.
        turn_rad: an error common to all stars, see `photograph`.
        q_ib_prior: (4,) predicted attitude, with which the stars are identified by
            `robins.ins.star_identification.track_stars`. None: by their true identity.
        tolerance_rad: of the match [rad]; None: six sigmas of the faintest star that is reported.

    Returns:
        Measured q_ib, its covariance (3, 3) [rad^2] in body axes (of dtheta in
        ``q_true = q exp(dtheta)``), the number of stars used. With fewer than two stars, or none
        far enough from another, the first two are NaN.
    """
    image = photograph(key, index, q_ib, camera, turn_rad)
    return solve(image, index, camera, q_ib_prior, tolerance_rad)


def solve(
    image: StarImage,
    index: StarIndex,
    camera: StarCamera,
    q_ib_prior: _arguments.Listed | None = None,
    tolerance_rad: _arguments.Listed | None = None,
) -> tuple[Float[Array, "4"], Float[Array, "3 3"], Int[Array, ""]]:
    """Attitude from an image of `expose`; other arguments and results as in `measure_attitude`."""
    star = image.star
    if q_ib_prior is not None:
        boresight = rotate(
            normalise(_arguments.rows("q_bs", camera.q_bs, 4)), jnp.array([0.0, 0, 1.0])
        )
        there = ~jnp.isnan(image.magnitude)
        if tolerance_rad is None:
            tolerance_rad = 6.0 * jnp.max(jnp.where(there, image.sigma_rad, 0.0))
        prior = _arguments.rows("q_ib_prior", q_ib_prior, 4)
        star = track_stars(index, image.vectors_b, prior, boresight, tolerance_rad)
    weight = jnp.where(star >= 0, 1.0 / image.sigma_rad**2, 0.0)
    found = quest(image.vectors_b, jnp.asarray(index.unit_i)[star], weight)
    return found.q_ib, found.covariance, found.stars


def _deflected(unit: Float[Array, "n 3"], angles: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
    """Unit vectors near z, rotated by two small angles [rad] across the line of sight."""
    first = jnp.stack([unit[:, 2], jnp.zeros(len(unit)), -unit[:, 0]], 1)
    first = first / jnp.sqrt(jnp.sum(first**2, 1, keepdims=True))
    moved = unit + angles[:, :1] * first + angles[:, 1:] * jnp.cross(unit, first)
    return moved / jnp.sqrt(jnp.sum(moved**2, 1, keepdims=True))


def observe_euler(
    key: Array, q_nb: _arguments.Listed, sigma_rad: _arguments.Listed, present: _arguments.Listed
) -> Float[Array, "epochs 3"]:
    """Measured pitch, roll, heading [rad] of the body, each with white noise.

    The angles are those of `robins.rotation.to_euler`, in another order. Roll and heading are
    wrapped to [-pi, pi); noise that takes a pitch beyond the vertical does not flip the others.

    Args:
        key: of the run, `Component.STAR_SENSOR` of `robins.sim.random.stream`.
        q_nb: (E, 4) true attitude, scalar first.
        sigma_rad: standard deviation, a number or one each for pitch, roll, heading.
        present: (E,) bool, True where there is a sample; NaN elsewhere.

    Raises:
        ValueError: shapes that do not fit together, or a negative sigma.
    """
    there = _arguments.presence(present)
    count = len(there)
    true = _arguments.rows("q_nb", q_nb, count, 4)
    sigma = _arguments.vector("sigma_rad", sigma_rad, 3, low=0.0)
    error = sigma[None] * jax.random.normal(key, (count, 3))
    roll, pitch, heading = to_euler(true)
    angles = pitch + error[:, 0], wrap(roll + error[:, 1]), wrap(heading + error[:, 2])
    return jnp.where(there[:, None], jnp.stack(angles, 1), jnp.nan)
