"""A run on the bench.

- `setup`: its parameters.
- `session`: its execution. `processes`: those of its parts. `clocks`: the start of each step.
- `orders`, `switching`: faults and messages of the operator; faults of processes.
- `telemetry`, `outcome`: its results, in a `number_store` on disk if it is long.
- `watching`: the page and the status file.
"""

from robins.bench.accounting import Latencies
from robins.bench.evaluation import RunResult
from robins.bench.rig import LoadedRun
from robins.bench.run.clocks import LockStep, RealTime
from robins.bench.run.session import Session
from robins.bench.run.setup import Setup
from robins.errors import moved

__all__ = ["Latencies", "LoadedRun", "LockStep", "RealTime", "RunResult", "Session", "Setup"]

__getattr__ = moved(__name__)
