"""A sender of frames without a socket, for tests of the receiver."""

from __future__ import annotations

import math
from collections.abc import Sequence

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinect import kinect_protocol as protocol
from body_tracking.kinect.kinect_protocol import Body, ClockTimes, Frame, Header
from body_tracking.kinect.network import Address, ReceivedFrame, Receiver

KEY = b"0123456789abcdef0123456789abcdef"
FRAME_NS = NANOSECONDS // 30


def body(index: int = 0, shift: float = 0.0) -> Body:
    """Somebody two metres away."""
    return Body(
        index,
        72057594037927936 + index,
        tuple((0.01 * k + shift, 0.02 * k, 2.0) for k in range(protocol.N_JOINTS)),
        tuple(k % 3 for k in range(protocol.N_JOINTS)),
        tuple((0.0, math.sin(0.1 * k), 0.0, math.cos(0.1 * k)) for k in range(protocol.N_JOINTS)),
    )


class Partner:
    """Sends to a receiver and answers it; every way takes a millisecond.

    Args:
        receiver: to whom.
        session: its number.
        address: its own.
        ahead_ns: its clock minus the receiver's.
        sensor_ns: its sensor's clock minus its own.
    """

    def __init__(
        self,
        receiver: Receiver,
        session: int = 7,
        address: Address = ("10.0.0.5", 4242),
        ahead_ns: int = 300_000_000,
        sensor_ns: int = -5_000_000_000,
        key: bytes = KEY,
    ) -> None:
        self.receiver, self.session, self.address, self.key = receiver, session, address, key
        self.ahead_ns, self.sensor_ns = ahead_ns, sensor_ns
        self.sequence = 0
        self.sent: list[bytes] = []

    def frame(self, now_ns: int, bodies: Sequence[Body] = (body(),), sequence: int | None = None) -> bytes:
        """A packet with a frame captured now."""
        self.sequence = self.sequence + 1 if sequence is None else sequence
        sent_ns = now_ns + self.ahead_ns
        header = Header(protocol.FRAME, "kinect1", self.session, self.sequence, sent_ns)
        packet = protocol.pack_frame(
            Frame(sent_ns + self.sensor_ns, tuple(bodies), (0.0, 1.0, 0.0, 0.9)), header, self.key
        )
        self.sent.append(packet)
        return packet

    def give(self, packet: bytes, now_ns: int) -> ReceivedFrame | None:
        """Hand a packet that is sent now to the receiver, and answer its requests."""
        arrival_ns = now_ns + 1_000_000
        result = self.receiver.take(packet, self.address, arrival_ns, arrival_ns)
        self.answer(arrival_ns)
        return result

    def stream(self, begin_ns: int, count: int) -> list[ReceivedFrame | None]:
        """Send ``count`` frames at 30 Hz; returns the receiver's result for each."""
        return [self.give(self.frame(begin_ns + k * FRAME_NS), begin_ns + k * FRAME_NS) for k in range(count)]

    def answer(self, now_ns: int) -> None:
        """Answer every request of the receiver, which is made now."""
        self.receiver.ask_clock(now_ns)
        requests, self.receiver.outgoing = self.receiver.outgoing, []
        for packet, address in requests:
            header = protocol.read_header(packet)
            protocol.check_signature(packet, self.key)
            if address != self.address or header.session != self.session:
                continue
            there_ns = now_ns + 1_000_000 + self.ahead_ns
            times = ClockTimes(protocol.read_clock(packet).asked_ns, there_ns, there_ns + 10_000)
            answer = protocol.pack_clock(times, header._replace(kind=protocol.CLOCK_ANSWER), self.key)
            self.sent.append(answer)
            back_ns = now_ns + 2_010_000
            self.receiver.take(answer, self.address, back_ns, back_ns)
