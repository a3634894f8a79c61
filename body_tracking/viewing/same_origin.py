"""Protects the viewer from pages of other sites: cross-site websockets and clickjacking.

Browsers let any page open a websocket to any address, including this machine's, with the page's site in ``Origin`` (RFC
6455, section 10.2). viser neither checks it nor has a hook for a check, so its websocket server is patched here. Every
answer also forbids to embed the page in a frame (RFC 7034; Content Security Policy Level 3, section 6.4.2).
"""

from __future__ import annotations

import http
import inspect
import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server

from body_tracking.viewing.snapshot import PageError

_NO_FRAMES = {"X-Frame-Options": "DENY", "Content-Security-Policy": "frame-ancestors 'none'"}


def is_own(origin: str | None, host: str | None) -> bool:
    """Whether a websocket request comes from a page of this server, or not from a browser.

    Args:
        origin: header of the request: scheme, name and port of the requesting page; None for a program.
        host: header of the request: name and port of the requested server.
    """
    if origin is None:
        return True
    try:
        page, server = urlsplit(origin).netloc, urlsplit(f"//{host or ''}")
        name = server.hostname or ""
    except ValueError:  # invalid address in brackets
        return False
    # equal headers do not suffice: a foreign name can be resolved to this machine (DNS rebinding)
    return page.lower() == server.netloc.lower() and _is_mine(name)


def _is_mine(name: str) -> bool:
    """Whether the name is an address or this machine's own name, which no foreign DNS can define."""
    own = socket.gethostname().lower()  # not the full name, whose lookup could block the server
    if name in ("localhost", own, f"{own}.local"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextmanager
def same_origin() -> Iterator[None]:
    """Patch websocket servers that start in this context to refuse other origins with 403, and to forbid frames.

    Raises:
        PageError: no server was started through the patched function.
    """
    serve = websockets.asyncio.server.serve
    guarded = 0

    def guarding(*args: Any, process_request: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        nonlocal guarded
        guarded += 1

        async def check(connection: Any, request: Any) -> Any:
            if "Upgrade" in request.headers and not is_own(request.headers.get("Origin"), request.headers.get("Host")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "a page of another site\n")
            answer = process_request(connection, request) if process_request is not None else None
            if inspect.isawaitable(answer):
                answer = await answer
            if answer is not None:
                for name, value in _NO_FRAMES.items():
                    answer.headers[name] = value
            return answer

        return serve(*args, process_request=check, **kwargs)

    websockets.asyncio.server.serve = guarding  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not guarded:
        raise PageError("this viser serves websockets in a way that cannot be guarded: install another release")
