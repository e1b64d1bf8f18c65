"""The test bench: each part of a vehicle is a process or a board on its own serial line.

From the ground up:

- `wire`: every message, field by field, and the frames that carry it; the same for firmware.
- `ports`: serial devices, pseudo-terminals in their place, and a line that takes its time.
- `parts`: programs at the end of a line. `rig`: a vehicle; `rigs`: those there are.
- `broker`: the hub, which passes messages between parts and injects faults.
- `recording`: traffic of the lines: written, read, replayed, compared.
- `live`: a running bench in a browser.
- `bridges`: autopilots and ROS 2, by their protocols; independent of the rest.
- `evaluation`: figures and page of a run. `accounting`: its latencies.
- `run`: setup, execution and outcome of a run. `status`: the benches of this machine.

Needs the extra "bench"; the page needs "live", bridges "autopilot" and "ros".
"""

from robins.bench.evaluation import PageView, RunFigures
from robins.bench.parts import Part
from robins.bench.rig import Rig, Timing
from robins.bench.wire import VERSION, Wire
from robins.errors import moved

__all__ = ["VERSION", "PageView", "Part", "Rig", "RunFigures", "Timing", "Wire"]

__getattr__ = moved(__name__)
