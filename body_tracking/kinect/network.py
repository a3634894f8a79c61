"""The backend ``network``: skeletons that ``kinect_sender`` streams from a computer with a Kinect v2.

Packets are checked in the order size, header, name of the sensor, signature, session and sequence, content, so that
packets without the key are dropped at the signature, which takes ten microseconds. There is no rate limit before it:
an attacker can forge the sender's address and would use up the sender's share. A session is accepted only after its
sender has answered a new challenge, so that replayed packets are rejected, even after a restart.
"""

from __future__ import annotations

import hashlib
import ipaddress
import secrets
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from body_tracking.core.skeleton import MAX_RANGE, NANOSECONDS, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame, check_sensor_name, optical_frame
from body_tracking.kinect import kinect_protocol as protocol
from body_tracking.kinect.axes import camera_space_to_optical
from body_tracking.kinect.kinect_protocol import ClockTimes, Header, ProtocolError
from body_tracking.kinect.live import SourceError, SourceSettings
from body_tracking.kinect.remote_clock import CaptureClock, RoundTrips

Address: TypeAlias = tuple[str, int]

TAKEOVER_NS = NANOSECONDS // 2
"""A restarted sender replaces one that has been silent for this long."""

SILENCE_NS = NANOSECONDS
"""Time without frames after which the stream is reported as stopped."""

_REFUSAL_SHOWN_NS = 10 * NANOSECONDS
_ANSWER_TIMEOUT_NS = 2 * NANOSECONDS
_EARLIEST_NS, _LATEST_NS = NANOSECONDS, 5 * NANOSECONDS
"""A frame is refused if it was sent, by its stamp, this long after its receipt or this long before it."""
_FIRST_ASKS, _ASK_FAST_NS, _ASK_NS = 20, NANOSECONDS // 20, NANOSECONDS // 4
"""Number and period of the first clock requests of a session, and the period of the later ones."""

_CHALLENGE_NS, _CHALLENGED = NANOSECONDS // 10, 64
"""Shortest period of the challenges to one unknown session, and the number of sessions whose challenges are stored."""

_MAX_RATE, _MAX_JUMP = 600, 120
"""Greatest increase of sequence numbers, per second and at once; a Kinect sends 30 frames a second."""

_RECEIVE_BUFFER = 1 << 20
_SHORTEST_WAIT = 0.001


@dataclass(frozen=True, slots=True)
class ReceivedFrame:
    """An accepted frame and its capture time by the local wall clock (ns)."""

    frame: protocol.Frame
    stamp_ns: int


class _Session:
    """State of the accepted sender: number, address, clocks, the newest frame and answer."""

    def __init__(self, number: int, address: Address, least_delay_ns: int, now_ns: int) -> None:
        self.number, self.address = number, address
        self.trips, self.clock = RoundTrips(), CaptureClock(least_delay_ns)
        self.newest = self.last_answer = self.asked = 0
        self.last_ns = self.last_frame_ns = self.next_ask_ns = now_ns


class Receiver:
    """Checks packets; has neither socket nor clock. Its memory is bounded.

    Times other than stamps are nanoseconds of the local monotonic clock.

    Args:
        sensor: whose frames are accepted; others are refused.
        key: of the signatures.
        least_delay_ns: see :class:`CaptureClock`.

    Attributes:
        counters: accepted frames, and refused packets by reason.
        lost: frames of all sessions that were lost or arrived after a later one.
        refusal: reason and source of the last refused packet.
        refused_ns: its time.
        silent: whether the sender reports that its sensor delivers no frames.
        floor: of the last frame with one, see :class:`~body_tracking.kinect.kinect_protocol.Frame`.
        outgoing: packets to be sent and their addresses; the caller empties the list.
    """

    def __init__(self, sensor: str, key: bytes, least_delay_ns: int = 0) -> None:
        self.counters: Counter[str] = Counter()
        self.refusal, self.refused_ns = "", 0
        self.lost, self.silent = 0, False
        self.floor: tuple[float, ...] | None = None
        self.outgoing: list[tuple[bytes, Address]] = []
        self._sensor, self._key, self._least_delay_ns = sensor, key, least_delay_ns
        self._secret = secrets.token_bytes(16)
        self._session: _Session | None = None
        self._unknown_ns = self._challenged_ns = self._last_frame_ns = 0
        self._challenges: dict[tuple[Address, int], int] = {}

    # --- packets

    def take(self, packet: bytes, source: Address, now_ns: int, wall_ns: int) -> ReceivedFrame | None:
        """Process an untrusted packet; returns its frame if that is a new one of the accepted sender.

        Args:
            packet: at most one byte more than the largest one.
            source: its address, which may be forged.
            now_ns: its receipt.
            wall_ns: its receipt by the wall clock.
        """
        try:
            header = protocol.read_header(packet)
            if header.kind == protocol.CLOCK_REQUEST:
                raise ProtocolError("kind", "a clock request, which only senders take")
            if header.sensor != self._sensor:
                raise ProtocolError("another sensor", f"frames of {header.sensor!r}, expected {self._sensor!r}")
            protocol.check_signature(packet, self._key)
            session = self._session
            if header.kind == protocol.CLOCK_ANSWER:
                self._take_answer(header, protocol.read_clock(packet), source, now_ns)
            elif session is None or header.session != session.number:
                self._challenge(header.session, source, now_ns)
            else:
                return self._take_frame(session, header, packet, source, now_ns, wall_ns - now_ns)
        except (ArithmeticError, ValueError) as failure:  # absurd times, and ProtocolError
            error = failure if isinstance(failure, ProtocolError) else ProtocolError("out of range", str(failure))
            self.counters[f"rejected, {error.reason}"] += 1
            self.refusal, self.refused_ns = f"{error} (from {source[0]} port {source[1]})", now_ns
        return None

    def _take_frame(
        self, session: _Session, header: Header, packet: bytes, source: Address, now_ns: int, wall_offset_ns: int
    ) -> ReceivedFrame | None:
        most = session.newest + _MAX_JUMP + _MAX_RATE * (now_ns - session.last_frame_ns) // NANOSECONDS
        if session.newest and header.sequence > most:
            raise ProtocolError("wrong sequence", f"frame {header.sequence} soon after frame {session.newest}")
        if header.sequence <= session.newest:
            self.counters["late or repeated, not used"] += 1
            return None
        offset_ns = session.trips.offset_ns(header.sent_ns)
        if not -_EARLIEST_NS < now_ns - header.sent_ns - offset_ns < _LATEST_NS:
            raise ProtocolError("wrong time", "a frame that was sent long ago, or later than now")
        frame = protocol.read_frame(packet)
        self.lost += header.sequence - session.newest - 1 if session.newest else 0
        session.newest = header.sequence
        session.address, session.last_ns = source, now_ns
        session.last_frame_ns = self._last_frame_ns = now_ns
        self.silent = frame.silent
        if frame.silent:
            return None
        self.counters["accepted"] += 1
        self.floor = frame.floor or self.floor
        return ReceivedFrame(frame, session.clock.stamp(frame.time_ns, header.sent_ns, offset_ns + wall_offset_ns))

    # --- sessions and clocks

    def _challenge(self, session: int, source: Address, now_ns: int) -> None:
        """Send a challenge to an unknown session; its random number is a keyed hash, so that none is stored."""
        self.counters["of unknown sessions"] += 1
        if now_ns - self._unknown_ns > SILENCE_NS:
            self._challenged_ns = now_ns
        self._unknown_ns = now_ns
        asked = source, session  # per session, so that a replayed one uses up no other's share
        if now_ns - self._challenges.get(asked, -_CHALLENGE_NS) >= _CHALLENGE_NS:
            self._challenges.pop(asked, None)  # the newest ones last
            self._challenges[asked] = now_ns
            if len(self._challenges) > _CHALLENGED:
                del self._challenges[next(iter(self._challenges))]
            self._ask(session, source, now_ns)

    def _ask(self, session: int, address: Address, now_ns: int) -> None:
        header = Header(protocol.CLOCK_REQUEST, self._sensor, session, self._random(session, now_ns), 0)
        self.outgoing.append((protocol.pack_clock(ClockTimes(now_ns, 0, 0), header, self._key), address))

    def _random(self, session: int, asked_ns: int) -> int:
        """A keyed hash of a request, which only this receiver can compute."""
        question = session.to_bytes(8, "little") + asked_ns.to_bytes(8, "little", signed=True)
        return int.from_bytes(hashlib.blake2b(question, key=self._secret, digest_size=8).digest(), "little")

    def _take_answer(self, header: Header, times: ClockTimes, source: Address, now_ns: int) -> None:
        if header.sequence != self._random(header.session, times.asked_ns):
            raise ProtocolError("unasked", "an answer to no request of this receiver")
        if not 0 <= now_ns - times.asked_ns <= _ANSWER_TIMEOUT_NS:
            raise ProtocolError("late answer", "an answer that took too long")
        session = self._session
        if session is None or header.session != session.number:
            if session is not None and now_ns - session.last_ns < TAKEOVER_NS:
                text = "a second sender of the same sensor; the first one is listened to"
                raise ProtocolError("another sender", text)
            self.counters["sessions"] += 1
            session = self._session = _Session(header.session, source, self._least_delay_ns, now_ns)
        if times.asked_ns <= session.last_answer:
            raise ProtocolError("replayed", "an answer that was there before")
        session.last_answer, session.last_ns, session.address = times.asked_ns, now_ns, source
        self.counters["round trips"] += session.trips.add(times.asked_ns, times.received_ns, times.answered_ns, now_ns)

    def ask_clock(self, now_ns: int) -> None:
        """Put a clock request into ``outgoing`` if one is due."""
        session = self._session
        if session is not None and now_ns >= session.next_ask_ns:
            session.asked += 1
            session.next_ask_ns = now_ns + (_ASK_FAST_NS if session.asked < _FIRST_ASKS else _ASK_NS)
            self._ask(session.number, session.address, now_ns)

    # --- diagnostics

    def problem(self, now_ns: int) -> str:
        """The problem of the stream in one line; empty for none."""
        refused = self.refusal and now_ns - self.refused_ns < _REFUSAL_SHOWN_NS
        refusal = f"packets are refused: {self.refusal}" if refused else ""
        if not self._last_frame_ns or now_ns - self._last_frame_ns > SILENCE_NS:
            seconds = (now_ns - self._last_frame_ns) // NANOSECONDS
            text = f"no frame for {seconds} s" if self._last_frame_ns else "no frame yet"
            asked_for_long = self._unknown_ns - self._challenged_ns > _ANSWER_TIMEOUT_NS
            if asked_for_long and now_ns - self._unknown_ns < SILENCE_NS:
                return f"{text}; a sender is there, but answers no clock requests: does its firewall let UDP in?"
            return "; ".join(filter(None, (text, refusal)))
        return "the sender is there, but its sensor delivers nothing" if self.silent else refusal

    def values(self, now_ns: int) -> dict[str, object]:
        """Values for diagnostics."""
        values: dict[str, object] = {"accepted": 0, **self.counters, "lost": self.lost}
        if self._last_frame_ns:
            values["last frame s ago"] = f"{(now_ns - self._last_frame_ns) / NANOSECONDS:.2f}"
        session = self._session
        if session is not None:
            trips = session.trips
            values |= {
                "sender": f"{session.address[0]} port {session.address[1]}",
                "round trip ms": f"{trips.round_trip_ns / 1e6:.3f}",
                "clock offset s": f"{trips.offset_ns(trips.remote_ns) / NANOSECONDS:.6f}",
                "clock drift ppm": f"{trips.drift * 1e6:.1f}",
                "clock set": trips.steps,
            }
        if self.floor is not None:
            values["floor x y z w"] = " ".join(f"{value:.3f}" for value in self.floor)
        return values


# --- the backend


class NetworkSource:
    """A socket and a :class:`Receiver`; stamps are capture times in this computer's wall clock.

    Args:
        settings: uses ``sensor``, ``device`` (the sensor's name at the sender; empty for the same), ``address``,
            ``port``, ``key_file`` and ``least_delay``.

    Raises:
        SensorNameError: an invalid name of the sensor.
        SourceError: an invalid name at the sender, no key for an address reachable from other computers, an invalid
            key file, an address or port that is not available.
    """

    def __init__(self, settings: SourceSettings) -> None:
        self._sensor = check_sensor_name(settings.sensor)
        sent_as = settings.device or settings.sensor
        try:
            protocol.sensor_bytes(sent_as)
        except ProtocolError as error:
            raise SourceError(str(error)) from None
        self._where = f"{settings.address} port {settings.port}"
        self._receiver = Receiver(sent_as, _key(settings), round(settings.least_delay * NANOSECONDS))
        self._closed = threading.Event()
        family = socket.AF_INET6 if ":" in settings.address else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self._socket.bind((settings.address, settings.port))
        except OSError as error:
            self._socket.close()
            raise SourceError(f"cannot listen on {self._where}: {error.strerror or error}") from error

    @property
    def address(self) -> Address:
        """Host and port on which it listens."""
        host, port = self._socket.getsockname()[:2]
        return str(host), int(port)

    @property
    def ended(self) -> bool:
        return False  # a sender may start at any time

    @property
    def counters(self) -> Mapping[str, object]:
        """Frames accepted, lost and refused by reason; round trip and clock of the sender."""
        return self._receiver.values(time.monotonic_ns())

    @property
    def problem(self) -> str:
        text = self._receiver.problem(time.monotonic_ns())
        return f"{self._where}: {text}" if text else ""

    def close(self) -> None:
        self._closed.set()

    def read(self, timeout: float) -> RecordedFrame | None:
        """See :class:`body_tracking.kinect.live.SkeletonSource`."""
        deadline = time.monotonic() + timeout
        while not self._closed.is_set():
            self._receiver.ask_clock(time.monotonic_ns())
            self._send()
            left = deadline - time.monotonic()
            if left <= 0.0:
                return None
            # No longer than until the next clock request; 0 would make the socket non-blocking.
            self._socket.settimeout(max(_SHORTEST_WAIT, min(left, _ASK_FAST_NS / NANOSECONDS)))
            try:
                packet, source = self._socket.recvfrom(protocol.MAX_PACKET + 1)
            except OSError:
                continue  # timeout, or an ICMP error for an earlier packet
            wall_ns = time.time_ns()
            received = self._receiver.take(packet, source[:2], time.monotonic_ns(), wall_ns)
            if received is not None and received.frame.bodies:
                name, stamp_ns = optical_frame(self._sensor), received.stamp_ns
                skeletons = tuple(skeleton_of(body, stamp_ns, name) for body in received.frame.bodies)
                return RecordedFrame(self._sensor, wall_ns, skeletons)
        self._socket.close()
        return None

    def _send(self) -> None:
        for packet, address in self._receiver.outgoing:
            try:
                self._socket.sendto(packet, address)
            except OSError:
                self._receiver.counters["requests that could not be sent"] += 1
        self._receiver.outgoing.clear()


def skeleton_of(body: protocol.Body, stamp_ns: int, frame_id: str) -> Skeleton:
    """A body in the package's conventions; a joint with invalid coordinates is NaN and not tracked."""
    positions = camera_space_to_optical(np.array(body.positions, dtype=np.float64))
    unsound = ~(np.abs(positions) < MAX_RANGE).all(axis=1)
    positions[unsound] = np.nan
    states = np.array(body.states, dtype=np.uint8)
    states[unsound] = TrackingState.NOT_TRACKED
    return Skeleton(stamp_ns, frame_id, positions, states, body.sdk_index)


def _key(settings: SourceSettings) -> bytes:
    if settings.key_file:
        try:
            return protocol.read_key(settings.key_file)
        except ProtocolError as error:
            raise SourceError(f"parameter 'key_file': {error}") from None
    try:
        loopback = ipaddress.ip_address(settings.address).is_loopback
    except ValueError:
        text = f"parameter 'address': {settings.address!r}, expected an IP address of this computer"
        raise SourceError(text) from None
    if not loopback:
        raise SourceError(
            f"parameter 'address': {settings.address} is reached from other computers, which needs the parameter "
            "'key_file' (kinect_sender --make-key FILE makes one)"
        )
    return protocol.NO_KEY
