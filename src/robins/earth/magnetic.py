"""The Earth's magnetic field: spherical-harmonic models such as the WMM, vectorised.

The field is minus the gradient of ``V = a sum_n (a/r)^(n+1) sum_m (g_nm cos m lon + h_nm sin m lon)
P_nm`` with Schmidt's quasi-normal functions P_nm of the sine of the geocentric latitude, a = 6371.2
km (Chulliat et al. 2020, "The US/UK World Magnetic Model for 2020-2025", eq. 1 to 17). It is summed
after Pines (1973, "Uniform representation of the gravitational potential and its derivatives"):
with (x, y, z) the direction to the point, ``P_nm cos m lon = Q_nm(z) Re (x + i y)^m``, Q_nm a
polynomial. Nothing is divided by the cosine of the latitude, so field and gradients are finite
everywhere, poles included; north at a pole is along the meridian of the longitude given.

A model holds from its epoch for five years and from 1 km below to 850 km above the ellipsoid.
`field_along` refuses other dates and heights; `field_n`, for compiled code, cannot check them.
The fields of the crust and of ionospheric and magnetospheric currents are not modelled: 130 to
160 nT (one sigma) at the ground.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth.wgs84 import dcm_en, ecef_from_geodetic
from robins.errors import RobinsError

RADIUS_M = 6371200.0  # a, the reference radius of WMM and IGRF
LIFE_YEARS = 5.0
LOWEST_M, HIGHEST_M = -1e3, 850e3  # heights for which a model is valid
_NT = 1e-9


class MagneticModelError(RobinsError, ValueError):
    """A model that cannot be read, or a date or place outside what a model covers."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class MagneticModel:
    """Coefficients of degree n (row) and order m (column), zero where m > n; degree N in all.

    Passes through `jit` and `vmap`; name and epoch are fixed when a function is compiled.
    """

    g: Any  # (N+1, N+1) tesla, Schmidt quasi-normal, of the cosines
    h: Any  # (N+1, N+1) tesla, of the sines
    g_rate: Any  # (N+1, N+1) tesla per year
    h_rate: Any  # (N+1, N+1) tesla per year
    name: str = field(metadata={"static": True})
    epoch: float = field(metadata={"static": True})  # decimal year

    @property
    def life(self) -> tuple[float, float]:
        """First and last decimal year for which the model is valid."""
        return self.epoch, self.epoch + LIFE_YEARS


class Elements(NamedTuple):
    """Magnetic elements of a field: declination, inclination and intensities."""

    declination_rad: Array  # of the horizontal component, clockwise from true north
    inclination_rad: Array  # below the horizon
    horizontal_t: Array
    total_t: Array


def wmm(year: int) -> MagneticModel:
    """The World Magnetic Model of 2020 or 2025, degree 12, as NOAA and BGS published it.

    Raises:
        MagneticModelError: another year.
    """
    return _shipped(int(year))


@functools.cache
def _shipped(year: int) -> MagneticModel:
    folder = resources.files("robins.earth") / "coefficients"
    models = sorted(int(entry.name[3:7]) for entry in folder.iterdir() if entry.name[:3] == "WMM")
    if year not in models:
        raise MagneticModelError(f"there is no WMM of {year} here; there are {models}")
    with resources.as_file(folder / f"WMM{year}.COF") as path:
        return read_cof(path)


def wmm_for(decimal_year: float) -> MagneticModel:
    """The World Magnetic Model that is valid at the date.

    Raises:
        MagneticModelError: none of those included; `read_cof` reads the file of another.
    """
    for year in (2025, 2020):
        model = _shipped(year)
        if model.life[0] <= decimal_year <= model.life[1]:
            return model
    raise MagneticModelError(
        "the World Magnetic Models here hold from 2020 to 2030",
        f"decimal_year {decimal_year:g}",
        "read the coefficient file of another with read_cof",
    )


def decimal_year(when: date | datetime | np.datetime64 | int) -> float:
    """The date as a year and its fraction, 2027.5 in the first days of July 2027.

    Args:
        when: a day (its beginning), a time (UTC if it has no time zone), or Unix time [ns].
    """
    if isinstance(when, int | np.integer):
        when = np.datetime64(int(when), "ns")
    if isinstance(when, np.datetime64):
        moment = datetime.fromisoformat(str(when.astype("datetime64[us]")))
    elif isinstance(when, datetime):
        moment = when
    else:
        moment = datetime(when.year, when.month, when.day)
    moment = moment.astimezone(UTC) if moment.tzinfo else moment.replace(tzinfo=UTC)
    begin, end = (datetime(year, 1, 1, tzinfo=UTC) for year in (moment.year, moment.year + 1))
    return moment.year + (moment - begin) / (end - begin)


def read_cof(path: str | Path) -> MagneticModel:
    """Read a coefficient file of the WMM's text form: epoch and name, then ``n m g h g' h'`` [nT].

    Raises:
        MagneticModelError: the file is not of this form; the message names the line.
    """
    lines = Path(path).read_text("ascii", errors="replace").splitlines()
    head = lines[0].split() if lines else []
    try:
        epoch, name = float(head[0]), head[1]
    except (IndexError, ValueError):
        raise MagneticModelError(
            "a coefficient file begins with epoch and name, as in '2025.0 WMM-2025 11/13/2024', "
            f"got {lines[0][:60] if lines else ''!r}",
            f"{path}, line 1",
        ) from None
    rows = {}
    for number, line in enumerate(lines[1:], start=2):
        if line.startswith("9999"):  # the end mark
            break
        try:
            n, m, *values = (convert(x) for convert, x in zip(_ROW, line.split(), strict=True))
        except ValueError:
            n, m, values = 0, 0, []
        if not (0 <= m <= n and n >= 1 and np.all(np.isfinite(values))):
            raise MagneticModelError(
                f"expected degree, order and four coefficients [nT], got {line[:60]!r}",
                f"{path}, line {number}",
            )
        rows[int(n), int(m)] = values
    degree = max((n for n, _ in rows), default=0)
    missing = [(n, m) for n in range(1, degree + 1) for m in range(n + 1) if (n, m) not in rows]
    if missing or not degree:
        raise MagneticModelError(
            f"the coefficients of (degree, order) {missing[:3] or (1, 0)} are missing; the file is "
            "not whole",
            path,
        )
    table = np.zeros((4, degree + 1, degree + 1))
    for place, values in rows.items():
        table[(slice(None), *place)] = np.asarray(values) * _NT
    table.flags.writeable = False  # one copy is shared by all callers
    return MagneticModel(*table, name=name, epoch=epoch)


_ROW = (int, int, float, float, float, float)


def field_n(
    model: MagneticModel,
    lat_rad: ArrayLike,
    lon_rad: ArrayLike,
    alt_m: ArrayLike,
    decimal_year: ArrayLike,
) -> Float[Array, "*b 3"]:
    """Field [T] in north, east, down at geodetic positions and dates, which broadcast.

    For use under `jit`, `vmap` and `grad`: dates and heights outside the model's validity are not
    refused here but in `field_along`. Differentiable everywhere but at the Earth's centre.
    """
    years = jnp.asarray(decimal_year, float) - model.epoch
    return _field_n(model, *_floats(lat_rad, lon_rad, alt_m), years)


def elements(field_n: ArrayLike) -> Elements:
    """Declination, inclination, horizontal and total intensity of fields (..., 3) [T] in NED.

    A vertical field has no declination: it is zero there, and its gradient is not finite.
    """
    (b,) = _floats(field_n)
    horizontal = jnp.hypot(b[..., 0], b[..., 1])
    return Elements(
        jnp.arctan2(b[..., 1], b[..., 0]),
        jnp.arctan2(b[..., 2], horizontal),
        horizontal,
        jnp.sqrt(jnp.sum(b * b, -1)),
    )


def field_along(
    model: MagneticModel,
    lat_rad: Any,
    lon_rad: Any,
    alt_m: Any,
    decimal_year: Any,
    time_s: Any | None = None,
    knot_s: float = 1.0,
) -> np.ndarray:
    """Field [T] in north, east, down at each of many places, date and height checked.

    With ``time_s`` the places are a path: the model is evaluated at samples about ``knot_s`` apart
    and interpolated linearly in Earth-fixed axes, in which it is smooth at the poles too. The
    error at orbital speed is below 0.2 nT with knots of 1 s and below 15 nT with knots of 10 s.

    Args:
        model: of the main field, e.g. ``wmm_for(decimal_year)``.
        lat_rad: geodetic latitude, a number or many; likewise the next three, which broadcast.
        lon_rad: longitude, east.
        alt_m: height above the ellipsoid.
        decimal_year: the date, see `decimal_year`.
        time_s: (N,) increasing times of a path of N places [s]; None: evaluate at every place.
        knot_s: greatest time between evaluations [s], where the samples are as dense.

    Raises:
        MagneticModelError: a date or height outside the model's life, a latitude beyond 90 deg, a
            number that is not finite, or times that do not increase or do not fit the places.
    """
    given = (np.asarray(v, float) for v in (lat_rad, lon_rad, alt_m, decimal_year))
    lat, lon, alt, when = np.broadcast_arrays(*given)
    half_pi = np.pi / 2.0
    where = "at the poles latitude is +-pi/2: is it in degrees?"
    _refuse_outside("lat_rad", lat, -half_pi, half_pi, where)
    _refuse_outside("lon_rad", lon, -np.inf, np.inf, "every value must be finite")
    _refuse_outside("alt_m", alt, LOWEST_M, HIGHEST_M, f"{model.name} holds between these heights")
    remedy = f"that is the life of {model.name}; take the model of the date with wmm_for"
    _refuse_outside("decimal_year", when, *model.life, remedy)
    if time_s is None:
        return np.asarray(_field_n(model, lat, lon, alt, when - model.epoch))
    time = np.asarray(time_s, float)
    if time.ndim != 1 or time.shape != lat.shape or not np.all(np.diff(time) > 0.0):
        raise MagneticModelError(
            f"time_s must hold one increasing time for each of the {lat.shape} places, "
            f"got shape {time.shape}"
        )
    knots = _knots(time, knot_s)
    at_knots = _field_e(model, *(v[knots] for v in (lat, lon, alt, when - model.epoch)))
    b_e = np.stack([np.interp(time, time[knots], b) for b in np.asarray(at_knots).T], -1)
    return np.asarray(_turn_to_n(b_e, lat, lon))


def _refuse_outside(name: str, value: np.ndarray, low: float, high: float, why: str) -> None:
    bad = ~((value >= low) & (value <= high) & np.isfinite(value))
    if np.any(bad):
        place = np.unravel_index(np.argmax(bad), value.shape)
        index = f"[{', '.join(map(str, place))}]" if place else ""
        raise MagneticModelError(
            f"{name}{index} = {value[place]:.9g} is not from {low:.9g} to {high:.9g}: {why}"
        )


def _knots(time: np.ndarray, knot_s: float) -> np.ndarray:
    """Indices of samples at most knot_s apart (or adjacent), the first and the last included."""
    if not knot_s > 0.0:
        raise MagneticModelError(f"knot_s must be a positive number of seconds, got {knot_s}")
    # The last sample before each multiple of knot_s, and the first after it, bound every gap.
    marks = np.searchsorted(time, np.arange(time[0], time[-1], knot_s), side="right") - 1
    return np.unique(np.concatenate([marks, marks + 1, [0, len(time) - 1]]).clip(0, len(time) - 1))


def _floats(*values: ArrayLike) -> list[Array]:
    return [jnp.asarray(v, float) for v in values]


@jax.jit
def _field_n(model: MagneticModel, lat, lon, alt, years) -> Array:
    return _to_n(_earth_fixed(model, lat, lon, alt, years), lat, lon)


@jax.jit
def _field_e(model: MagneticModel, lat, lon, alt, years) -> Array:
    return _earth_fixed(model, lat, lon, alt, years)


def _to_n(b_e, lat, lon) -> Array:
    C = dcm_en(lat, lon)  # transposed: from e to n
    C, b_e = C.reshape((1,) * (b_e.ndim + 1 - C.ndim) + C.shape), b_e[..., None]
    return jnp.sum(C * b_e, -2)


_turn_to_n = jax.jit(_to_n)


def _earth_fixed(model: MagneticModel, lat, lon, alt, years) -> Array:
    """Field [T] along Earth-fixed axes; arrays are (order, point) inside."""
    lat, lon, alt, years = jnp.broadcast_arrays(lat, lon, alt, years)
    shape = lat.shape
    r_e = ecef_from_geodetic(lat.reshape(-1), lon.reshape(-1), alt.reshape(-1)).T
    years = years.reshape(-1)[None]
    r = jnp.sqrt(jnp.sum(r_e * r_e, 0))
    x, y, z = r_e / r[None]
    # Without the barrier XLA would repeat the sums over degrees for each use.
    sums = _sums_over_degree(model, z[None], (RADIUS_M / r)[None], years)
    sums = jax.lax.optimization_barrier(sums)
    cos, sin, weighted_cos, weighted_sin, slope_cos, slope_sin = sums
    # The gradient in (x, y, z) of the direction, and then the part along the radius; that of
    # x and y by d(x + i y)^m = m (x + i y)^(m-1) (dx + i dy), of the radius by Euler's theorem.
    m = np.arange(len(cos), dtype=float)[:, None]
    along_x, against_y = _polynomial((m * cos)[1:], (m * sin)[1:], x, y)
    along_y = -against_y
    along_z, _ = _polynomial(slope_cos, slope_sin, x, y)
    inward, _ = _polynomial(weighted_cos, weighted_sin, x, y)
    inward = inward + x * along_x + y * along_y + z * along_z
    b_e = jnp.stack([x * inward - along_x, y * inward - along_y, z * inward - along_z], -1)
    return b_e.reshape((*shape, 3))


def _sums_over_degree(model: MagneticModel, z, ratio, years) -> list[Array]:
    """Six sums over n of ``(a/r)^(n+2)`` times a coefficient times a function of z, (order, point).

    The functions are Q_nm, (n + 1) Q_nm and dQ_nm/dz, each with g and with h.
    """
    degree = len(model.g) - 1
    first, second, diagonal = _recursion(degree)
    zero = jnp.zeros((degree + 1, 1)) * z
    sums = [zero] * 6
    before, now, slope_before, slope = zero, zero + diagonal[0], zero, zero
    power = ratio * ratio
    for n in range(1, degree + 1):
        a, b = first[n], second[n]
        before, now, slope_before, slope = (
            now,
            a * z * now - b * before + diagonal[n],
            slope,
            a * (now + z * slope) - b * slope_before,
        )
        power = power * ratio
        g, h = (
            power * (jnp.asarray(c[n])[:, None] + years * jnp.asarray(rate[n])[:, None])
            for c, rate in ((model.g, model.g_rate), (model.h, model.h_rate))
        )
        terms = g * now, h * now, (n + 1) * g * now, (n + 1) * h * now, g * slope, h * slope
        sums = [total + term for total, term in zip(sums, terms, strict=True)]
    return sums


@functools.cache
def _recursion(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tables (degree, order, 1) of ``Q_nm = first z Q_(n-1)m - second Q_(n-2)m + diagonal``.

    ``diagonal`` holds Q_mm, which does not depend on z and starts the column of order m.
    """
    n, m = np.meshgrid(np.arange(degree + 1.0), np.arange(degree + 1.0), indexing="ij")
    below = m < n
    size = np.sqrt(np.where(below, n * n - m * m, 1.0))
    first = np.where(below, (2.0 * n - 1.0) / size, 0.0)
    second = np.where(below, np.sqrt(np.maximum((n - 1.0) ** 2 - m * m, 0.0)) / size, 0.0)
    steps = [1.0, 1.0, *(np.sqrt(1.0 - 0.5 / k) for k in range(2, degree + 1))]
    return first[..., None], second[..., None], np.diag(np.cumprod(steps[: degree + 1]))[..., None]


def _polynomial(cos, sin, x, y) -> tuple[Array, Array]:
    """Real and imaginary part of ``sum_m (cos_m - i sin_m) (x + i y)^m`` by Horner's rule."""
    real, imag = cos[-1], -sin[-1]
    for k in range(len(cos) - 2, -1, -1):
        real, imag = real * x - imag * y + cos[k], real * y + imag * x - sin[k]
    return real, imag
