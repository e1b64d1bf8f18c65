"""Velocity and attitude matching, twelve states open loop, after a patent of Southeast Univ."""

from robins.systems.transfer_alignment.velocity_attitude.study import STUDY

__all__ = ["STUDY"]
