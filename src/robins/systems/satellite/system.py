"""The satellite as a system: its study, its scenarios."""

from __future__ import annotations

from pathlib import Path

from robins.systems.satellite.claims import CLAIMS
from robins.systems.satellite.filters import FILTERS
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.problem import attitude_problem
from robins.systems.system import Study, System

_HERE = Path(__file__).parent / "scenarios"
_SCENARIOS = (
    *("s1", "s2", "s3", "s4", "stars"),
    *("star-stuck", "star-wrong", "star-lost", "star-sign", "wheel-lost"),
)

SYSTEM = System(
    name="satellite",
    summary="a satellite's attitude in closed loop: gyro, star sensor, mixed H2/H-infinity",
    studies={"attitude-loop": Study(AttitudeLoop, attitude_problem, FILTERS, CLAIMS)},
    scenarios={name: _HERE / f"{name}.toml" for name in _SCENARIOS},
)

__all__ = ["SYSTEM"]
