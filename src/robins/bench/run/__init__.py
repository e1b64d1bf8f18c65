"""A run on the bench.

- `setup`: its parameters.
- `session`: its execution. `crew`: its processes. `clocks`: the start of each step.
- `telemetry`, `outcome`: its results, in a `room` on disk if it is long.
- `watching`: the page and the status file.
"""

from robins.bench.accounting import Latencies
from robins.bench.evaluation import Ran
from robins.bench.rig import Flight
from robins.bench.run.clocks import LockStep, RealTime
from robins.bench.run.session import Session
from robins.bench.run.setup import Setup

__all__ = ["Flight", "Latencies", "LockStep", "Ran", "RealTime", "Session", "Setup"]
