"""Simulation: motions over the Earth and the outputs of sensors along them.

- `trajectory`: smooth motions from waypoints, velocities or a sine; motion of a lever-arm point.
- `commands`: smooth motions from manoeuvres (import the manoeuvres by their module).
- `flexure`: vibration and bending of the structure between two inertial units.
- `manoeuvres`: smooth motions of a banking aircraft, a ship in waves, a vehicle on a rough road.
- `disturbance`: heavy tails, outliers, steps of noise and drift (import it by its name).
- `ideal_imu`: an IMU without errors, and the inversion of the mechanisation.
- `imu_sensor`, `gnss_sensor`: an IMU and a receiver with errors.
- `wind`: gusts, and a vehicle carried by them; Dryden and von Karman spectra.
- `air_data`, `sar`: sensors of an airship.
- `ballistic`, `free_body`: a rocket after burnout, its trajectory and its attitude.
- `gyro`, `magnetometer`: the rocket's sensors.
- `spacecraft`, `orbit`: a rigid body with wheels and magnetorquers, and its environment.
- `attitude_reference`, `attitude_control`: target attitude, and the control law that tracks it.
- `rate_table`: a three-axis rate table that turns a gyro on the ground.
- `star_sensor`, also `gyro`: sensors of a spacecraft under attitude control.
- `random`: streams of random numbers by seed, run and component; Gauss-Markov processes.
"""

from robins.errors import moved
from robins.sim.commands import from_commands
from robins.sim.flexure import Flexure, simulate_flexure
from robins.sim.gnss_sensor import GnssErrorModel, GnssFixes, as_table, fix_times, observe
from robins.sim.ideal_imu import ideal_increments, true_increments
from robins.sim.imu_sensor import ImuTruth, corrupt, corrupt_table
from robins.sim.manoeuvres import fly, roughen, sail
from robins.sim.random import Component, stream
from robins.sim.trajectory import (
    MotionProfile,
    at_lever_arm,
    from_velocity,
    from_waypoints,
    sine_velocity,
)

__all__ = [
    "Component",
    "Flexure",
    "GnssErrorModel",
    "GnssFixes",
    "ImuTruth",
    "MotionProfile",
    "as_table",
    "at_lever_arm",
    "corrupt",
    "corrupt_table",
    "fix_times",
    "fly",
    "from_commands",
    "from_velocity",
    "from_waypoints",
    "ideal_increments",
    "observe",
    "roughen",
    "sail",
    "simulate_flexure",
    "sine_velocity",
    "stream",
    "true_increments",
]

__getattr__ = moved(__name__)
