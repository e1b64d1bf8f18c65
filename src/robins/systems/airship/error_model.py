"""Nine error states of a SINS at misalignments of any size: eqs. (38), (40) of the airship's paper.

Zhao, Gao, Ding & Wei (2017), section 4.1, corrected. As there, navigation is east-north-up and the
body right-forward-up; robins' own states are NED/FRD and come over by `sins_at`, `error_between`
and `corrected`. Errors are *computed minus true* (38),

    x = [phi_E, phi_N, phi_U  rad,  dv_E, dv_N, dv_U  m/s,  dlon, dlat  rad,  dalt  m]

Frame n is the true ENU frame, frame c the one computed by the SINS: C_cb = C_cn C_nb, where
the paper writes C_b^c = C_n^c C_b^n. The misalignment phi is three angles, about up first, then
east, then north; small ones are a rotation vector, and then phi is also the attitude error of
`robins.ins.errors`, whose velocity and position errors have the other sign.

Differences of nonlinear functions (rates, gravity, velocity over radius) are not linearised, so
with known sensor errors the model is exact: it is the difference of two mechanisations. Gravity is
that of `robins.earth`, which above the ellipsoid has a small north component.

Eq. (40) as printed has two errors: the last cross product has the true rates in place of their
errors, which nearly cancels the term before it, and the rates of dlat and dlon are exchanged.

As a filter (`CorrectedSins`) the state is the SINS and the estimate of its errors; once a step the
SINS is corrected by the estimate, and the errors are reset to zero. It is the total-state form
of `model` in different variables, so it serves as its check; the paper's local filters do not use
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, curvature_radii, earth_rate_n, gravity_n, transport_rate_n
from robins.filters import Belief, Code, Motion, Rule
from robins.filters.rule import Memory
from robins.filters.values import Numbers, value
from robins.ins.frames import swap
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav
from robins.ins.mechanise import step as navigate
from robins.ins.state import InsNoise
from robins.manifold import wrap
from robins.rotation import Rotation, conjugate, rotate
from robins.systems.airship.model import States, believed_noise, white_noise_factor
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import AirshipCourse, start_sigma

PHI, VELOCITY = slice(0, 3), slice(3, 6)
LON, LAT, ALT = 6, 7, 8


class Sins(NamedTuple):
    """Output of the SINS, at an instant or on average over a period; ENU/RFU."""

    C_cb: Any  # (3, 3) body to computed navigation frame
    v_n: Any  # (3,) m/s
    lat: Any  # () rad
    alt: Any  # () m
    f_c: Any  # (3,) m/s^2, measured specific force in the computed frame, C_cb f_b


NO_ERRORS = np.zeros(3), np.zeros(3)


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
    """Misalignment phi [rad] of C_cn: the inverse of `dcm_cn`.

    phi_E lies within a quarter turn of zero, phi_N and phi_U within half a turn. At phi_E = +-90
    deg the other two are not distinct.
    """
    level = jnp.hypot(C_cn[..., 0, 2], C_cn[..., 2, 2])
    east = jnp.arctan2(C_cn[..., 1, 2], level)
    north = jnp.arctan2(-C_cn[..., 0, 2], C_cn[..., 2, 2])
    up = jnp.arctan2(-C_cn[..., 1, 0], C_cn[..., 1, 1])
    return jnp.stack([east, north, up], -1)


def rate_matrix_inverse(phi: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """C_w^-1 of phi' = C_w^-1 w_nc_c, w_nc_c the angular rate of c relative to n.

    It grows as 1/cos(phi_E): the three angles are singular at phi_E = +-90 deg.
    """
    (sE, sN, _), (cE, cN, _) = _parts(jnp.sin(phi)), _parts(jnp.cos(phi))
    o, one = jnp.zeros_like(sE), jnp.ones_like(sE)
    return _matrix((cN, o, sN), (sN * sE / cE, one, -cN * sE / cE), (-sN / cE, o, cN / cE))


def error_rate(
    x: Float[Array, "9"], sins: Sins, errors: Sequence[ArrayLike] = NO_ERRORS
) -> Float[Array, "9"]:
    """The right-hand side f of x' = f (eq. 40).

        phi'  = C_w^-1 [(I - C_cn) w_in + C_cn dw_in - C_cb dw_ib]
        dv'   = (I - C_cn') C_cb f + C_cn' C_cb df - (2 dw_ie + dw_en) x v
                - (2 w_ie + w_en) x dv + (2 dw_ie + dw_en) x dv + dg
        dlon' = v_E sec(lat) / (RN + alt), computed minus true
        dlat' = v_N / (RM + alt), likewise
        dalt' = dv_U

    Rates, v and f are those of the SINS. For a function of the state, d is its value at the SINS
    state minus its value at the corrected state. The gyro's output enters through its error only.

    Args:
        x: error state, computed minus true.
        sins: output of the SINS.
        errors: of its gyros (3,) [rad/s] and accelerometers (3,) [m/s^2], measured minus true, RFU;
            zero in a filter, where they are process noise.
    """
    phi, dv = x[PHI], x[VELOCITY]
    C_cn = dcm_cn(phi)
    C_cb, v, f_c = (jnp.asarray(a, float) for a in (sins.C_cb, sins.v_n, sins.f_c))
    gyro_c, accel_c = (C_cb @ jnp.asarray(e, float) for e in errors)

    here = surroundings(sins.lat, sins.alt, v)
    true = surroundings(sins.lat - x[LAT], sins.alt - x[ALT], v - dv)
    omega_in, coriolis, *_ = here
    d_omega_in, d_coriolis, d_gravity, d_lonlat = (a - b for a, b in zip(here, true, strict=True))

    w_nc = (jnp.eye(3) - C_cn) @ omega_in + C_cn @ d_omega_in - gyro_c
    dv_rate = f_c - C_cn.T @ (f_c - accel_c) - jnp.cross(d_coriolis, v)
    dv_rate = dv_rate - jnp.cross(coriolis, dv) + d_gravity + jnp.cross(d_coriolis, dv)
    return jnp.concatenate([rate_matrix_inverse(phi) @ w_nc, dv_rate, d_lonlat, dv[2:]])


def step(
    x: Float[Array, "9"], over: Sins, dt_s: ArrayLike, errors: Sequence[ArrayLike] = NO_ERRORS
) -> Float[Array, "9"]:
    """Move errors x by the midpoint rule over a filter period T: x + f(x + f(x) T/2) T.

    The paper uses f, a derivative, as if it were this map. `over` is the SINS averaged over the
    period, or at its middle; f_c is then the velocity increment over the period's length.
    """
    dt = jnp.asarray(dt_s, float)
    middle = x + 0.5 * dt * error_rate(x, over, errors)
    return x + dt * error_rate(middle, over, errors)


# ------------------------------------------------------------------- to and from robins' own states


def sins_at(nav: Nav, f_b: Float[Array, "3"]) -> Sins:
    """Output of a SINS whose state is `nav` and whose accelerometers read f_b (FRD) [m/s^2]."""
    f_c = swap(nav.q_nb.apply(f_b))
    return Sins(
        _swap_dcm(nav.q_nb.as_dcm()), swap(nav.v_n), nav.position.lat, nav.position.alt, f_c
    )


def error_between(computed: Nav, true: Nav) -> Float[Array, "*b 9"]:
    """Error state of a SINS at `computed` with the truth at `true`; both NED/FRD."""
    phi = misalignment(_swap_dcm((computed.q_nb @ true.q_nb.inverse()).as_dcm()))
    dv = swap(computed.v_n - true.v_n)
    a, b = computed.position, true.position
    place = jnp.stack([wrap(a.lon - b.lon), a.lat - b.lat, a.alt - b.alt], -1)
    return jnp.concatenate([phi, dv, place], -1)


def corrected(computed: Nav, x: Float[Array, "9"]) -> Nav:
    """State corrected by its errors: the inverse of `error_between`."""
    C_nc = jnp.swapaxes(_swap_dcm(dcm_cn(x[PHI])), -1, -2)
    q_nb = Rotation.from_dcm(C_nc) @ computed.q_nb
    p = computed.position
    place = Geodetic(p.lat - x[LAT], wrap(p.lon - x[LON]), p.alt - x[ALT])
    return Nav(q_nb, computed.v_n - swap(x[VELOCITY]), place)


def error_from_tangent(lat_rad: ArrayLike, alt_m: ArrayLike) -> Float[Array, "9 9"]:
    """Matrix from the tangent vector of a `Nav` to the error state, to first order.

    That is attitude, velocity, position north, east, down [m], true minus estimated. A small
    misalignment is the same rotation vector in both, for it is defined by C_true = exp(phi x) C. So
    rows H of a paper become ``-H @ error_from_tangent(...)`` for a measurement less computed one.
    """
    meridian, transverse = curvature_radii(lat_rad)
    alt, enu = jnp.asarray(alt_m, float), swap(np.eye(3))
    out = jnp.zeros((9, 9)).at[PHI, 0:3].set(enu).at[VELOCITY, 3:6].set(-enu)
    out = out.at[LAT, 6].set(-1.0 / (meridian + alt))
    out = out.at[LON, 7].set(-1.0 / ((transverse + alt) * jnp.cos(jnp.asarray(lat_rad, float))))
    return out.at[ALT, 8].set(1.0)


# ---------------------------------------------------------------------------------- as a filter


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CorrectedSins:
    """A SINS and its errors x = (phi, dv, dlon, dlat, dalt), computed minus true; ENU, SI."""

    sins: Nav
    x: Any  # (9,)

    dim = 9
    units: ClassVar[dict[str, str]] = {
        "v_n": "m/s, NED: of the SINS",
        "x": "errors of the SINS, ENU: rad; m/s; longitude, latitude rad; height m",
    }

    def retract(self, delta: Array) -> CorrectedSins:
        """Add to the errors."""
        return CorrectedSins(self.sins, self.x + delta)

    def local(self, other: CorrectedSins) -> Array:
        """Errors of this SINS with the other state as truth, less those it has here."""
        return error_between(self.sins, other.nav) - self.x

    @property
    def nav(self) -> Nav:
        """The SINS less its errors."""
        return corrected(self.sins, self.x)


def _motion(given: Airship, course: AirshipCourse) -> Motion:
    """Motion of a `CorrectedSins`; input of a step: one increment. Needs the rule `Feedback`."""
    return Motion(_step, Partial(_noise, believed_noise(given), course.datum.metres))


def _step(fed: CorrectedSins, block: Increments) -> CorrectedSins:
    """Propagate the SINS over the block, and its errors by (40) about the middle of the block."""
    before, after = fed.sins, navigate(fed.sins, block)
    half = Rotation.from_rotvec(0.5 * block.theta)
    p, q = before.position, after.position
    middle = Nav(
        before.q_nb @ half,
        0.5 * (before.v_n + after.v_n),
        Geodetic(0.5 * (p.lat + q.lat), p.lon, 0.5 * (p.alt + q.alt)),
    )
    force_b = rotate(conjugate(half.wxyz), block.dv / block.dt)
    return CorrectedSins(after, step(fed.x, sins_at(middle, force_b), block.dt))


def _noise(
    noise: InsNoise, metres_per_radian: Array, fed: CorrectedSins, block: Increments
) -> Array:
    """Process noise as for the total state; longitude and latitude in radians."""
    per_metre = jnp.concatenate([jnp.ones(6), 1.0 / metres_per_radian[::-1], jnp.ones(1)])
    return per_metre[:, None] * white_noise_factor(noise, block.dt)


@value
class Feedback(Rule):
    """Correct the SINS by its estimated errors, once a step after all its measurements."""

    name = "feedback"

    def settle(self, memory: Memory, belief: Belief):
        nav = belief.mean.nav
        return memory, Belief(CorrectedSins(nav, jnp.zeros(9)), belief.factor), int(Code.DONE)


def _start_sigma(given: Airship, course: AirshipCourse) -> list[Numbers]:
    """Initial sigmas: east, north, up; longitude and latitude in radians."""
    enu = start_sigma(given).reshape(3, 3)[:, [1, 0, 2]].ravel()
    return [enu / np.array([*np.ones(6), *course.datum.metres[::-1], 1.0])]


def _reported(course: AirshipCourse) -> np.ndarray:
    """Map to true minus estimated, in metres: velocity and position errors change sign."""
    north, east = course.datum.metres
    return np.diag([1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -east, -north, -1.0])


ERRORS = States(
    _motion,
    lambda nav, gyro, accel, wind: CorrectedSins(nav, jnp.zeros((*wind.shape[:-1], 9))),
    _start_sigma,
    _reported,
)


def surroundings(lat: Array, alt: Array, v: Array) -> tuple[Array, Array, Array, Array]:
    """Rates and gravity at a position and velocity, ENU.

    They are w_ie + w_en and 2 w_ie + w_en [rad/s], gravity [m/s^2], and the rates of longitude and
    latitude [rad/s].
    """
    omega_ie = swap(earth_rate_n(lat))
    omega_en = swap(transport_rate_n(lat, alt, swap(v)))
    meridian, transverse = curvature_radii(lat)
    lonlat_rate = [v[0] / ((transverse + alt) * jnp.cos(lat)), v[1] / (meridian + alt)]
    gravity = swap(gravity_n(lat, alt))
    return omega_ie + omega_en, 2.0 * omega_ie + omega_en, gravity, jnp.stack(lonlat_rate)


def _swap_dcm(C):
    """Convert a direction cosine matrix between NED/FRD and ENU/RFU."""
    other = swap(C)
    return jnp.swapaxes(swap(jnp.swapaxes(other, -1, -2)), -1, -2)


def _parts(v):
    return v[..., 0], v[..., 1], v[..., 2]


def _matrix(*rows) -> Float[Array, "*b 3 3"]:
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
