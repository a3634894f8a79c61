"""Keeps pages of other sites from pressing the viewer's buttons, and from showing it in a frame of theirs.

Browsers let any page open a websocket to any address, also to one of this machine, and say in ``Origin`` whose page it
is (RFC 6455, section 10.2). viser does not look at it, and has no place to put a look in: so the server that it makes
is given one here. What is shown in a frame of another page can be laid under what people press there (clickjacking), so
every answer forbids that, too (RFC 7034; Content Security Policy Level 3, section 6.4.2).
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
    """Whether a websocket is asked for by a page that this server has served, or by no browser at all.

    Args:
        origin: header of the request: scheme, name and port of whose page asks; None where no page does.
        host: header of the request: name and port of who is asked.
    """
    if origin is None:
        return True
    try:
        asking, asked = urlsplit(origin).netloc, urlsplit(f"//{host or ''}")
        name = asked.hostname or ""
    except ValueError:  # brackets that hold no address
        return False
    # a name that somebody else's DNS makes this machine's address of would be the same in both headers
    return asking.lower() == asked.netloc.lower() and _is_mine(name)


def _is_mine(name: str) -> bool:
    """Whether a name cannot be somebody else's: an address, or what this machine calls itself."""
    own = socket.gethostname().lower()  # no longer name: to look that up would hold the server up
    if name in ("localhost", own, f"{own}.local"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextmanager
def same_origin() -> Iterator[None]:
    """Websocket servers that begin meanwhile refuse the pages of others, with 403, and frames in pages of others.

    Raises:
        PageError: none began in the way that is known here.
    """
    serve = websockets.asyncio.server.serve
    guarded = 0

    def guarding(*args: Any, process_request: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        nonlocal guarded
        guarded += 1

        async def look(connection: Any, request: Any) -> Any:
            if "Upgrade" in request.headers and not is_own(request.headers.get("Origin"), request.headers.get("Host")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "a page of another site\n")
            answer = process_request(connection, request) if process_request is not None else None
            if inspect.isawaitable(answer):
                answer = await answer
            if answer is not None:
                for name, value in _NO_FRAMES.items():
                    answer.headers[name] = value
            return answer

        return serve(*args, process_request=look, **kwargs)

    websockets.asyncio.server.serve = guarding  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not guarded:
        raise PageError("this viser serves websockets in a way that cannot be guarded: install another release")
