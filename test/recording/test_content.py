"""What is in a recording, in words, and the option that takes it."""

from __future__ import annotations

import pytest

from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, IMU, JOINT_STATE, POINT_CLOUD
from body_tracking.recording.content import content_of, in_words
from body_tracking.recording.finding import advice_for

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
MARKERS = {"/left/balls": POINT_CLOUD, "/right/balls": POINT_CLOUD, "/markers/points": POINT_CLOUD}


@pytest.mark.parametrize(
    ("options", "left"),
    [
        (
            {"sensors": ("kinect1",)},
            "depth images of camera1, kinect1; colour images of camera1; IMUs pelvis; marker points of left",
        ),
        (
            {"sensors": ("kinect1",), "depth": ("kinect1",), "imus": ("upper_trunk:pelvis",)},
            "depth images of camera1; colour images of camera1; marker points of left",
        ),
        (
            {"sensors": ("kinect1",), "camera": ("camera1",), "marker_setup": "lab"},
            "IMUs pelvis",
        ),
    ],
)
def test_sources_that_a_graph_does_not_take_are_named(options: dict[str, str | tuple[str, ...]], left: str) -> None:
    content = content_of(FIVE)
    assert not content.bodies
    assert in_words(content.without(options)) == left


def test_estimates_are_results_and_no_sensors() -> None:
    estimated = {
        "/filtered/skeleton": POINT_CLOUD,
        "/imu/forearm_left/orientation": IMU,
        "/humans/bodies/body1/joint_states": JOINT_STATE,
    }
    content = content_of(estimated)
    assert content.bodies == ("body1",) and not content.sources


def test_a_recording_of_marker_points_says_which_option_to_add() -> None:
    assert in_words(content_of(MARKERS).sources) == "marker points of left, right"
    assert in_words(content_of({"/markers/points": POINT_CLOUD}).sources) == "marker points"
    for more in ({}, {"/left/image_raw": IMAGE}):
        advice = advice_for({**MARKERS, **more}, "body_tracking view")
        assert advice.startswith("add to body_tracking view the option that takes them: --marker-setup FOLDER (")
