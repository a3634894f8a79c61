"""The options of ``up`` that take the topics of a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, IMU, JOINT_STATE, POINT_CLOUD
from body_tracking.core.skeleton import Joint, Skeleton, TrackingState
from body_tracking.messages.codecs import Skeletons
from body_tracking.recording import replay
from body_tracking.recording.finding import advice_for, unused, unused_imus
from body_tracking.recording.rosbag2 import BAG_WIRE, BagWriter
from body_tracking.systems import options_of

FIVE = {
    "/kinect1/skeleton": POINT_CLOUD,
    "/kinect1/depth/image_raw": IMAGE,
    "/camera1/color/image_raw/compressed": COMPRESSED_IMAGE,
    "/camera1/depth/image_raw": IMAGE,
    "/pelvis/imu/data": IMU,
    "/left/balls": POINT_CLOUD,
    "/ground_truth/joint_states": JOINT_STATE,
    "/ground_truth/skeleton": POINT_CLOUD,
}
IMAGES = "--camera, --camera-rig or --depth"
MARKERS = {"/left/balls": POINT_CLOUD, "/right/balls": POINT_CLOUD, "/markers/points": POINT_CLOUD}


@pytest.mark.parametrize(
    ("options", "left"),
    [
        ({"sensors": ("kinect1",)}, f"--depth: kinect1; {IMAGES}: camera1; --imus: pelvis; --marker-setup: left"),
        (
            {"sensors": ("kinect1",), "depth": ("kinect1",), "imus": ("upper_trunk:pelvis",)},
            f"{IMAGES}: camera1; --marker-setup: left",
        ),
        ({"sensors": ("kinect1",), "camera": ("camera1",), "marker_setup": "lab"}, "--depth: kinect1; --imus: pelvis"),
        (
            {"sensors": ("kinect1_mesh",), "computed": ("kinect1_mesh",), "depth": ("kinect1",), "marker_setup": "lab"},
            f"{IMAGES}: camera1; --imus: pelvis; --sensors: kinect1",
        ),
        ({"sensors": ("kinect1",), "camera_rig": "rig"}, "--depth: kinect1; --imus: pelvis; --marker-setup: left"),
    ],
)
def test_sources_that_a_graph_leaves_out_are_named(options: dict[str, str | tuple[str, ...]], left: str) -> None:
    assert unused(FIVE, options) == left


@pytest.mark.parametrize(
    ("options", "used"),
    [
        ({}, False),
        ({"filter": "lkf_zero_velocity"}, False),
        ({"filter": "ekf"}, True),
        ({"sensors": ()}, True),  # ekf by default
        ({"depth": ("kinect1",)}, True),  # by the mesh
        ({"imus": ()}, True),  # there are none
    ],
)
def test_a_filter_that_does_not_use_the_inertial_sensors_is_named(options: dict[str, Any], used: bool) -> None:
    note = unused_imus(options_of(**{"sensors": ("kinect1",), "imus": ("forearm_left",), **options}))
    assert note == "" if used else note.startswith("the filter lkf_") and note.endswith(": --filter ekf does")


def test_only_options_that_fit_the_images_are_advised() -> None:
    turning = {f"/camera{number}/color/image_raw/compressed": COMPRESSED_IMAGE for number in (1, 2)}
    assert advice_for(turning).endswith("the option that takes them: --camera-rig FOLDER")
    assert advice_for({"/kinect1/depth/image_raw": IMAGE}).endswith("the option that takes them: --depth SENSOR")
    everything = "--camera SENSOR, --camera-rig FOLDER, --depth SENSOR or --marker-setup FOLDER"
    assert advice_for({"/left/image_raw": IMAGE}).endswith(everything)


def test_estimates_are_no_sources() -> None:
    estimated = {
        "/filtered/skeleton": POINT_CLOUD,
        "/imu/forearm_left/orientation": IMU,
        "/humans/bodies/body1/joint_states": JOINT_STATE,
        "/humans/height": IMAGE,
    }
    assert unused(estimated, {}) == advice_for(estimated) == ""


def test_a_recording_of_marker_points_says_which_option_to_add() -> None:
    for more in ({}, {"/left/image_raw": IMAGE}):
        advice = advice_for({**MARKERS, **more}, "body_tracking view")
        assert advice.startswith("add to body_tracking view the option that takes them: --marker-setup FOLDER (")


def test_cameras_whose_skeletons_a_recording_has_are_not_corrected_as_kinects(tmp_path: Path) -> None:
    """A session of ``up --camera`` or ``--depth`` may be replayed with another filter."""
    points, states = np.zeros((len(Joint), 3)), np.full(len(Joint), TrackingState.TRACKED)
    covariances = np.broadcast_to(1e-4 * np.eye(3), (len(Joint), 3, 3))
    with BagWriter(tmp_path / "session") as writer:
        for sensor, stated in (
            ("camera1", covariances),
            ("kinect1", None),
            ("kinect2", 0.0 * covariances),
            ("silent", None),
        ):
            writer.add_topic(f"/{sensor}/skeleton", POINT_CLOUD)
            seen = Skeleton(1, f"{sensor}_optical_frame", points, states, covariances=stated)
            if sensor != "silent":
                writer.write(f"/{sensor}/skeleton", Skeletons().encode((seen,), BAG_WIRE), 1)
    parser = argparse.ArgumentParser()
    replay.add_parser(parser.add_subparsers())
    words = ["replay", str(tmp_path / "session"), "-o", "out"]
    settings = replay.settings_from(parser.parse_args(words))
    assert settings.parameters["skeleton_filter"]["not_kinects"] == ("camera1",)
    settings = replay.settings_from(parser.parse_args([*words, "--sensors", "kinect1,kinect2"]))
    assert not settings.parameters["skeleton_filter"].get("not_kinects")  # the filter names those that are not there
