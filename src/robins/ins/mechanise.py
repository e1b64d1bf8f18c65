"""Strapdown mechanisation in the local level frame, north-east-down.

One step propagates attitude, velocity and position by the increments of one interval (Savage 1998,
parts 1 and 2; Groves 2013, section 5.5). Rates, gravity and Coriolis acceleration are evaluated at
the middle of the interval, found by a half step with the values at its start, so the error of a
step is of third order in its duration and that of a path of second.

The frame is not defined at the poles; `refuse_polar` refuses them before a run starts. ENU/RFU
users convert their tables, see `robins.ins.frames`.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from robins import _float64
from robins.dataset import Trajectory
from robins.earth import A_M, E2, OMEGA_E, Geodetic
from robins.errors import require
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, displacement
from robins.ins.kernel import one_kernel, pack
from robins.ins.zonal_gravity import gravity_nd, horner
from robins.linalg.library import Real
from robins.linalg.scalars import cross, product, rotate
from robins.rotation import Rotation

POLAR_LAT_RAD = math.radians(89.9)

_SIN = [(-1) ** k / math.factorial(2 * k + 1) for k in range(11)]
_COS = [(-1) ** k / math.factorial(2 * k) for k in range(12)]


class Nav(NamedTuple):
    """Attitude, velocity and position: one, or many along leading axes."""

    q_nb: Rotation  # body FRD to navigation NED
    v_n: Array  # (..., 3) m/s relative to the Earth, NED
    position: Geodetic


def step(nav: Nav, inc: Increments) -> Nav:
    """Propagate over one interval: ``inc.dt`` a scalar, theta, dv and dr of shape (3,).

    A zero increment returns `nav` bit for bit, so blocks may be padded with them.
    """
    return unpacked(advance(vector(nav), rows(inc)))


def step_each(nav: Nav, inc: Increments) -> Nav:
    """Step N states by an increment each, as `step`, in NumPy: nothing is compiled."""
    p = nav.position
    columns = [*nav.q_nb.wxyz.T, *nav.v_n.T, p.lat, p.lon, p.alt]
    return unpacked(np.stack(_advanced(columns, rows(inc, np).T, np), -1))


def mechanise(nav: Nav, increments: Increments) -> Nav:
    """Navigate from `nav` over N increments; return the N states at the ends of the intervals.

    Compiled for each N, unlike `mechanise_chunked`.
    """
    return _run(nav, increments)[1]


@jax.jit
def _run(nav: Nav, increments: Increments) -> tuple[Nav, Nav]:
    """The last state, and all of them."""

    def body(x, row):
        x = advance(x, row)
        return x, x

    last, path = lax.scan(body, vector(nav), rows(increments))
    return unpacked(last), unpacked(path)


def mechanise_chunked(nav: Nav, increments: Increments, chunk: int = 16384) -> Nav:
    """Navigate as `mechanise`, on the host: NumPy arrays in and out, `chunk` increments at a time.

    The device holds one chunk whatever the length of the run, and one compilation serves all
    lengths, the last chunk being padded.

    Raises:
        ValueError: the start is too near a pole, see `refuse_polar`; or `chunk` is less than one.
    """
    _float64.require()
    refuse_polar(nav.position.lat)
    require(chunk >= 1, f"chunk = {chunk}: at least one increment is taken at a time")
    inc = Increments(*(None if a is None else np.asarray(a, float) for a in increments))
    total = len(inc.dt)
    size = max(min(chunk, total), 1)
    path = jax.tree.map(lambda leaf: np.empty((total, *jnp.shape(leaf))), nav)
    for start in range(0, total, size):
        stop = min(start + size, total)
        block = jax.tree.map(lambda a, at=slice(start, stop): _padded(a[at], size), inc)
        nav, part = _run(nav, block)
        for whole, piece in zip(jax.tree.leaves(path), jax.tree.leaves(part), strict=True):
            whole[start:stop] = np.asarray(piece)[: stop - start]
    return path


def _padded(a: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([a, np.zeros((size - len(a), *a.shape[1:]))]) if len(a) < size else a


def refuse_polar(lat_rad) -> None:
    """Refuse latitudes where north is ill-defined.

    Raises:
        ValueError: a latitude is beyond 89.9 deg.
    """
    lat = np.atleast_1d(np.asarray(lat_rad, float))
    worst = float(lat[np.argmax(np.abs(lat))]) if lat.size else 0.0
    if abs(worst) > POLAR_LAT_RAD:
        raise ValueError(
            f"latitude {math.degrees(worst):.6f} deg: this mechanisation works in the local level "
            "frame, whose north turns ever faster towards a pole and is not defined there; it "
            "starts at up to 89.9 deg"
        )


def nav_at(
    trajectory: Trajectory, index: int | slice | np.ndarray = 0, library: ModuleType = jnp
) -> Nav:
    """One or many states of a trajectory, in NED/FRD whatever its own frames; of JAX or NumPy."""
    t = to_ned_frd(trajectory)
    leaves = (t.q_nb, t.v_n, t.lat_rad, t.lon_rad, t.alt_m)
    q, v, lat, lon, alt = (library.asarray(np.asarray(a, float)[index]) for a in leaves)
    return Nav(Rotation(q), v, Geodetic(lat, lon, alt))


def as_trajectory(time_ns: np.ndarray, nav: Nav, source: str = "") -> Trajectory:
    """States along one leading axis as a table."""
    p = nav.position
    leaves = (p.lat, p.lon, p.alt, nav.v_n, nav.q_nb.wxyz)
    lat, lon, alt, v_n, q_nb = (np.asarray(a) for a in leaves)
    return Trajectory(np.asarray(time_ns), lat, lon, alt, v_n, q_nb, source=source)


# ---------------------------------------------------------------------- the step on plain vectors


def vector(nav: Nav) -> Float[Array, "*b 10"]:
    """State as a vector: q_nb, v_n, lat, lon, alt."""
    p = nav.position
    lla = jnp.stack([jnp.asarray(a, float) for a in (p.lat, p.lon, p.alt)], -1)
    return jnp.concatenate([jnp.asarray(nav.q_nb.wxyz), jnp.asarray(nav.v_n), lla], -1)


def unpacked(x: Float[Real, "*b 10"]) -> Nav:
    """State from a `vector`."""
    return Nav(Rotation(x[..., :4]), x[..., 4:7], Geodetic(x[..., 7], x[..., 8], x[..., 9]))


def rows(inc: Increments, library: ModuleType = jnp) -> Float[Real, "*b 11"]:
    """Parts of a step that depend only on the increment: dt, quaternion of theta, dv, dr."""
    inc = Increments(*(None if a is None else library.asarray(a, float) for a in inc))
    half = 0.5 * inc.theta
    sq = library.sum(half * half, -1, keepdims=True)
    # As `rotation.from_rotvec`, for turns of at most two pi, by the cheaper series.
    q_bb = [horner(_COS, sq), half * horner(_SIN, sq)]
    return library.concatenate([inc.dt[..., None], *q_bb, inc.dv, displacement(inc)], -1)


def _sin_cos(x):
    """Sine and cosine on [-pi/2, pi/2] to rounding.

    A library call would prevent vectorisation over the runs of a batch.
    """
    sq = x * x
    return x * horner(_SIN, sq), horner(_COS, sq)


def _wrap(lon, library):
    low = library.where(lon < -np.pi, lon + 2.0 * np.pi, lon)
    return library.where(lon >= np.pi, lon - 2.0 * np.pi, low)


@one_kernel
def advance(x: Float[Array, "10"], row: Float[Array, "11"]) -> Float[Array, "10"]:
    """The step, on scalars; `robins.ins.kernel` gives the reason."""
    return pack(_advanced(x, row, jnp))


def _exponential(half: list) -> tuple:
    """Quaternion of half a rotation vector, to its fifth power."""
    sq = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    sinc = 1.0 - sq * (1.0 / 6.0 - sq / 120.0)
    return 1.0 - sq * (0.5 - sq / 24.0), sinc * half[0], sinc * half[1], sinc * half[2]


def _advanced(x, row, library) -> list:
    """The ten components of a state after the step, from those of the state and of its row.

    Each is a JAX scalar, or a NumPy column.
    """
    w, qx, qy, qz, v_north, v_east, v_down, lat, lon, alt = x
    dt, *rest = row
    q, v, q_bb = (w, qx, qy, qz), (v_north, v_east, v_down), tuple(rest[:4])
    half = 0.5 * dt
    dv, dr = rotate(q, tuple(rest[4:7])), rotate(q, tuple(rest[7:]))

    # Latitude and height at the middle, and what depends on them. The shift in latitude is tiny
    # (2e-7 rad at 300 m/s and 100 Hz), so two terms suffice for sine, cosine and the radii.
    s, c = _sin_cos(lat)
    per_w_sq = 1.0 / (1.0 - E2 * s * s)
    transverse = A_M * library.sqrt(per_w_sq)
    meridian = transverse * (1.0 - E2) * per_w_sq
    shift = v_north * half / (meridian + alt)
    s_mid = s + shift * (c - 0.5 * shift * s)
    c_mid = c - shift * (s + 0.5 * shift * c)
    alt_mid = alt - v_down * half
    growth = E2 * s * c * per_w_sq * shift
    transverse = transverse * (1.0 + growth)
    per_north = 1.0 / (meridian * (1.0 + 3.0 * growth) + alt_mid)
    per_east = 1.0 / (transverse + alt_mid)
    tan_mid = s_mid / c_mid
    earth = (OMEGA_E * c_mid, 0.0, -OMEGA_E * s_mid)  # omega_ie_n
    g_north, g_down = gravity_nd(s_mid, c_mid, transverse, alt_mid, library)

    def over_earth(north, east):
        """omega_en_n of a velocity, or the rotation of the frame over a displacement."""
        about_north = east * per_east
        return about_north, -north * per_north, -about_north * tan_mid

    def acceleration(v):
        """Gravity and Coriolis, and omega_in_n."""
        turn = over_earth(v[0], v[1])
        coriolis = cross([2.0 * e + t for e, t in zip(earth, turn, strict=True)], v)
        omega = [e + t for e, t in zip(earth, turn, strict=True)]
        return (g_north - coriolis[0], -coriolis[1], g_down - coriolis[2]), omega

    a_start, _ = acceleration(v)
    v_mid = tuple(v[i] + 0.5 * (dv[i] + a_start[i] * dt) for i in range(3))
    a_mid, omega_in = acceleration(v_mid)
    # The frame turns during the interval: on average by half of its rotation, and by a third of
    # that half in the double integral.
    turned = cross([half * o for o in omega_in], dv)
    v_new = tuple(v[i] + dv[i] - turned[i] + a_mid[i] * dt for i in range(3))
    r = tuple(v[i] * dt + dr[i] + dt * (half * a_mid[i] - turned[i] / 3.0) for i in range(3))

    turn = over_earth(r[0], r[1])
    lat_new = lat - turn[1]
    lon_new = _wrap(lon + turn[0] / c_mid, library)

    q_frame = _exponential([-0.5 * (turn[i] + earth[i] * dt) for i in range(3)])
    q = product(q_frame, product(q, q_bb))
    # One Newton step to unit length; none for a zero step, which must not change a bit.
    excess = 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] - 1.0)
    scale = 1.0 - library.where(dt == 0.0, 0.0, excess)
    return [*(scale * component for component in q), *v_new, lat_new, lon_new, alt - r[2]]
