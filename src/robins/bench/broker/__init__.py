"""The broker of the bench: it holds the far ends of all lines and passes messages on.

- `broker`: passes messages between parts, step by step. `link`: one far end, and the checks of its
  frames.
- `faults`: faults that can be injected, as parameters; `injector` applies them.
- `revive`: sends a restarted part all its input again. `errors`: conditions that end a run.
"""

from robins.bench.broker.broker import Broker, Wiring
from robins.bench.broker.faults import DeviceFault, FaultTable, LinkFault
from robins.bench.broker.injector import Injector, LineOutput
from robins.bench.broker.link import BenchError, Health, Link, LinkLost
from robins.errors import moved

__all__ = [
    "BenchError",
    "Broker",
    "DeviceFault",
    "FaultTable",
    "Health",
    "Injector",
    "LineOutput",
    "Link",
    "LinkFault",
    "LinkLost",
    "Wiring",
]

__getattr__ = moved(__name__)
