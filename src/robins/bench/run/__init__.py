"""A run on the bench.

- `setup`: what is asked for; `scenarios`: some to begin with.
- `session`: doing it. `crew`: its processes. `clocks`: when a step begins. `accounting`: how late.
- `telemetry`, `outcome`: what came of it. `watching`: who looks on.
"""

from robins.bench.run.accounting import Latencies
from robins.bench.run.clocks import LockStep, RealTime
from robins.bench.run.session import Ran, Session, in_process
from robins.bench.run.setup import Flight, Setup

__all__ = [
    "Flight",
    "Latencies",
    "LockStep",
    "Ran",
    "RealTime",
    "Session",
    "Setup",
    "in_process",
]
