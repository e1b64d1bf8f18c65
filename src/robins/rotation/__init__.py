"""Rotations: unit quaternions, rotation vectors, direction cosine matrices, Euler angles.

Quaternions are scalar first (w, x, y, z), Hamilton product; ``q_nb`` maps body coordinates to
navigation coordinates, ``v_n = rotate(q_nb, v_b)``. All functions work on one or many alike: the
last axis holds the components, leading axes broadcast. Euler angles are roll, pitch, heading of
the aerospace (Z-Y-X) sequence between an NED navigation frame and an FRD body frame.

- `arithmetic`: what is computed by NumPy where NumPy is given, with nothing to compile, else by
  JAX.
- `element`: rotations as elements of a state, the exponential map, its Jacobians; by JAX.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robins.errors import lazy, places

if TYPE_CHECKING:
    from robins.rotation.arithmetic import (
        conjugate,
        from_dcm,
        from_euler,
        multiply,
        normalise,
        rotate,
        skew,
        to_dcm,
        to_euler,
        to_rotvec,
    )
    from robins.rotation.element import (
        BodyRotation,
        Rotation,
        from_rotvec,
        left_jacobian,
        turn_coefficients,
    )

__all__ = [
    "BodyRotation",
    "Rotation",
    "conjugate",
    "from_dcm",
    "from_euler",
    "from_rotvec",
    "left_jacobian",
    "multiply",
    "normalise",
    "rotate",
    "skew",
    "to_dcm",
    "to_euler",
    "to_rotvec",
    "turn_coefficients",
]

_FILES = {
    "arithmetic": "conjugate from_dcm from_euler multiply normalise rotate skew to_dcm to_euler "
    "to_rotvec",
    "element": "BodyRotation Rotation from_rotvec left_jacobian turn_coefficients",
}

__getattr__ = lazy(__name__, places(__name__, _FILES))
