"""The live page: a running bench in a browser, from a process of its own.

- `LivePage`: the handle of the bench; starts the server, feeds it, takes its commands, never waits.
- `feed`: signals of the page, and data between the bench and the server.
- `events`, `history`: events and samples of the run so far.
- `hub`, `commands`, `guard`, `server`: the server; they need the extra "live".
- `static`: the page; no build step, uPlot with its licence.
"""

from robins.bench.live.feed import Signal
from robins.bench.live.handle import LivePage
from robins.errors import moved

__all__ = ["LivePage", "Signal"]

__getattr__ = moved(__name__)
