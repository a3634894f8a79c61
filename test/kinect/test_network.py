"""The network receiver accepts valid packets, and refuses all others without side effects."""

from __future__ import annotations

import math
import random
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from senders import FRAME_NS, KEY, Partner, body

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinect import kinect_protocol as protocol
from body_tracking.kinect.kinect_protocol import ClockTimes, Frame, Header
from body_tracking.kinect.kinect_sender import Sender
from body_tracking.kinect.live import SourceSettings, open_source
from body_tracking.kinect.network import NetworkSource, Receiver, skeleton_of
from draws import draws
from patience import PATIENCE

START_NS = 10 * NANOSECONDS
STRANGER = ("10.0.0.66", 666)


def settled(seconds: float = 1.0) -> tuple[Receiver, Partner, int]:
    """A receiver that listens to a sender, and the time."""
    receiver = Receiver("kinect1", KEY)
    partner = Partner(receiver)
    now = START_NS
    for _ in range(round(30 * seconds)):
        partner.give(partner.frame(now), now)
        now += FRAME_NS
    del partner.sent[0]  # made the receiver ask, and was not taken
    return receiver, partner, now


# --- the good stream


def test_after_one_round_trip_every_frame_is_taken_with_its_time() -> None:
    receiver = Receiver("kinect1", KEY)
    partner = Partner(receiver)
    got = [partner.give(partner.frame(START_NS + k * FRAME_NS), START_NS + k * FRAME_NS) for k in range(90)]
    assert got[0] is None  # its session was not known to be alive
    stamps = [each.stamp_ns for each in got[1:] if each is not None]
    assert len(stamps) == 89
    # ways of one millisecond each cancel
    assert np.abs(np.array(stamps) - START_NS - FRAME_NS * np.arange(1, 90)).max() < 100_000
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
    assert receiver.counters["late or repeated, not used"] == 1
    assert receiver.lost == 2
    assert receiver.counters["accepted"] == before + 9


def test_frames_without_bodies_keep_the_stream_alive_and_a_silent_sensor_is_reported() -> None:
    receiver, partner, now = settled()
    result = partner.give(partner.frame(now, ()), now)
    assert result is not None
    assert result.frame.bodies == ()
    assert receiver.problem(now + 2_000_000) == ""
    header = Header(protocol.FRAME, "kinect1", partner.session, partner.sequence + 1, now + FRAME_NS)
    partner.give(protocol.pack_frame(Frame(0, (), None, True), header, KEY), now + FRAME_NS)
    assert receiver.problem(now + 2 * FRAME_NS) == "the sender is there, but its sensor delivers nothing"


def test_a_stream_that_stops_is_named_with_its_time_and_goes_on_by_itself() -> None:
    receiver, partner, now = settled()
    assert receiver.problem(now) == ""
    assert receiver.problem(now + 12 * NANOSECONDS) == "no frame for 12 s"
    later = now + 30 * NANOSECONDS
    result = partner.give(partner.frame(later), later)
    assert result is not None
    # thirty seconds without round trips: the prediction of the clocks still holds
    assert abs(result.stamp_ns - later) < 100_000
    assert receiver.counters["sessions"] == 1


def test_a_sender_that_is_started_anew_is_taken_once_it_answers() -> None:
    receiver, old, now = settled()
    old.give(old.frame(now), now)
    now += NANOSECONDS
    new = Partner(receiver, session=8, address=("10.0.0.5", 4343), ahead_ns=-77 * NANOSECONDS, sensor_ns=0)
    got = [new.give(new.frame(now + k * FRAME_NS), now + k * FRAME_NS) for k in range(10)]
    assert got[0] is None
    assert all(got[1:])
    stamps = [each.stamp_ns for each in got if each is not None]
    assert np.abs(np.array(stamps) - now - FRAME_NS * np.arange(1, 10)).max() < 100_000
    # packets of the old sender in flight do not count
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
            receiver_now.outgoing.clear()  # a replaying attacker cannot answer
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


@pytest.mark.parametrize("sent", [-(2**63), 2**63 - 1, 0, -10 * NANOSECONDS, 10 * NANOSECONDS])
def test_frames_of_an_impossible_time_are_refused_and_change_nothing(sent: int) -> None:
    receiver, partner, now = settled()
    when = now + partner.ahead_ns + sent if abs(sent) < 2**60 and sent else sent
    header = Header(protocol.FRAME, "kinect1", partner.session, partner.sequence + 1, when)
    assert partner.give(protocol.pack_frame(Frame(2**62, (body(),)), header, KEY), now) is None
    assert receiver.counters["rejected, wrong time"] == 1
    partner.sequence += 1
    result = partner.give(partner.frame(now), now)
    assert result is not None
    assert abs(result.stamp_ns - now) < 100_000


def attacks(numbers: random.Random, partner: Partner, now: int) -> Iterator[tuple[str, bytes]]:
    """Packets of every kind that must be refused, with their descriptions."""
    good = partner.sent[numbers.randrange(len(partner.sent))]
    yield "random", numbers.randbytes(numbers.randrange(protocol.MAX_PACKET + 200))
    yield "random behind a true header", good[:64] + numbers.randbytes(len(good) - 64)
    yield "truncated", good[: numbers.randrange(len(good))]
    yield "replayed", good
    header = Header(protocol.FRAME, "kinect1", partner.session, partner.sequence + 5, now)
    yield "wrongly signed", protocol.pack_frame(Frame(now, (body(),)), header, numbers.randbytes(32))
    yield "not signed", protocol.pack_frame(Frame(now, (body(),)), header, protocol.NO_KEY)
    yield "oversized", good + numbers.randbytes(protocol.MAX_PACKET)
    changed = bytearray(good)
    changed[numbers.randrange(len(good))] ^= 1 << numbers.randrange(8)
    yield "changed", bytes(changed)
    answer = header._replace(kind=protocol.CLOCK_ANSWER)
    yield "wrong answer", protocol.pack_clock(ClockTimes(now, 0, 0), answer, numbers.randbytes(32))
    yield "another version", good[:4] + bytes([numbers.randrange(2, 256)]) + good[5:]


def test_of_many_bad_packets_none_is_accepted_and_the_good_stream_loses_nothing() -> None:
    count = draws(10_000, 1_000_000)
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
    refused = {name: number for name, number in receiver.counters.items() if name.startswith(("rejected", "late"))}
    assert sum(refused.values()) == count
    for reason in ("wrong signature", "too large", "too short", "not ours", "version", "wrong size"):
        assert refused[f"rejected, {reason}"] > count // 50, refused


def test_signed_numbers_that_no_clock_shows_raise_nothing_and_are_not_taken() -> None:
    receiver, partner, now = settled()
    numbers, extremes = random.Random(7), (-(2**63), -1, 0, 1, 2**62, 2**63 - 1)
    for _ in range(draws(800, 50_000)):
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


def test_12000_recorded_and_forged_packets_a_second_use_up_nothing_of_the_sender_s_share() -> None:
    """From the sender's own address, while it streams and when it is started anew."""
    receiver, partner, now = settled()
    header = Header(protocol.FRAME, "kinect1", partner.session, partner.sequence + 1, now)
    earlier = Partner(Receiver("kinect1", KEY), session=3)
    bad = [protocol.pack_frame(Frame(now, (body(),)), header, b"another key another key"), *partner.sent]
    bad += [earlier.frame(now) for _ in range(30)]

    def flood(partner: Partner, now: int, frames: int) -> list[bool]:
        """Which of the sender's own frames are taken meanwhile."""
        taken = []
        for k in range(frames):
            at = now + k * FRAME_NS
            assert not any(receiver.take(bad[j % len(bad)], partner.address, at, at) for j in range(400))
            assert len(receiver.outgoing) <= 2  # of 400 packets
            taken.append(partner.give(partner.frame(at), at) is not None)
        return taken

    assert all(flood(partner, now, 30))
    assert receiver.lost == 0
    again = Partner(receiver, session=11, address=partner.address)
    assert all(flood(again, now + 30 * FRAME_NS, 40)[20:])  # once the one before counts as silent


def test_each_unknown_session_is_asked_ten_times_a_second_and_few_are_remembered() -> None:
    receiver, packet = Receiver("kinect1", KEY), Partner(Receiver("kinect1", KEY)).frame(START_NS)
    for k in range(1000):
        receiver.take(packet, STRANGER, START_NS + k * NANOSECONDS // 1000, 0)
    assert len(receiver.outgoing) == 10
    for port in range(1000):
        receiver.take(packet, ("10.0.0.66", port), START_NS + NANOSECONDS, 0)
    assert len(receiver._challenges) == 64


def test_one_sequence_number_far_ahead_does_not_end_the_stream() -> None:
    receiver, partner, now = settled()
    header = Header(protocol.FRAME, "kinect1", partner.session, 2**64 - 1, now + partner.ahead_ns)
    assert partner.give(protocol.pack_frame(Frame(now, (body(),)), header, KEY), now) is None
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


def key_file(folder: Path) -> str:
    file = folder / "key"
    file.write_bytes(KEY)
    file.chmod(0o600)
    return str(file)


def read_frames(source: NetworkSource, count: int, sender: Sender) -> list[int]:
    """Send until so many frames were read; their stamps."""
    stamps: list[int] = []
    end = time.monotonic() + PATIENCE
    while len(stamps) < count and time.monotonic() < end:
        sender.send(Frame(time.perf_counter_ns(), (body(), body(2, 0.5))))
        frame = source.read(0.02)
        if frame is not None:
            assert [skeleton.body for skeleton in frame.skeletons] == [0, 2]
            assert frame.skeletons[0].frame_id == "left_optical_frame"
            stamps.append(frame.skeletons[0].stamp_ns)
    return stamps


def open_network(**settings: object) -> NetworkSource:
    source = open_source("network", SourceSettings("left", port=0, **settings))  # type: ignore[arg-type]
    assert isinstance(source, NetworkSource)
    return source


def test_a_real_sender_reaches_a_real_receiver_through_thousands_of_bad_packets(tmp_path: Path) -> None:
    file = key_file(tmp_path)
    source = open_network(key_file=file, device="kinect1")
    sender = Sender("kinect1", *source.address, protocol.read_key(file))
    numbers, partner = random.Random(2), Partner(Receiver("kinect1", KEY), session=5)
    partner.frame(0)
    pool = [packet for _ in range(30) for _, packet in attacks(numbers, partner, 0)] + partner.sent

    stamps = read_frames(source, 5, sender)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bad:
        for k in range(60):
            for packet in pool[k % 4 :: 4]:
                bad.sendto(packet, source.address)
            stamps += read_frames(source, 1, sender)
    sender.close()
    values = source.counters
    assert (np.diff(stamps) > 0).all()
    assert abs(stamps[-1] - time.time_ns()) < 5 * NANOSECONDS
    assert len(stamps) == 65 <= int(str(values["accepted"])) <= sender.sent
    assert values["sessions"] == 1
    # a socket that overflows drops some before anybody sees them
    assert sum(int(str(values[name])) for name in values if name.startswith("rejected")) > 1000
    source.close()
    assert source.read(0.0) is None


def test_a_sender_answers_each_request_of_its_session_once_and_no_forged_one() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(PATIENCE)
        sender = Sender("kinect1", *receiver.getsockname(), KEY)
        sender.send(Frame(0, ()))
        packet, source = receiver.recvfrom(1000)
        good = protocol.read_header(packet)._replace(kind=protocol.CLOCK_REQUEST)
        requests = [(good, KEY), (good, KEY), (good._replace(session=1), KEY), (good._replace(sequence=2), b"k" * 16)]
        for header, key in requests:
            receiver.sendto(protocol.pack_clock(ClockTimes(5, 0, 0), header, key), source)
            time.sleep(0.005)
        answer, _ = receiver.recvfrom(1000)
        assert protocol.read_header(answer) == good._replace(kind=protocol.CLOCK_ANSWER)
        assert protocol.read_clock(answer).asked_ns == 5
        receiver.settimeout(0.3)
        with pytest.raises(TimeoutError):
            receiver.recvfrom(1000)
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
    ("settings", "reported"),
    [
        ({"address": "0.0.0.0"}, "needs the parameter 'key_file'"),
        ({"address": "192.0.2.7"}, "needs the parameter 'key_file'"),
        ({"address": "lab-pc"}, "expected an IP address"),
        ({"key_file": "/nowhere"}, "/nowhere: cannot be read"),
        ({"device": "a/b"}, "sensor name 'a/b'"),
    ],
)
def test_unsafe_or_unavailable_settings_are_refused(settings: dict[str, str], reported: str) -> None:
    with pytest.raises(BodyTrackingError, match=reported):
        open_network(**settings)


def test_an_address_that_cannot_be_had_is_named(tmp_path: Path) -> None:
    source = open_network()
    with pytest.raises(BodyTrackingError, match=f"cannot listen on 127.0.0.1 port {source.address[1]}"):
        open_source("network", SourceSettings("left", port=source.address[1]))
    source.close()
    source.read(0.0)
    with pytest.raises(BodyTrackingError, match=r"cannot listen on 192\.0\.2\.7"):
        open_network(address="192.0.2.7", key_file=key_file(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("forging", [False, True])
def test_5000_forged_packets_a_second_cost_at_most_one_frame_in_a_hundred(tmp_path: Path, forging: bool) -> None:
    file = key_file(tmp_path)
    source = open_network(key_file=file, device="kinect1")
    sender = Sender("kinect1", *source.address, protocol.read_key(file))
    forged = Partner(Receiver("kinect1", KEY), key=b"another key another key").frame(0)
    ended = threading.Event()
    sent = 0

    def attack() -> None:
        nonlocal sent
        begin = time.monotonic()
        while not ended.wait(0.002):
            while sent < 5000 * (time.monotonic() - begin):
                sender._socket.sendto(forged, source.address)  # type: ignore[union-attr]  # from the sender's address
                sent += 1

    def stream() -> None:
        while not ended.wait(1.0 / 30.0):
            sender.send(Frame(time.perf_counter_ns(), (body(),)))

    stamps: list[int] = []
    threads = [threading.Thread(target=each) for each in ((stream, attack) if forging else (stream,))]
    for thread in threads:
        thread.start()
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        frame = source.read(0.05)
        if frame is not None:
            stamps.append(frame.skeletons[0].stamp_ns)
    ended.set()
    for thread in threads:
        thread.join()
    values = dict(source.counters)
    print(f"{sender.sent} sent, {len(stamps)} taken, {sent / 20.0:.0f} forged a second, {values}")
    sender.close()
    source.close()
    source.read(0.0)
    assert sender.sent - len(stamps) <= 4 + 0.01 * sender.sent  # the first ones are asked for, and not taken
    assert not forging or sent > 90_000
