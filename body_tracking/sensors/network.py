"""The backend ``network``: skeletons that ``kinect_sender`` streams from a computer with a Kinect v2.

The protocol is that of ``kinect_protocol``. Whoever has no key gets no further than the signature: size, header, name
of the sensor, signature, session and sequence, content. No limit on packets comes before the signature, for anybody can
write the sender's address into a packet, and what he sends would use up what the sender may send; a packet that was
recorded and is sent again uses up nothing either. A signature takes some ten microseconds: 5,000 forged packets a
second cost a twentieth of a processor. A session counts only after its sender has answered a question that was never
asked before, so that packets which somebody recorded are worth nothing, not even when this side was started anew.
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

from body_tracking.sensors import RecordedFrame, check_sensor_name, optical_frame
from body_tracking.sensors import kinect_protocol as protocol
from body_tracking.sensors.kinect import camera_space_to_optical
from body_tracking.sensors.kinect_protocol import ClockTimes, Header, ProtocolError
from body_tracking.sensors.live import SourceError, SourceSettings, register
from body_tracking.sensors.remote_clock import CaptureClock, RoundTrips
from body_tracking.skeleton import MAX_RANGE, NANOSECONDS, Skeleton, TrackingState

Address: TypeAlias = tuple[str, int]

TAKEOVER_NS = NANOSECONDS // 2
"""A sender that was started anew takes the place of one that has been silent for so long."""

SILENCE_NS = NANOSECONDS
"""From when on a stream that has stopped is a problem."""

_REFUSAL_SHOWN_NS = 10 * NANOSECONDS
_ANSWER_TIMEOUT_NS = 2 * NANOSECONDS
_EARLIEST_NS, _LATEST_NS = NANOSECONDS, 5 * NANOSECONDS
"""A frame that was sent earlier or later than so before its receipt is none to track anybody by."""
_FIRST_ASKS, _ASK_FAST_NS, _ASK_NS = 20, NANOSECONDS // 20, NANOSECONDS // 4
"""A new session is asked every 50 ms at first, later four times a second."""

# A sender sends 30 frames a second and some answers; its sequence numbers go up no faster than it may send. Of each
# session that is not the one that is listened to, few frames are answered with a question.
_KNOWN_RATE, _KNOWN_BURST = 600.0, 120.0
_CHALLENGE_RATE, _CHALLENGE_BURST = 10.0, 5.0
_RECEIVE_BUFFER = 1 << 20
_SHORTEST_WAIT = 0.001


@dataclass(frozen=True, slots=True)
class ReceivedFrame:
    """An accepted frame and when its capture was, by the local clock of stamps (ns)."""

    frame: protocol.Frame
    stamp_ns: int


class _Session:
    """What is known of the sender that is listened to."""

    def __init__(self, number: int, address: Address, least_delay_ns: int, now_ns: int) -> None:
        self.number, self.address = number, address
        self.window = protocol.SequenceWindow()
        self.trips = RoundTrips()
        self.clock = CaptureClock(least_delay_ns)
        self.last_ns = self.last_frame_ns = now_ns
        self.last_answer = 0
        self.asked = 0
        self.next_ask_ns = now_ns


class Receiver:
    """Judges packets; knows no socket, and the time only as it is told.

    Times are nanoseconds of the local monotonic clock, but for stamps. Whatever comes, memory stays bounded.

    Args:
        sensor: whose frames are taken; others are refused.
        key: of the signatures.
        least_delay_ns: see :class:`CaptureClock`.

    Attributes:
        counters: accepted frames, and what was refused by reason.
        refusal: what was wrong with the packet refused last, and whose it was.
        refused_ns: when that was.
        silent: whether the sender says that its sensor delivers nothing.
        floor: of the last frame that had one, see :class:`~body_tracking.sensors.kinect_protocol.Frame`.
        outgoing: packets to be sent and where to; whoever sends them empties the list.
    """

    def __init__(self, sensor: str, key: bytes, least_delay_ns: int = 0) -> None:
        self.counters: Counter[str] = Counter()
        self.refusal, self.refused_ns = "", 0
        self.silent = False
        self.floor: tuple[float, ...] | None = None
        self.outgoing: list[tuple[bytes, Address]] = []
        self._sensor, self._key, self._least_delay_ns = sensor, key, least_delay_ns
        self._secret = secrets.token_bytes(16)
        self._session: _Session | None = None
        self._lost_before = 0
        self._unknown_ns, self._challenged_ns = 0, 0
        self._last_frame_ns = 0
        self._known = protocol.RateLimit(_KNOWN_RATE, _KNOWN_BURST, 1)
        self._challenges = protocol.RateLimit(_CHALLENGE_RATE, _CHALLENGE_BURST, 64)

    # --- packets

    def take(self, packet: bytes, source: Address, now_ns: int, wall_ns: int) -> ReceivedFrame | None:
        """Judge a packet of whatever origin; the frame, if it is a new one of the sender that is listened to.

        Args:
            packet: at most one byte more than the largest one.
            source: where it came from, as the network has it.
            now_ns: its receipt.
            wall_ns: the same by the clock in which stamps are to be.
        """
        try:
            header = protocol.read_header(packet)
            if header.kind == protocol.CLOCK_REQUEST:
                raise ProtocolError("kind", "a clock request, which is not for receivers")
            if header.sensor != self._sensor:
                raise ProtocolError("another sensor", f"frames of {header.sensor!r}, expected {self._sensor!r}")
            protocol.check_signature(packet, self._key)
            if header.kind == protocol.CLOCK_ANSWER:
                self._take_answer(header, protocol.read_clock(packet), source, now_ns)
                return None
            return self._take_frame(header, packet, source, now_ns, wall_ns - now_ns)
        except (ArithmeticError, ValueError) as failure:  # numbers that no clock shows, and ProtocolError
            error = failure if isinstance(failure, ProtocolError) else ProtocolError("out of range", str(failure))
            self.counters[f"rejected, {error.reason}"] += 1
            self.refusal, self.refused_ns = f"{error} (from {source[0]} port {source[1]})", now_ns
            return None

    def _take_frame(
        self, header: Header, packet: bytes, source: Address, now_ns: int, wall_offset_ns: int
    ) -> ReceivedFrame | None:
        session = self._session
        if session is None or header.session != session.number:
            self._challenge(header.session, source, now_ns)
            return None
        window = session.window
        most = window.newest + _KNOWN_BURST + _KNOWN_RATE * (now_ns - session.last_frame_ns) / NANOSECONDS
        if window.newest and header.sequence > most:
            raise ProtocolError("wrong sequence", f"frame {header.sequence} soon after frame {window.newest}")
        if window.has(header.sequence):
            raise ProtocolError("replayed", "a frame that was there before")
        offset_ns = session.trips.offset_ns(header.sent_ns)
        if not -_EARLIEST_NS < now_ns - header.sent_ns - offset_ns < _LATEST_NS:
            raise ProtocolError("wrong time", "a frame that was sent long ago, or later than now")
        frame = protocol.read_frame(packet)
        place = window.take(header.sequence)
        if not self._known.allows(None, now_ns):
            raise ProtocolError("too many", "more frames than a sensor sends")
        session.address, session.last_ns = source, now_ns
        session.last_frame_ns = self._last_frame_ns = now_ns
        if place == "late":
            self.counters["late, not used"] += 1
            return None
        self.silent = frame.silent
        if frame.silent:
            return None
        self.counters["accepted"] += 1
        self.floor = frame.floor or self.floor
        stamp_ns = session.clock.stamp(frame.time_ns, header.sent_ns, offset_ns + wall_offset_ns)
        return ReceivedFrame(frame, stamp_ns)

    # --- sessions and clocks

    def _challenge(self, session: int, source: Address, now_ns: int) -> None:
        """Ask whether a session is alive; nothing is kept of the question, its random number holds what was asked."""
        self.counters["of unknown sessions"] += 1
        if now_ns - self._unknown_ns > SILENCE_NS:
            self._challenged_ns = now_ns
        self._unknown_ns = now_ns
        if self._challenges.allows(
            (source, session), now_ns
        ):  # a session that somebody recorded takes no other's place
            self._ask(session, source, now_ns)

    def _ask(self, session: int, address: Address, now_ns: int) -> None:
        header = Header(protocol.CLOCK_REQUEST, self._sensor, session, self._random(session, now_ns), 0)
        self.outgoing.append((protocol.pack_clock(ClockTimes(now_ns, 0, 0), header, self._key), address))

    def _random(self, session: int, asked_ns: int) -> int:
        """A number that only this receiver can have made of this question."""
        question = session.to_bytes(8, "little") + asked_ns.to_bytes(8, "little", signed=True)
        return int.from_bytes(hashlib.blake2b(question, key=self._secret, digest_size=8).digest(), "little")

    def _take_answer(self, header: Header, times: ClockTimes, source: Address, now_ns: int) -> None:
        if header.sequence != self._random(header.session, times.asked_ns):
            raise ProtocolError("unasked", "an answer to a question that this receiver has not asked")
        if not 0 <= now_ns - times.asked_ns <= _ANSWER_TIMEOUT_NS:
            raise ProtocolError("late answer", "an answer that took too long")
        session = self._session
        if session is None or header.session != session.number:
            if session is not None and now_ns - session.last_ns < TAKEOVER_NS:
                raise ProtocolError(
                    "another sender", "a second sender of the same sensor; the first one is listened to"
                )
            self._lost_before += 0 if session is None else session.window.lost
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

    # --- what is to be said

    @property
    def lost(self) -> int:
        """Frames that were sent and did not come, by their sequence numbers."""
        return self._lost_before + (self._session.window.lost if self._session is not None else 0)

    def problem(self, now_ns: int) -> str:
        """What keeps the stream from being as it should, in a line; empty if nothing does."""
        if not self._last_frame_ns or now_ns - self._last_frame_ns > SILENCE_NS:
            seconds = (now_ns - self._last_frame_ns) // NANOSECONDS
            text = f"no frame for {seconds} s" if self._last_frame_ns else "no frame yet"
            asked_for_long = self._unknown_ns - self._challenged_ns > _ANSWER_TIMEOUT_NS
            if asked_for_long and now_ns - self._unknown_ns < SILENCE_NS:
                return f"{text}; a sender is there, but answers no clock requests: does its firewall let UDP in?"
            return f"{text}{self._refused_lately(now_ns)}"
        if self.silent:
            return "the sender is there, but its sensor delivers nothing"
        return self._refused_lately(now_ns).removeprefix("; ")

    def _refused_lately(self, now_ns: int) -> str:
        lately = self.refusal and now_ns - self.refused_ns < _REFUSAL_SHOWN_NS
        return f"; packets are refused: {self.refusal}" if lately else ""

    def values(self, now_ns: int) -> dict[str, object]:
        """For diagnostics."""
        values: dict[str, object] = {"accepted": 0, **self.counters, "lost": self.lost}
        if self._last_frame_ns:
            values["last frame s ago"] = f"{(now_ns - self._last_frame_ns) / NANOSECONDS:.2f}"
        session = self._session
        if session is not None:
            values["sender"] = f"{session.address[0]} port {session.address[1]}"
            values["round trip ms"] = f"{session.trips.round_trip_ns / 1e6:.3f}"
            values["clock offset s"] = f"{session.trips.offset_ns(session.trips.remote_ns) / NANOSECONDS:.6f}"
            values["clock drift ppm"] = f"{session.trips.drift * 1e6:.1f}"
            values["clock set"] = session.trips.steps
        if self.floor is not None:
            values["floor x y z w"] = " ".join(f"{value:.3f}" for value in self.floor)
        return values


# --- the backend


class NetworkSource:
    """A socket and a :class:`Receiver`.

    Stamps are capture times in this computer's wall clock.

    Args:
        settings: ``sensor``, ``device`` (the sensor's name at the sender; empty for the same), ``address``, ``port``,
            ``key_file`` and ``least_delay`` count.

    Raises:
        SensorNameError: a name that cannot be a sensor's.
        SourceError: likewise, as packets hold it; no key for an address beyond this computer, a key file that is none,
            an address or port that cannot be had.
    """

    def __init__(self, settings: SourceSettings) -> None:
        check_sensor_name(settings.sensor)
        sent_as = settings.device or settings.sensor
        try:
            protocol.sensor_bytes(sent_as)
        except ProtocolError as error:
            raise SourceError(str(error)) from None
        self._sensor = settings.sensor
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
        """Where it listens."""
        host, port = self._socket.getsockname()[:2]
        return str(host), int(port)

    @property
    def ended(self) -> bool:
        """Never: a sender may always come."""
        return False

    @property
    def counters(self) -> Mapping[str, object]:
        """Frames accepted, lost and refused by reason; round trip and clock of the sender."""
        return self._receiver.values(time.monotonic_ns())

    @property
    def problem(self) -> str:
        """What keeps frames from coming."""
        text = self._receiver.problem(time.monotonic_ns())
        return f"{self._where}: {text}" if text else ""

    def close(self) -> None:
        """Let a ``read`` in another thread return."""
        self._closed.set()

    def read(self, timeout: float) -> RecordedFrame | None:
        """See :class:`body_tracking.sensors.live.SkeletonSource`."""
        deadline = time.monotonic() + timeout
        while not self._closed.is_set():
            self._receiver.ask_clock(time.monotonic_ns())
            self._send()
            left = deadline - time.monotonic()
            if left <= 0.0:
                return None
            # Not longer than until the next clock request; 0 would mean not to wait at all.
            self._socket.settimeout(max(_SHORTEST_WAIT, min(left, _ASK_FAST_NS / NANOSECONDS)))
            try:
                packet, source = self._socket.recvfrom(protocol.MAX_PACKET + 1)
            except OSError:
                continue  # none came; or an answer to an earlier packet could not be delivered
            wall_ns = time.time_ns()
            received = self._receiver.take(packet, source[:2], time.monotonic_ns(), wall_ns)
            if received is not None and received.frame.bodies:
                return self._converted(received, wall_ns)
        self._socket.close()
        return None

    def _send(self) -> None:
        for packet, address in self._receiver.outgoing:
            try:
                self._socket.sendto(packet, address)
            except OSError:
                self._receiver.counters["requests that could not be sent"] += 1
        self._receiver.outgoing.clear()

    def _converted(self, received: ReceivedFrame, received_ns: int) -> RecordedFrame:
        name, stamp_ns = optical_frame(self._sensor), received.stamp_ns
        skeletons = tuple(skeleton_of(body, stamp_ns, name) for body in received.frame.bodies)
        return RecordedFrame(self._sensor, received_ns, skeletons)


def skeleton_of(body: protocol.Body, stamp_ns: int, frame_id: str) -> Skeleton:
    """A body as it came, in the package's conventions; a joint without sound coordinates is NaN and not tracked."""
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
        raise SourceError(
            f"parameter 'address': {settings.address!r}, expected an IP address of this computer"
        ) from None
    if not loopback:
        raise SourceError(
            f"parameter 'address': {settings.address} is reached from other computers, which needs the parameter "
            "'key_file' (kinect_sender --make-key FILE makes one)"
        )
    return protocol.NO_KEY


register("network", NetworkSource)
