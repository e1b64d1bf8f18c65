"""Access to the server: only its own pages may connect.

A browser on the machine of the bench also runs pages of other sites, which may open a websocket to
any address. Two headers, which a page cannot forge, identify them: `Origin`, the site of the page,
must be this server, and `Host`, the address that it requested, must be an address or name of this
machine, since a foreign name can be made to point here (DNS rebinding).
"""

from __future__ import annotations

import ipaddress
import re
import socket
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::\d{1,5})?")


def known_host(host: str) -> bool:
    """True if a Host header is a bare address, localhost or the name of this machine."""
    found = _HOST.fullmatch(host)
    if found is None:
        return False
    name = found["name"].strip("[]").lower().rstrip(".")
    if name in {"localhost", socket.gethostname().lower(), socket.getfqdn().lower()}:
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def same_origin(origin: str | None, host: str) -> bool:
    """True if an Origin header names the Host, or there is none, as from other than browsers."""
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in {"http", "https"} and parts.netloc.lower() == host.lower()


class Guard:
    """Middleware: other sites get 403, and browsers are forbidden to load from other sites."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request or websocket."""
        if scope["type"] not in {"http", "websocket"}:
            return await self._app(scope, receive, send)
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if known_host(host) and same_origin(headers.get("origin"), host):
            return await self._app(scope, receive, _with_policy(send, host))
        # A websocket closed before it is accepted is answered with 403.
        if scope["type"] == "websocket":
            return await send({"type": "websocket.close", "code": 1008})
        plain = [(b"content-type", b"text/plain; charset=utf-8")]
        await send({"type": "http.response.start", "status": 403, "headers": plain})
        text = b"This page is for this machine: open it by the address that the bench printed.\n"
        return await send({"type": "http.response.body", "body": text})


def _with_policy(send: Send, host: str) -> Send:
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
        f"connect-src 'self' ws://{host} wss://{host}; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    added = {
        b"content-security-policy": policy.encode(),
        b"x-content-type-options": b"nosniff",
        b"referrer-policy": b"no-referrer",
        b"cache-control": b"no-cache",
    }

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", ()), *added.items()]}
        await send(message)

    return sending
