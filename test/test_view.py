"""The recordings in the list of the start page."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="viser is not installed")


from body_tracking.core.message_types import JOINT_STATE, POINT_CLOUD, STRING
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter
from body_tracking.ros import view
from body_tracking.viewing.start_page import Recording

BAGS = Path(__file__).resolve().parents[1] / "bags"


def described(bag: Path) -> Recording:
    """The recording's entry in the list."""
    parser = argparse.ArgumentParser()
    view.add_parser(parser.add_subparsers())
    found = view._described(parser.parse_args(["view"]), bag, "here")
    assert isinstance(found, Recording)
    return found


def written(folder: Path, topics: dict[str, str]) -> Path:
    """A bag with these topics, and one message on another one."""
    with BagWriter(folder) as writer:
        for name, type_name in topics.items():
            writer.add_topic(name, type_name)
        writer.add_topic("/note", STRING)
        writer.write_message("/note", BAG_MESSAGES.make(STRING, data=""), 1)
    return folder


def test_other_sensors_of_a_recording_are_named() -> None:
    content = described(BAGS / "five_systems").content
    assert "sensors kinect1, kinect2; also in it, for " in content
    for each in ("--imus: forearm_left", "--marker-setup: left, right", "--marker-setup: camera1, kinect1"):
        assert each in content
    assert described(BAGS / "tpose_wave").content == "15.4 s, sensors kinect1, kinect2"


def test_a_recording_without_skeletons_says_which_option_to_add(tmp_path: Path) -> None:
    found = described(written(tmp_path / "markers", {"/left/balls": POINT_CLOUD, "/markers/points": POINT_CLOUD}))
    assert found.content == "0.0 s"
    assert "add to body_tracking view the option that takes them: --marker-setup FOLDER" in found.refusal
    assert "give up" not in found.refusal


def test_a_recording_of_angles_is_labelled_as_results(tmp_path: Path) -> None:
    angles = {"/humans/bodies/body1/joint_states": JOINT_STATE}
    found = described(written(tmp_path / "result", {**angles, "/filtered/skeleton": POINT_CLOUD}))
    assert found.content == "0.0 s, results (angles of body1)"
    assert "body_tracking show" in found.refusal
    found = described(written(tmp_path / "both", {**angles, "/kinect1/skeleton": POINT_CLOUD}))
    assert found.content == "0.0 s, results (angles of body1), sensors kinect1" and not found.refusal
