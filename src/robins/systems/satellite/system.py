"""The satellite as a system: its study, its scenarios."""

from __future__ import annotations

from robins.systems.satellite.claims import CLAIMS
from robins.systems.satellite.filters import FILTERS
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.problem import attitude_problem
from robins.systems.study import Study
from robins.systems.system import System

SYSTEM = System(
    name="satellite",
    studies={"attitude-loop": Study(AttitudeLoop, attitude_problem, FILTERS, CLAIMS)},
)

__all__ = ["SYSTEM"]
