"""The test bench: each part of a vehicle is a process or a board on its own serial line.

From the ground up:

- `wire`: every message, field by field, and the frames that carry it; the same for firmware.
- `ports`: serial devices, pseudo-terminals in their place, and a line that takes its time.
- `parts`: what sits at the end of a line. `rig`: a vehicle as data; `rigs`: those there are.
- `broker`: the middle, which says what to whom; what goes wrong on purpose.
- `recording`: what went over the lines, written down, heard again, compared.
- `live`: a running bench in a browser.
- `bridges`: autopilots and ROS 2, by their protocols; know nothing of the rest.
- `run`: what is asked for, doing it, what came of it. `status`: the benches of this machine.

Needs the extra "bench"; the page needs "live", bridges "autopilot" and "ros".
"""

from robins.bench.parts import Part
from robins.bench.rig import Judged, Rig, Timing, View
from robins.bench.wire import VERSION, Wire

__all__ = ["VERSION", "Judged", "Part", "Rig", "Timing", "View", "Wire"]
