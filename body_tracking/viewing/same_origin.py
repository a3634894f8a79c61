"""Keeps pages of other sites from pressing the viewer's buttons.

Browsers let any page open a websocket to any address, also to one of this machine, and say in ``Origin`` whose page it
is (RFC 6455, section 10.2). viser does not look at it, and has no place to put a look in: so the server that it makes
is given one here.
"""

from __future__ import annotations

import http
import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server

from body_tracking.viewing.snapshot import PageError


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
    """Websocket servers that begin meanwhile refuse the pages of others, with 403.

    Raises:
        PageError: none began in the way that is known here.
    """
    serve = websockets.asyncio.server.serve
    guarded = 0

    def guarding(*args: Any, process_request: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        nonlocal guarded
        guarded += 1

        def look(connection: Any, request: Any) -> Any:
            if "Upgrade" in request.headers and not is_own(request.headers.get("Origin"), request.headers.get("Host")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "a page of another site\n")
            return process_request(connection, request) if process_request is not None else None

        return serve(*args, process_request=look, **kwargs)

    websockets.asyncio.server.serve = guarding  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not guarded:
        raise PageError("this viser serves websockets in a way that cannot be guarded: install another release")
