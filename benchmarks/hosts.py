"""Simulated hosts: network namespaces with a bad link between them, and the clock of another computer.

Uses only the standard library, so that its processes start quickly. As a command:

    hosts.py relay LOSS JITTER PORT...   forward datagrams both ways; reads ``FROM TO`` (wall times of a cut) from stdin
    hosts.py shift SECONDS COMMAND...    run a command with its monotonic clock this much ahead
"""

from __future__ import annotations

import contextlib
import ctypes
import heapq
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

OUTSIDE, RELAY_OUT, RELAY_IN, INSIDE = "10.87.1.2", "10.87.1.1", "10.87.2.1", "10.87.2.2"
"""Addresses of the far host, of the relay on both sides, and of this host."""

_CLONE_NEWTIME = 0x80


def not_permitted() -> str:
    """Why namespaces are not possible here; empty if they are."""
    try:
        probe = ["unshare", *_kinds(), sys.executable, __file__, "shift", "1", "ip", "link"]
        tried = subprocess.run(probe, capture_output=True, text=True, timeout=60, check=False)
    except OSError as error:
        return f"unshare: {error.strerror}"
    return tried.stderr.strip() if tried.returncode else ""


def _kinds() -> list[str]:
    return ["--net"] if os.geteuid() == 0 else ["--net", "--map-root-user"]


def in_own_network(command: Sequence[str]) -> list[str]:
    """The command in its own network namespace."""
    return ["unshare", *_kinds(), *command]


def command(*words: object) -> list[str]:
    """Command line of this file."""
    return [sys.executable, __file__, *(str(word) for word in words)]


@contextlib.contextmanager
def hosts() -> Iterator[tuple[list[str], list[str]]]:
    """Two more hosts, the second between the first and this one; for a process in its own namespace.

    Yields:
        Prefixes of a command that run it on the far host, and on the host between. Both hosts end with this context.
    """
    _ip([], "link set lo up")
    holders = [subprocess.Popen(["unshare", "--net", "sleep", "3600"]) for _ in range(2)]
    try:
        outside, middle = (str(each.pid) for each in holders)
        far, between = (["nsenter", "-t", pid, "-n"] for pid in (outside, middle))
        own, end = Path("/proc/self/ns/net").readlink(), time.monotonic() + 20.0
        while any(Path(f"/proc/{pid}/ns/net").readlink() == own for pid in (outside, middle)):
            if time.monotonic() > end:
                raise SystemExit("hosts: no network namespace")
            time.sleep(0.01)
        _ip([], f"link add inside type veth peer name relay1 netns {middle}")
        _ip(between, f"link add relay0 type veth peer name outside netns {outside}")
        for prefix, name, address in (
            ([], "inside", INSIDE),
            (between, "relay1", RELAY_IN),
            (between, "relay0", RELAY_OUT),
            (far, "outside", OUTSIDE),
        ):
            for words in (f"addr add {address}/24 dev {name}", f"link set {name} up", "link set lo up"):
                _ip(prefix, words)
        yield far, between
    finally:
        for each in holders:
            each.kill()
            each.wait()


def _ip(prefix: Sequence[str], words: str) -> None:
    subprocess.run([*prefix, "ip", *words.split()], check=True, capture_output=True)


def relay(loss: float, jitter: float, ports: Sequence[int]) -> None:
    """Forward datagrams between the far host and the inner one, until stdin ends.

    Args:
        loss: probability of losing a packet.
        jitter: largest delay of a packet, seconds; delays are uniform.
        ports: to which the far host sends.
    """
    numbers = random.Random(1)
    inner: dict[tuple[int, Any], socket.socket] = {}
    ways: dict[socket.socket, tuple[socket.socket, Any]] = {}
    outer: dict[socket.socket, int] = {}
    cut = (0.0, 0.0)
    for port in ports:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind((RELAY_OUT, port))
        outer[made] = port
    waiting: list[tuple[float, int, socket.socket, bytes, Any]] = []
    count = 0
    while True:
        timeout = max(0.0, waiting[0][0] - time.time()) if waiting else 1.0
        for each in select.select([*outer, *ways, sys.stdin], [], [], timeout)[0]:
            if each is sys.stdin:
                line = sys.stdin.readline()
                if not line:
                    return
                begin, end = line.split()
                cut = float(begin), float(end)
                continue
            packet, source = each.recvfrom(65535)
            if each in outer:
                way = outer[each], source
                if way not in inner:
                    inner[way] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                    inner[way].bind((RELAY_IN, 0))
                    ways[inner[way]] = each, source
                through, target = inner[way], (INSIDE, outer[each])
            else:
                through, target = ways[each]
            now = time.time()
            if numbers.random() < loss or cut[0] <= now < cut[1]:
                continue
            count += 1
            heapq.heappush(waiting, (now + numbers.uniform(0.0, jitter), count, through, packet, target))
        while waiting and waiting[0][0] <= time.time():
            _, _, through, packet, target = heapq.heappop(waiting)
            with contextlib.suppress(OSError):
                through.sendto(packet, target)


def shift(seconds: float, words: Sequence[str]) -> int:
    """Run a command with a shifted monotonic clock; returns its exit code."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWTIME):
        raise SystemExit(f"no time namespace: {os.strerror(ctypes.get_errno())}")
    whole, rest = divmod(round(seconds * 1e9), 1_000_000_000)
    Path("/proc/self/timens_offsets").write_text(f"monotonic {whole} {rest}\n")
    process = subprocess.Popen(words)  # only child processes are in the new time namespace
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda got, _: process.send_signal(got))
    return process.wait()


def main() -> int:
    """The command."""
    what, first, *rest = sys.argv[1:]
    if what == "shift":
        return shift(float(first), rest)
    relay(float(first), float(rest[0]), [int(port) for port in rest[1:]])
    return 0


if __name__ == "__main__":
    sys.exit(main())
