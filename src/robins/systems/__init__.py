"""Systems: one problem each, with model, scenarios, filters and claims; here is the registry."""

from robins.systems import airship, ins_gnss, marg, rocket, satellite, transfer_alignment
from robins.systems.system import (
    Case,
    Contender,
    Limit,
    Outcome,
    Output,
    Problem,
    Progress,
    SensorAxes,
    StateBlock,
    Study,
    System,
)

SYSTEMS: dict[str, System] = {
    s.name: s
    for s in (
        ins_gnss.SYSTEM,
        transfer_alignment.SYSTEM,
        airship.SYSTEM,
        rocket.SYSTEM,
        satellite.SYSTEM,
        marg.SYSTEM,
    )
}

__all__ = [
    "SYSTEMS",
    "Case",
    "Contender",
    "Limit",
    "Outcome",
    "Output",
    "Problem",
    "Progress",
    "SensorAxes",
    "StateBlock",
    "Study",
    "System",
]
