"""A run on the bench.

- `setup`: its parameters.
- `session`: its execution. `crew`: its processes. `clocks`: the start of each step. `accounting`:
  lateness and latencies.
- `telemetry`, `outcome`: its results, in a `room` on disk if it is long; `numbers`: defaults where
  a rig defines none.
- `watching`: the page and the status file.
"""

from robins.bench.run.accounting import Latencies
from robins.bench.run.clocks import LockStep, RealTime
from robins.bench.run.session import Ran, Session
from robins.bench.run.setup import Flight, Setup

__all__ = ["Flight", "Latencies", "LockStep", "Ran", "RealTime", "Session", "Setup"]
