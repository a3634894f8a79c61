"""The recordings in the list of the start page."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="viser is not installed")


from body_tracking.core.message_types import DIAGNOSTICS as DIAGNOSTICS_TYPE
from body_tracking.core.message_types import JOINT_STATE, POINT_CLOUD, STRING
from body_tracking.core.names import DIAGNOSTICS
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter
from body_tracking.ros import view
from body_tracking.viewing.start_page import Recording

BAGS = Path(__file__).resolve().parents[1] / "bags"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    view.add_parser(parser.add_subparsers())
    return parser.parse_args(["view"])


def described(bag: Path) -> Recording:
    """The recording's entry in the list."""
    found = view._described(arguments(), bag, "here")
    assert isinstance(found, Recording)
    return found


def written(folder: Path, topics: dict[str, str], messages: bool = True) -> Path:
    """A bag with these topics, and one message on another one."""
    with BagWriter(folder) as writer:
        for name, type_name in topics.items():
            writer.add_topic(name, type_name)
            if messages:
                writer.write(name, b"", 1)
        writer.add_topic("/note", STRING)
        writer.write_message("/note", BAG_MESSAGES.make(STRING, data=""), 1)
    return folder


def test_other_sensors_of_a_recording_are_named() -> None:
    content = described(BAGS / "five_systems").content
    assert "sensors kinect1, kinect2; also in it, for " in content
    for each in (
        "--imus: forearm_left",
        "--marker-setup: left, right",
        "--camera, --camera-rig or --depth: camera1",
        "--depth: kinect1",
    ):
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
    found = described(
        written(tmp_path / "live", {**angles, "/kinect1/skeleton": POINT_CLOUD, DIAGNOSTICS: DIAGNOSTICS_TYPE})
    )
    assert found.content == "0.0 s, angles of body1, sensors kinect1" and not found.refusal


def test_a_recording_that_was_cut_off_is_labelled_as_incomplete(tmp_path: Path) -> None:
    (whole,) = (BAGS / "tpose_wave").glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:60_000])
    assert described(cut).content.endswith(" s, incomplete, sensors kinect1, kinect2")


def test_a_recording_without_frames_cannot_be_played(tmp_path: Path) -> None:
    """As one that was begun after the bag had ended."""
    found = described(written(tmp_path / "late", {"/kinect1/skeleton": POINT_CLOUD}, messages=False))
    assert found.refusal == "It holds no message of a sensor"


def test_recordings_and_examples_come_before_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    measured, angles = {"/kinect1/skeleton": POINT_CLOUD}, {"/humans/bodies/body1/joint_states": JOINT_STATE}
    written(Path("session"), {**measured, **angles, DIAGNOSTICS: DIAGNOSTICS_TYPE})
    written(Path("replayed"), {**measured, **angles})
    written(Path("only_angles"), angles)
    first, *examples, replayed, refused = (each.path.name for each in view._recordings(arguments(), {}))
    assert (first, replayed, refused) == ("session", "replayed", "only_angles")
    assert examples[0].startswith("tpose")
