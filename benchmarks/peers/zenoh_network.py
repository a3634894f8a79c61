"""The network source beside a prototype over Eclipse Zenoh: TLS, or QUIC with frames in datagrams, both with mutual
certificates. Needs root (network namespaces), openssl, and a Python with ``eclipse-zenoh`` beside this package.

    benchmarks/peers/zenoh_network.py link LOSS SECONDS CUT...  # delay, loss, clock; recovery from cuts of so many s
    benchmarks/peers/zenoh_network.py restart                   # sender, then receiver are started anew
    benchmarks/peers/zenoh_network.py hostile TRANSPORT [ATTACK]... # strangers on the same computer

All three transports run at the same time over the same link and carry the same frames at 30 Hz: the layout of
``kinect_protocol``, with the same clock estimate. Docs: docs/several_hosts.md.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # as a file run in another namespace

import hosts

from body_tracking.sensors import RecordedFrame, optical_frame
from body_tracking.sensors import kinect_protocol as protocol
from body_tracking.sensors.kinect_protocol import Body, ClockTimes, Frame, Header
from body_tracking.sensors.kinect_sender import Sender, make_key
from body_tracking.sensors.live import SourceSettings
from body_tracking.sensors.network import NetworkSource, ReceivedFrame, skeleton_of
from body_tracking.sensors.remote_clock import CaptureClock, RoundTrips

KINDS = ("own", "tls", "quic")
PORTS = dict(zip(KINDS, (7525, 7526, 7527), strict=True))
RATE, SENSOR = 30.0, "kinect1"
SHIFT = 0.3
"""Seconds between the two clocks."""


# --- the prototype


def configuration(kind: str, host: str, port: int, folder: Path, listening: bool) -> Any:
    """A Zenoh session that knows one link, and takes only who has a certificate of the folder's authority."""
    import zenoh

    endpoint = f"{kind}/{host}:{port}" + ("?mixed_rel=1" if kind == "quic" else "")
    who = "receiver" if listening else "sender"
    tls: dict[str, object] = {"root_ca_certificate": str(folder / "ca.pem"), "enable_mtls": True}
    for way in ("listen", "connect"):
        tls |= {f"{way}_certificate": str(folder / f"{who}.pem"), f"{way}_private_key": str(folder / f"{who}.key")}
    values: dict[str, object] = {
        "mode": "peer" if listening else "client",
        "listen/endpoints": [endpoint] if listening else [],
        "connect/endpoints": [] if listening else [endpoint],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 250, "period_max_ms": 500, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/protocols": [kind],
        "transport/link/tls": tls,
    }
    made = zenoh.Config()
    for name, value in values.items():
        made.insert_json5(name, json.dumps(value))
    return made


class ZenohSender:
    """Publishes frames and answers clock queries."""

    def __init__(self, kind: str, host: str, port: int, folder: Path) -> None:
        import zenoh

        self._random, self._sequence = random.getrandbits(64), 0
        self._session = zenoh.open(configuration(kind, host, port, folder, False))
        how = {"express": True, "priority": zenoh.Priority.REAL_TIME}
        self._frames = self._session.declare_publisher(
            f"{SENSOR}/frame",
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.BEST_EFFORT,
            **how,
        )
        self._clock = self._session.declare_queryable(f"{SENSOR}/clock", self._answer)

    def _answer(self, query: Any) -> None:
        received_ns = time.perf_counter_ns()
        asked_ns = int.from_bytes(query.payload.to_bytes(), "little")
        header = Header(protocol.CLOCK_ANSWER, SENSOR, self._random, 0, 0)
        times = ClockTimes(asked_ns, received_ns, time.perf_counter_ns())
        query.reply(f"{SENSOR}/clock", protocol.pack_clock(times, header, protocol.NO_KEY), express=True)

    def send(self, frame: Frame) -> None:
        self._sequence += 1
        header = Header(protocol.FRAME, SENSOR, self._random, self._sequence, time.perf_counter_ns())
        self._frames.put(protocol.pack_frame(frame, header, protocol.NO_KEY))

    def close(self) -> None:
        self._session.close()


class ZenohSource:
    """Takes frames of the sender that answers; as :class:`NetworkSource`."""

    def __init__(self, kind: str, host: str, port: int, folder: Path) -> None:
        import zenoh

        self._came: deque[tuple[bytes, int, int]] = deque(maxlen=8)
        self._any = threading.Event()
        self._next_ask_ns = self._asked = self._alive = self._newest = 0
        self._trips, self._clock = RoundTrips(), CaptureClock()
        self._zenoh, self._session = zenoh, zenoh.open(configuration(kind, host, port, folder, True))
        self._subscriber = self._session.declare_subscriber(f"{SENSOR}/frame", lambda sample: self._take(sample))

    def _take(self, sample: Any) -> None:
        self._came.append((sample.payload.to_bytes(), time.monotonic_ns(), time.time_ns()))
        self._any.set()

    def _ask(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns < self._next_ask_ns:
            return
        self._next_ask_ns = now_ns + (50_000_000 if self._asked < 20 else 250_000_000)
        self._session.get(
            f"{SENSOR}/clock",
            lambda reply: self._take(reply.ok) if reply.ok is not None else None,
            payload=now_ns.to_bytes(8, "little"),
            timeout=2.0,
            express=True,
            priority=self._zenoh.Priority.REAL_TIME,
        )

    def read(self, timeout: float) -> RecordedFrame | None:
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            self._ask()
            if not self._came:
                self._any.clear()
                self._any.wait(min(0.05, timeout))
                continue
            packet, now_ns, wall_ns = self._came.popleft()
            header = protocol.read_header(packet)
            if header.kind == protocol.CLOCK_ANSWER:
                if header.session != self._alive:
                    self._alive, self._newest, self._asked = header.session, 0, 0
                    self._trips, self._clock = RoundTrips(), CaptureClock()
                self._asked += 1
                self._trips.add(*protocol.read_clock(packet), now_ns)
            elif header.session == self._alive and header.sequence > self._newest:
                self._newest = header.sequence
                frame = protocol.read_frame(packet)
                offset_ns = self._trips.offset_ns(header.sent_ns) + wall_ns - now_ns
                received = ReceivedFrame(frame, self._clock.stamp(frame.time_ns, header.sent_ns, offset_ns))
                name = optical_frame(SENSOR)
                skeletons = tuple(skeleton_of(body, received.stamp_ns, name) for body in frame.bodies)
                return RecordedFrame(SENSOR, wall_ns, skeletons)
        return None


def make_certificates(folder: Path) -> None:
    """An authority, and a certificate for either side."""

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    openssl("req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.pem", "-days", "3650", "-subj", "/CN=lab")
    names = f"subjectAltName=IP:127.0.0.1,IP:{hosts.INSIDE},IP:{hosts.OUTSIDE}\nextendedKeyUsage=serverAuth,clientAuth"
    (folder / "names").write_text(names)
    for name in ("receiver", "sender"):
        openssl("req", *key, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        authority = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "3650", "-extfile", "names")
        openssl("x509", "-req", "-in", f"{name}.csr", "-out", f"{name}.pem", *authority)


# --- the two processes


def body(index: int) -> Body:
    """Somebody whose first coordinate counts frames."""
    positions = tuple((1e-4 * (index % 40_000), 0.02 * k, 2.0) for k in range(protocol.N_JOINTS))
    return Body(0, 1, positions, (2,) * protocol.N_JOINTS, ((0.0, 0.0, 0.0, 1.0),) * protocol.N_JOINTS)


def send(kind: str, host: str, first: int, folder: Path, out: Path) -> None:
    """Until SIGINT: a frame each thirtieth of a second; then when each was sent, by the wall."""
    rows = []
    print("started", flush=True)
    began = time.time()
    sender: Any = (
        Sender(SENSOR, host, PORTS[kind], protocol.read_key(str(folder / "key")))
        if kind == "own"
        else ZenohSender(kind, host, PORTS[kind], folder)
    )
    index, due = first, time.monotonic()
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            due += 1.0 / RATE
            time.sleep(max(0.0, due - time.monotonic()))
            rows.append((index, time.time_ns()))
            sender.send(Frame(time.perf_counter_ns(), (body(index),)))
            index += 1
    _report(out, rows, began)


def receive(kind: str, host: str, folder: Path, out: Path) -> None:
    """Until SIGINT; then number, stamp, receipt of each frame, by the wall."""
    rows = []
    began = time.time()
    settings = SourceSettings(SENSOR, address=host, port=PORTS[kind], key_file=str(folder / "key"))
    source: Any = NetworkSource(settings) if kind == "own" else ZenohSource(kind, host, PORTS[kind], folder)
    print("listening", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            frame = source.read(0.5)
            if frame is not None:
                (skeleton,) = frame.skeletons
                rows.append((round(1e4 * abs(skeleton.positions[0, 0])), skeleton.stamp_ns, time.time_ns()))
    _report(out, rows, began)


def _report(out: Path, rows: Sequence[tuple[int, ...]], began: float) -> None:
    used = resource.getrusage(resource.RUSAGE_SELF)
    result = {"rows": rows, "began": began, "cpu_s": used.ru_utime + used.ru_stime, "s": time.time() - began}
    out.write_text(json.dumps(result))
    os._exit(0)  # a session whose link is cut takes its time to close


class Pair:
    """A sender and a receiver of a transport, as processes."""

    def __init__(self, kind: str, folder: Path, far: Sequence[str] | None) -> None:
        self.kind, self.folder, self.far = kind, folder, far
        self.host = "127.0.0.1" if far is None else hosts.INSIDE
        self.sent: list[Any] = []
        self.received: list[Any] = []
        self.first = 0
        self.start_receiver()
        self.start_sender()

    def _start(self, name: str, before: Sequence[str], *words: object) -> subprocess.Popen[bytes]:
        command = [*before, sys.executable, __file__, name, self.kind, self.host, *map(str, words)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(Path.cwd())})

    def start_receiver(self) -> None:
        self.receiver = self._start("receive", [], self.folder, self.folder / f"{self.kind}.received")
        self.receiver.stdout.readline()  # type: ignore[union-attr]

    def start_sender(self) -> None:
        before = [] if self.far is None else [*self.far, *hosts.command("shift", SHIFT)]
        self.sender = self._start("send", before, self.first, self.folder, self.folder / f"{self.kind}.sent")
        self.sender.stdout.readline()  # type: ignore[union-attr]
        self.first += 10_000

    def stop(self, name: str) -> dict[str, Any]:
        """End one of the two; its report."""
        process, file = (self.sender, "sent") if name == "sender" else (self.receiver, "received")
        path = self.folder / f"{self.kind}.{file}"
        path.unlink(missing_ok=True)
        process.send_signal(signal.SIGINT)
        try:
            process.wait(10.0)
            report: dict[str, Any] = json.loads(path.read_text())
        except (subprocess.TimeoutExpired, FileNotFoundError):  # it still waits for a connection
            process.kill()
            report = {"rows": [], "began": None, "cpu_s": 0.0, "s": 0.0}
        getattr(self, file).append(report)
        return report

    def memory(self) -> float:
        """Of the receiver, MB."""
        status = Path(f"/proc/{self.receiver.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1e3

    def figures(self, watch: Watch, cuts: Sequence[tuple[float, float]]) -> dict[str, Any]:
        """Loss, delay and clock from three seconds after the start on, beside cuts and stalls of the machine."""
        sent = np.array([row for each in self.sent for row in each["rows"]], dtype=np.int64)
        rows = np.array([row for each in self.received for row in each["rows"]], dtype=np.int64).reshape(-1, 3)

        def use(wall_ns: Any) -> Any:
            wall = wall_ns / 1e9
            good = (wall > sent[0, 1] / 1e9 + 3.0) & (wall < sent[-1, 1] / 1e9 - 1.0)
            for begin, end in cuts:
                good &= (wall < begin - 0.1) | (wall > end + 3.0)
            for begin, end in watch.stalls:
                good &= (wall < begin) | (wall > end)
            return good

        by_index = dict(sent.tolist())
        when = np.array([by_index[index] for index in rows[:, 0]], dtype=np.int64)
        good = use(when)
        delay = (rows[good, 2] - when[good]) / 1e6
        error = (rows[good, 1] - when[good]) / 1e6
        count = int(use(sent[:, 1]).sum())
        return {
            "frames": count,
            "lost_percent": round(100.0 * (1.0 - good.sum() / count), 2),
            "delay_ms": [round(float(np.percentile(delay, q)), 2) for q in (50, 99, 100)],
            "later_than_33_ms_percent": round(100.0 * float((delay > 33.3).mean()), 2),
            "clock_error_ms": [round(float(np.percentile(error, q)), 3) for q in (50, 1, 99)],
            "cpu_percent": {
                name: round(100.0 * sum(each["cpu_s"] for each in of) / sum(each["s"] for each in of), 1)
                for name, of in (("sender", self.sent), ("receiver", self.received))
            },
            "first_frames_after_cuts_s": [
                round(float(rows[rows[:, 2] > end * 1e9, 2].min()) / 1e9 - end, 2) for _, end in cuts
            ],
            # frames that waited for the end of a cut say where somebody was, not where he is
            "stale_after_cuts": [int(((when < end * 1e9) & (rows[:, 2] > end * 1e9)).sum()) for _, end in cuts],
        }


@contextlib.contextmanager
def pairs(kinds: Sequence[str], far: Sequence[str] | None) -> Iterator[list[Pair]]:
    """One of each, that stream for a second."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_certificates(folder)
        with contextlib.redirect_stdout(sys.stderr):
            make_key(str(folder / "key"))
        made = [Pair(kind, folder, far) for kind in kinds]
        try:
            yield made
        finally:
            for each in made:
                for process in (each.sender, each.receiver):
                    process.kill()
                    process.wait()


# --- what is measured


class Watch(threading.Thread):
    """Finds when the machine stands still for everybody: this process wakes up more than 10 ms late.

    Attributes:
        stalls: wall times between which frames do not count, from the stall until half a second later.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.stalls: list[tuple[float, float]] = []
        self.late_ms: list[float] = []
        self.start()

    def run(self) -> None:
        while True:
            before = time.time()
            time.sleep(0.01)
            after = time.time()
            self.late_ms.append(1e3 * (after - before - 0.01))
            if after - before > 0.02:
                self.stalls.append((before - 0.1, after + 0.5))

    def figures(self) -> dict[str, Any]:
        late = [round(float(np.percentile(self.late_ms, q)), 2) for q in (50, 99, 100)]
        return {"woken_late_ms": late, "stalls": len(self.stalls), "load": os.getloadavg()[0]}


def link(loss: str = "0", seconds: str = "20", *lengths: str) -> dict[str, Any]:
    """The three at once over a link that loses so many packets, percent, then cuts of it."""
    with hosts.hosts(float(loss) / 100.0, 0.002) as (far, relay), pairs(KINDS, far) as made:
        time.sleep(4.0)
        watch = Watch()
        time.sleep(float(seconds))
        cuts = []
        for length in map(float, lengths):
            cuts.append((begin := time.time() + 0.5, begin + length))
            relay.stdin.write(f"{begin} {begin + length}\n".encode())  # type: ignore[union-attr]
            relay.stdin.flush()  # type: ignore[union-attr]
            time.sleep(length + 8.0 + random.random())
        result = {"machine": watch.figures(), "loss": loss, "cuts": lengths}
        for pair in made:
            pair.stop("sender")
            pair.stop("receiver")
        return result | {pair.kind: pair.figures(watch, cuts) for pair in made}


def restart() -> dict[str, Any]:
    """Seconds from the start of a process until its first frame, which is the time of its imports and of a session."""
    result: dict[str, Any] = {}
    with hosts.hosts(0.01, 0.002) as (far, _), pairs(KINDS, far) as made:
        time.sleep(5.0)
        watch = Watch()
        for name in ("sender", "sender", "sender", "receiver", "receiver", "receiver"):
            for pair in made:
                pair.stop(name)
                getattr(pair, f"start_{name}")()
            time.sleep(10.0)
        for pair in made:
            pair.stop("sender")
            pair.stop("receiver")
            rows = np.array([row for each in pair.received for row in each["rows"]])
            result[pair.kind] = {
                "sender": [
                    round(float(rows[rows[:, 0] // 10_000 == k][0, 2]) / 1e9 - pair.sent[k]["began"], 2)
                    for k in range(1, 4)
                ],
                "receiver": [round(each["rows"][0][2] / 1e9 - each["began"], 2) for each in pair.received[1:]],
            }
    return result | {"machine": watch.figures()}


def hostile(kind: str, *methods: str) -> dict[str, Any]:
    """Of each attack: what it did to the stream, and whether a sender that is started meanwhile gets through."""
    result: dict[str, Any] = {}
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    for method in methods or ATTACKS[kind]:
        with pairs([kind], None) as (pair,):
            time.sleep(4.0)
            before, begin = pair.memory(), time.time()
            used = _cpu(pair.receiver.pid)
            command = [sys.executable, __file__, "attack", kind, method, "25", str(pair.folder)]
            attacker = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": "."})
            watch = Watch()
            time.sleep(15.0)
            machine = watch.figures()
            used, grown = (_cpu(pair.receiver.pid) - used) / 15.0, pair.memory() - before
            files = len(list(Path(f"/proc/{pair.receiver.pid}/fd").iterdir()))
            pair.stop("sender")
            pair.start_sender()
            anew = time.time()
            out, _ = attacker.communicate()
            time.sleep(1.0)
            pair.stop("sender")
            last = pair.stop("receiver")
            rows = np.array(last["rows"], dtype=np.int64).reshape(-1, 3)
            sent = np.array(pair.sent[0]["rows"])
            sent = sent[(sent[:, 1] > (begin + 1.0) * 1e9)]
            when = dict(sent.tolist())
            delays = [((row[2] - when[row[0]]) / 1e6, when[row[0]] / 1e9) for row in rows.tolist() if row[0] in when]
            calm = [delay for delay, at in delays if not any(a < at < b for a, b in watch.stalls)]
            again = rows[rows[:, 0] >= 10_000, 2]
            result[f"{kind}, {method}"] = {
                "machine": machine,
                "attempts": json.loads(out),
                "lost_percent": round(100.0 * (1.0 - len(delays) / len(sent)), 2),
                "calm_frames": len(calm),
                "delay_ms": [round(float(np.percentile(calm, q)), 2) for q in (50, 99, 100)] if calm else None,
                "receiver_cpu_percent": round(100.0 * used, 1),
                "memory_grew_mb": round(grown, 1),
                "open_files": files,
                "new_sender_after_s": round(float(again[0]) / 1e9 - anew, 2) if len(again) else None,
            }
            print(json.dumps({f"{kind}, {method}": result[f"{kind}, {method}"]}), file=sys.stderr)
    return result


def _cpu(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# --- strangers


ATTACKS = {
    "own": {"none": 0, "forged packets": 5000, "random packets": 5000},
    "tls": {"none": 0, "garbage": 200, "half-open": 50, "half a handshake": 50, "no certificate": 20},
    "quic": {"none": 0, "random packets": 5000, "first packets of real clients": 5000},
}
"""Of each transport the attacks and their rate, 1/s."""


def attack(kind: str, method: str, seconds: float, folder: Path) -> dict[str, float]:
    """Disturb a receiver; what was done."""
    numbers, rate, to = random.Random(1), ATTACKS[kind][method], ("127.0.0.1", PORTS[kind])
    packets = [numbers.randbytes(numbers.randrange(1, 1400)) for _ in range(200)]
    if method == "forged packets":
        header, key = Header(protocol.FRAME, SENSOR, 1, 1, 0), b"another key another key"
        frame = protocol.pack_frame(Frame(0, (body(1),)), header, key)
        answer = protocol.pack_clock(ClockTimes(1, 2, 3), header._replace(kind=protocol.CLOCK_ANSWER), key)
        packets = [frame, frame[:200], frame + bytes(4000), answer]
    elif method == "first packets of real clients":
        packets = _first_datagrams(folder)
    udp = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(50)]
    kept: deque[socket.socket] = deque(maxlen=900)
    began, done = time.monotonic(), 0
    while (passed := time.monotonic() - began) < seconds:
        if done >= rate * passed:
            time.sleep(0.001)
            continue
        done += 1
        if kind != "tls":
            numbers.choice(udp).sendto(numbers.choice(packets), to)
            continue
        with contextlib.suppress(OSError):
            made = socket.create_connection(to, timeout=0.5)
            if method == "garbage":
                made.sendall(numbers.choice(packets))
                made.close()
            elif method == "no certificate":
                _stranger().wrap_socket(made).sendall(b"x" * 100)
            else:
                made.sendall(_client_hello() if method == "half a handshake" else b"")
                kept.append(made)  # and is silent
    return {"a second": round(done / seconds), "open": len(kept)}


def _stranger() -> ssl.SSLContext:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def _client_hello() -> bytes:
    out = ssl.MemoryBIO()
    with contextlib.suppress(ssl.SSLWantReadError):
        _stranger().wrap_bio(ssl.MemoryBIO(), out, server_hostname="127.0.0.1").do_handshake()
    return out.read()


def _first_datagrams(folder: Path) -> list[bytes]:
    """What a real client sends first, to a port where nobody answers."""
    import zenoh

    found = []
    for _ in range(3):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
            silent.bind(("127.0.0.1", 0))
            silent.settimeout(20.0)
            made = configuration("quic", "127.0.0.1", silent.getsockname()[1], folder, False)
            thread = threading.Thread(target=zenoh.open, args=(made,), daemon=True)
            thread.start()
            found.append(silent.recv(2000))
    return found


def main() -> None:
    """The command."""
    what, *words = sys.argv[1:]
    if what == "send":
        send(words[0], words[1], int(words[2]), Path(words[3]), Path(words[4]))
    elif what == "receive":
        receive(words[0], words[1], Path(words[2]), Path(words[3]))
    elif what == "attack":
        print(json.dumps(attack(words[0], words[1], float(words[2]), Path(words[3]))), flush=True)
        os._exit(0)
    elif "--inside" not in words:
        inside = hosts.in_own_network([sys.executable, __file__, what, "--inside", *words])
        sys.exit(subprocess.run(inside, env={**os.environ, "PYTHONPATH": str(Path.cwd())}).returncode)
    else:
        print(json.dumps({"link": link, "restart": restart, "hostile": hostile}[what](*words[1:]), indent=1))


if __name__ == "__main__":
    main()
