"""Trajectories for evo and other tools that score odometry: TUM text.

Lines ``timestamp tx ty tz qx qy qz qw``: metres east, north, up about an origin, and the rotation
from body to those axes, **scalar last** (everything else in robins has it first).
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from robins.dataset import Trajectory
from robins.logs.findings import LogError
from robins.logs.local import Origin, to_local
from robins.logs.writing import rows_of_numbers, write_lines


def write_tum(
    path: str | os.PathLike[str], trajectory: Trajectory, origin: Origin | None = None
) -> Origin:
    """Write a trajectory as TUM text; two that are compared must share their origin.

    Args:
        path: the file.
        trajectory: any frames; its body axes stay as they are.
        origin: where the local axes sit; by default the first point.

    Returns:
        The origin used, for writing another trajectory beside this one.

    Raises:
        LogError: the trajectory is empty, or the file cannot be written.
    """
    if not len(trajectory):
        raise LogError(str(path), "the trajectory has no points", "nothing to write")
    if origin is None:
        lat, lon = (np.rad2deg(a[0]) for a in (trajectory.lat_rad, trajectory.lon_rad))
        origin = Origin(float(lat), float(lon), float(trajectory.alt_m[0]))
    local = to_local(trajectory, origin)
    values = np.hstack([local.r_l, np.roll(local.q_lb, -1, axis=-1)])

    def blocks() -> Iterator[str]:
        yield "# timestamp tx ty tz qx qy qz qw\n"
        yield (
            f"# s; m east, north, up of {origin.lat_deg!r} deg {origin.lon_deg!r} deg "
            f"{origin.alt_m!r} m; rotation {trajectory.body} to ENU, scalar last\n"
        )
        yield from rows_of_numbers(trajectory.time_ns, values, " ")

    write_lines(path, blocks())
    return origin
