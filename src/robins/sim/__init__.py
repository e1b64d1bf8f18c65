"""Simulation: motions over the Earth and what sensors make of them.

- `trajectory`: smooth motions from waypoints, velocity or a sine.
- `ideal_imu`: an IMU without errors, and the inversion of the mechanisation.
"""

from robins.sim.ideal_imu import ideal_increments, ideal_rates, true_increments
from robins.sim.trajectory import Motion, from_velocity, from_waypoints, sine_velocity

__all__ = [
    "Motion",
    "from_velocity",
    "from_waypoints",
    "ideal_increments",
    "ideal_rates",
    "sine_velocity",
    "true_increments",
]
