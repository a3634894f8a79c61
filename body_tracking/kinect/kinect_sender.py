"""Streams the bodies that a Kinect v2 sees to another computer, where ``kinect_skeleton`` receives them.

Runs on Windows without ROS and without this package: copy kinect_sender.py and kinect_protocol.py into one folder,
install PyKinect2 (docs/kinects.md says which), and

    python kinect_sender.py --make-key kinect.key
    python kinect_sender.py --sensor kinect1 --to 192.168.1.20:7525 --key-file kinect.key

The receiving computer needs the same key file. With --replay a recording takes the place of the sensor (needs the
package body_tracking). The sender waits for an absent receiver, network or sensor.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import ipaddress
import os
import secrets
import select
import socket
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or __package__:
    from body_tracking.kinect import kinect_protocol as protocol
else:  # a plain file in the folder of kinect_protocol.py
    protocol = importlib.import_module("kinect_protocol")

STATUS_PERIOD = 5.0
RETRY_PERIOD = 2.0
SILENT_AFTER, SILENT_PERIOD = 2.0, 0.5
"""Seconds without a frame after which the sender reports that the sensor is silent, and the period of the reports."""

_ANSWER_PERIOD_NS = 1_000_000
"""At most one answer per millisecond; a receiver sends requests every 50 ms."""

_POLL = 0.002
_TICKS_NS = 100
"""Unit of the SDK's ``RelativeTime``, ns."""


class SenderError(Exception):
    """Raised when the sender cannot start; the text is one line."""


def now_ns() -> int:
    """The sender's clock. Not ``time.monotonic``, which on Windows counts in steps of 16 ms."""
    return time.perf_counter_ns()


# --- sources


class Kinect:
    """The sensor, by PyKinect2."""

    ended = False

    def __init__(self) -> None:
        # PyKinect2 was last released in 2014 and uses names since removed from Python and numpy.
        try:
            numpy = importlib.import_module("numpy")
            for module, name, value in ((time, "clock", time.perf_counter), (numpy, "object", object)):
                if name not in vars(module):
                    setattr(module, name, value)
            self._api: Any = importlib.import_module("pykinect2.PyKinectV2")
            self._runtime: Any = importlib.import_module("pykinect2.PyKinectRuntime")
        except (ImportError, AssertionError, AttributeError, OSError) as error:
            raise SenderError(
                f"PyKinect2 cannot be used here ({type(error).__name__}: {error}). It needs Windows, the Kinect for "
                "Windows SDK 2.0 and PyKinect2 from its repository; see docs/kinects.md. --replay FILE needs none of it"
            ) from error
        self._sensor: Any = None

    def read(self, timeout: float) -> protocol.Frame | None:
        """The next frame; None when none is within the timeout, seconds."""
        try:
            if self._sensor is None:
                self._sensor = self._runtime.PyKinectRuntime(self._api.FrameSourceTypes_Body)
            end = time.perf_counter() + timeout
            while time.perf_counter() < end:
                seen = self._sensor.get_last_body_frame() if self._sensor.has_new_body_frame() else None
                if seen is not None:
                    return self._frame(seen)
                time.sleep(_POLL)
        except Exception as error:  # COM's exceptions without a sensor are not documented
            print(f"kinect_sender: the sensor cannot be read ({error}); trying again", file=sys.stderr)
            self._sensor = None
            time.sleep(timeout)
        return None

    def _frame(self, seen: Any) -> protocol.Frame:
        bodies = []
        for index, body in enumerate(seen.bodies):
            if not body.is_tracked:
                continue
            joints = [body.joints[k] for k in range(protocol.N_JOINTS)]
            positions = tuple((each.Position.x, each.Position.y, each.Position.z) for each in joints)
            turned = [body.joint_orientations[k].Orientation for k in range(protocol.N_JOINTS)]
            orientations = tuple((each.x, each.y, each.z, each.w) for each in turned)
            states = tuple(int(each.TrackingState) for each in joints)
            tracking_id = int(body.tracking_id) % (1 << 64)
            bodies.append(protocol.Body(index, tracking_id, positions, states, orientations))
        floor = seen.floor_clip_plane
        plane = (0.0,) if floor is None else (floor.x, floor.y, floor.z, floor.w)
        known = any(plane[:3])  # the normal of an unknown floor is zero
        return protocol.Frame(int(seen.relative_time) * _TICKS_NS, tuple(bodies), plane if known else None)

    def close(self) -> None:
        if self._sensor is not None:
            self._sensor.close()


class Replay:
    """A recording in real time; its sensor clock continues when the recording restarts."""

    def __init__(self, args: argparse.Namespace) -> None:
        try:
            live: Any = importlib.import_module("body_tracking.kinect.live")
            self._kinect: Any = importlib.import_module("body_tracking.kinect.axes")
            errors: Any = importlib.import_module("body_tracking.core.errors")
        except ImportError as error:
            raise SenderError(f"--replay needs the package body_tracking ({error})") from error
        how = {name: getattr(args, name) for name in ("recorded_sensor", "rate", "loop", "start_time")}
        try:
            self._source: Any = live.open_source("recording", live.SourceSettings(args.sensor, file=args.replay, **how))
        except errors.BodyTrackingError as error:
            raise SenderError(str(error)) from error
        self._rate = args.rate
        self._zero_ns = self._recorded_ns = self._last_ns = 0

    @property
    def ended(self) -> bool:
        return bool(self._source.ended)

    def read(self, timeout: float) -> protocol.Frame | None:
        """As of :class:`Kinect`."""
        frame = self._source.read(timeout)
        if frame is None:
            return None
        stamp_ns = frame.skeletons[0].stamp_ns
        if not self._zero_ns or stamp_ns < self._last_ns:
            self._zero_ns, self._recorded_ns = now_ns(), stamp_ns
        self._last_ns = stamp_ns
        bodies = []
        for index, skeleton in enumerate(frame.skeletons[: protocol.MAX_BODIES]):
            positions = tuple(map(tuple, self._kinect.camera_space_to_optical(skeleton.positions).tolist()))
            sdk_index = skeleton.body if skeleton.body < protocol.MAX_BODIES else index
            none = ((0.0, 0.0, 0.0, 0.0),) * protocol.N_JOINTS
            bodies.append(protocol.Body(sdk_index, skeleton.body, positions, tuple(skeleton.states.tolist()), none))
        return protocol.Frame(self._zero_ns + round((stamp_ns - self._recorded_ns) / self._rate), tuple(bodies))

    def close(self) -> None:
        self._source.close()


# --- the socket


class Sender:
    """Sends frames and answers clock requests; network errors are counted and retried.

    Args:
        sensor: the name under which frames are sent.
        host: the receiver's name or address.
        port: its port.
        key: of the signatures.

    Raises:
        SenderError: an address of another computer without a key.
    """

    def __init__(self, sensor: str, host: str, port: int, key: bytes) -> None:
        self._sensor, self._host, self._port, self._key = sensor, host, port, key
        self._session, self._sequence = secrets.randbits(64), 0
        self._answered: deque[int] = deque(maxlen=256)
        self._next_answer_ns = 0
        self._socket: socket.socket | None = None
        self._address: Any = None
        self._retry_at = 0.0
        self.sent = self.answered = self.failures = 0
        self.last_error = ""
        self._closed = threading.Event()
        self._open()
        threading.Thread(target=self._answer, daemon=True).start()

    def _open(self) -> None:
        """Resolve the receiver's address and open a socket; on failure, :meth:`send` retries later."""
        try:
            family, kind, number, _, address = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            self._failed(error)
            return
        loopback = ipaddress.ip_address(address[0]).is_loopback
        if not self._key and not loopback:
            raise SenderError(f"{self._host} is another computer: frames for it are signed; give --key-file")
        old, made = self._socket, socket.socket(family, kind, number)
        made.bind((address[0] if loopback else "", 0))
        self._address, self._socket = address, made
        if old is not None:
            old.close()

    def _failed(self, error: OSError) -> None:
        self.failures += 1
        self.last_error = error.strerror or str(error)
        self._retry_at = time.monotonic() + RETRY_PERIOD

    def send(self, frame: protocol.Frame) -> None:
        """Send a frame; one that cannot be sent is lost."""
        self._sequence += 1
        if self._socket is None or (self._retry_at and time.monotonic() > self._retry_at):
            self._retry_at = 0.0
            self._open()
        if self._socket is None:
            return
        header = protocol.Header(protocol.FRAME, self._sensor, self._session, self._sequence, now_ns())
        try:
            self._socket.sendto(protocol.pack_frame(frame, header, self._key), self._address)
            self.sent += 1
        except OSError as error:
            if not self._retry_at:
                self._failed(error)

    def _answer(self) -> None:
        """Run in a thread of its own: answer each clock request once, without delay."""
        while not self._closed.is_set():
            current = self._socket
            if current is None:
                self._closed.wait(0.1)
                continue
            try:
                if select.select([current], [], [], 0.2)[0]:
                    packet, source = current.recvfrom(protocol.MAX_PACKET + 1)
                    self._answer_one(current, packet, source, now_ns())
            except protocol.ProtocolError:
                continue
            except (OSError, ValueError):
                self._closed.wait(0.01)  # no receiver at the other end, or the socket was replaced

    def _answer_one(self, current: socket.socket, packet: bytes, source: Any, received_ns: int) -> None:
        header = protocol.read_header(packet)
        if header[:3] != (protocol.CLOCK_REQUEST, self._sensor, self._session):
            return
        protocol.check_signature(packet, self._key)
        if header.sequence in self._answered or received_ns < self._next_answer_ns:
            return
        self._next_answer_ns = received_ns + _ANSWER_PERIOD_NS
        self._answered.append(header.sequence)
        times = protocol.ClockTimes(protocol.read_clock(packet).asked_ns, received_ns, now_ns())
        answer = protocol.pack_clock(times, header._replace(kind=protocol.CLOCK_ANSWER), self._key)
        current.sendto(answer, source)
        self.answered += 1

    def close(self) -> None:
        """Stop answering."""
        self._closed.set()
        if self._socket is not None:
            self._socket.close()


# --- the command


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="kinect_sender", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    to = f"127.0.0.1:{protocol.DEFAULT_PORT}"
    text = "the computer that runs kinect_skeleton, and its port (default %(default)s)"
    made.add_argument("--to", metavar="HOST:PORT", default=to, help=text)
    text = "the sensor's name at the receiver (default %(default)s)"
    made.add_argument("--sensor", default="kinect1", metavar="NAME", help=text)
    made.add_argument("--key-file", metavar="FILE", help="the shared key; not needed for 127.0.0.1")
    made.add_argument("--make-key", metavar="FILE", help="write a new key into a new file, and exit")
    replay = made.add_argument_group("a recording in place of the sensor")
    replay.add_argument("--replay", metavar="FILE", help="a bag, a .csv, .csv.gz or .skeleton file")
    text = "the sensor's name in it (default: --sensor)"
    replay.add_argument("--recorded-sensor", default="", metavar="NAME", help=text)
    replay.add_argument("--rate", type=float, default=1.0, metavar="X", help="play it X times as fast (default 1)")
    replay.add_argument("--loop", action="store_true", help="play again from the beginning at its end")
    text = "wall time in seconds at which it begins; the same for several senders keeps them in step (default: now)"
    replay.add_argument("--start-time", type=float, default=0.0, metavar="S", help=text)
    return made


def make_key(path: str) -> None:
    """Write a new key into a new file that only its owner may read.

    Raises:
        SenderError: the file exists or cannot be written.
    """
    try:
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise SenderError(f"{path}: cannot be made ({error.strerror})") from error
    with os.fdopen(number, "w") as file:
        file.write(secrets.token_hex(32) + "\n")
    print(f"{Path(path)}: a new key; copy it to both computers, and keep it secret")


def stream(sender: Sender, source: Any) -> None:
    """Send the frames of a source until it ends; prints a status line on stderr every ``STATUS_PERIOD``."""
    begin = last = time.monotonic()
    silent_at = begin + SILENT_AFTER
    while not source.ended:
        frame = source.read(0.2)
        now = time.monotonic()
        if frame is not None:
            sender.send(frame)
            silent_at = now + SILENT_AFTER
        elif now >= silent_at:
            sender.send(protocol.Frame(0, (), None, True))
            silent_at = now + SILENT_PERIOD
        if now - last >= STATUS_PERIOD:
            last = now
            bodies = "the sensor is silent" if frame is None else f"bodies in the last one: {len(frame.bodies)}"
            asked = (
                f"answered {sender.answered} clock requests" if sender.answered else "the receiver has not asked yet"
            )
            error = f"; {sender.last_error}, {sender.failures} times" if sender.failures else ""
            text = f"{now - begin:.0f} s: sent {sender.sent} frames, {bodies}, {asked}{error}"
            print(f"kinect_sender: {text}", file=sys.stderr, flush=True)


def run() -> None:
    """Run the command line.

    Raises:
        SenderError, ProtocolError: invalid arguments, key or source.
        KeyboardInterrupt: on Ctrl-C, also while a sensor's library or a recording is loaded.
    """
    args = parser().parse_args()
    if args.make_key:
        make_key(args.make_key)
        return
    host, colon, port = args.to.rpartition(":")
    if not colon or not port.isdigit() or not 0 < int(port) < 1 << 16:
        raise SenderError(f"--to {args.to}: expected HOST:PORT")
    protocol.sensor_bytes(args.sensor)
    key = protocol.read_key(args.key_file) if args.key_file else protocol.NO_KEY
    with contextlib.ExitStack() as stack:
        source = stack.enter_context(contextlib.closing(Replay(args) if args.replay else Kinect()))
        sender = stack.enter_context(contextlib.closing(Sender(args.sensor, host.strip("[]"), int(port), key)))
        stream(sender, source)


def main() -> int:
    """The command: 0 at the end of a recording or on Ctrl-C, 2 with one line when it cannot start."""
    try:
        run()
    except (SenderError, protocol.ProtocolError) as error:
        print(f"kinect_sender: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
