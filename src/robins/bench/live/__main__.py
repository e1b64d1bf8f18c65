"""The server process of the live page; `robins.bench.live.LivePage` starts it.

By hand, `python -m robins.bench.live` serves a page that waits for a bench.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import socket

from robins.bench.live.server import serve

NICE = 5  # lower priority than the bench


def main() -> None:
    """Serve until the bench disconnects."""
    parser = argparse.ArgumentParser(prog="python -m robins.bench.live")
    parser.add_argument("--feed", type=int, help="file descriptor of the pipe to the bench")
    parser.add_argument("--listen", type=int, help="file descriptor of a socket that listens")
    parser.add_argument("--port", type=int, default=0, help="at 127.0.0.1, if no socket is given")
    given = parser.parse_args()
    if given.listen is not None:
        at = socket.socket(fileno=given.listen)
    else:
        at = socket.create_server(("127.0.0.1", given.port))
        print(f"http://127.0.0.1:{at.getsockname()[1]}/", flush=True)
    if given.feed is not None:
        os.nice(NICE)
    pipe = None if given.feed is None else socket.socket(fileno=given.feed)
    asyncio.run(serve(at, pipe))


if __name__ == "__main__":
    main()
