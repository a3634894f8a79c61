"""A recording that was made in a namespace serves like any other."""

from __future__ import annotations

from pathlib import Path

import pytest

from body_tracking import cli, graph, names
from body_tracking.doctor import PROBLEM
from body_tracking.doctor.bags import bag as examined
from body_tracking.recording.replay import replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, BagWriter, RawMessage
from body_tracking.recording.stages import ReplaySettings
from body_tracking.skeleton import NANOSECONDS

BAG = Path(__file__).resolve().parents[2] / "bags" / "tpose_wave"
SECONDS = 6.0


def copied(folder: Path, *namespaces: str) -> Path:
    """The beginning of a bag, with its topics in these namespaces."""
    with BagReader(BAG) as reader, BagWriter(folder, flush_interval_s=60.0) as writer:
        for topic, info in reader.topics.items():
            for namespace in namespaces:
                writer.add_topic(names.resolved(topic, namespace), info.type_name, info.qos)
        for message in reader.messages():
            if message.log_time_ns > reader.start_ns + SECONDS * NANOSECONDS:
                break
            for namespace in namespaces:
                topic = names.resolved(message.topic, namespace)
                writer.write(topic, message.cdr, message.log_time_ns, message.publish_time_ns)
    return folder


def contents(bag: Path) -> list[RawMessage]:
    with BagReader(bag) as reader:
        return list(reader.messages())


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copied(tmp_path_factory.mktemp("plain") / "bag", "/")


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copied(tmp_path_factory.mktemp("named") / "bag", "/lab/left")


def test_a_reader_gives_the_names_of_the_root_namespace(plain: Path, named: Path) -> None:
    with RigReader(named) as rig, BagReader(plain) as reader, BagReader(named) as recorded:
        assert (rig.namespace, rig.topics) == ("/lab/left", reader.topics)
        assert list(rig.messages()) == list(reader.messages())
        wanted = [graph.skeleton_topic("kinect2")]
        assert list(rig.messages(wanted)) == list(reader.messages(wanted)) != []
        assert list(rig.messages(["/nothing"])) == []
        assert "/lab/left/kinect1/skeleton" in recorded.topics


def test_a_replay_gives_the_same_messages(plain: Path, named: Path, tmp_path: Path) -> None:
    for bag in (plain, named):
        replay(bag, tmp_path / bag.parent.name, ReplaySettings(()))
    assert contents(tmp_path / plain.parent.name) == contents(tmp_path / named.parent.name)


def test_a_recording_of_joint_angles_is_shown_and_compared(
    named: Path, plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replay(plain, tmp_path / "plain", ReplaySettings(()))
    with BagReader(tmp_path / "plain") as reader, BagWriter(tmp_path / "named") as writer:
        for topic, info in reader.topics.items():
            writer.add_topic(names.resolved(topic, "/lab"), info.type_name, info.qos)
        for message in reader.messages():
            writer.write(names.resolved(message.topic, "/lab"), message.cdr, message.log_time_ns)
    said = []
    for bag in ("plain", "named"):
        assert cli.main(["show", str(tmp_path / bag), "--output", str(tmp_path / "shown.png")]) == 0
        shown = capsys.readouterr().out
        assert cli.main(["evaluate", str(tmp_path / bag)]) == 0
        said.append((shown.replace(bag, ""), capsys.readouterr().out.replace(bag, "")))
    assert said[0] == said[1]
    assert cli.main(["calibrate", str(named)]) == 0
    assert "kinect2" in capsys.readouterr().out


def test_the_doctor_finds_the_sensors(named: Path) -> None:
    findings = list(examined(named))
    assert not [each for each in findings if each.level == PROBLEM]
    assert any("/lab/left/kinect2/skeleton: " in each.found for each in findings)


def test_two_rigs_in_one_bag_are_not_mixed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = copied(tmp_path / "both", "/left", "/right")
    with RigReader(both) as rig, BagReader(both) as reader:
        assert rig.namespace == "/"
        assert rig.topics == reader.topics
    assert cli.main(["replay", str(both), "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "no topic /<sensor>/skeleton" in said
    assert "/left/kinect1/skeleton" in said and "/right/kinect1/skeleton" in said
