"""The live page: a running bench in a browser, from a process of its own.

- `Live`: what the bench holds; starts the server, feeds it, takes its commands, never waits for it.
- `signals`: what is drawn.
- `feed`: what goes between the bench and the server.
- `hub`, `commands`, `guard`, `server`: the server; they need the extra "live".
- `static`: the page; no build step, uPlot with its licence beside it.
"""

from robins.bench.live.feed import Signal
from robins.bench.live.handle import Live

__all__ = ["Live", "Signal"]
