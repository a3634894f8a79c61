"""Each check against the real thing that it is about: files, sockets, the kernel's counters, bags."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from body_tracking import cli
from body_tracking.doctor import bags, machine
from body_tracking.doctor.environment import domain_of, environment, range_of
from body_tracking.doctor.finding import OK, PROBLEM, WARNING, Finding
from body_tracking.recording.rosbag2 import BagReader, BagWriter

BAGS = Path(__file__).resolve().parent.parent.parent / "bags"
BAG = BAGS / "tpose_wave"


def levels(findings: Iterable[Finding]) -> dict[str, str]:
    """The worst level of each check."""
    order = (OK, WARNING, PROBLEM)
    worst: dict[str, str] = {}
    for each in findings:
        worst[each.check] = max(worst.get(each.check, OK), each.level, key=order.index)
        assert (each.level == OK) == (not each.remedy), each
        assert "\n" not in each.found + each.remedy
    return worst


# --- machine


def test_the_machine_is_told_as_it_is() -> None:
    before = machine.snapshot()
    found = {each.check: each for each in machine.machine(before, machine.snapshot())}
    assert found["python"].level == OK
    assert found["cores"].found.startswith(f"{len(os.sched_getaffinity(0))} cores")
    assert set(found) == {"python", "cores", "steal", "memory"}


def test_a_host_that_keeps_the_processors_is_named() -> None:
    now = machine.snapshot()
    stolen = replace(now, total=now.total + 100, stolen=now.stolen + 30)
    assert levels(machine.machine(now, stolen))["steal"] == WARNING


@pytest.mark.parametrize(("megabytes", "level"), [(100.0, PROBLEM), (1000.0, WARNING), (8000.0, OK)])
def test_memory_must_hold_the_graph(megabytes: float, level: str) -> None:
    assert machine.memory(megabytes).level == level


def test_the_clock_says_whether_it_is_kept_and_whether_it_jumped() -> None:
    now = machine.snapshot()
    assert any(
        "ms while we looked" in each.found for each in machine.clock(now, replace(now, wall_ns=now.wall_ns + 10**8))
    )
    later = machine.snapshot()
    assert not any("jumped" in each.found for each in machine.clock(now, later))
    kept = machine.synchronised()
    assert kept is None or (isinstance(kept[0], bool) and kept[1] >= 0.0)


def test_shared_memory_that_cannot_be_written_is_a_problem(tmp_path: Path) -> None:
    assert machine.shared_memory(tmp_path).level == OK
    for folder in (Path("/proc/self"), tmp_path / "absent"):  # root may write everywhere else
        assert machine.shared_memory(folder).level == PROBLEM


def test_a_multicast_that_nobody_sends_back_is_noticed() -> None:
    assert isinstance(machine.multicast(), bool)
    assert not machine.multicast("203.0.113.7")  # no interface of ours has this address (RFC 5737)


def test_datagrams_that_the_kernel_drops_are_counted() -> None:
    before = machine.snapshot()
    with (
        contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as receiver,
        contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender,
    ):
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        receiver.bind(("127.0.0.1", 0))
        for _ in range(200):
            sender.sendto(bytes(1024), receiver.getsockname())
        after = machine.snapshot()
    finding = machine.buffers(before, after)
    assert finding.level == WARNING
    assert "found a full buffer" in finding.found


def test_too_many_participants_of_a_domain_are_a_problem_for_localhost_alone() -> None:
    domain = 97
    with ExitStack() as stack:
        for number in range(machine.PARTICIPANTS):
            taken = stack.enter_context(contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
            taken.bind(("127.0.0.1", 7400 + 250 * domain + 10 + 2 * number))
        assert levels(machine.ports(domain, True)) == {"ports": PROBLEM}
        assert levels(machine.ports(domain, False)) == {"ports": OK}
    assert levels(machine.ports(domain, True)) == {"ports": OK}
    assert levels(machine.ports(200, True)) == {"ports": WARNING}


# --- environment


def _install(folder: Path) -> str:
    (folder / "rclpy").mkdir(parents=True)
    (folder / "rclpy" / "__init__.py").touch()
    return str(folder)


def test_an_environment_as_it_should_be(tmp_path: Path) -> None:
    own = _install(tmp_path / "ros")
    variables = {"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DISTRO": "jazzy"}
    assert levels(environment({**variables, "AMENT_PREFIX_PATH": str(tmp_path)}, [own])) == dict.fromkeys(
        ("ros", "domain", "range"), OK
    )
    assert (domain_of(variables), range_of(variables)) == (7, "LOCALHOST")
    assert (domain_of({}), range_of({})) == (0, "SUBNET")


@pytest.mark.parametrize(
    ("variables", "check", "level", "said"),
    [
        ({"ROS_DOMAIN_ID": "lab"}, "domain", PROBLEM, "'lab'"),
        ({"ROS_DOMAIN_ID": "233"}, "domain", PROBLEM, "0 to 232"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCAL"}, "range", PROBLEM, "LOCALHOST"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "range", PROBLEM, "no node finds another"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "range", WARNING, "overrides"),
        ({"ROS_LOCALHOST_ONLY": "1", "ROS_STATIC_PEERS": "10.0.0.2"}, "range", WARNING, "ignored"),
        ({"FASTDDS_DEFAULT_PROFILES_FILE": "/absent.xml"}, "fast dds", PROBLEM, "no such file"),
        ({"FASTDDS_DEFAULT_PROFILES_FILE": __file__}, "fast dds", WARNING, "replaces"),
        ({"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}, "fast dds", WARNING, "who hears whom"),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}, "fast dds", WARNING, "10.0.0.1"),
        ({"ROS_DISTRO": "humble"}, "ros", WARNING, "humble"),
        ({"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}, "ros", PROBLEM, "another environment's Python"),
        ({"AMENT_PREFIX_PATH": "/opt/ros/jazzy"}, "ros", PROBLEM, "two ROS installs mix"),
    ],
)
def test_what_contradicts_is_named(
    tmp_path: Path, variables: dict[str, str], check: str, level: str, said: str
) -> None:
    found = list(environment(variables, [_install(tmp_path)]))
    assert levels(found)[check] == level
    assert any(said in each.found for each in found if each.level == level)


def test_no_ros_and_two_of_them_are_problems(tmp_path: Path) -> None:
    assert levels(environment({}, [str(tmp_path)]))["ros"] == PROBLEM
    two = [_install(tmp_path / name) for name in ("a", "b")]
    assert levels(environment({}, two))["ros"] == PROBLEM
    assert levels(environment({}, [two[0], two[0]]))["ros"] == OK


# --- bags


def test_a_whole_bag_has_what_the_graph_needs() -> None:
    assert levels(bags.bag(BAG)) == {"bag": OK}


def test_a_bag_that_was_cut_off_is_played_in_part(tmp_path: Path) -> None:
    folder = tmp_path / "cut"
    shutil.copytree(BAG, folder)
    file = next(folder.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    found = list(bags.bag(folder))
    assert levels(found)["bag"] == WARNING
    assert any("bag recover" in each.remedy for each in found)
    for path in folder.glob("*.mcap"):
        path.write_bytes(b"nothing of the kind")
    assert levels(bags.bag(folder)) == {"bag": PROBLEM}
    assert levels(bags.bag(tmp_path / "absent")) == {"bag": PROBLEM}


def _copy(source: Path, target: Path, keep: slice, leave_out: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Some topics of a bag, without what came in a time."""
    with BagReader(source) as reader, BagWriter(target) as writer:
        topics = sorted(reader.topics)[keep]
        for topic in topics:
            writer.add_topic(topic, reader.topics[topic].type_name, reader.topics[topic].offered)
        for message in reader.messages(topics):
            if not leave_out[0] <= (message.log_time_ns - reader.start_ns) / 1e9 < leave_out[1]:
                writer.write(message.topic, message.cdr, message.log_time_ns)
    return target


def test_gaps_and_missing_sensors_of_a_bag_are_named(tmp_path: Path) -> None:
    found = list(bags.bag(_copy(BAG, tmp_path / "gap", slice(-2, None), (4.0, 6.0))))
    assert levels(found) == {"bag": WARNING}
    assert any("longest gap 2." in each.found for each in found)
    assert any("one sensor, kinect2" in each.found for each in bags.bag(_copy(BAG, tmp_path / "one", slice(-1, None))))
    found = list(bags.bag(_copy(BAG, tmp_path / "none", slice(0, 2))))
    assert levels(found) == {"bag": PROBLEM}
    assert any("no skeletons" in each.found for each in found)


def test_a_long_bag_is_read_for_a_time_only() -> None:
    assert any("could be read in time" in each.found for each in bags.bag(BAG, time.monotonic()))


# --- the command


def test_the_exit_code_says_whether_there_is_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--bag-only", "--bag", str(BAG)]) == 0
    assert "0 problems, 0 warnings" in capsys.readouterr().out
    assert cli.main(["doctor", "--bag-only", "--bag", str(tmp_path), "--json"]) == 1
    content = json.loads(capsys.readouterr().out)
    assert content["counts"]["problem"] == 1
    assert content["findings"][0]["remedy"]
    assert cli.main(["doctor", "--bag-only"]) == 2
    assert cli.main(["doctor", "--seconds", "0"]) == 2
