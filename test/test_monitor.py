"""Rates of a node's messages: per second, or of a bag per second of its time."""

from __future__ import annotations

import time

import pytest

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.ros import monitor
from body_tracking.ros.monitor import Monitor

KEY, TOPIC, HZ = "rate in /kinect1/skeleton", "/kinect1/skeleton", 30


class Sensor:
    """A sensor of 30 Hz in a bag, and the reports of a node that hears it, one a second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall, self.played, self.frames, self.monitor = 0.0, 0.0, 0, Monitor()
        monkeypatch.setattr(time, "monotonic", lambda: self.wall)
        monkeypatch.setattr(monitor, "time", time)
        self.monitor._since = 0.0

    def reports(self, count: int, speed: float, simulated: bool = True) -> list[float]:
        """The rates in this many reports, at a playback speed."""
        found = []
        for _ in range(count):
            self.wall, self.played = self.wall + 1.0, self.played + speed
            while self.frames < int(self.played * HZ + 1e-6):
                self.frames += 1
                self.monitor.arrived(TOPIC)
            values = self.monitor.values(round(self.played * NANOSECONDS) if simulated else None)
            found.append(float(str(values[KEY])))
        return found


def test_errors_in_another_thread_end_no_report() -> None:
    """``kinect_skeleton`` publishes in a thread of its own."""

    class Where(str):
        """A callback whose name is printed while another one fails."""

        __slots__ = ()

        def __format__(self, spec: str) -> str:
            told.failures["timer ValueError"] += 1
            return str(self)

    told = Monitor()
    told.failures[Where("frames ValueError")] += 1
    assert told.values()["raised frames ValueError"] == 1


@pytest.mark.parametrize("speed", [0.1, 0.25, 1.0, 7.0])
def test_rate_of_a_bag_is_per_second_of_its_time(monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    assert Sensor(monkeypatch).reports(30, speed)[3:] == pytest.approx([HZ] * 27, abs=1.5)


def test_rate_without_simulated_time_is_per_second(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Sensor(monkeypatch).reports(5, 0.5, simulated=False) == [HZ / 2] * 5


def test_rate_of_a_paused_bag_is_zero_and_then_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor(monkeypatch)
    sensor.reports(5, 1.0)
    assert sensor.reports(3, 0.0) == [0.0] * 3
    assert sensor.reports(3, 1.0) == [HZ] * 3


def test_rate_of_a_lost_sensor_falls_to_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor(monkeypatch)
    sensor.reports(20, 0.25)
    sensor.frames = 10_000
    assert sensor.reports(5, 0.25)[-1] == 0.0
