"""A run on the bench.

- `setup`: what is asked for.
- `session`: doing it. `crew`: its processes. `clocks`: when a step begins. `accounting`: how late.
- `telemetry`, `outcome`: what came of it, in a `room` on disk if it is long; `numbers`: where a
  rig says nothing of that.
- `watching`: who looks on.
"""

from robins.bench.run.accounting import Latencies
from robins.bench.run.clocks import LockStep, RealTime
from robins.bench.run.session import Ran, Session
from robins.bench.run.setup import Flight, Setup

__all__ = ["Flight", "Latencies", "LockStep", "Ran", "RealTime", "Session", "Setup"]
