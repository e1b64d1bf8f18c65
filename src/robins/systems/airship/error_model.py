"""Nine error states of a SINS at misalignments of any size: eq. (40) of the airship's paper.

Zhao, Gao, Ding & Wei (2017), section 4.1, corrected. As there, navigation is east-north-up and the
body right-forward-up; robins' own states are NED/FRD and come over by `sins_at`, `error_between`
and `corrected`. Errors are *computed minus true*,

    x = [phi_E, phi_N, phi_U  rad,  dv_E, dv_N, dv_U  m/s,  dlon, dlat  rad,  dalt  m]

Frame n is the true ENU frame, frame c the one that the SINS takes for it: C_cb = C_cn C_nb, where
the paper writes C_b^c = C_n^c C_b^n. The misalignment phi is three angles, about up first, then
east, then north; small ones are a rotation vector, and then phi is also the attitude error of
`robins.ins.errors`, whose velocity and position errors have the other sign.

Differences of nonlinear functions (rates, gravity, velocity over radius) are taken as such, so with
the sensors' errors known the model is exact: it is the difference of two mechanisations. Gravity is
that of `robins.earth`, which above the ellipsoid has a small north component.

Eq. (40) in print has slips, and other accounts of the model have others. Each can be asked for by
name, one or several at once, so that a test can see what it costs; see `SLIPS`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, curvature_radii, earth_rate_n, gravity_n, transport_rate_n
from robins.ins.frames import swap
from robins.ins.mechanise import Nav
from robins.manifold import wrap
from robins.rotation import Rotation, skew

STATES = 9
PHI, VELOCITY = slice(0, 3), slice(3, 6)
LON, LAT, ALT = 6, 7, 8

STEEPEST_RAD = math.radians(85.0)

SLIPS = {
    "last-cross-term": "+ (2 w_ie + w_en) x dv with the true rates, where their errors belong: it "
    "all but cancels the term before it",
    "swapped-rows": "rows 7 and 8 are the rates of dlat, dlon; the state (38) has dlon, dlat",
    "omitted-cross-term": "the last cross product left out, being of second order",
    "gyro-sign": "the error of the gyro taken as true minus measured",
    "small-angle": "C_cn = I - [phi x], and phi' = w_nc",
}
"""What may be got wrong in eq. (40), by name; the first two are as printed."""

AS_PRINTED = ("last-cross-term", "swapped-rows")


class Sins(NamedTuple):
    """What the SINS says, at an instant or on average over a period; ENU/RFU."""

    C_cb: Any  # (3, 3) body to computed navigation frame
    v_n: Any  # (3,) m/s
    lat: Any  # () rad
    alt: Any  # () m
    f_c: Any  # (3,) m/s^2, measured specific force in the computed frame, C_cb f_b


class SensorErrors(NamedTuple):
    """Measured minus true, in body axes RFU."""

    gyro: Any  # (3,) rad/s
    accel: Any  # (3,) m/s^2


NO_ERRORS = SensorErrors(np.zeros(3), np.zeros(3))


def dcm_cn(phi: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """C_cn = Ry(phi_N) Rx(phi_E) Rz(phi_U), of passive rotations: true to computed frame.

    For small angles I - [phi x].
    """
    (sE, sN, sU), (cE, cN, cU) = _parts(jnp.sin(phi)), _parts(jnp.cos(phi))
    return _matrix(
        (cN * cU - sN * sE * sU, cN * sU + sN * sE * cU, -sN * cE),
        (-cE * sU, cE * cU, sE),
        (sN * cU + cN * sE * sU, sN * sU - cN * sE * cU, cN * cE),
    )


def misalignment(C_cn: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """The phi [rad] of a matrix: `dcm_cn` undone.

    phi_E lies within a quarter turn of zero, phi_N and phi_U within half a turn. At phi_E = +-90
    deg the other two are not distinct.
    """
    level = jnp.hypot(C_cn[..., 0, 2], C_cn[..., 2, 2])
    east = jnp.arctan2(C_cn[..., 1, 2], level)
    north = jnp.arctan2(-C_cn[..., 0, 2], C_cn[..., 2, 2])
    up = jnp.arctan2(-C_cn[..., 1, 0], C_cn[..., 1, 1])
    return jnp.stack([east, north, up], -1)


def rate_matrix(phi: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """C_w: turn rate of c against n from the rates of the angles, w_nc_c = C_w phi'."""
    (sE, sN, _), (cE, cN, _) = _parts(jnp.sin(phi)), _parts(jnp.cos(phi))
    o, one = jnp.zeros_like(sE), jnp.ones_like(sE)
    return _matrix((cN, o, -sN * cE), (o, one, sE), (sN, o, cN * cE))


def rate_matrix_inverse(phi: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """C_w^-1, phi' = C_w^-1 w_nc_c; grows as 1/cos(phi_E), see `refuse_steep_misalignment`."""
    (sE, sN, _), (cE, cN, _) = _parts(jnp.sin(phi)), _parts(jnp.cos(phi))
    o, one = jnp.zeros_like(sE), jnp.ones_like(sE)
    return _matrix((cN, o, sN), (sN * sE / cE, one, -cN * sE / cE), (-sN / cE, o, cN / cE))


def refuse_steep_misalignment(x: ArrayLike) -> None:
    """Refuse states near the singularity of the three angles; outside compiled code.

    Args:
        x: (..., 9) error states, or (..., 3) misalignments.

    Raises:
        ValueError: a phi_E is more than 85 deg from level, or is not a number.
    """
    phi_east = np.asarray(x, float)[..., 0].reshape(-1)
    off = np.abs(np.remainder(phi_east + np.pi, 2.0 * np.pi) - np.pi)  # from zero, any turns off
    steep = np.flatnonzero(~(np.minimum(off, np.pi - off) <= STEEPEST_RAD))
    if len(steep):
        value = math.degrees(phi_east[steep[0]])
        where = f" of state {steep[0]}" if len(phi_east) > 1 else ""
        raise ValueError(
            f"phi_E{where} is {value:.3f} deg: within {90.0 - math.degrees(STEEPEST_RAD):g} deg of "
            "a quarter turn the angles of the misalignment are singular. Feed the estimate back to "
            "the SINS, so that phi begins anew at zero, or estimate the attitude itself, as a "
            "robins.rotation.Rotation"
        )


def error_rate(
    x: Float[Array, "9"],
    sins: Sins,
    errors: SensorErrors = NO_ERRORS,
    slips: Collection[str] = (),
) -> Float[Array, "9"]:
    """The right-hand side f of x' = f (eq. 40).

        phi'  = C_w^-1 [(I - C_cn) w_in + C_cn dw_in - C_cb dw_ib]
        dv'   = (I - C_cn') C_cb f + C_cn' C_cb df - (2 dw_ie + dw_en) x v
                - (2 w_ie + w_en) x dv + (2 dw_ie + dw_en) x dv + dg
        dlon' = v_E sec(lat) / (RN + alt), as computed minus as it is truly
        dlat' = v_N / (RM + alt), likewise
        dalt' = dv_U

    Rates, v and f are the SINS's, d of a function is its value there minus that at the state less
    the errors. The gyro's output enters by its error only.

    Args:
        x: error state, computed minus true.
        sins: what the SINS says.
        errors: of its sensors; zero in a filter, which has them as process noise.
        slips: mistakes to make, of `SLIPS`; static under `jit`.

    Raises:
        ValueError: a slip has an unknown name, or two exclude each other.
    """
    _check(slips)
    phi, dv = x[PHI], x[VELOCITY]
    small = "small-angle" in slips
    unit = jnp.eye(3)
    C_cn = unit - skew(phi) if small else dcm_cn(phi)
    per_rate = unit if small else rate_matrix_inverse(phi)
    C_cb, v, f_c = (jnp.asarray(a, float) for a in (sins.C_cb, sins.v_n, sins.f_c))
    gyro_c, accel_c = (C_cb @ jnp.asarray(e, float) for e in errors)
    if "gyro-sign" in slips:
        gyro_c = -gyro_c

    here = _surroundings(sins.lat, sins.alt, v)
    true = _surroundings(sins.lat - x[LAT], sins.alt - x[ALT], v - dv)
    d = _Surroundings(*(a - b for a, b in zip(here, true, strict=True)))

    w_nc = (unit - C_cn) @ here.omega_in + C_cn @ d.omega_in - gyro_c
    dv_rate = f_c - C_cn.T @ (f_c - accel_c) - jnp.cross(d.coriolis, v)
    dv_rate = dv_rate - jnp.cross(here.coriolis, dv) + d.gravity
    if "last-cross-term" in slips:
        dv_rate = dv_rate + jnp.cross(true.coriolis, dv)
    elif "omitted-cross-term" not in slips:
        dv_rate = dv_rate + jnp.cross(d.coriolis, dv)
    horizontal = d.lonlat_rate[::-1] if "swapped-rows" in slips else d.lonlat_rate
    return jnp.concatenate([per_rate @ w_nc, dv_rate, horizontal, dv[2:]])


def step(
    x: Float[Array, "9"],
    over: Sins,
    dt_s: ArrayLike,
    errors: SensorErrors = NO_ERRORS,
    slips: Collection[str] = (),
) -> Float[Array, "9"]:
    """Move over one filter period by the midpoint rule: x + f(x + f(x) T/2) T.

    The paper uses f, a derivative, as if it were this map.

    Args:
        x: error state at the begin.
        over: the SINS on average over the period, see `average`.
        dt_s: length of the period.
        errors: as in `error_rate`.
        slips: as in `error_rate`.
    """
    dt = jnp.asarray(dt_s, float)
    middle = x + 0.5 * dt * error_rate(x, over, errors, slips)
    return x + dt * error_rate(middle, over, errors, slips)


def average(sins: Sins) -> Sins:
    """Mean over the leading axis, of samples at the middles of equal parts of a period.

    The mean of v, latitude and height is that of the middle but for terms that `step` leaves out as
    well; f_c becomes the velocity gained over the length of the period, and C_cb, no longer a
    rotation, what turns the constant error of a sensor.
    """
    return Sins(*(jnp.mean(jnp.asarray(a, float), axis=0) for a in sins))


# ------------------------------------------------------------------- to and from robins' own states


def sins_at(nav: Nav, f_b: Float[Array, "3"]) -> Sins:
    """What a SINS says whose state is `nav` and whose accelerometers read f_b (FRD) [m/s^2]."""
    f_c = swap(nav.q_nb.apply(f_b))
    return Sins(
        _swap_dcm(nav.q_nb.as_dcm()), swap(nav.v_n), nav.position.lat, nav.position.alt, f_c
    )


def error_between(computed: Nav, true: Nav) -> Float[Array, "*b 9"]:
    """The error state that a SINS at `computed` has when the truth is `true`; NED/FRD both."""
    phi = misalignment(_swap_dcm((computed.q_nb @ true.q_nb.inverse()).as_dcm()))
    dv = swap(computed.v_n - true.v_n)
    a, b = computed.position, true.position
    place = jnp.stack([wrap(a.lon - b.lon), a.lat - b.lat, a.alt - b.alt], -1)
    return jnp.concatenate([phi, dv, place], -1)


def corrected(computed: Nav, x: Float[Array, "9"]) -> Nav:
    """The state less its errors: `error_between` undone."""
    C_nc = jnp.swapaxes(_swap_dcm(dcm_cn(x[PHI])), -1, -2)
    q_nb = Rotation.from_dcm(C_nc) @ computed.q_nb
    p = computed.position
    place = Geodetic(p.lat - x[LAT], wrap(p.lon - x[LON]), p.alt - x[ALT])
    return Nav(q_nb, computed.v_n - swap(x[VELOCITY]), place)


# --------------------------------------------------------------------------------- the small things


class _Surroundings(NamedTuple):
    """What position and velocity decide; ENU."""

    omega_in: Array  # rad/s, w_ie + w_en
    coriolis: Array  # rad/s, 2 w_ie + w_en
    gravity: Array  # m/s^2
    lonlat_rate: Array  # rad/s


def _surroundings(lat, alt, v) -> _Surroundings:
    omega_ie = swap(earth_rate_n(lat))
    omega_en = swap(transport_rate_n(lat, alt, swap(v)))
    meridian, transverse = curvature_radii(lat)
    lonlat_rate = [v[0] / ((transverse + alt) * jnp.cos(lat)), v[1] / (meridian + alt)]
    return _Surroundings(
        omega_ie + omega_en,
        2.0 * omega_ie + omega_en,
        swap(gravity_n(lat, alt)),
        jnp.stack(lonlat_rate),
    )


def _check(slips: Collection[str]) -> None:
    if isinstance(slips, str) or not SLIPS.keys() >= set(slips):
        raise ValueError(f"slips = {slips!r}: wanted is a tuple of some of {tuple(SLIPS)}")
    if "last-cross-term" in slips and "omitted-cross-term" in slips:
        raise ValueError("the last cross term is either wrong or left out, not both")


def _swap_dcm(C):
    """A direction cosine matrix in the other convention on both sides, NED/FRD <-> ENU/RFU."""
    other = swap(C)
    return jnp.swapaxes(swap(jnp.swapaxes(other, -1, -2)), -1, -2)


def _parts(v):
    return v[..., 0], v[..., 1], v[..., 2]


def _matrix(*rows) -> Float[Array, "*b 3 3"]:
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
