"""Who receives skeletons over the network: takes what it should, refuses all else, and is not disturbed by it."""

from __future__ import annotations

import math
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from senders import FRAME_NS, KEY, Partner, body

from body_tracking.errors import BodyTrackingError
from body_tracking.sensors import kinect_protocol as protocol
from body_tracking.sensors.kinect_protocol import ClockTimes, Frame, Header
from body_tracking.sensors.kinect_sender import Sender
from body_tracking.sensors.live import SourceSettings, open_source
from body_tracking.sensors.network import NetworkSource, ReceivedFrame, Receiver, skeleton_of
from body_tracking.skeleton import NANOSECONDS
from draws import draws

START_NS = 10 * NANOSECONDS
STRANGER = ("10.0.0.66", 666)


def settled(seconds: float = 1.0) -> tuple[Receiver, Partner, int]:
    """A receiver that listens to a sender, and the time."""
    receiver = Receiver("kinect1", KEY)
    partner = Partner(receiver)
    partner.stream(START_NS, round(30 * seconds))
    del partner.sent[0]  # made the receiver ask, and was not taken
    return receiver, partner, START_NS + round(30 * seconds) * FRAME_NS


def signed(partner: Partner, sent_ns: int, ahead: int = 1, frame: Frame | None = None, key: bytes = KEY) -> bytes:
    """A frame that says to be of a sender, by its clock, ``ahead`` of its last."""
    header = Header(protocol.FRAME, "kinect1", partner.session, partner.sequence + ahead, sent_ns)
    return protocol.pack_frame(frame or Frame(sent_ns, (body(),)), header, key)


def check_times(got: list[ReceivedFrame | None], begin_ns: int) -> None:
    """The first is not taken, its session is not known to be alive; the others are, with their time."""
    assert got[0] is None
    stamps = [each.stamp_ns for each in got[1:] if each is not None]
    assert len(stamps) == len(got) - 1
    # ways of one millisecond each cancel
    assert np.abs(np.array(stamps) - begin_ns - FRAME_NS * np.arange(1, len(got))).max() < 100_000


# --- the good stream


def test_after_one_round_trip_every_frame_is_taken_with_its_time() -> None:
    receiver = Receiver("kinect1", KEY)
    check_times(Partner(receiver).stream(START_NS, 90), START_NS)
    assert receiver.lost == 0
    assert receiver.counters["accepted"] == 89
    assert not any(name.startswith("rejected") for name in receiver.counters)


def test_lost_frames_are_counted_and_late_ones_are_not_used() -> None:
    receiver, partner, now = settled()
    before = receiver.counters["accepted"]
    held = partner.frame(now)
    for k in range(1, 11):
        packet = partner.frame(now + k * FRAME_NS)
        if k != 5:
            assert partner.give(packet, now + k * FRAME_NS) is not None
    assert receiver.lost == 2
    assert partner.give(held, now + 11 * FRAME_NS) is None
    assert receiver.counters["late, not used"] == 1
    assert receiver.lost == 1
    assert receiver.counters["accepted"] == before + 9


def test_nobody_in_view_keeps_the_stream_alive_and_a_silent_sensor_is_named() -> None:
    receiver, partner, now = settled()
    result = partner.give(partner.frame(now, ()), now)
    assert result is not None
    assert result.frame.bodies == ()
    assert receiver.problem(now + 2_000_000) == ""
    partner.give(signed(partner, now + FRAME_NS, frame=Frame(0, (), None, True)), now + FRAME_NS)
    assert receiver.problem(now + 2 * FRAME_NS) == "the sender is there, but its sensor delivers nothing"


def test_a_stream_that_stops_is_named_with_its_time_and_goes_on_by_itself() -> None:
    receiver, partner, now = settled()
    assert receiver.problem(now) == ""
    assert receiver.problem(now + 12 * NANOSECONDS) == "no frame for 12 s"
    later = now + 30 * NANOSECONDS
    result = partner.give(partner.frame(later), later)
    assert result is not None
    # thirty seconds without round trips: the clocks are where they were foretold to be
    assert abs(result.stamp_ns - later) < 100_000
    assert receiver.counters["sessions"] == 1


def test_a_sender_that_is_started_anew_is_taken_once_it_answers() -> None:
    receiver, old, now = settled()
    old.give(old.frame(now), now)
    now += NANOSECONDS
    new = Partner(receiver, session=8, address=("10.0.0.5", 4343), ahead_ns=-77 * NANOSECONDS, sensor_ns=0)
    check_times(new.stream(now, 10), now)
    # what the old one still has in flight does not count
    assert receiver.take(old.frame(now), old.address, now, now) is None
    assert receiver.counters["sessions"] == 2


def test_two_senders_of_one_name_do_not_alternate() -> None:
    receiver, first, now = settled()
    second = Partner(receiver, session=9, address=("10.0.0.9", 1))
    for k in range(60):
        at = now + k * FRAME_NS
        assert first.give(first.frame(at), at) is not None
        assert second.give(second.frame(at), at) is None
    assert receiver.counters["sessions"] == 1
    assert receiver.counters["rejected, another sender"] > 0
    assert "second sender" in receiver.problem(now + 60 * FRAME_NS)


# --- the bad ones


def test_nothing_that_was_recorded_is_taken_even_by_a_receiver_that_was_started_anew() -> None:
    receiver, partner, now = settled(3.0)
    recorded = list(partner.sent)
    before = receiver.counters["accepted"]
    for receiver_now in (receiver, Receiver("kinect1", KEY)):
        for k, packet in enumerate(recorded):
            at = now + NANOSECONDS + k * 20_000_000
            assert receiver_now.take(packet, partner.address, at, at) is None
            receiver_now.outgoing.clear()  # whoever recorded cannot answer
    assert receiver.counters["accepted"] == before
    assert receiver.counters["sessions"] == 1


def test_answers_to_questions_that_were_not_asked_or_long_ago_do_not_count() -> None:
    receiver, partner, now = settled()
    trips = receiver.counters["round trips"]
    for number, asked in ((1, now), (0, 0), (2**64 - 1, now - NANOSECONDS)):
        header = Header(protocol.CLOCK_ANSWER, "kinect1", partner.session, number, 0)
        receiver.take(protocol.pack_clock(ClockTimes(asked, now, now), header, KEY), partner.address, now, now)
    receiver.ask_clock(now + NANOSECONDS)
    ((request, _),) = receiver.outgoing
    asked = protocol.read_header(request)
    late = now + 4 * NANOSECONDS
    times = ClockTimes(now + NANOSECONDS, late, late)
    answer = protocol.pack_clock(times, asked._replace(kind=protocol.CLOCK_ANSWER), KEY)
    receiver.take(answer, partner.address, late, late)
    assert receiver.counters["round trips"] == trips
    assert receiver.counters["rejected, unasked"] == 3
    assert receiver.counters["rejected, late answer"] == 1


def attacks(numbers: random.Random, partner: Partner, now: int) -> Iterator[tuple[str, bytes]]:
    """Packets of every kind that should not be taken, and what they are."""
    good = partner.sent[numbers.randrange(len(partner.sent))]
    yield "random", numbers.randbytes(numbers.randrange(protocol.MAX_PACKET + 200))
    yield "random behind a true header", good[:64] + numbers.randbytes(len(good) - 64)
    yield "truncated", good[: numbers.randrange(len(good))]
    yield "replayed", good
    yield "wrongly signed", signed(partner, now, 5, key=numbers.randbytes(32))
    yield "not signed", signed(partner, now, 5, key=protocol.NO_KEY)
    yield "oversized", good + numbers.randbytes(protocol.MAX_PACKET)
    changed = bytearray(good)
    changed[numbers.randrange(len(good))] ^= 1 << numbers.randrange(8)
    yield "changed", bytes(changed)
    answer = Header(protocol.CLOCK_ANSWER, "kinect1", partner.session, partner.sequence + 5, now)
    yield "wrong answer", protocol.pack_clock(ClockTimes(now, 0, 0), answer, numbers.randbytes(32))
    yield "another version", good[:4] + bytes([numbers.randrange(2, 256)]) + good[5:]


def test_of_many_bad_packets_none_is_accepted_and_the_good_stream_loses_nothing() -> None:
    count = draws(40_000, 1_000_000)
    receiver, partner, now = settled(3.0)
    numbers = random.Random(5)
    pool = [each for _ in range(count // 500) for each in attacks(numbers, partner, now)]
    before, frames = receiver.counters["accepted"], 0
    for k in range(count):
        kind, packet = pool[numbers.randrange(len(pool))]
        now += FRAME_NS // 20
        source = partner.address if numbers.random() < 0.3 else (f"10.1.{numbers.randrange(4)}.1", 7)
        assert receiver.take(packet[: protocol.MAX_PACKET + 1], source, now, now) is None, kind
        if k % 20 == 0:
            assert partner.give(partner.frame(now), now) is not None
            frames += 1
            if len(partner.sent) > 1000:
                del partner.sent[:500]
    assert receiver.counters["accepted"] == before + frames
    assert receiver.lost == 0
    assert receiver.counters["sessions"] == 1
    refused = {name: number for name, number in receiver.counters.items() if name.startswith("rejected")}
    assert sum(refused.values()) == count
    for reason in ("wrong signature", "replayed", "too large", "too short", "not ours", "version", "wrong size"):
        assert refused[f"rejected, {reason}"] > count // 50, refused


def test_signed_numbers_that_no_clock_shows_are_not_taken_and_impossible_times_change_nothing() -> None:
    receiver, partner, now = settled()
    for sent in (-(2**63), 2**63 - 1, 0, now + partner.ahead_ns - 10 * NANOSECONDS, now + partner.ahead_ns + 10**10):
        refused = receiver.counters["rejected, wrong time"]
        assert partner.give(signed(partner, sent, frame=Frame(2**62, (body(),))), now) is None
        assert receiver.counters["rejected, wrong time"] == refused + 1
    result = partner.give(partner.frame(now), now)
    assert result is not None and abs(result.stamp_ns - now) < 100_000
    numbers, extremes = random.Random(7), (-(2**63), -1, 0, 1, 2**62, 2**63 - 1)
    for _ in range(draws(2_000, 50_000)):
        now += NANOSECONDS
        receiver.outgoing.clear()
        receiver.ask_clock(now)
        for request, _ in receiver.outgoing:
            header = protocol.read_header(request)._replace(kind=protocol.CLOCK_ANSWER)
            times = ClockTimes(
                protocol.read_clock(request).asked_ns, numbers.choice(extremes), numbers.choice(extremes)
            )
            receiver.take(protocol.pack_clock(times, header, KEY), partner.address, now + 10**6, now + 10**6)
        header = Header(protocol.FRAME, "kinect1", partner.session, numbers.randrange(2**64), numbers.choice(extremes))
        frame = Frame(numbers.choice(extremes), (body(),), tuple(numbers.choice((0.0, math.inf)) for _ in range(4)))
        taken = receiver.take(protocol.pack_frame(frame, header, KEY), partner.address, now, now)
        assert taken is None or abs(taken.stamp_ns - now) < 20 * NANOSECONDS


@pytest.mark.parametrize("kind", ["wrongly signed", "replayed", "of an earlier session"])
def test_forged_packets_use_up_nothing_of_what_the_sender_may_send(kind: str) -> None:
    receiver, partner, now = settled()
    earlier = Partner(Receiver("kinect1", KEY), session=3)
    forged = {
        "wrongly signed": [signed(partner, now, key=b"another key another key")],
        "replayed": list(partner.sent),
        "of an earlier session": [earlier.frame(now) for _ in range(30)],
    }[kind]

    def flood(partner: Partner, now: int, frames: int) -> list[bool]:
        """12,000 packets a second that say they are of the sender; which of its own frames are taken meanwhile."""
        taken = []
        for k in range(frames):
            at = now + k * FRAME_NS
            for j in range(400):
                assert receiver.take(forged[j % len(forged)], partner.address, at, at) is None
            taken.append(partner.give(partner.frame(at), at) is not None)
        return taken

    assert all(flood(partner, now, 120))
    assert receiver.lost == 0
    # A sender that is started anew meanwhile is taken as soon as the one before counts as silent.
    again = Partner(receiver, session=11, address=partner.address)
    taken = flood(again, now + 120 * FRAME_NS, 45)
    assert all(taken[30:])


def test_one_sequence_number_far_ahead_does_not_end_the_stream() -> None:
    receiver, partner, now = settled()
    assert partner.give(signed(partner, now + partner.ahead_ns, 2**64 - 1 - partner.sequence), now) is None
    assert receiver.counters["rejected, wrong sequence"] == 1
    assert partner.give(partner.frame(now), now) is not None
    assert receiver.lost == 0
    # a link that was cut for an hour leaves a gap that is no jump
    later = now + 3600 * NANOSECONDS
    partner.sequence += 30 * 3600
    assert partner.give(partner.frame(later), later) is not None


def test_refused_packets_are_named_with_their_source() -> None:
    receiver, partner, now = settled()
    other = Partner(receiver, key=b"another key another key")
    receiver.take(other.frame(now), STRANGER, now, now)
    partner.give(partner.frame(now), now)
    problem = receiver.problem(now + 1_000_000)
    assert "signed with another key" in problem
    assert "10.0.0.66 port 666" in problem
    wrong = partner.frame(now)
    named = wrong[:8] + b"kinect2".ljust(32, b"\0") + wrong[40:]
    receiver.take(named, STRANGER, now, now)
    assert "frames of 'kinect2', expected 'kinect1'" in receiver.problem(now + 1_000_000)
    assert receiver.counters["rejected, another sensor"] == 1


# --- the backend, with sockets


@pytest.fixture
def key(tmp_path: Path) -> str:
    file = tmp_path / "key"
    file.write_bytes(KEY)
    file.chmod(0o600)
    return str(file)


Open = Callable[..., NetworkSource]


@pytest.fixture
def network() -> Iterator[Open]:
    """Opens sources that are closed in the end."""
    opened: list[NetworkSource] = []

    def open_network(port: int = 0, **settings: object) -> NetworkSource:
        source = open_source("network", SourceSettings("left", port=port, **settings))  # type: ignore[arg-type]
        assert isinstance(source, NetworkSource)
        opened.append(source)
        return source

    yield open_network
    for source in opened:
        source.close()
        assert source.read(0.0) is None


def read_frames(source: NetworkSource, count: int, sender: Sender, timeout: float = 20.0) -> list[int]:
    """Send until so many frames were read; their stamps."""
    stamps: list[int] = []
    end = time.monotonic() + timeout
    while len(stamps) < count and time.monotonic() < end:
        sender.send(Frame(time.perf_counter_ns(), (body(), body(2, 0.5))))
        frame = source.read(0.02)
        if frame is not None:
            assert [skeleton.body for skeleton in frame.skeletons] == [0, 2]
            assert frame.skeletons[0].frame_id == "left_optical_frame"
            stamps.append(frame.skeletons[0].stamp_ns)
    assert len(stamps) == count
    return stamps


@pytest.mark.parametrize("seconds", [0.5, pytest.param(20.0, marks=pytest.mark.slow)])
def test_a_real_sender_reaches_a_real_receiver_through_5000_bad_packets_a_second(
    network: Open, key: str, seconds: float
) -> None:
    source = network(key_file=key, device="kinect1")
    sender = Sender("kinect1", *source.address, protocol.read_key(key))
    partner = Partner(Receiver("kinect1", KEY), session=5, key=b"another key another key")
    forged = partner.frame(0)
    pool = [packet for _ in range(30) for _, packet in attacks(random.Random(2), partner, 0)]
    ended = threading.Event()
    sent = 0

    def attack() -> None:
        nonlocal sent
        begin = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bad:
            while not ended.wait(0.002):
                while sent < 5000 * (time.monotonic() - begin):
                    bad.sendto(pool[sent % len(pool)], source.address)
                    sender._socket.sendto(forged, source.address)  # type: ignore[union-attr]  # from its address
                    sent += 2

    stamps = read_frames(source, 5, sender)
    thread = threading.Thread(target=attack)
    thread.start()
    end = time.monotonic() + seconds
    while time.monotonic() < end or len(stamps) < 60:
        stamps += read_frames(source, 1, sender)
        while (frame := source.read(1.0 / 30.0)) is not None:  # one that is late; 30 frames a second are sent
            stamps.append(frame.skeletons[0].stamp_ns)
    ended.set()
    thread.join()
    sender.close()
    values = source.counters
    assert (np.diff(stamps) > 0).all()
    assert abs(stamps[-1] - time.time_ns()) < 5 * NANOSECONDS
    assert len(stamps) <= int(str(values["accepted"])) <= sender.sent
    assert values["sessions"] == 1
    # a socket that overflows drops some before anybody sees them
    assert sum(int(str(values[name])) for name in values if name.startswith("rejected")) > min(1000.0, 0.5 * sent)
    # the first ones are asked for, and not taken
    assert seconds < 20.0 or (sent > 90_000 and sender.sent - len(stamps) <= 4 + 0.01 * sender.sent)


def test_a_sender_and_a_receiver_of_one_machine_need_no_key_and_survive_each_other(network: Open) -> None:
    source = network()
    host, port = source.address
    sender = Sender("left", host, port, protocol.NO_KEY)
    read_frames(source, 5, sender)
    source.close()
    source.read(0.0)
    for _ in range(20):  # nobody listens now
        sender.send(Frame(time.perf_counter_ns(), (body(),)))
        time.sleep(0.005)
    read_frames(network(port), 5, sender)
    sender.close()


def test_coordinates_are_those_of_the_optical_frame_and_damaged_ones_are_not_tracked() -> None:
    seen = body()
    damaged = ((float("nan"), 0.0, 0.0), (1e6, 0.0, 0.0), *seen.positions[2:])
    skeleton = skeleton_of(seen._replace(positions=damaged), 5, "f")
    assert skeleton.states[:2].tolist() == [0, 0]
    assert np.isnan(skeleton.positions[:2]).all()
    # camera space has x to the sensor's left and y up
    np.testing.assert_allclose(skeleton.positions[3], np.array(seen.positions[3]) * [-1, -1, 1])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"address": "0.0.0.0"}, "needs the parameter 'key_file'"),
        ({"address": "192.0.2.7"}, "needs the parameter 'key_file'"),
        ({"address": "lab-pc"}, "expected an IP address"),
        ({"key_file": "/nowhere"}, "/nowhere: cannot be read"),
        ({"device": "a/b"}, "sensor name 'a/b'"),
        ({"address": "192.0.2.7", "key_file": "KEY"}, r"cannot listen on 192\.0\.2\.7"),
        ({"port": "TAKEN"}, "cannot listen on 127.0.0.1 port "),
    ],
)
def test_what_is_not_safe_or_not_there_is_refused(
    network: Open, key: str, settings: dict[str, object], said: str
) -> None:
    stand_ins = {"KEY": key, "TAKEN": network().address[1]}
    with pytest.raises(BodyTrackingError, match=said):
        network(**{name: stand_ins.get(str(value), value) for name, value in settings.items()})
