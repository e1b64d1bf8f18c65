"""A run on the bench.

- `setup`: what is asked for; `scenarios`: some to begin with.
- `session`: doing it. `crew`: its processes. `clocks`: when a step begins. `accounting`: how late.
- `telemetry`, `outcome`: what came of it. `watching`: who looks on. `alarms`: what is said.
- `one_program`: the same without any wire.
"""

from robins.bench.run.accounting import Latencies
from robins.bench.run.clocks import LockStep, RealTime
from robins.bench.run.one_program import in_process
from robins.bench.run.session import Ran, Session
from robins.bench.run.setup import Flight, Setup

__all__ = ["Flight", "Latencies", "LockStep", "Ran", "RealTime", "Session", "Setup", "in_process"]
