"""Bridges: autopilots and ROS 2 as ends of the bench, by their published protocols.

- `px4`: the simulator of PX4's SITL, MAVLink 2 over TCP; extra "autopilot".
- `ardupilot`: the physics of ArduPilot's SITL, JSON over UDP; needs no extra.
- `ros2`: topics of ROS 2 over Zenoh, without ROS; extra "ros".
- `errors`: errors of all bridges.

A bridge owns its socket and knows nothing of the bench's broker.
"""

from robins.bench.bridges.errors import BridgeClosed, BridgeError, BridgeTimeout, MissingPackage

__all__ = ["BridgeClosed", "BridgeError", "BridgeTimeout", "MissingPackage"]
