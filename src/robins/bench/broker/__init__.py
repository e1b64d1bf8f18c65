"""The broker of the bench: it holds the far ends of all lines and passes messages on.

- `broker`: passes messages between parts, step by step. `link`: one far end, and the checks of its
  frames.
- `faults`: faults that can be injected, as parameters; `injector` applies them.
- `revive`: sends a restarted part all its input again. `errors`: conditions that end a run.
"""

from robins.bench.broker.broker import Broker, Wiring
from robins.bench.broker.faults import LinkFault, Said, Table
from robins.bench.broker.injector import Injector, Piece
from robins.bench.broker.link import BenchError, Health, Link, LinkLost

__all__ = [
    "BenchError",
    "Broker",
    "Health",
    "Injector",
    "Link",
    "LinkFault",
    "LinkLost",
    "Piece",
    "Said",
    "Table",
    "Wiring",
]
