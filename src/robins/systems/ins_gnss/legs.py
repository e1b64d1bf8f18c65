"""The legs of a scenario as the commands of a motion."""

from __future__ import annotations

from collections.abc import Sequence

from robins.earth import Geodetic
from robins.sim.commands import Command, accelerate, climb, from_commands, stop, straight, turn
from robins.sim.trajectory import Motion
from robins.systems.ins_gnss.parameters import Leg, Place

# what each leg says, in the order its command takes it
LEGS = {
    "stop": (stop, ("seconds",)),
    "straight": (straight, ("seconds",)),
    "accelerate": (accelerate, ("speed", "seconds")),
    "turn": (turn, ("angle", "rate")),
    "climb": (climb, ("height", "seconds")),
}
QUANTITIES = ("seconds", "speed", "angle", "rate", "height")


def command_of(leg: Leg) -> Command:
    """The command of a leg.

    Raises:
        ValueError: the leg lacks a quantity it needs, or has one it does not take.
    """
    make, needed = LEGS[leg.do]
    given = {name for name in QUANTITIES if getattr(leg, name) is not None}
    if wrong := sorted(given ^ set(needed)):
        what = "needs" if wrong[0] in needed else "does not take"
        raise ValueError(f"legs: '{leg.do}' {what} '{wrong[0]}'; it takes {', '.join(needed)}")
    return make(*(getattr(leg, name) for name in needed))


def motion_of(place: Place, legs: Sequence[Leg]) -> Motion:
    """The motion that legs describe, from rest.

    Raises:
        ValueError: there are no legs, or one of them is not complete.
    """
    if not legs:
        raise ValueError("legs: a drive needs at least one [[legs]]")
    start = Geodetic(place.latitude, place.longitude, place.height)
    return from_commands(start, [command_of(leg) for leg in legs], heading_rad=place.heading)
