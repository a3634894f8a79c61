"""The viewer accepts its own pages and programs without an origin; it refuses pages of another site."""

from __future__ import annotations

import socket
import urllib.request
from collections.abc import Iterator
from contextlib import redirect_stdout
from io import StringIO

import pytest

pytest.importorskip("viser", reason="viser is not installed")

import viser
import websockets.asyncio.server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from body_tracking.viewing.same_origin import is_own, same_origin
from body_tracking.viewing.snapshot import PageError


@pytest.mark.parametrize(
    ("origin", "host", "own"),
    [
        (None, "127.0.0.1:8080", True),  # a program, no browser
        ("http://127.0.0.1:8080", "127.0.0.1:8080", True),
        ("http://localhost:8080", "localhost:8080", True),
        ("http://LOCALHOST:8080", "localhost:8080", True),
        ("http://[::1]:8080", "[::1]:8080", True),
        ("http://192.168.1.7:8080", "192.168.1.7:8080", True),
        (f"http://{socket.gethostname()}:8080", f"{socket.gethostname()}:8080", True),
        ("https://example.com", "127.0.0.1:8080", False),
        ("http://127.0.0.1:8000", "127.0.0.1:8080", False),  # another server of this machine
        ("http://localhost:8080", "127.0.0.1:8080", False),
        ("http://example.com:8080", "example.com:8080", False),  # a foreign name that resolves to this machine
        ("http://127.0.0.1.example.com:8080", "127.0.0.1.example.com:8080", False),
        ("null", "127.0.0.1:8080", False),  # a file, or a frame in a sandbox
        ("", "127.0.0.1:8080", False),
        ("http://[::1", "127.0.0.1:8080", False),
        ("http://127.0.0.1:8080", None, False),
    ],
)
def test_origin_is_compared_with_host(origin: str | None, host: str | None, own: bool) -> None:
    assert is_own(origin, host) == own


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with same_origin(), redirect_stdout(StringIO()):
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server.get_port()
    with redirect_stdout(StringIO()):
        server.stop()


def handshake(port: int, origin: str | None) -> int:
    """The status of a websocket's handshake."""
    try:
        with connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=["viser-v0"]):  # type: ignore[arg-type, list-item]
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_the_server_refuses_the_handshake_of_another_sites_page(port: int) -> None:
    assert handshake(port, "https://example.com") == 403
    assert handshake(port, f"http://127.0.0.1:{port}") == 101
    assert handshake(port, None) == 101


def test_no_page_of_another_site_may_show_it_in_a_frame(port: int) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10.0) as answer:
        assert answer.status == 200
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"


def test_servers_started_afterwards_are_not_patched() -> None:
    serve = websockets.asyncio.server.serve
    with pytest.raises(PageError, match="cannot be guarded"), same_origin():
        pass
    assert websockets.asyncio.server.serve is serve
