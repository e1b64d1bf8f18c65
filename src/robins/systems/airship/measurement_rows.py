"""How the errors of the airship's SINS show in what its sensors say, corrected and as printed.

Zhao, Gao, Ding & Wei (2017), sections 4.2 and 4.3. The error state is that of `error_model`:
computed minus true, east-north-up, position [rad, rad, m]; and so are the differences that the rows
explain. Heading is a compass heading, clockwise from north, unless a name says counterclockwise.

The printed attitude rows (44), (45), (48) mix two senses of heading: the first row is right for a
clockwise one, the other two for a counterclockwise one, and two of their terms belong to neither.
So whatever the heading is taken for, towards east an entry that should be 1 is -1, which makes a
filter push its error on. The printed constraint (49) loses a row towards east, where they fly.

robins' filters have their errors the other way, true minus estimated, in NED and metres:
`error_from_tangent` turns any rows H into such ones, ``-H @ error_from_tangent(...)`` for a
difference measured minus computed.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import curvature_radii
from robins.filters.limits.constrain import check_rows
from robins.rotation import skew, to_euler
from robins.systems.airship.error_model import ALT, LAT, LON, PHI, STATES, VELOCITY

WORST_CONDITION = 1e12  # of D P D'

_SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # NED <-> ENU
_COMPONENTS = ("east", "north")


# ----------------------------------------------------------------------------------------- attitude


def attitude_rows(pitch_rad: ArrayLike, heading_rad: ArrayLike) -> Float[Array, "3 3"]:
    """Errors of pitch, roll and heading [rad] by phi_E, phi_N, phi_U.

    dpitch   = -phi_E cos(psi) + phi_N sin(psi)
    droll    = -(phi_E sin(psi) + phi_N cos(psi)) / cos(pitch)
    dheading = phi_U - tan(pitch) (phi_E sin(psi) + phi_N cos(psi))
    """
    (s, c), (sin_pitch, cos_pitch) = _sin_cos(heading_rad), _sin_cos(pitch_rad)
    t = sin_pitch / cos_pitch
    return _matrix((-c, s, 0.0), (-s / cos_pitch, -c / cos_pitch, 0.0), (-t * s, -t * c, 1.0))


def counterclockwise_attitude_rows(
    pitch_rad: ArrayLike, heading_ccw_rad: ArrayLike
) -> Float[Array, "3 3"]:
    """As `attitude_rows` for a heading that counts, as its error does, counterclockwise."""
    (s, c), (sin_pitch, cos_pitch) = _sin_cos(heading_ccw_rad), _sin_cos(pitch_rad)
    t = sin_pitch / cos_pitch
    return _matrix((-c, -s, 0.0), (s / cos_pitch, -c / cos_pitch, 0.0), (-t * s, t * c, -1.0))


def printed_attitude_rows(
    roll_rad: ArrayLike, pitch_rad: ArrayLike, heading_rad: ArrayLike
) -> Float[Array, "3 3"]:
    """Eq. (44) to the letter, in whatever sense the heading counts: see the module."""
    (s, c), (sin_pitch, cos_pitch) = _sin_cos(heading_rad), _sin_cos(pitch_rad)
    sin_roll, cos_roll = _sin_cos(roll_rad)
    t = sin_pitch / cos_pitch
    north = c - 2.0 * sin_pitch * sin_roll * cos_roll * s
    return _matrix(
        (-c, s, 0.0),
        (s / cos_pitch, -north / cos_pitch, 0.0),
        (-s * t / cos_pitch, c * t / cos_pitch, -1.0),
    )


def attitude_rows_ned(q_nb: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Change of pitch, roll and heading [rad] by e, q_true = exp(e x) q_nb; NED/FRD."""
    _, pitch, heading = to_euler(q_nb)
    return -attitude_rows(pitch, heading) @ _SWAP


def printed_attitude_rows_ned(
    q_nb: Float[Array, "4"], counterclockwise: bool = False
) -> Float[Array, "3 3"]:
    """The printed rows in the place of `attitude_rows_ned`.

    Args:
        q_nb: attitude.
        counterclockwise: in which sense to take the heading of the paper. What comes back is the
            change of the compass heading either way.
    """
    roll, pitch, heading = to_euler(q_nb)
    if not counterclockwise:
        return -printed_attitude_rows(roll, pitch, heading) @ _SWAP
    return -printed_attitude_rows(roll, pitch, -heading).at[2].multiply(-1.0) @ _SWAP


# ----------------------------------------------------------------------------- the two measurements


def sar_rows(pitch_rad: ArrayLike, heading_rad: ArrayLike) -> Float[Array, "4 9"]:
    """SINS minus SAR and barometer: longitude, latitude [rad], heading [rad], height [m]."""
    heading = jnp.zeros((1, STATES)).at[:, PHI].set(attitude_rows(pitch_rad, heading_rad)[2:])
    unit = jnp.eye(STATES)
    return jnp.concatenate([unit[LON : LAT + 1], heading, unit[ALT:]])


def star_rows(pitch_rad: ArrayLike, heading_rad: ArrayLike) -> Float[Array, "3 9"]:
    """SINS minus star sensor: pitch, roll, heading [rad]."""
    return jnp.zeros((3, STATES)).at[:, PHI].set(attitude_rows(pitch_rad, heading_rad))


def printed_sar_rows(pitch_rad: ArrayLike, heading_rad: ArrayLike) -> Float[Array, "3 9"]:
    """Eq. (45) to the letter: longitude, latitude, heading.

    The measurement (43) has latitude first, and no height, which is so left to itself.
    """
    printed = printed_attitude_rows(0.0, pitch_rad, heading_rad)[2:]  # this row has no roll
    heading = jnp.zeros((1, STATES)).at[:, PHI].set(printed)
    return jnp.concatenate([jnp.eye(STATES)[LON : LAT + 1], heading])


def printed_star_rows(
    roll_rad: ArrayLike, pitch_rad: ArrayLike, heading_rad: ArrayLike
) -> Float[Array, "3 9"]:
    """Eq. (48) to the letter: pitch, roll, heading."""
    printed = printed_attitude_rows(roll_rad, pitch_rad, heading_rad)
    return jnp.zeros((3, STATES)).at[:, PHI].set(printed)


def error_from_tangent(lat_rad: ArrayLike, alt_m: ArrayLike) -> Float[Array, "9 9"]:
    """The error state by the tangent vector of a `Nav`, to first order.

    That is attitude, velocity, position north, east, down [m], true minus estimated. A small
    misalignment is the same rotation vector in both, for it is defined by C_true = exp(phi x) C.
    """
    meridian, transverse = curvature_radii(lat_rad)
    alt = jnp.asarray(alt_m, float)
    out = jnp.zeros((STATES, STATES)).at[PHI, 0:3].set(_SWAP).at[VELOCITY, 3:6].set(-_SWAP)
    out = out.at[LAT, 6].set(-1.0 / (meridian + alt))
    out = out.at[LON, 7].set(-1.0 / ((transverse + alt) * jnp.cos(jnp.asarray(lat_rad, float))))
    return out.at[ALT, 8].set(1.0)


# ----------------------------------------------------------------------------------- the constraint


def constraint_rows(v_air_enu: Float[Array, "3"]) -> Float[Array, "2 9"]:
    """D of the wind constraint D x = d: rows east and north, of rank 2 at every heading.

    Velocity over the Earth is air velocity, known in body axes, plus wind. So velocity and attitude
    of the SINS may only be wrong together: D = [-[v_air x] | I | 0]. The attitude columns matter
    from a milliradian on, at 10 m/s.

    Args:
        v_air_enu: m/s, air velocity turned by the SINS's attitude.
    """
    out = jnp.zeros((2, STATES)).at[:, PHI].set(-skew(v_air_enu)[:2])
    return out.at[:, VELOCITY].set(jnp.eye(3)[:2])


def constraint_value(
    v_enu: Float[Array, "3"], v_air_enu: Float[Array, "3"], wind_enu: Float[Array, "3"]
) -> Float[Array, "2"]:
    """Value d of the wind constraint [m/s]: what is left of v - v_air - wind, east and north.

    It is D x less the errors of air data and wind.
    """
    return (v_enu - v_air_enu - wind_enu)[:2]


def printed_constraint(
    heading_rad: ArrayLike, air_speed_error: ArrayLike, wind_error_en: ArrayLike
) -> tuple[Float[Array, "2 9"], Float[Array, "2"]]:
    """D and d of eqs. (49) and (50) to the letter; D loses a row wherever the heading is cardinal.

    dv_E and dv_N are components already, and yet are multiplied by sine and cosine of the heading;
    d has these two the other way round.

    Args:
        heading_rad: SINS's.
        air_speed_error: () m/s, see `printed_air_speed_error`.
        wind_error_en: (2,) m/s, east and north. In words (50) has the wind itself here.
    """
    s, c = _sin_cos(heading_rad)
    D = jnp.zeros((2, STATES)).at[0, 3].set(s).at[1, 4].set(c)
    along = jnp.asarray(air_speed_error, float) * jnp.stack([c, s])
    return D, jnp.asarray(wind_error_en, float) + along


def printed_air_speed_error(
    v_enu: Float[Array, "3"], wind_enu: Float[Array, "3"], air_speed: ArrayLike
) -> Array:
    """The dv_a of eq. (50) as it can be had: |v - wind| of the SINS less the measured air speed."""
    return jnp.linalg.norm(v_enu - wind_enu) - jnp.asarray(air_speed, float)


def check_constraint(D: np.ndarray, d: np.ndarray, P: np.ndarray | None = None) -> None:
    """Refuse a constraint that cannot be imposed exactly; outside compiled code.

    Args:
        D: (c, n).
        d: (c,).
        P: (n, n) covariance, or whatever is in its place in D P D'; the identity if not given.

    Raises:
        ValueError: a number is not finite, a row of D is zero or depends on those above it, or
            D P D' has a condition number beyond 1e12; it says which row.
    """
    D, d = np.asarray(D, float), np.asarray(d, float)
    unfit = np.flatnonzero(~(np.isfinite(D).all(1) & np.isfinite(d)))
    if len(unfit):
        row = _row(int(unfit[0]), D)
        raise ValueError(f"{row} of the constraint is not finite: leave it out")
    check_rows(D, d, np.ones(len(D), bool))
    spread = D @ (np.eye(D.shape[1]) if P is None else np.asarray(P, float)) @ D.T
    values, vectors = np.linalg.eigh(0.5 * (spread + spread.T))
    if values[0] * WORST_CONDITION <= values[-1]:
        row = int(np.argmax(np.abs(vectors[:, 0])))
        condition = values[-1] / values[0] if values[0] > 0.0 else np.inf
        raise ValueError(
            f"D P D' has condition {condition:.1e}, at most {WORST_CONDITION:.0e} can be inverted: "
            f"{_row(row, D)} is almost without weight, or is known already. "
            "Leave it out, or give it noise"
        )


def _row(row: int, D: np.ndarray) -> str:
    name = f" ({_COMPONENTS[row]})" if D.shape == (2, STATES) else ""
    return f"row {row}{name}, counted from 0,"


def _sin_cos(angle: ArrayLike) -> tuple[Array, Array]:
    a = jnp.asarray(angle, float)
    return jnp.sin(a), jnp.cos(a)


def _matrix(*rows) -> Float[Array, "3 3"]:
    return jnp.stack([jnp.stack([jnp.asarray(x, float) for x in row]) for row in rows])
