"""A recording that was made in a namespace serves like any other."""

from __future__ import annotations

from pathlib import Path

import pytest

from body_tracking import cli
from body_tracking.core import names
from body_tracking.pipeline import graph
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, BagWriter
from body_tracking.ros.doctor import PROBLEM
from body_tracking.ros.doctor import bag as examined
from excerpts import contents


def copied(bag: Path, folder: Path, *namespaces: str) -> Path:
    """A bag with the topics of another one in these namespaces."""
    with BagReader(bag) as reader, BagWriter(folder, flush_interval_s=60.0) as writer:
        for topic, info in reader.topics.items():
            for namespace in namespaces:
                writer.add_topic(names.resolved(topic, namespace), info.type_name, info.qos)
        for message in reader.messages():
            for namespace in namespaces:
                topic = names.resolved(message.topic, namespace)
                writer.write(topic, message.cdr, message.log_time_ns, message.publish_time_ns)
    return folder


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory, wave: Path) -> Path:
    return copied(wave, tmp_path_factory.mktemp("named") / "bag", "/lab/left")


def test_a_reader_gives_the_names_of_the_root_namespace(wave: Path, named: Path) -> None:
    with RigReader(named) as rig, RigReader(wave) as reader, BagReader(named) as recorded:
        assert (rig.namespace, rig.topics) == ("/lab/left", reader.topics)
        assert list(rig.messages()) == list(reader.messages())
        wanted = [graph.skeleton_topic("kinect2")]
        assert list(rig.messages(wanted)) == list(reader.messages(wanted)) != []
        assert list(rig.messages(["/nothing"])) == []
        assert "/lab/left/kinect1/skeleton" in recorded.topics


def test_a_replay_gives_the_same_messages(replayed_wave: Path, named: Path, tmp_path: Path) -> None:
    replay(named, tmp_path / "out", ReplaySettings(()))
    assert contents(tmp_path / "out") == contents(replayed_wave)


def test_a_recording_of_joint_angles_is_shown_and_compared(
    replayed_wave: Path, named: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_namespace = copied(replayed_wave, tmp_path / replayed_wave.name, "/lab")
    reported = []
    for bag in (replayed_wave, in_namespace):
        for command in ("show", "evaluate"):
            assert cli.main([command, str(bag)]) == 0
        reported.append(capsys.readouterr().out.replace(str(bag.parent), ""))
    assert reported[0] == reported[1]
    assert cli.main(["calibrate", str(named)]) == 0
    assert "kinect2" in capsys.readouterr().out


def test_the_doctor_finds_the_sensors(named: Path) -> None:
    findings = list(examined(named))
    assert not [each for each in findings if each.level == PROBLEM]
    assert any("/lab/left/kinect2/skeleton: " in each.found for each in findings)


def test_two_rigs_in_one_bag_are_not_mixed(wave: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = copied(wave, tmp_path / "both", "/left", "/right")
    with RigReader(both) as rig, BagReader(both) as reader:
        assert rig.namespace == "/"
        assert rig.topics == reader.topics
    assert cli.main(["replay", str(both), "-o", str(tmp_path / "out")]) == 2
    reported = capsys.readouterr().err
    assert "no topic /<sensor>/skeleton" in reported
    assert "/left/kinect1/skeleton" in reported and "/right/kinect1/skeleton" in reported
