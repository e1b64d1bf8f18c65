"""The server: one page, one websocket, fed by the bench.

bench --feed--> Hub --queue of each page--> websocket
page --websocket--> commands.read --feed--> bench
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from robins.bench.live import commands
from robins.bench.live.feed import HEAD, JsonObject, to_json
from robins.bench.live.guard import Guard
from robins.bench.live.hub import Client, Hub

STATIC = Path(__file__).parent / "static"
BEAT_S = 0.5
LONGEST_COMMAND = 4096  # bytes
MOST_UNREAD = 1 << 16  # bytes of commands that the bench has not taken
LAST_WORDS_S = 0.2  # time to send pages the notice that the bench is gone

Pass = Callable[[dict[str, Any]], bool]


def application(hub: Hub, pass_on: Pass) -> Starlette:
    """The page and its websocket.

    Args:
        hub: source of the data shown.
        pass_on: takes a command to the bench; False if the bench does not take it.
    """

    async def page(_: Request) -> FileResponse:
        return FileResponse(STATIC / "index.html")

    async def live_socket(websocket: WebSocket) -> None:
        await websocket.accept()
        client = Client()
        hub.join(client)
        pump = asyncio.create_task(client.pump(websocket.send_text, websocket.send_bytes))
        listen = asyncio.create_task(_listen(websocket, client, hub, pass_on))
        try:
            await asyncio.wait({pump, listen}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            hub.leave(client)
            for task in (pump, listen):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                    await task

    routes = [
        Route("/", page),
        WebSocketRoute("/live", live_socket),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard)])


async def _listen(websocket: WebSocket, client: Client, hub: Hub, pass_on: Pass) -> None:
    """Receive commands until the page disconnects."""
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        try:
            text = message.get("text") or message.get("bytes") or ""
            command = commands.read(text, hub.faults, hub.events.waiting(), hub.says)
        except commands.CommandError as error:
            client.line(to_json({"kind": "refused", "text": str(error)}))
            continue
        if pass_on(command):
            if command["do"] == "acknowledge":
                hub.acknowledge(command["alarms"])
            client.line(to_json({"kind": "taken", "do": command["do"]}))
        else:
            client.line(to_json({"kind": "refused", "text": "no bench takes commands now"}))


async def serve(at: socket.socket, pipe: socket.socket | None) -> None:
    """Serve the page until the bench disconnects.

    Args:
        at: listening socket.
        pipe: socket to the bench; None: there is none, and the page waits for one.
    """
    hub = Hub()
    writer: asyncio.StreamWriter | None = None
    reader: asyncio.StreamReader | None = None
    if pipe is not None:
        reader, writer = await asyncio.open_connection(sock=pipe)

    def pass_on(command: JsonObject) -> bool:
        if writer is None or writer.transport.get_write_buffer_size() > MOST_UNREAD:
            return False
        writer.write(to_json(command).encode() + b"\n")
        return True

    server = uvicorn.Server(
        uvicorn.Config(
            application(hub, pass_on),
            log_level="error",
            access_log=False,
            lifespan="off",
            server_header=False,
            ws_max_size=LONGEST_COMMAND,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
        )
    )
    tasks = [asyncio.create_task(server.serve(sockets=[at])), asyncio.create_task(_heartbeat(hub))]
    if reader is not None and writer is not None:
        while not server.started and not tasks[0].done():
            await asyncio.sleep(0.01)
        writer.write(to_json({"listens": True}).encode() + b"\n")
        tasks += [
            asyncio.create_task(_receive_frames(reader, hub)),
            asyncio.create_task(_watch_parent()),
        ]
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks[1:]:
        task.cancel()
    hub.end()
    await asyncio.sleep(LAST_WORDS_S)
    server.should_exit = True
    await tasks[0]


async def _receive_frames(reader: asyncio.StreamReader, hub: Hub) -> None:
    """Receive the data of the bench until it disconnects."""
    with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
        while True:
            length, kind = HEAD.unpack(await reader.readexactly(HEAD.size))
            hub.take(kind, await reader.readexactly(length))


async def _heartbeat(hub: Hub) -> None:
    while True:
        hub.heartbeat()
        await asyncio.sleep(BEAT_S)


async def _watch_parent() -> None:
    """End with the bench even if a child process of it still holds its end of the pipe."""
    parent = os.getppid()
    while os.getppid() == parent:
        await asyncio.sleep(BEAT_S)
