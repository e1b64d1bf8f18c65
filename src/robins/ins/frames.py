"""The two frame conventions of robins, and the conversion between them.

Native are north-east-down for navigation and forward-right-down for the body (NED/FRD). East-north-
up and right-forward-up (ENU/RFU) differ in labels only: with T the half turn about (1, 1, 0)

    v_ENU = T v_NED       v_RFU = T v_FRD       C_ENU_RFU = T C_NED_FRD T'

T exchanges the first two components and changes the sign of the third, so the conversion is exact,
and T is its own inverse, so one function serves both directions. Roll, pitch and heading are those
of the vehicle and the same in both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from robins.dataset import (
    AttitudeTable,
    BodyFrame,
    GnssTable,
    ImuTable,
    MagTable,
    NavFrame,
    Trajectory,
)
from robins.linalg.library import Each
from robins.rotation import multiply, to_euler

Table = TypeVar("Table", ImuTable, GnssTable, Trajectory, MagTable, AttitudeTable)

_ORDER = np.array([1, 0, 2])
_ORDER_Q = np.array([0, 2, 1, 3])
_HALF_TURN = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])  # T as a quaternion


def swap(v):
    """Convert a vector (..., 3) to the other convention, NED <-> ENU or FRD <-> RFU; exact."""
    return _turn_last(v[..., _ORDER])


def turned(C: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) multiplied by a matrix (..., 3, 3), to the same bits alone and in any array.

    A matrix product rounds a single row differently than many.
    """
    return np.sum(C * v[..., None, :], axis=-1)


def swap_q(q):
    """Convert a quaternion q_nb (..., 4) to the other convention, NED/FRD <-> ENU/RFU; exact."""
    return _turn_last(q[..., _ORDER_Q])


def _turn_last(v):
    sign = np.ones(v.shape[-1:])
    sign[-1] = -1.0
    return v * sign.reshape((1,) * (v.ndim - 1) + sign.shape)


_COLUMNS: dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]] = {  # by the converted side
    "nav": {
        "v_n": swap,
        **dict.fromkeys(("sigma_m", "sigma_v", "assumed_m", "assumed_v"), lambda s: s[..., _ORDER]),
    },
    "body": {"gyro": swap, "accel": swap, "field_t": swap, "omega_ib_b": swap},
}


def to_ned_frd(table: Table) -> Table:
    """The same table in NED/FRD; see `to_enu_rfu`."""
    return _to(table, "NED", "FRD")


def to_enu_rfu(table: Table) -> Table:
    """The same table in ENU/RFU.

    Exact, and a round trip gives the same bits. Only attitudes that mix the conventions (such as
    NED with RFU) are rounded: converting one side of a quaternion needs a square root of two.
    """
    return _to(table, "ENU", "RFU")


def _to(table: Table, nav: NavFrame, body: BodyFrame) -> Table:
    targets = {side: to for side, to in (("nav", nav), ("body", body)) if hasattr(table, side)}
    turns = {side for side, to in targets.items() if getattr(table, side) != to}
    if not turns:
        return table
    new: dict[str, Any] = {
        name: turned(getattr(table, name))
        for side, columns in _COLUMNS.items()
        for name, turned in columns.items()
        if side in turns and getattr(table, name, None) is not None
    }
    if isinstance(table, Trajectory | AttitudeTable):
        new["q_nb"] = _swapped_axes(table.q_nb, "nav" in turns, "body" in turns)
    return replace(table, **targets, **new)


def _swapped_axes(q, turn_nav: bool, turn_body: bool):
    """Attitudes with the axes of one side, of both, or of none exchanged."""
    if turn_nav and turn_body:
        return swap_q(q)
    if turn_nav:
        return multiply(_HALF_TURN, q)
    if turn_body:
        return multiply(q, -_HALF_TURN)
    return q


def euler_enu_rfu(q_nb) -> tuple[Each, Each, Each]:
    """Roll, pitch, heading [rad] of an ENU/RFU attitude (..., 4).

    Positive right wing down, nose up, clockwise from north: the angles of
    `robins.rotation.to_euler` for the same vehicle in NED/FRD.
    """
    return to_euler(swap_q(q_nb))
