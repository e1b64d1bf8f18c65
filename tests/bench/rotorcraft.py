"""A rotor craft that only turns, and an autopilot for it that knows its gyros only.

Both are plain functions of what they are given, so that the loop inside one program and the loop
over a line compute the same numbers, to the last bit, if the line changes none.
"""

import numpy as np

INERTIA = np.array([0.02, 0.02, 0.04])  # kg m^2
MOST = np.array([1.0, 1.0, 1.0])  # N m, at full control
STIFF, DAMPING = np.array([8.0, 8.0, 16.0]), np.array([1.6, 1.6, 3.2])
STEP_US = 4000


def multiply(p, q):
    w, x, y, z = p
    a, b, c, d = q
    return np.array(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )


def turned(q, rate, dt):
    """Attitude after a step of constant rate."""
    phi = rate * dt
    angle = np.sqrt(phi @ phi)
    half = 0.5 * np.sinc(angle / (2.0 * np.pi))
    return multiply(q, np.array([np.cos(angle / 2.0), *(half * phi)]))


class Craft:
    """The physics: a rigid body, tumbling at the start."""

    def __init__(self):
        self.q_nb = turned(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.6, -0.4, 0.9]), 1.0)
        self.omega = np.array([1.0, -0.5, 0.3])

    def step(self, controls):
        """A step with controls in [-1, 1] about each axis."""
        torque = MOST * np.clip(np.asarray(controls, float), -1.0, 1.0)
        gyroscopic = np.cross(self.omega, INERTIA * self.omega)
        self.omega = self.omega + STEP_US * 1e-6 * (torque - gyroscopic) / INERTIA
        self.q_nb = turned(self.q_nb, self.omega, STEP_US * 1e-6)

    def force(self):
        """Specific force at rest [m/s^2], FRD: gravity seen in the body, turned round."""
        w, x, y, z = self.q_nb
        down = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])
        return -9.80665 * down


class Pilot:
    """The autopilot: it integrates its gyros and steers back to level and north."""

    def __init__(self):
        self.q_nb = Craft().q_nb  # as aligned before the start

    def controls(self, gyro):
        """Controls in [-1, 1] about each axis, of a sample of the gyros [rad/s]."""
        gyro = np.asarray(gyro, float)
        self.q_nb = turned(self.q_nb, gyro, STEP_US * 1e-6)
        error = 2.0 * self.q_nb[1:] * np.sign(self.q_nb[0])
        return np.clip(-(STIFF * error + DAMPING * gyro) / 4.0, -1.0, 1.0)


def angle_deg(q):
    """Angle of an attitude from level and north."""
    return np.rad2deg(2.0 * np.arctan2(np.sqrt(q[1:] @ q[1:]), abs(q[0])))


def fly(steps, gyro_through, controls_through):
    """The loop inside one program; what a line does to the numbers is given."""
    craft, pilot, attitudes = Craft(), Pilot(), []
    for _ in range(steps):
        craft.step(controls_through(pilot.controls(gyro_through(craft.omega))))
        attitudes.append(craft.q_nb)
    return np.array(attitudes)
