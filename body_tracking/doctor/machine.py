"""The machine: processors, memory, clock, shared memory, network buffers and ports. Linux."""

from __future__ import annotations

import ctypes
import os
import platform
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from body_tracking.doctor.finding import OK, PROBLEM, WARNING, Finding

PYTHON = (3, 11)
"""The oldest that the package runs on."""
MEMORY_MB, COMFORT_MB = 600, 1500
"""What the graph of two sensors takes (measured: 470 MB by PSS), and what leaves room beside it."""
STEAL = 0.1
"""Share of the processors' time that the host may keep before it shows as delay."""
MISSING_NS = 5_000_000
"""By so much the wall clock may move against the steady one while we look: NTP slews it by 0.5 ms a second."""
RMEM_MAX = 212_992
"""Linux's own default."""
ENOUGH = 4_194_304
"""What the makers of DDS recommend."""
SHM_MB = 16
"""Fast DDS takes 0.5 MB of shared memory per process."""
PARTICIPANTS = 32
"""With the range LOCALHOST rmw_fastrtps looks at so many participants of a machine."""

_PROC = Path("/proc")
_UNSYNCHRONISED = 0x40
_DOMAIN_PORTS, _FIRST_PORT, _UNICAST = 250, 7400, 10


# --- processors and memory


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The system's counters at one time.

    Attributes:
        total: seconds of all processors so far, in ticks.
        stolen: those of them that the host kept.
        dropped: UDP datagrams that found their receiver's buffer full.
        wall_ns: the wall clock less the steady one.
    """

    total: int
    stolen: int
    dropped: int
    wall_ns: int


def snapshot() -> Snapshot:
    """Now."""
    ticks = [int(word) for word in (_PROC / "stat").read_text().split("\n", 1)[0].split()[1:9]]
    names, values = [
        line.split() for line in (_PROC / "net" / "snmp").read_text().splitlines() if line.startswith("Udp:")
    ]
    dropped = int(values[names.index("RcvbufErrors")])
    return Snapshot(sum(ticks), ticks[7], dropped, time.time_ns() - time.monotonic_ns())


def machine(before: Snapshot, after: Snapshot) -> Iterator[Finding]:
    """Processors, memory and Python.

    Args:
        before: some seconds ago.
        after: now.
    """
    version = platform.python_version()
    if sys.version_info < PYTHON:
        yield Finding("python", PROBLEM, f"Python {version}", f"install Python {PYTHON[0]}.{PYTHON[1]} or newer")
    else:
        yield Finding("python", OK, f"Python {version} ({sys.executable})")
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    text = f"{cores} cores, load average {load:.1f}"
    if cores < 2:
        yield Finding("cores", WARNING, text, "the graph is six processes: give it 2 cores at least")
    elif load > cores:
        yield Finding(
            "cores", WARNING, f"{text}: more work than cores", "see what else runs: top; frames are lost or late by it"
        )
    else:
        yield Finding("cores", OK, text)
    share = (after.stolen - before.stolen) / max(1, after.total - before.total)
    text = f"the host keeps {100.0 * share:.0f} % of the processors' time"
    if share > STEAL:
        yield Finding("steal", WARNING, text, "a virtual machine on a busy host: expect delays that are not ours")
    else:
        yield Finding("steal", OK, text)
    yield memory(_available_mb())


def memory(available_mb: float) -> Finding:
    """Whether the graph fits into what is free."""
    text = f"{available_mb:.0f} MB of memory available"
    if available_mb < MEMORY_MB:
        return Finding("memory", PROBLEM, text, f"end something: the graph takes some {MEMORY_MB} MB")
    if available_mb < COMFORT_MB:
        return Finding("memory", WARNING, text, f"the graph takes some {MEMORY_MB} MB; little is left for the rest")
    return Finding("memory", OK, text)


def _available_mb() -> float:
    rows = (line.split() for line in (_PROC / "meminfo").read_text().splitlines())
    return next(int(row[1]) for row in rows if row[0] == "MemAvailable:") / 1024.0


# --- clock


class _Timex(ctypes.Structure):
    """``struct timex`` of adjtimex(2); what follows ``status`` is not looked at."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def synchronised() -> tuple[bool, float] | None:
    """Whether the kernel's clock is kept by NTP or PTP, and its greatest error, seconds; None where it does not say."""
    timex = _Timex()
    adjtimex = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    if adjtimex is None or adjtimex(ctypes.byref(timex)) < 0:
        return None
    return not timex.status & _UNSYNCHRONISED, timex.maxerror / 1e6


def clock(before: Snapshot, after: Snapshot) -> Iterator[Finding]:
    """Synchronisation, jumps and resolution of the wall clock."""
    kept = synchronised()
    if kept is None:
        yield Finding("clock", WARNING, "the kernel does not say whether the clock is synchronised", "timedatectl")
    elif not kept[0]:
        yield Finding(
            "clock",
            WARNING,
            "the clock is not synchronised",
            "on one machine that does no harm; with sensors on several: sudo timedatectl set-ntp true",
        )
    else:
        yield Finding("clock", OK, f"synchronised; its error is at most {1e3 * kept[1]:.0f} ms")
    moved = after.wall_ns - before.wall_ns
    if abs(moved) > MISSING_NS:
        yield Finding(
            "clock",
            WARNING,
            f"the clock jumped by {moved / 1e6:+.1f} ms while we looked",
            "something sets it: see journalctl -u systemd-timesyncd -u chrony; a jump of 1 s restarts the estimates",
        )
    resolution = time.clock_getres(time.CLOCK_REALTIME)
    if resolution > 1e-3:
        yield Finding("clock", WARNING, f"resolution {1e3 * resolution:g} ms", "stamps are as coarse as this")
    else:
        yield Finding("clock", OK, f"no jump, resolution {1e9 * resolution:g} ns")


# --- shared memory, network


def shared_memory(folder: Path = Path("/dev/shm")) -> Finding:
    """Whether Fast DDS can make its segments there."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix="body_tracking_doctor_") as file:
            file.write(b"\0" * 4096)
            file.flush()
        status = os.statvfs(folder)
    except OSError as error:
        return Finding(
            "shared memory",
            PROBLEM,
            f"{folder} cannot be written ({error.strerror})",
            "export FASTDDS_BUILTIN_TRANSPORTS=UDPv4, or in a container: --ipc=host",
        )
    free_mb = status.f_bavail * status.f_frsize / 2**20
    left = sum(1 for path in folder.glob("fastrtps_*"))
    text = f"{folder} is writable, {free_mb:.0f} MB free, {left} files of Fast DDS"
    if free_mb < SHM_MB:
        return Finding("shared memory", WARNING, text, "fastdds shm clean, or in a container: --shm-size=256m")
    return Finding("shared memory", OK, text)


def multicast(interface: str = "127.0.0.1") -> bool:
    """Whether a multicast datagram comes back on an interface; an empty address is the one that the system chooses."""
    group = "239.255.0.1"
    address = socket.inet_aton(interface) if interface else struct.pack("=I", socket.INADDR_ANY)
    try:
        with (
            closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as receiver,
            closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender,
        ):
            receiver.bind(("", 0))
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + address)
            receiver.settimeout(0.5)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, address)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            token = os.urandom(16)
            sender.sendto(token, (group, receiver.getsockname()[1]))
            return receiver.recv(64) == token
    except OSError:
        return False


def buffers(before: Snapshot, after: Snapshot) -> Finding:
    """UDP receive buffers."""
    size = int((_PROC / "sys" / "net" / "core" / "rmem_max").read_text())
    text = f"net.core.rmem_max is {size} bytes"
    remedy = f"sudo sysctl -w net.core.rmem_max={ENOUGH}" if size < ENOUGH else "somebody is held up: see top"
    dropped = after.dropped - before.dropped
    if dropped > 0:
        return Finding(
            "udp buffers", WARNING, f"{dropped} datagrams found a full buffer while we looked; {text}", remedy
        )
    if size < RMEM_MAX:
        return Finding("udp buffers", WARNING, f"{text}, less than usual", remedy)
    return Finding("udp buffers", OK, f"{text}, no datagram dropped while we looked")


def ports(domain: int, local: bool) -> Iterator[Finding]:
    """The UDP ports of a ROS domain.

    Args:
        domain: its number.
        local: discovery stays on this machine.
    """
    first = _FIRST_PORT + _DOMAIN_PORTS * domain
    if first + _DOMAIN_PORTS > 65536:
        return  # the environment's check has said so
    taken = _udp_ports()
    participants = sum(first + _UNICAST + 2 * k in taken for k in range((_DOMAIN_PORTS - _UNICAST) // 2))
    text = f"domain {domain}: UDP ports {first} to {first + _DOMAIN_PORTS - 1}, {participants} participants here"
    ours = _ephemeral()
    if local and participants >= PARTICIPANTS:
        yield Finding(
            "ports",
            PROBLEM,
            f"{text}; with the range LOCALHOST only {PARTICIPANTS} find each other",
            "end nodes that are left over, or choose another ROS_DOMAIN_ID",
        )
    elif first + _DOMAIN_PORTS > ours[0] and first < ours[1]:
        yield Finding(
            "ports",
            WARNING,
            f"{text}; the system gives these to others too ({ours[0]} to {ours[1]})",
            "choose a ROS_DOMAIN_ID from 0 to 101",
        )
    else:
        yield Finding("ports", OK, text)


def _udp_ports() -> set[int]:
    lines = [
        line
        for name in ("udp", "udp6")
        if (_PROC / "net" / name).exists()
        for line in (_PROC / "net" / name).read_text().splitlines()[1:]
    ]
    return {int(line.split()[1].rpartition(":")[2], 16) for line in lines}


def _ephemeral() -> tuple[int, int]:
    low, high = (_PROC / "sys" / "net" / "ipv4" / "ip_local_port_range").read_text().split()
    return int(low), int(high)
