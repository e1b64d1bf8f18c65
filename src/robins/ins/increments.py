"""IMU samples to increments: rotation and velocity increment of the body over each interval.

An `Increments` row describes the motion of the body relative to inertial space between two times,
in body axes at the earlier one: rotation vector, velocity increment and displacement, corrected for
coning, sculling and scrolling. The samples do not show rate and specific force inside an interval;
they are interpolated by a rule for each kind of sensor:

*increment*: both are linear, with the slope given by the previous sample. For equal intervals
the coning term is then a 12th of (previous x this), that of Ignagni (1996) and Savage (1998, part
1), and likewise for sculling (part 2). Causal. The error of a path is of third order in the
interval; a cone of half angle a at rate W, sampled every T, leaves a drift of a^2 x^5 / (60 T),
x = W T (Ignagni 1996). After lost samples the line runs from the middle of the previous sample's
own interval to the middle of the present one's (`own_intervals`).

*rate*: both follow the cubic through the four nearest samples. Fourth order; needs one sample
ahead. If there are fewer than four, or their intervals differ by more than a factor of two, both
follow the straight line between two samples: second order.

The integrals are then taken by the Gauss rule of two points, with the rotation at each point in
closed form: exact in every product of the linear model up to the third order, of fourth order
beyond (Iserles & Norsett 1999 for the rotation vector). All is NumPy over whole tables.

`own_intervals` finds missing samples, and the interval over which the sample after a gap was
integrated. An increment is the integral since the previous sample. If that one was lost, most
sensors output the integral over their own interval only, so the motion of the lost samples is
missing; others keep summing and include the motion of the whole gap. Stamps cannot separate the two
cases, but rate and specific force can: the case closer to the previous sample is assumed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from robins.dataset import ImuTable
from robins.errors import require, require_kind
from robins.ins.frames import to_ned_frd
from robins.linalg.library import Real
from robins.rotation import multiply, normalise, rotate, to_rotvec

_EVEN = 2.0  # largest ratio of neighbouring intervals for a cubic
_OTHERS = [[j for j in range(4) if j != i] for i in range(4)]  # of four samples but one
_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])
_ROWS = 1 << 16  # intervals integrated together: temporary arrays stay small in a long log
_GAUSS = 0.5 + np.array([-1.0, 1.0]) * np.sqrt(3.0) / 6.0  # points of the unit interval


class Increments(NamedTuple):
    """Motion over intervals, in body axes (FRD) at the start of each; NumPy or JAX arrays.

    One interval has ``dt`` a scalar and (3,) vectors; many have a leading axis.
    """

    dt: Any  # (N,) s
    theta: Any  # (N, 3) rad, rotation vector of the body relative to inertial space
    dv: Any  # (N, 3) m/s, integral of specific force
    dr: Any = None  # (N, 3) m, its double integral; None: for constant force in the turning body


def from_imu(imu: ImuTable, usual_s: float | None = None) -> tuple[Increments, np.ndarray]:
    """Increments of the intervals between samples, and the end of each interval [ns].

    N samples make N - 1 intervals, from ``imu.time_ns[0]`` to ``imu.time_ns[-1]``. The first row of
    an increment table belongs to an interval that began before the table; it only gives the slope
    for the second, and is taken to be as long as that.

    Args:
        imu: the samples.
        usual_s: s, sampling interval of the sensor, for a table too short to show it; None: found
            from the table.

    Raises:
        TypeError: the table is not one of an IMU.
        ValueError: fewer than two samples, time that does not increase, a value that is not finite.
    """
    require_kind(imu, ImuTable, "from_imu")
    imu = to_ned_frd(imu)
    time = np.asarray(imu.time_ns)
    gyro, accel = np.asarray(imu.gyro, float), np.asarray(imu.accel, float)
    _check(imu, time, gyro, accel)
    dt = np.diff(time) * 1e-9
    if imu.kind == "increment":
        points_of = _points_of_increments(dt, gyro, accel, usual_s)
    else:
        points_of = _points_of_rates(dt, gyro, accel)
    theta, dv, dr = (np.empty((len(dt), 3)) for _ in range(3))
    for first in range(0, len(dt), _ROWS):
        rows = slice(first, min(first + _ROWS, len(dt)))
        theta[rows], dv[rows], dr[rows] = _integrate(dt[rows, None], *points_of(rows))
    return Increments(dt, theta, dv, dr), time[1:]


def _check(imu: ImuTable, time: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> None:
    name = imu.source or "IMU table"
    require(len(time) >= 2, f"{name}: {len(time)} sample(s); an interval needs two")
    for label, values in (("gyro", gyro), ("accel", accel)):
        if values.shape != (len(time), 3):
            raise ValueError(f"{name}: {label} has shape {values.shape}, not ({len(time)}, 3)")
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise ValueError(
                f"{name}: {label} in {_row(imu, int(bad[0]))} is {values[bad[0]]}: samples that "
                "are not finite must be bridged or cut out before they are integrated "
                "(robins.logs.clean)"
            )
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        k = int(back[0]) + 1
        raise ValueError(
            f"{name}: time stands still or runs backwards at {_row(imu, k)}: {time[k]} ns after "
            f"{time[k - 1]} ns, {len(back)} such row(s) in all; sort or cut them out first "
            "(robins.logs.clean)"
        )


def _row(imu: ImuTable, k: int) -> str:
    return f"row {k}" if imu.rows is None else f"line {imu.rows[k]}"


def _points_of_increments(dt, gyro, accel, usual_s):
    """Rate and force on the line through the means of two intervals, at the Gauss points of rows.

    Without a gap, a sample is the integral over its interval.
    """
    own = own_intervals(dt, gyro, accel, usual_s)[:, None]

    def points_of(rows):
        both = slice(rows.start, rows.stop + 1)  # with the sample before
        h, lasted = dt[rows, None], own[both]
        middle = 1.0 - 0.5 * lasted[1:] / h  # middle of the sample's own interval, in units of h
        points = []
        for raw in (gyro, accel):
            mean = raw[both] / lasted
            rise = (mean[1:] - mean[:-1]) / (middle + 0.5 * lasted[:-1] / h)  # over the interval
            points.append([mean[1:] + (c - middle) * rise for c in _GAUSS])
        return points

    return points_of


def _points_of_rates(dt, gyro, accel):
    """Rate and force on the cubic or the line through the samples, at the Gauss points of rows."""

    def points_of(rows):
        stencil, weights = _stencil(dt, rows)
        return [[np.einsum("kn,knj->nj", w, x[stencil]) for w in weights] for x in (gyro, accel)]

    return points_of


def _stencil(dt, rows):
    """Four samples for each of K intervals (4, K), and their weights for its two Gauss points.

    The interval is the middle one of the three between them; an outer one at the table's ends.
    """
    n, h = len(dt), dt[rows]
    each, at = np.arange(rows.start, rows.stop), np.arange(4)[:, None]
    first = np.minimum(np.maximum(each - 1, 0), max(n - 3, 0))
    stencil = np.minimum(first + at, n)
    steps = dt[np.minimum(first + at[:3], n - 1)]
    even = (n >= 3) & (steps.max(0) <= _EVEN * steps.min(0))
    knots = np.zeros((4, len(h)))
    np.cumsum(steps, 0, out=knots[1:])
    before = each - first  # which of the four is at the start of the interval
    points = [np.take_along_axis(knots, before[None], 0)[0] + c * h for c in _GAUSS]
    cubics = np.ones((len(points), 4, len(h)))
    for i, others in enumerate(_OTHERS):
        gaps = np.where(even, knots[i] - knots[others], 1.0)
        for cubic, point in zip(cubics, points, strict=True):
            np.prod((point - knots[others]) / gaps, 0, out=cubic[i])
    if even.all():
        return stencil, list(cubics)
    lines = [(1.0 - c) * (at == before) + c * (at == before + 1) for c in _GAUSS]
    weights = [np.where(even, cubic, line) for cubic, line in zip(cubics, lines, strict=True)]
    return stencil, weights


def _integrate(h, rate, force):
    """Rotation vector, velocity and displacement from values at the two Gauss points."""
    (w1, w2), (f1, f2) = rate, force
    theta = 0.5 * h * (w1 + w2) + np.sqrt(3.0) / 12.0 * h**2 * _cross(w1, w2)
    # Rotation vectors at the points: integrals of the line through both rates (Gauss-Legendre).
    early, late = 0.25 - np.sqrt(3.0) / 6.0, 0.25 + np.sqrt(3.0) / 6.0
    u1 = _rotated(h * (0.25 * w1 + early * w2), f1)
    u2 = _rotated(h * (late * w1 + 0.25 * w2), f2)
    dv = 0.5 * h * (u1 + u2)
    dr = 0.5 * h**2 * ((1.0 - _GAUSS[0]) * u1 + (1.0 - _GAUSS[1]) * u2)
    return theta, dv, dr


def _cross(a, b):
    """Cross product of NumPy or JAX arrays (..., 3); `np.cross` is several times slower."""
    return a[..., _YZX] * b[..., _ZXY] - a[..., _ZXY] * b[..., _YZX]


def _rotated(phi, v):
    """Rotate vectors v by rotation vectors phi (Rodrigues)."""
    sq = np.einsum("ni,ni->n", phi, phi)[:, None]
    # sin(p)/p and (1 - cos(p))/p^2; np.sinc(x) is sin(pi x)/(pi x), with its limit at 0
    p = np.sqrt(sq) / np.pi
    turn = _cross(phi, v)
    return v + np.sinc(p) * turn + 0.5 * np.sinc(0.5 * p) ** 2 * _cross(phi, turn)


def displacement(increments: Increments) -> Any:
    """Displacement ``dr`` [m]; if None, that of a constant specific force in the turning body."""
    dt, theta, dv, dr = increments
    return dt[..., None] * (dv / 2.0 - _cross(theta, dv) / 12.0) if dr is None else dr


_MISSING = 1.5  # usual intervals; in a longer one at least one sample is missing
_SPAN = 8  # intervals averaged together, against bursts of stamps
_GRAVITY = 9.8  # m/s^2 weighted like 1 rad/s


def usual_interval(dt: np.ndarray) -> float:
    """Sampling interval [s] of a sensor, from intervals (N,) between samples with some missing.

    The median, or, if stamps come in bursts, the tenth percentile of means over eight.
    """
    span = min(_SPAN, len(dt))
    ends = np.concatenate([[0.0], np.cumsum(dt)])
    together = float(np.percentile(ends[span:] - ends[:-span], 10.0)) / span
    usual = float(np.median(dt))
    return usual if usual > 0.5 * together else together


def after_gap(dt: np.ndarray, usual_s: float | None = None) -> np.ndarray:
    """Mask (N,) of the intervals (N,) [s] in which samples are missing.

    A long interval followed by a short one is a late stamp: no sample is missing there. The usual
    interval is that of `dt` unless it is given.
    """
    usual = usual_interval(dt) if usual_s is None else usual_s
    late = np.append(dt[1:] < (2.0 - _MISSING) * usual, False)
    return (dt > _MISSING * usual) & ~late


def own_intervals(
    dt: np.ndarray, theta: np.ndarray, dv: np.ndarray, usual_s: float | None = None
) -> np.ndarray:
    """Duration of each increment of a table [s]: the interval before it, or less after a gap.

    Args:
        dt: (N - 1,) s, between the samples.
        theta: (N, 3) rad, as recorded.
        dv: (N, 3) m/s.
        usual_s: s, the usual interval; None: that of `dt`.

    Returns:
        (N,) s; the first as long as the second, or the usual interval if that ends a gap.
    """
    usual = usual_interval(dt) if usual_s is None else usual_s
    gap = after_gap(dt, usual)
    own = np.concatenate([np.where(gap[:1], usual, dt[:1]), dt])
    for k in np.flatnonzero(gap) + 1:
        before, last = np.hstack([theta[k - 1 : k + 1], dv[k - 1 : k + 1] / _GRAVITY])
        before = before / own[k - 1]
        alone, whole = (np.linalg.norm(last / h - before) for h in (usual, own[k]))
        if alone < whole:
            own[k] = usual
    return own


_CONTEXT = 3  # samples that an increment needs before its last


class IncrementStream:
    """Increments of samples of rate and specific force that arrive in chunks.

    An increment is final when the next sample is known; any chunks give the same bits. Rows (8,)
    are end [s] after the first sample, dt, theta and dv.

    Attributes:
        origin_ns: stamp of the first sample.
        time_ns: (M,) stamps of the last samples; empty before the first.
        newest: (1, 8) the last increment, which the next sample changes; (0, 8) before it.
    """

    def __init__(self, usual_s: float):
        """Create a stream without samples, of a sensor with this sampling interval [s]."""
        self._usual_s, self._has_final = usual_s, False
        self.origin_ns, self.time_ns = 0, np.zeros(0, np.int64)
        self._raw, self.newest = np.zeros((0, 6)), np.zeros((0, 8))

    def push(self, time_ns: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """Add samples; return the rows (K, 8) that have become final.

        Args:
            time_ns: (M,) int64, increasing.
            samples: (M, 6) gyro [rad/s] and accel [m/s^2] in body axes.
        """
        if not len(self.time_ns):
            self.origin_ns = int(time_ns[0])
        self.time_ns = np.concatenate([self.time_ns[-_CONTEXT:], time_ns])
        self._raw = np.concatenate([self._raw[-_CONTEXT:], samples])
        if len(self._raw) < 2:
            return self.newest
        table = ImuTable(self.time_ns, self._raw[:, :3], self._raw[:, 3:], "rate")
        made, end_ns = from_imu(table, self._usual_s)
        ends = (end_ns - self.origin_ns) * 1e-9
        found = np.column_stack([ends, *(np.asarray(a, float) for a in made[:3])])
        self.newest = found[-1:]
        if len(self._raw) <= _CONTEXT:  # later samples change all increments
            return found[:0]
        final = found[1 if self._has_final else 0 : -1]
        self._has_final = True
        return final


def joined(increments: Increments) -> Increments:
    """Join K successive increments into one: dt (), theta, dv and dr (3,), by

        q <- q exp(theta_k)     dr <- dr + dv dt_k + C(q) dr_k     dv <- dv + C(q) dv_k

    Exact, if the total rotation is less than pi; `jax.vmap` joins many intervals.

    Args:
        increments: K of them, leading axis, with dr or without.
    """
    import jax  # here: nothing else in this module needs it
    import jax.numpy as jnp

    from robins.rotation import from_rotvec

    inc = Increments(*(None if a is None else jnp.asarray(a, float) for a in increments))

    def add(sum_: tuple[Real, Real, Real, Real], one: Increments):
        q, dv, dr, dt = sum_
        dr = dr + dv * one.dt + rotate(q, one.dr)
        dv = dv + rotate(q, one.dv)
        return (normalise(multiply(q, from_rotvec(one.theta))), dv, dr, dt + one.dt), None

    zero = jnp.zeros(3)
    begin = (jnp.array([1.0, 0.0, 0.0, 0.0]), zero, zero, jnp.zeros(()))
    (q, dv, dr, dt), _ = jax.lax.scan(add, begin, inc._replace(dr=displacement(inc)))
    return Increments(dt, to_rotvec(q), dv, dr)
