"""The broker of the bench: it holds the far ends of all lines and passes messages on.

- `broker`: who says what to whom, step by step. `link`: one far end; what is wrong with its frames.
- `faults`: what may go wrong on purpose, as parameters; `injector` does it.
- `revive`: a part that was started anew is told all again. `errors`: what ends a run.
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
