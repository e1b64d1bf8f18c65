"""Velocity and attitude matching, twelve states open loop, after a patent of Southeast Univ."""
