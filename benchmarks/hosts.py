"""Hosts that are none: network namespaces with a bad link between them, and a clock of another computer.

Knows only the standard library, so that its processes start at once. As a command:

    hosts.py relay LOSS JITTER PID      link this host with that of a process; reads ``FROM TO`` (wall times of a cut)
                                        on stdin, and ends with it
    hosts.py shift SECONDS COMMAND...   run a command whose monotonic clock is so far ahead
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import heapq
import os
import random
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

OUTSIDE, INSIDE = "10.87.1.2", "10.87.1.1"
"""Addresses of the far host and of this one."""

_CLONE_NEWNET, _TUNSETIFF, _TUN_WITHOUT_INFO = 0x40000000, 0x400454CA, 0x1001
_CLONE_NEWTIME = 0x80


def not_permitted() -> str:
    """Why there can be no namespaces here; empty where there can."""
    try:
        probe = ["unshare", *_kinds(), sys.executable, __file__, "shift", "1", "ip", "link"]
        tried = subprocess.run(probe, capture_output=True, text=True, timeout=60, check=False)
    except OSError as error:
        return f"unshare: {error.strerror}"
    return tried.stderr.strip() if tried.returncode else ""


def _kinds() -> list[str]:
    return ["--net"] if os.geteuid() == 0 else ["--net", "--map-root-user"]


def in_own_network(command: Sequence[str]) -> list[str]:
    """The command in a network namespace of its own."""
    return ["unshare", *_kinds(), *command]


def command(*words: object) -> list[str]:
    """This file as a command."""
    return [sys.executable, __file__, *(str(word) for word in words)]


@contextlib.contextmanager
def hosts(loss: float, jitter: float) -> Iterator[tuple[list[str], subprocess.Popen[bytes]]]:
    """Another host and a link to it; for a process in a namespace of its own.

    Args:
        loss: probability that a packet is lost.
        jitter: seconds by which a packet is held up at most; the times are uniform.

    Yields:
        What to put before a command to run it on the far host, and the relay between, which takes the times of a cut.
        Both end with this.
    """
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    holder = subprocess.Popen(["unshare", "--net", "sleep", "3600"])
    between = None
    try:
        own, end = Path("/proc/self/ns/net").readlink(), time.monotonic() + 20.0
        while Path(f"/proc/{holder.pid}/ns/net").readlink() == own:
            if time.monotonic() > end:
                raise SystemExit("hosts: no network namespace")
            time.sleep(0.01)
        between = subprocess.Popen(
            command("relay", loss, jitter, holder.pid), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert between.stdout is not None
        if not between.stdout.readline():
            raise SystemExit("hosts: no link")
        yield ["nsenter", "-t", str(holder.pid), "-n"], between
    finally:
        for each in filter(None, (between, holder)):
            each.kill()
            each.wait()


def relay(loss: float, jitter: float, far: int) -> None:
    """Pass IP packets on between this host and that of a process, until stdin ends; see :func:`hosts`."""
    numbers, cut = random.Random(1), (0.0, 0.0)
    inside = _interface("inside", INSIDE)
    with Path(f"/proc/{far}/ns/net").open() as namespace:
        if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), _CLONE_NEWNET):
            raise SystemExit(f"no network namespace: {os.strerror(ctypes.get_errno())}")
    other_end = {inside: (outside := _interface("outside", OUTSIDE)), outside: inside}
    print("linked", flush=True)
    listened: list[Any] = [*other_end, sys.stdin]
    waiting: list[tuple[float, int, int, bytes]] = []
    count = 0
    while True:
        timeout = max(0.0, waiting[0][0] - time.time()) if waiting else 1.0
        for each in select.select(listened, [], [], timeout)[0]:
            if each is sys.stdin:
                line = sys.stdin.readline()
                if not line:
                    return
                begin, end = line.split()
                cut = float(begin), float(end)
                continue
            packet, now = os.read(each, 65535), time.time()
            if numbers.random() < loss or cut[0] <= now < cut[1]:
                continue
            count += 1
            heapq.heappush(waiting, (now + numbers.uniform(0.0, jitter), count, other_end[each], packet))
        while waiting and waiting[0][0] <= time.time():
            _, _, through, packet = heapq.heappop(waiting)
            with contextlib.suppress(OSError):
                os.write(through, packet)


def _interface(name: str, address: str) -> int:
    """A network interface of the present namespace whose packets this process reads and writes."""
    made = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(made, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _TUN_WITHOUT_INFO))
    for words in (f"addr add {address}/24 dev {name}", f"link set {name} up", "link set lo up"):
        subprocess.run(["ip", *words.split()], check=True)
    return made


def shift(seconds: float, words: Sequence[str]) -> int:
    """Run a command whose monotonic clock is shifted; its exit code."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWTIME):
        raise SystemExit(f"no time namespace: {os.strerror(ctypes.get_errno())}")
    whole, rest = divmod(round(seconds * 1e9), 1_000_000_000)
    Path("/proc/self/timens_offsets").write_text(f"monotonic {whole} {rest}\n")
    process = subprocess.Popen(words)  # only children are in the new namespace
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda got, _: process.send_signal(got))
    return process.wait()


def main() -> int:
    """The command."""
    what, first, *rest = sys.argv[1:]
    if what == "shift":
        return shift(float(first), rest)
    relay(float(first), float(rest[0]), int(rest[1]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
