"""The timing of playback, with a clock that the test advances."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_bags import Stored, messages, write

from body_tracking.recording.player import Playback
from body_tracking.recording.rosbag2 import BagError, BagReader
from draws import draws

SECOND = 1_000_000_000
NOW = 5_000 * SECOND  # any steady clock


@pytest.fixture(scope="module")
def stored() -> list[Stored]:
    return messages(90)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory, stored: list[Stored]) -> Iterator[BagReader]:
    folder: Path = tmp_path_factory.mktemp("player") / "bag"
    write(folder, stored, chunk_bytes=800)
    with BagReader(folder) as reader:
        yield reader


class Run:
    """Calls a playback when it asks for it, plus a delay, and records the times of the messages."""

    def __init__(self, playback: Playback, delays: Iterator[int] | None = None) -> None:
        self.playback = playback
        self.now_ns = NOW
        self.sent: list[tuple[int, str, bytes, int]] = []
        self.clock: list[tuple[int, int]] = []
        self._delays = delays

    def step(self) -> bool:
        step = self.playback.step(self.now_ns)
        for batch in step.batches:
            self.clock.append((self.now_ns, batch.clock_ns))
            for message in batch.messages:
                assert message.log_time_ns == batch.clock_ns
                self.sent.append((self.now_ns, message.topic, message.cdr, message.log_time_ns))
        if step.wake_ns is None:
            return False
        assert step.wake_ns >= self.now_ns
        self.now_ns = step.wake_ns + (next(self._delays, 0) if self._delays is not None else 0)
        return True

    def until(self, steady_ns: int) -> None:
        while self.now_ns <= steady_ns and self.step():
            pass

    def to_the_end(self) -> None:
        for _ in range(100_000):
            if not self.step():
                return
        raise AssertionError("it does not end")

    @property
    def stored(self) -> list[Stored]:
        return [(topic, cdr, at) for _, topic, cdr, at in self.sent]


@settings(max_examples=draws(12, 40), deadline=None)
@given(
    st.floats(0.01, 500.0),
    st.sampled_from([0.0, 1.0, 100.0, 1000.0]),
    st.lists(st.integers(0, SECOND // 2), max_size=30),
)
@example(0.35, 1.0, [])  # time rounds down there and back
def test_everything_comes_in_order_never_early_and_the_clock_with_it(reader, stored, rate, clock_hz, delays):
    run = Run(Playback(reader, rate=rate, clock_hz=clock_hz), iter(delays))
    run.to_the_end()
    assert run.stored == stored and run.playback.finished and run.playback.sent == len(stored)
    for at_ns, *_, log_time_ns in run.sent:
        assert (at_ns - NOW) * rate >= (log_time_ns - stored[0][2]) - 10 * rate
    times = [clock_ns for _, clock_ns in run.clock]
    assert times == sorted(times) and times[-1] == stored[-1][2]
    # The clock is never ahead of the remaining messages.
    for (at_ns, clock_ns), following in zip(run.clock, run.clock[1:], strict=False):
        assert clock_ns <= following[1] and at_ns <= following[0]


def test_without_delays_everything_comes_on_time(reader, stored):
    run = Run(Playback(reader, rate=2.0))
    run.to_the_end()
    for at_ns, *_, log_time_ns in run.sent:
        assert abs((at_ns - NOW) * 2 - (log_time_ns - stored[0][2])) <= 4


def test_the_clock_ticks_by_the_steady_clock_or_comes_with_messages_only(reader, stored):
    run = Run(Playback(reader, rate=0.1, clock_hz=50.0))
    run.until(NOW + 2 * SECOND)
    assert [at_ns for at_ns, _ in run.clock] == [NOW + index * SECOND // 50 for index in range(101)]
    run = Run(Playback(reader, clock_hz=0.0))
    run.to_the_end()
    assert [clock_ns for _, clock_ns in run.clock] == [at for *_, at in stored]


@settings(max_examples=draws(12, 30), deadline=None)
@given(st.integers(0, SECOND), st.integers(0, 5 * SECOND))
def test_a_pause_delays_later_messages_by_its_length(reader, stored, begin, length):
    run = Run(Playback(reader))
    run.until(NOW + begin)
    before = len(run.sent)
    now = NOW + begin
    run.playback.pause(now)
    run.now_ns = now
    run.until(now + length)
    assert len(run.sent) == before or all(at <= now for at, *_ in run.sent), "nothing while it is paused"
    if not run.playback.finished:
        now += length
        run.playback.resume(now)
        run.now_ns = now
        n_before = len(run.sent)
        run.to_the_end()
        for at_ns, *_, log_time_ns in run.sent[n_before:]:
            assert at_ns - NOW - length >= log_time_ns - stored[0][2] - 2
    assert run.stored == stored


@settings(max_examples=draws(12, 30), deadline=None)
@given(st.integers(0, SECOND), st.integers(0, SECOND // 5), st.floats(0.2, 20.0))
def test_the_clock_never_runs_ahead_of_messages_that_a_pause_finds_due(reader, stored, begin, late, rate):
    """As when the process is busy: messages were due, but not sent, at the pause."""
    run = Run(Playback(reader))
    run.until(NOW + begin)
    now = NOW + begin + late
    run.playback.pause(now)
    run.now_ns = now
    run.until(now + SECOND // 10)
    run.playback.set_rate(rate, run.now_ns)
    run.playback.resume(run.now_ns)
    run.to_the_end()
    times = [clock_ns for _, clock_ns in run.clock]
    assert times == sorted(times)
    assert run.stored == stored


def test_while_paused_the_clock_stands_still_and_ticks(reader, stored):
    run = Run(Playback(reader, paused=True))
    run.until(NOW + SECOND)
    assert run.sent == [] and len(run.clock) >= 100
    assert {clock_ns for _, clock_ns in run.clock} == {stored[0][2]}


def test_the_rate_may_change_while_it_plays(reader, stored):
    run = Run(Playback(reader))
    run.until(NOW + 300_000_000)
    run.now_ns = NOW + 300_000_000
    run.playback.set_rate(10.0, run.now_ns)
    run.to_the_end()
    assert run.stored == stored
    last = run.sent[-1][0] - NOW
    assert last == pytest.approx(300_000_000 + (stored[-1][2] - stored[0][2] - 300_000_000) / 10, abs=10)
    times = [clock_ns for _, clock_ns in run.clock]
    assert times == sorted(times)


def test_it_begins_anew(reader, stored):
    run = Run(Playback(reader, loop=True, rate=20.0))
    while len(run.sent) < 3 * len(stored):
        assert run.step()
    assert run.stored == stored * 3 and run.playback.loops == 2
    run.playback.loop = False
    run.to_the_end()
    assert run.playback.finished


def test_a_bag_of_one_instant_does_not_spin(tmp_path, stored):
    write(tmp_path / "bag", stored[:1])
    with BagReader(tmp_path / "bag") as reader:
        run = Run(Playback(reader, loop=True))
        run.until(NOW + SECOND)
        assert 50 < len(run.sent) <= 101


def test_seek_continues_at_another_place_forwards_and_back(reader, stored):
    run = Run(Playback(reader, start_offset_s=0.405))
    begun = [raw.log_time_ns for raw in reader.messages()]
    run.playback.step(0)
    run.playback.seek(0.0, 0)
    assert [each.log_time_ns for batch in run.playback.step(0).batches for each in batch.messages] == begun[:1]
    with pytest.raises(BagError, match="after 60 s"):
        run.playback.seek(60.0, 0)
    run.playback.pause(0)
    run.playback.seek((begun[-1] - begun[0]) / 1e9, 0)
    assert not run.playback.step(10**9).batches[0].messages
    run.playback.resume(10**9)
    (last,) = run.playback.step(10**9).batches[-1].messages
    assert last.log_time_ns == begun[-1]


def test_start_offset_and_selection_of_topics(reader, stored):
    run = Run(Playback(reader, start_offset_s=0.405))
    run.to_the_end()
    assert run.stored == stored[41:]
    assert run.sent[0][0] - NOW == pytest.approx(5_000_000, abs=2), "the bag's time begins at the offset"
    run = Run(Playback(reader, topics=["/text", "/pose"]))
    run.to_the_end()
    assert run.stored == [item for item in stored if item[0] != "/number"]


def test_a_pause_interrupts_catching_up(tmp_path):
    many = [(topic, cdr, 0) for topic, cdr, _ in messages(1000)]
    write(tmp_path / "bag", many)
    with BagReader(tmp_path / "bag") as reader:
        playback = Playback(reader)
        step = playback.step(NOW)
        assert 0 < sum(len(batch.messages) for batch in step.batches) < 1000 and step.wake_ns == NOW
        run = Run(playback)
        run.to_the_end()
        assert playback.sent == 1000


def test_an_offset_beyond_the_end_is_an_error(reader):
    with pytest.raises(BagError, match="no message to play after 60 s"):
        Playback(reader, start_offset_s=60.0)


def test_time_stands_still_at_the_end(reader: BagReader) -> None:
    run = Run(Playback(reader))
    while run.step():
        pass
    assert run.playback.finished
    later_ns = run.now_ns + 3600 * SECOND
    assert run.playback.bag_time_ns(later_ns) == reader.end_ns
    run.playback.pause(later_ns)
    assert run.playback.bag_time_ns(later_ns) == reader.end_ns
