"""The server of a page: viser on an address of this machine, for pages of its own only."""

from __future__ import annotations

import logging
import socket
import threading
from contextlib import redirect_stdout
from io import StringIO
from typing import Final

import viser

from body_tracking.viewing.colours import PALETTE
from body_tracking.viewing.same_origin import same_origin
from body_tracking.viewing.snapshot import PageError

_STOP_S: Final = 2.0
"""Time limit for stopping the server, seconds."""


def serve(host: str, port: int) -> viser.ViserServer:
    """A server on the first free port from ``port`` on; 0 for any.

    Raises:
        PageError: the address is not one of this machine, or the same-origin check could not be installed.
    """
    try:  # viser would try port after port forever
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise PageError(f"host {host!r}: cannot listen there ({error.strerror or error})") from error
    with same_origin(), redirect_stdout(StringIO()):  # viser prints a banner
        server = viser.ViserServer(host, port, label="body_tracking", verbose=False)
    # it prints a traceback for each request of a proxy or a scanner that is no page and no websocket
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=PALETTE[0])
    return server


def address_of(server: viser.ViserServer) -> str:
    """URL of the page."""
    host = server.get_host()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def stop(server: viser.ViserServer) -> None:
    """Stop serving; a server that does not stop in time is abandoned, its threads are daemons."""
    with redirect_stdout(StringIO()):
        stopping = threading.Thread(target=server.stop, daemon=True)
        stopping.start()
        stopping.join(_STOP_S)
