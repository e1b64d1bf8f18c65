"""Frames and units of other programs, from those of robins and back.

robins has north-east-down (NED) navigation axes n, forward-right-down (FRD) body axes b and
quaternions q_nb scalar first, from body to navigation; so have PX4 and ArduPilot. ROS has
east-north-up (ENU) and forward-left-up (FLU), quaternions scalar last, also from body to navigation
(REP 103). Between the two pairs components are only permuted and negated:

    v_enu = T v_ned,  T = [0 1 0; 1 0 0; 0 0 -1]        v_flu = D v_frd,  D = diag(1, -1, -1)

T and D are their own inverses, and turns by 180 deg: T about (1, 1, 0)/sqrt(2), D about (1, 0, 0).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from robins.rotation import multiply

GAUSS_PER_T = 1e4
_T = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_Q_T = np.array([0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0])
_Q_D = np.array([0.0, 1.0, 0.0, 0.0])
_SIGNS = np.array([1.0, -1.0, -1.0])


def enu_from_ned(v_n: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """East, north, up of north, east, down."""
    return np.stack([v_n[..., 1], v_n[..., 0], -v_n[..., 2]], -1)


def ned_from_enu(v_enu: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """North, east, down of east, north, up."""
    return enu_from_ned(v_enu)


def flu_from_frd(v_b: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Forward, left, up of forward, right, down."""
    return v_b * _SIGNS


def frd_from_flu(v_flu: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Forward, right, down of forward, left, up."""
    return flu_from_frd(v_flu)


def enu_covariance_from_ned(P_n: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Covariance T P T' in east, north, up of one in north, east, down."""
    return _T @ P_n @ _T.T


def ned_covariance_from_enu(P_enu: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Covariance in north, east, down of one in east, north, up."""
    return enu_covariance_from_ned(P_enu)


def flu_covariance_from_frd(P_b: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Covariance D P D' in forward, left, up of one in forward, right, down."""
    return P_b * np.outer(_SIGNS, _SIGNS)


def frd_covariance_from_flu(P_flu: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Covariance in forward, right, down of one in forward, left, up."""
    return flu_covariance_from_frd(P_flu)


def enu_flu_from_ned_frd(q_nb: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
    """The same attitude from FLU to ENU, scalar first, of one from FRD to NED."""
    return multiply(multiply(_Q_T, q_nb), _Q_D)


def ned_frd_from_enu_flu(q_ros: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
    """The same attitude q_nb from FRD to NED of one from FLU to ENU, both scalar first."""
    return multiply(multiply(_Q_T, q_ros), _Q_D)


def xyzw(q: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
    """Scalar last of a quaternion scalar first."""
    return np.roll(q, -1, -1)


def wxyz(q_xyzw: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
    """Scalar first of a quaternion scalar last."""
    return np.roll(q_xyzw, 1, -1)


def degE7(angle_rad: float) -> float:
    """An angle [rad] in units of 1e-7 deg, as MAVLink has latitudes and longitudes; not rounded."""
    return math.degrees(angle_rad) * 1e7


def rad_from_degE7(angle_degE7: int) -> float:
    """An angle [rad] of one in units of 1e-7 deg."""
    return math.radians(angle_degE7 * 1e-7)


def gauss(field_T: float) -> float:
    """A magnetic flux density [T] in gauss (1 G = 1e-4 T, exactly)."""
    return field_T * GAUSS_PER_T


def course_cdeg(v_n_m_s: Float[np.ndarray, "3"]) -> float:
    """Course over ground in units of 0.01 deg, in [0, 36000), of a velocity north, east, down."""
    degrees = math.degrees(math.atan2(v_n_m_s[1], v_n_m_s[0])) % 360.0
    return degrees * 100.0
