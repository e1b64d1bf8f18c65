"""The kinds of tables, as the modules of this room name and hand them on."""

from __future__ import annotations

import numpy as np

from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory

Table = ImuTable | GnssTable | Trajectory | MagTable | AttitudeTable

KINDS: dict[type, str] = {
    ImuTable: "imu",
    GnssTable: "gnss",
    Trajectory: "truth",
    MagTable: "mag",
    AttitudeTable: "attitude",
}
"""The field of a `Dataset` in which a table lies; a path that is no truth is its ``master``."""


def place_of(table: GnssTable | Trajectory) -> np.ndarray:
    """(n, 3) latitude, longitude, height."""
    return np.stack([table.lat_rad, table.lon_rad, table.alt_m], axis=-1)


def kind_of(table: Table) -> str:
    """The field of a `Dataset` for a table of this type."""
    return KINDS[type(table)]


def kind_in_text(table: Table) -> str:
    """The kind of a table among those of `robins.logs.quantities`: a path is a trajectory."""
    kind = kind_of(table)
    return "trajectory" if kind == "truth" else kind


def tables_of(opened: Table | Dataset) -> list[Table]:
    """What a reader returned, as a list; of a dataset all tables but the master's."""
    if not isinstance(opened, Dataset):
        return [opened]
    tables = [getattr(opened, kind) for kind in KINDS.values()]
    return [table for table in tables if table is not None]
