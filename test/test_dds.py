"""The default settings of Fast DDS, and that the user's choice overrides them."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

from body_tracking.core.errors import BodyTrackingError
from body_tracking.ros import dds

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
OTHERS = ("ROS_LOCALHOST_ONLY", "FASTDDS_BUILTIN_TRANSPORTS", "ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS")
PERIOD = "{*}profiles/{*}data_writer/{*}times/{*}heartbeatPeriod/"


@pytest.fixture(autouse=True)
def nothing_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*dds.PROFILES, *OTHERS, RANGE):
        # set first, so that pytest removes the test's value afterwards
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")


def heartbeat() -> float:
    """Seconds between two heartbeats, as the file has it that Fast DDS will read."""
    (file,) = {os.environ[name] for name in dds.PROFILES}
    root = ElementTree.parse(file).getroot()
    return sum(
        float(root.findtext(PERIOD + unit) or 0) * scale for unit, scale in (("{*}sec", 1), ("{*}nanosec", 1e-9))
    )


@pytest.mark.parametrize("number", ["lab", "233", "-1"])
def test_a_domain_that_ends_the_process_is_an_error_in_one_line(number: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", number)
    with pytest.raises(BodyTrackingError, match=f"ROS_DOMAIN_ID is '{number}', expected 0 to 232"):
        dds.prepare()


def test_heartbeat_period_is_short() -> None:
    dds.prepare()
    assert heartbeat() == pytest.approx(0.1)
    assert RANGE not in os.environ
    dds.stay_on_this_machine()
    assert heartbeat() == pytest.approx(0.1)
    assert os.environ[RANGE] == "SUBNET"
    file = Path(os.environ[dds.PROFILES[0]])
    assert "<address>127.0.0.1</address>" in file.read_text()
    dds.prepare()
    assert os.environ[dds.PROFILES[0]] == str(file)


@pytest.mark.parametrize("name", dds.PROFILES)
def test_profiles_of_the_user_stay(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "/mine.xml")
    dds.prepare()
    dds.stay_on_this_machine()
    assert [os.environ.get(each) for each in dds.PROFILES] == [
        "/mine.xml" if each == name else None for each in dds.PROFILES
    ]


@pytest.mark.parametrize(
    "name, value",
    [(RANGE, "SUBNET"), *((name, "1") for name in OTHERS), ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")],
)
def test_another_choice_of_network_stays(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    dds.stay_on_this_machine()
    assert not any(each in os.environ for each in dds.PROFILES)
    assert os.environ.get(RANGE) != "SUBNET" or name == RANGE
