"""A GNSS receiver: fixes of position and velocity of its antenna along a true motion.

`fix_times` gives the instants at which the truth is needed, `observe` makes the fixes from it, in
pure JAX (map over ``key`` for a batch of runs), `as_table` makes a `GnssTable` of one run.

    times = fix_times(model, 0.0, 600.0)
    fixes = observe(model, key, times.valid_s, lat, lon, alt, v_n, q_nb, omega_ib_b)

where the truth is given at the instants ``valid_s``. North-east-down and forward-right-down.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.dataset import GnssTable
from robins.earth import OMEGA_E, Geodetic, dcm_en, ecef_from_geodetic, geodetic_from_ecef
from robins.errors import require
from robins.filters.values import value
from robins.rotation import rotate
from robins.sim import _arguments

# The draws at a fix are part of the file format, as `robins.sim.random.Component` is.
_NORMALS, _CHANCES = 0, 1  # streams folded into the key of the receiver
_ROWS = 5  # of three normal numbers, by the error that they are for
_POSITION, _VELOCITY, _MARKOV, _POSITION_OUTLIER, _VELOCITY_OUTLIER = range(_ROWS)
_DROPPED, _OUTLIER = 0, 1  # uniform numbers


@value
class GnssErrorModel:
    """Errors of a GNSS receiver; vectors are north, east, down, or one number for all three.

    Raises:
        ValueError: a wrong shape, a value not finite, a negative sigma, a share beyond 0 to 1, a
            Markov error without sigma or correlation time, an outage that ends before it begins.
    """

    sigma_m: Any  # (3,) m, white error of a position
    sigma_v: Any = None  # (3,) m/s, white error of a velocity; None: the receiver gives none
    markov_sigma_m: Any = None  # (3,) m, slowly changing error of position (first-order Markov)
    markov_tau_s: Any = None  # (3,) s, its correlation time
    stated_sigma_m: Any = None  # (3,) m, reported; None: the true one, white and Markov
    stated_sigma_v: Any = None  # (3,) m/s, reported for velocity; None: the true one
    lever_b_m: Any = None  # (3,) m, from IMU to antenna in body axes; None: no lever arm
    rate_hz: float = 1.0
    time_offset_s: float = 0.0  # time stamp less the instant the fix is true for
    latency_s: float = 0.0  # arrival of the fix less its time stamp
    outages_s: Any = None  # (k, 2) s, outages without fixes, from (included) to (excluded)
    drop_share: Any = 0.0  # share of the fixes lost independently
    outlier_share: Any = 0.0  # share of the fixes in gross error
    outlier_size: Any = 10.0  # length of a gross error in sigmas of the white error

    def __post_init__(self):
        for name in ("sigma_m", "sigma_v", "stated_sigma_m", "stated_sigma_v"):
            self._vector(name, low=0.0)
        self._vector("markov_sigma_m", low=0.0)
        self._vector("markov_tau_s", low=0.0, open_end=True)
        self._vector("lever_b_m")
        if (self.markov_sigma_m is None) != (self.markov_tau_s is None):
            raise ValueError(
                "markov_sigma_m and markov_tau_s belong together: give both or neither"
            )
        if self.sigma_v is None and self.stated_sigma_v is not None:
            raise ValueError("stated_sigma_v without sigma_v: the receiver gives no velocities")
        for name, low, high in (
            ("time_offset_s", -np.inf, np.inf),
            ("latency_s", 0.0, np.inf),
            ("drop_share", 0.0, 1.0),
            ("outlier_share", 0.0, 1.0),
            ("outlier_size", 0.0, np.inf),
        ):
            _arguments.number(name, getattr(self, name), low, high)
        _arguments.number("rate_hz", self.rate_hz, 0.0, above=True)
        if self.outages_s is not None and len(self.outages_s) == 0:
            object.__setattr__(self, "outages_s", None)
        elif self.outages_s is not None:
            outages = np.asarray(self.outages_s, float)
            if outages.ndim != 2 or outages.shape[1] != 2 or not np.all(np.isfinite(outages)):
                raise ValueError(f"outages_s must be pairs of times [s], got {self.outages_s}")
            for begin, end in outages:
                require(begin < end, f"an outage from {begin:g} s to {end:g} s ends too early")
            object.__setattr__(self, "outages_s", outages)

    def _vector(self, name: str, low: float = -np.inf, open_end: bool = False) -> None:
        value = getattr(self, name)
        if value is None or isinstance(value, jax.Array):
            return
        x = np.asarray(value, float)
        if x.shape not in ((), (3,)):
            raise ValueError(f"{name} must be a number or of shape (3,), got shape {x.shape}")
        _arguments.number(name, x, low, above=open_end)
        object.__setattr__(self, name, np.broadcast_to(x, (3,)))


class FixTimes(NamedTuple):
    """Times of the fixes of a run [s], each (m,)."""

    valid_s: np.ndarray  # the instants whose truth the fixes measure
    stamp_s: np.ndarray  # time stamps of the receiver
    arrival_s: np.ndarray  # when the fix is available


class GnssFixes(NamedTuple):
    """Fixes of one run; NaN in position and velocity where there is none."""

    lat_rad: Any  # (m,) of the antenna, measured
    lon_rad: Any  # (m,)
    alt_m: Any  # (m,)
    v_n: Any  # (m, 3) m/s of the antenna, measured; None: the receiver gives none
    sigma_m: Any  # (m, 3) as stated, north, east, down
    sigma_v: Any  # (m, 3) m/s as stated; None as above
    missing: Any  # (m,) bool: outage or lost
    outlier: Any  # (m,) bool: in gross error, if not missing
    error_m: Any  # (m, 3) true error, north, east, down, also of fixes that are missing


def fix_times(model: GnssErrorModel, start_s: float, end_s: float) -> FixTimes:
    """Times of the fixes stamped from start to end, at whole multiples of the fix interval.

    Raises:
        ValueError: an end before the start.
    """
    require(end_s >= start_s, f"fixes from {start_s} s to {end_s} s: the end is before the start")
    # A stamp within rounding of a multiple counts as one.
    first = np.ceil(start_s * model.rate_hz - 1e-6)
    last = np.floor(end_s * model.rate_hz + 1e-6)
    stamp = np.arange(first, last + 1.0) / model.rate_hz
    return FixTimes(stamp - model.time_offset_s, stamp, stamp + model.latency_s)


def antenna(
    lat_rad: Float[Array, "*b"],
    lon_rad: Float[Array, "*b"],
    alt_m: Float[Array, "*b"],
    v_n: Float[Array, "*b 3"],
    q_nb: Float[Array, "*b 4"],
    omega_ib_b: Float[Array, "*b 3"],
    lever_b_m: Float[Array, "3"],
) -> tuple[Array, Array, Array, Array]:
    """Latitude, longitude, height and velocity of an antenna on a lever arm l fixed to the vehicle.

    Position ``r_e + C_eb l`` and velocity ``v + C_nb (omega_eb_b x l)`` (Groves 2013, chapter
    14), without approximation: computed in Earth-fixed coordinates, the velocity resolved along
    north, east and down at the antenna.
    """
    C_en = dcm_en(lat_rad, lon_rad)
    lever_b = jnp.broadcast_to(lever_b_m, omega_ib_b.shape)
    # The Earth-rate term is added in Earth-fixed axes, where it is constant.
    lever_e = _turn(C_en, rotate(q_nb, lever_b))
    spin = jnp.broadcast_to(jnp.array([0.0, 0.0, OMEGA_E]), lever_e.shape)
    v_e = _turn(C_en, v_n + rotate(q_nb, jnp.cross(omega_ib_b, lever_b))) - jnp.cross(spin, lever_e)
    lat, lon, alt = geodetic_from_ecef(ecef_from_geodetic(lat_rad, lon_rad, alt_m) + lever_e)
    return lat, lon, alt, _turn(jnp.swapaxes(dcm_en(lat, lon), -1, -2), v_e)


def _turn(C: Array, v: Array) -> Array:
    return jnp.einsum("...ij,...j->...i", C, v)


def _truth(*given: Array) -> tuple[Array, ...]:
    names = ("valid_s", "lat_rad", "lon_rad", "alt_m", "v_n", "q_nb", "omega_ib_b")
    time = given[0]
    for name, x, tail in zip(names, given, ((), (), (), (), (3,), (4,), (3,)), strict=True):
        if time.ndim != 1 or x.shape != (*time.shape, *tail):
            wanted = ("m", *tail) if tail else "(m,)"
            raise ValueError(f"{name} must have shape {wanted}, m as in valid_s, got {x.shape}")
    return given


def _rows(count: int, sigma: ArrayLike) -> Array:
    return jnp.broadcast_to(jnp.asarray(sigma), (count, 3))


def _standard(white: Array, direction: Array, gross: Array) -> Array:
    """Errors in sigmas: white noise, and gross errors along a random direction."""
    return white + gross * (direction / jnp.linalg.norm(direction, axis=1, keepdims=True))


def _is_lost(model: GnssErrorModel, time_s: Array, chance: Array) -> Array:
    """Mask (m,) of the fixes dropped by chance or within an outage."""
    lost = chance < model.drop_share
    if model.outages_s is None:
        return lost
    begin, end, now = model.outages_s[None, :, 0], model.outages_s[None, :, 1], time_s[:, None]
    return lost | jnp.any((begin <= now) & (now < end), axis=1)


def _position_errors(
    model: GnssErrorModel, time_s: Array, normal: Array, gross: Array
) -> tuple[Array, Array]:
    """(m, 3) errors north, east, down [m], and the sigmas that the receiver states."""
    rows = partial(_rows, len(time_s))
    draws = normal[:, _POSITION], normal[:, _POSITION_OUTLIER]
    error_m, sigma_m = rows(model.sigma_m) * _standard(*draws, gross), rows(model.sigma_m)
    if model.markov_sigma_m is not None:
        slow = _markov(time_s, rows(model.markov_tau_s), normal[:, _MARKOV])
        error_m = error_m + rows(model.markov_sigma_m) * slow
        sigma_m = jnp.sqrt(sigma_m**2 + rows(model.markov_sigma_m) ** 2)
    if model.stated_sigma_m is not None:
        sigma_m = rows(model.stated_sigma_m)
    return error_m, sigma_m


def observe(
    model: GnssErrorModel,
    key: Array,
    valid_s: ArrayLike,
    lat_rad: ArrayLike,
    lon_rad: ArrayLike,
    alt_m: ArrayLike,
    v_n: ArrayLike,
    q_nb: ArrayLike,
    omega_ib_b: ArrayLike,
) -> GnssFixes:
    """Fixes of a receiver from the true motion of its vehicle at the instants of validity.

    The draws for a fix depend on its number alone, so outages and losses leave the errors of
    the other fixes unchanged. Gross errors are added along a random direction, their length
    measured in sigmas of the white error; a fix in gross error states the sigmas of a good one.
    With no lever arm and no error the truth comes back unchanged.

    Args:
        model: the error model.
        key: of the run and the receiver, from `robins.sim.random.stream`.
        valid_s: (m,) instants of the fixes, ascending, from `fix_times`, also the time scale of
            the outages.
        lat_rad: (m,) true latitude of the IMU.
        lon_rad: (m,) true longitude.
        alt_m: (m,) true height above the ellipsoid.
        v_n: (m, 3) true velocity, north, east, down [m/s].
        q_nb: (m, 4) true attitude, scalar first.
        omega_ib_b: (m, 3) true angular rate of the gyros [rad/s].

    Raises:
        ValueError: shapes that do not fit together.
    """
    given = (valid_s, lat_rad, lon_rad, alt_m, v_n, q_nb, omega_ib_b)
    time, lat, lon, alt, v, q, omega = _truth(*(jnp.asarray(x, float) for x in given))
    if model.lever_b_m is not None:
        lat, lon, alt, v = antenna(lat, lon, alt, v, q, omega, jnp.asarray(model.lever_b_m))

    numbers = jnp.arange(len(time))
    normal, chance = jax.vmap(lambda number: _drawn(key, number))(numbers)
    missing = _is_lost(model, time, chance[:, _DROPPED])
    outlier = chance[:, _OUTLIER] < model.outlier_share
    gross = jnp.where(outlier, model.outlier_size, 0.0)[:, None]
    rows = partial(_rows, len(time))
    error_m, sigma_m = _position_errors(model, time, normal, gross)
    measured = Geodetic(lat, lon, alt).retract(error_m)
    places = measured.lat, measured.lon, measured.alt
    lat, lon, alt = (jnp.where(missing, jnp.nan, x) for x in places)
    v_measured, sigma_v = None, None
    if model.sigma_v is not None:
        draws = normal[:, _VELOCITY], normal[:, _VELOCITY_OUTLIER]
        error_v = rows(model.sigma_v) * _standard(*draws, gross)
        v_measured = jnp.where(missing[:, None], jnp.nan, v + error_v)
        sigma_v = rows(model.sigma_v if model.stated_sigma_v is None else model.stated_sigma_v)
    return GnssFixes(lat, lon, alt, v_measured, sigma_m, sigma_v, missing, outlier, error_m)


def _drawn(key: Array, number: Array) -> tuple[Array, Array]:
    normals, chances = (
        jax.random.fold_in(jax.random.fold_in(key, which), number) for which in (_NORMALS, _CHANCES)
    )
    return jax.random.normal(normals, (_ROWS, 3)), jax.random.uniform(chances, (2,))


def _markov(time: Array, tau: Array, normal: Array) -> Array:
    """First-order Markov process of unit variance (m, 3), steady from the first fix on."""

    def step(before, x):
        fade, drive, number = x
        now = fade * before + drive * number
        return now, now

    # Infinite time before the first fix: the zeros it starts from decay completely.
    gone, steady = jnp.zeros((1, 3))[: len(time)], jnp.ones((1, 3))[: len(time)]
    x = jnp.diff(time)[:, None] / tau[1:]
    fades = jnp.concatenate([gone, jnp.exp(-x)])
    drives = jnp.concatenate([steady, jnp.sqrt(-jnp.expm1(-2.0 * x))])
    return jax.lax.scan(step, jnp.zeros(3), (fades, drives, normal))[1]


def as_table(fixes: GnssFixes, stamp_s: np.ndarray, start_ns: int = 0) -> GnssTable:
    """`GnssTable` of the fixes of one run, missing ones left out.

    Args:
        fixes: those of one run.
        stamp_s: (m,) time stamps [s], from `fix_times`.
        start_ns: time of the run's start, added to the stamps.

    Raises:
        ValueError: the number of fixes is not that of the stamps, or they are of many runs.
    """
    missing = np.asarray(fixes.missing)
    if missing.shape != np.shape(stamp_s):
        raise ValueError(
            f"{np.shape(stamp_s)} time stamps for fixes of shape {missing.shape}: give those of "
            "one run"
        )
    there = ~missing
    time_ns = start_ns + np.rint(np.asarray(stamp_s) * 1e9).astype(np.int64)

    def of(x: ArrayLike) -> np.ndarray:
        return np.asarray(x)[there]

    return GnssTable(
        time_ns[there],
        of(fixes.lat_rad),
        of(fixes.lon_rad),
        of(fixes.alt_m),
        of(fixes.sigma_m),
        v_n=None if fixes.v_n is None else of(fixes.v_n),
        sigma_v=None if fixes.sigma_v is None else of(fixes.sigma_v),
        source="simulated receiver",
    )
