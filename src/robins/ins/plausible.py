"""Magnitudes that reveal the unit of sensor data: gravity, the Earth's rate and field, ranges.

The doctor of logs and live filters use the same limits. A unit is named only if the numbers match
it; a rate at rest has no known magnitude that could reveal its unit.
"""

from __future__ import annotations

import numpy as np

G = 9.80665  # m/s^2
EARTH_RATE = 7.292115e-5  # rad/s
EARTH_FIELD_T = (20e-6, 70e-6)  # range on the ground

BIASED = 0.05  # largest error of a low-cost accelerometer, as a share of gravity
REST_RATE = 0.2  # rad/s (11 deg/s): more than the bias of almost any gyro
FASTEST = 75.0  # rad/s (4300 deg/s): beyond the range of gyros for vehicles
STRONGEST_T = 0.1  # beyond the range of magnetometers that find north

# Absurd numbers: beyond any vehicle in any unit.
GYRO_LIMIT = 1e4  # rad/s, 95 000 turns a minute, or rad for increments
ACCEL_LIMIT = 1e6  # m/s^2, or m/s for increments

# Gravity in a unit -> its name, and how to convert it to m/s^2.
FORCE_UNITS = {
    1.0: ("g", "multiply by 9.80665"),
    1e3: ("milli-g", "multiply by 0.00980665"),
    100.0 * G: ("cm/s^2", "divide by 100"),
    1e3 * G: ("mm/s^2", "divide by 1000"),
    G / 0.3048: ("ft/s^2", "multiply by 0.3048"),
}
# Power of ten by which the Earth's field is larger in a unit -> its name, how to convert it.
FIELD_UNITS = {
    9: ("nT", "multiply by 1e-9"),
    7: ("milligauss", "multiply by 1e-7"),
    6: ("uT", "multiply by 1e-6"),
    4: ("gauss", "multiply by 1e-4"),
}


def is_near(measured: float, expected: float) -> bool:
    """True if specific forces are equal within the error of a low-cost accelerometer."""
    return abs(measured / expected - 1.0) < BIASED


def force_unit(measured: float) -> tuple[str, str] | None:
    """Unit in which a specific force at rest is gravity, and how to convert it."""
    return next((unit for size, unit in FORCE_UNITS.items() if is_near(measured, size)), None)


def field_unit(measured: float) -> tuple[str, str] | None:
    """Unit in which the magnitude of a magnetic field is the Earth's, and how to convert it."""
    low, high = EARTH_FIELD_T
    fitting = (unit for k, unit in FIELD_UNITS.items() if low <= measured / 10.0**k <= high)
    return next(fitting, None)


def rate_across(rate: np.ndarray, force: np.ndarray) -> float:
    """Magnitude of a rate (3,) perpendicular to a constant specific force (3,).

    Only a rotation about the vertical keeps the direction of the force in body axes, so this part
    of the rate is a gyro error.
    """
    return float(np.linalg.norm(np.cross(rate, force)) / np.linalg.norm(force))
