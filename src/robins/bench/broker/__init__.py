"""The broker of the bench: it holds the bench's ends of all lines and passes messages on.

- `broker`: passes messages between parts, step by step. `link`: the bench's end of one line, with
  the checks of its frames, and the errors that end a run.
- `faults`: faults that can be injected, as parameters; `injector` applies them.
- `restart`: sends a restarted part its input again. `console`: messages of the operator.
"""

from robins.bench.broker.broker import Broker
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
]

__getattr__ = moved(__name__)
