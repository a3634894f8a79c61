"""The doctor's checks of a shell and of bags, each against the real thing."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest

from body_tracking import cli
from body_tracking.recording.rosbag2 import BagReader, BagWriter
from body_tracking.ros import doctor
from body_tracking.ros.doctor import OK, PROBLEM, WARNING, Finding, bag
from body_tracking.ros.up import no_ros

BAG = Path(__file__).resolve().parents[2] / "bags" / "tpose_wave"


def worst(findings: Iterable[Finding]) -> tuple[str, str]:
    """The worst level, and the findings of that level."""
    found = list(findings)
    assert all((each.level == OK) == (not each.remedy) and "\n" not in each.found for each in found)
    level = max((each.level for each in found), key=(OK, WARNING, PROBLEM).index)
    return level, "; ".join(each.found for each in found if each.level == level)


@pytest.mark.parametrize(
    ("variables", "level", "reported"),
    [
        ({}, OK, "ROS domain 0, discovery range not set: body_tracking up stays on this machine"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, OK, "range SUBNET, other machines: those of the network"),
        ({"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, OK, "7, discovery range LOCALHOST"),
        ({"ROS_STATIC_PEERS": "10.0.0.2"}, OK, "other machines: 10.0.0.2"),
        ({"ROS_STATIC_PEERS": "10.0.0.2;10.0.0.x"}, PROBLEM, "has '10.0.0.x', which is no address"),
        ({"ROS_DOMAIN_ID": "lab"}, PROBLEM, "'lab'"),
        ({"ROS_DOMAIN_ID": "233"}, PROBLEM, "0 to 232"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, PROBLEM, "do not find each other"),
        ({"ROS_LOCALHOST_ONLY": "1"}, WARNING, "ROS_LOCALHOST_ONLY=1"),
        ({"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}, WARNING, "limits which nodes find each other"),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}, WARNING, "10.0.0.1"),
    ],
)
def test_variables_that_separate_nodes_are_named(variables: dict[str, str], level: str, reported: str) -> None:
    found = worst(doctor.environment(variables))
    assert found[0] == level
    assert reported in found[1]


def test_a_domain_that_there_is_not_is_nowhere_called_right() -> None:
    found = list(doctor.environment({"ROS_DOMAIN_ID": "300"}))
    assert [each.level for each in found] == [PROBLEM, OK]
    assert "300" not in found[1].found


def test_a_library_that_is_not_found_has_its_remedy_also_where_the_message_goes_on() -> None:
    error = "librcl_action.so: cannot open shared object file: No such file or directory"
    more = "The C extension 'rclpy/_rclpy_pybind11.so' failed to be imported while being present on the system."
    reason, remedy = doctor.cause([error, more])
    assert (reason, remedy.split()[:2]) == (error, ["unset", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"])
    assert str(no_ros(ImportError(f"{error}\n{more}"))) == f"no ROS here ({error}): {remedy}"
    assert doctor.cause(["exit code 1"]) == ("exit code 1", "see docs/troubleshooting.md")


def test_missing_libraries_come_with_the_line_that_installs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "OPTIONAL", {"numpy": ("", ""), "absent_too": ("no page", "pip install x")})
    monkeypatch.setattr(doctor, "OF_ROS", {"absent_msgs": ("no frames", "sudo apt install x")})
    found = Finding(WARNING, "absent_too is not installed: no page", "pip install x")
    assert list(doctor.libraries({})) == [found]  # pip has no message packages of ROS
    of_ros = Finding(WARNING, "absent_msgs is not installed: no frames", "sudo apt install x")
    assert list(doctor.libraries({"ROS_DISTRO": "jazzy"})) == [found, of_ros]
    monkeypatch.setattr(doctor, "NEEDED", ("mcap", "absent"))
    assert next(doctor.libraries({})) == Finding(PROBLEM, "not installed: absent", "pip install absent")


def test_a_clock_in_the_past_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.clock({}).level == OK  # synchronised or not, it is the only one
    assert doctor.clock({"ROS_STATIC_PEERS": "10.0.0.2"}).level in (OK, WARNING)
    monkeypatch.setattr(doctor.time, "time", lambda: 0.0)
    assert doctor.clock({}).level == PROBLEM


def test_a_bag_that_was_cut_off_is_played_in_part(tmp_path: Path) -> None:
    assert worst(bag(BAG))[0] == OK
    folder = tmp_path / "cut"
    shutil.copytree(BAG, folder)
    file = next(folder.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert worst(bag(folder))[0] == WARNING
    file.write_bytes(b"nothing of the kind")
    for unreadable in (folder, tmp_path / "absent"):
        assert worst(bag(unreadable))[0] == PROBLEM


def test_the_remedy_for_a_bag_that_cannot_be_read_is_one_that_helps(tmp_path: Path) -> None:
    """``bag recover`` closes bags; it converts none, and finds nothing in an empty folder."""
    metadata = "rosbag2_bagfile_information: {storage_identifier: sqlite3, relative_file_paths: [a.db3]}"
    for name, text in (("db3", metadata), ("empty", "")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metadata.yaml").write_text(text)
    (found,) = bag(tmp_path / "db3")
    assert "ros2 bag convert" in found.remedy
    (found,) = bag(tmp_path / "empty")
    assert "recover" not in found.remedy


def _copy(target: Path, keep: slice, leave_out: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Some topics of the bag, without the messages of a time in seconds."""
    with BagReader(BAG) as reader, BagWriter(target) as writer:
        topics = sorted(reader.topics)[keep]
        for topic in topics:
            writer.add_topic(topic, reader.topics[topic].type_name, reader.topics[topic].offered)
        for message in reader.messages(topics):
            if not leave_out[0] <= (message.log_time_ns - reader.start_ns) / 1e9 < leave_out[1]:
                writer.write(message.topic, message.cdr, message.log_time_ns)
    return target


def test_gaps_and_missing_sensors_of_a_bag_are_named(tmp_path: Path) -> None:
    level, found = worst(bag(_copy(tmp_path / "gap", slice(-2, None), (4.0, 6.0))))
    assert level == WARNING
    assert "longest gap 2." in found
    level, found = worst(bag(_copy(tmp_path / "none", slice(0, 2))))
    assert level == PROBLEM
    assert "no skeletons" in found


@pytest.mark.parametrize("name", ["markers_arm", "cameras_turning", "camera_reaching", "mesh_reaching", "five_systems"])
def test_a_recording_of_another_system_is_no_problem(name: str) -> None:
    """Images and inertial sensors give angles, too; where they are alone, an option says which system takes them."""
    level, found = worst(bag(BAG.with_name(name)))
    assert level == (OK if name in ("mesh_reaching", "five_systems") else WARNING)
    if level == WARNING:
        assert found.startswith(f"{BAG.with_name(name)}: no skeletons on /<sensor>/skeleton, but /")


def test_the_exit_code_is_nonzero_for_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", str(BAG)]) == cli.main(["doctor", "--bag", str(BAG)]) == 0
    assert "problems: 0, warnings: 0" in capsys.readouterr().out
    assert cli.main(["doctor", "--bag", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "problem " in said
    assert said.endswith("solve the problems first\n")
    with pytest.raises(SystemExit) as ended:
        cli.main(["doctor", "--bag"])
    assert ended.value.code == 2
