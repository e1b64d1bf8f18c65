"""Quantities of the columns of a log, and the sets of them that make a table.

A column holds one quantity; those that belong together, such as three axes, are a group. A table
of `robins.dataset` needs one of several sets of groups and may have more.
"""

from __future__ import annotations

from typing import NamedTuple


class QuantityGroup(NamedTuple):
    """Quantities that are given together or not at all."""

    kinds: dict[str, str]  # quantity -> kind of its unit in `robins.units`
    text: str


class TableRecipe(NamedTuple):
    """Groups of quantities that make a table."""

    text: str
    needs: tuple[tuple[str, ...], ...]  # alternative sets of groups that suffice
    more: tuple[str, ...] = ()


def _alike(kind: str, names: str, text: str) -> QuantityGroup:
    """A group of quantities of the same kind of unit."""
    return QuantityGroup(dict.fromkeys(names.split(), kind), text)


GROUPS: dict[str, QuantityGroup] = {
    "time": _alike("time", "time", "time of the row"),
    "time_of_week": _alike("time", "time_of_week", "second of the GPS week, goes on at its end"),
    "week": _alike("ratio", "week", "GPS week; time counts from the beginning of the first"),
    "gyro": _alike("angle rate", "gyro_x gyro_y gyro_z", "turn rate"),
    "accel": _alike("specific force", "accel_x accel_y accel_z", "specific force"),
    "dtheta": _alike("angle", "dtheta_x dtheta_y dtheta_z", "turn since the row before"),
    "dv": _alike("speed", "dv_x dv_y dv_z", "specific force summed up since the row before"),
    "dt": _alike("time", "dt", "time over which dtheta and dv are, compared with that of the rows"),
    "mag": _alike("magnetic field", "mag_x mag_y mag_z", "magnetic field"),
    "place": QuantityGroup(
        {"lat": "angle", "lon": "angle", "height": "length"}, "place, above the WGS-84 ellipsoid"
    ),
    "local": _alike("length", "east north up", "place, from an origin"),
    "velocity": _alike("speed", "v_north v_east v_down", "velocity"),
    "sigma": _alike("length", "sigma_north sigma_east sigma_down", "sigma of the place"),
    "sigma_v": _alike("speed", "sigma_v_north sigma_v_east sigma_v_down", "sigma of the velocity"),
    "quality": _alike("ratio", "quality", "1 fixed, 2 float, 5 single, as RTKLIB counts"),
    "euler": _alike("angle", "roll pitch heading", "of the vehicle"),
    "quaternion": _alike("ratio", "q_w q_x q_y q_z", "turns body into navigation axes"),
    "wheels": _alike("speed", "wheel_speed sigma_wheel_speed", "forward speed by the wheels"),
    "omega": _alike("angle rate", "omega_x omega_y omega_z", "turn rate against inertial space"),
}
"""All groups by name."""

TABLES: dict[str, TableRecipe] = {
    "imu": TableRecipe("inertial samples", (("gyro", "accel"), ("dtheta", "dv")), ("dt",)),
    "mag": TableRecipe("magnetic field", (("mag",),)),
    "gnss": TableRecipe("fixes", (("place",),), ("sigma", "velocity", "sigma_v", "quality")),
    "trajectory": TableRecipe(
        "path",
        (
            ("place", "velocity", "euler"),
            ("place", "velocity", "quaternion"),
            ("local", "quaternion"),
        ),
        ("velocity", "omega"),
    ),
    "attitude": TableRecipe("attitude", (("quaternion",), ("euler",))),
    "odometry": TableRecipe("speed of the wheels", (("wheels",),)),
}
"""All tables by kind."""

QUANTITIES: dict[str, str] = {q: kind for g in GROUPS.values() for q, kind in g.kinds.items()}
"""The kind of unit of every quantity."""

CLOCKS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Units of time stamps -> number of decimals of a nanosecond in them."""

DATES = ("iso", "iso UTC", "iso GPS")
"""In place of a unit: ISO 8601 with its offset from UTC, or without one in UTC or GPS time."""

_GROUP_OF = {q: name for name, g in GROUPS.items() for q in g.kinds}


def parts(groups: tuple[str, ...] | str) -> list[str]:
    """Quantities of several groups, or of one."""
    names = (groups,) if isinstance(groups, str) else groups
    return [q for name in names for q in GROUPS[name].kinds]


def groups_of(quantities: set[str]) -> set[str]:
    """Groups with at least one of these quantities."""
    return {_GROUP_OF[q] for q in quantities}


def tables_of_groups(groups: set[str]) -> tuple[str, ...]:
    """Kinds of the tables that these groups make: a place with an attitude is a path."""
    placed, turned = groups & {"place", "local"}, groups & {"euler", "quaternion"}
    has = {
        "imu": groups & {"gyro", "accel", "dtheta", "dv"},
        "mag": groups & {"mag"},
        "gnss": placed and not turned,
        "trajectory": placed and turned,
        "attitude": turned and not placed,
        "odometry": groups & {"wheels"},
    }
    return tuple(kind for kind in TABLES if has[kind])


def words_of(kind: str) -> str:
    """Name of a kind of table in words."""
    return TABLES[kind].text
