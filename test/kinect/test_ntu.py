"""NTU RGB+D skeleton files, written by a generator that follows the data set's own reader."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core.skeleton import TrackingState
from body_tracking.core.sources import NOT_FINITE
from body_tracking.kinect.csv_recording import FAR
from body_tracking.kinect.ntu import EMPTY, NtuError, NtuRecording, sensor_of
from draws import draws
from skeleton_files import FIRST_ID, skeleton_text

NAME = "S001C002P003R001A010.skeleton"


def bodies(generator: np.random.Generator, *identities: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    return [
        (identity, generator.normal(size=(25, 3)).round(4), generator.integers(0, 3, 25)) for identity in identities
    ]


def write(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


@settings(max_examples=draws(12, 25), deadline=None)
@given(st.lists(st.lists(st.integers(FIRST_ID, FIRST_ID + 4), max_size=3, unique=True), min_size=1, max_size=6))
def test_the_whole_content_of_the_file_is_read(tmp_path_factory, sequence):
    generator = np.random.default_rng(0)
    frames = [bodies(generator, *identities) for identities in sequence]
    path = write(tmp_path_factory.mktemp("ntu") / NAME, skeleton_text(frames))
    recording = NtuRecording(path)
    numbers = {identity: number for number, identity in enumerate(dict.fromkeys(chain(*sequence)))}
    found = {frame.received_ns: frame for frame in recording}
    for index, frame in enumerate(frames):
        stamp_ns = round(index * 1e9 / 30)
        if not frame:
            assert stamp_ns not in found
            continue
        assert found[stamp_ns].sensor == "kinect2"
        for skeleton, (identity, positions, states) in zip(found[stamp_ns].skeletons, frame, strict=True):
            assert (skeleton.stamp_ns, skeleton.body) == (stamp_ns, numbers[identity])
            assert skeleton.frame_id == "kinect2_optical_frame"
            np.testing.assert_allclose(skeleton.positions, positions * [-1, -1, 1], atol=1e-9)
            np.testing.assert_array_equal(skeleton.states, states)
    empty = sum(not frame for frame in frames)
    assert recording.problems == ({EMPTY: empty} if empty else {})


def test_the_camera_is_in_the_name(tmp_path):
    assert sensor_of(Path("/data/S017C003P020R002A060.skeleton")) == "kinect3"
    assert sensor_of(Path("walk.skeleton")) is None
    path = write(tmp_path / "walk.skeleton", skeleton_text([bodies(np.random.default_rng(0), 1)]))
    with pytest.raises(NtuError, match="--sensor"):
        NtuRecording(path)
    assert [frame.sensor for frame in NtuRecording(path, "side")] == ["side"]


def test_coordinates_that_are_not_finite(tmp_path):
    frame = bodies(np.random.default_rng(0), 1)
    frame[0][1][7] = [np.nan, 0, np.inf]
    recording = NtuRecording(write(tmp_path / NAME, skeleton_text([frame])))
    (found,) = recording
    assert np.isnan(found.skeletons[0].positions[7]).all()
    assert found.skeletons[0].states[7] == TrackingState.NOT_TRACKED
    assert recording.problems == {NOT_FINITE: 1}


def test_coordinates_in_millimetres_are_counted(tmp_path):
    ((identity, _, states),) = bodies(np.random.default_rng(0), 1)
    recording = NtuRecording(write(tmp_path / NAME, skeleton_text([[(identity, np.full((25, 3), 2400.0), states)]])))
    list(recording)
    assert recording.problems == {FAR: 25}


def test_a_file_cut_anywhere_is_refused_or_read_up_to_its_last_whole_frame(tmp_path):
    generator = np.random.default_rng(0)
    frames = [bodies(generator, 1, 2), bodies(generator, 1), [], bodies(generator, 1)]
    text = skeleton_text(frames)
    expected = [frame.received_ns for frame in NtuRecording(write(tmp_path / NAME, text))]
    for size in [*range(4, 200), *range(200, len(text) - 3, 61)]:
        path = write(tmp_path / NAME, text[:size])
        with pytest.raises(NtuError, match="cut off"):
            list(NtuRecording(path))
        recording = NtuRecording(path, partial=True)
        found = [frame.received_ns for frame in recording]
        assert found == expected[: len(found)] and len(found) < len(expected) and len(recording.warnings) == 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda lines: [], "empty"),
        (lambda lines: ["many", *lines[1:]], "line 1: number of frames: 'many'"),
        (lambda lines: ["-1", *lines[1:]], "line 1"),
        (lambda lines: [*lines[:1], "one", *lines[2:]], "line 2: number of bodies"),
        (lambda lines: [*lines[:2], "1 2 3", *lines[3:]], "line 3: 3 values of a body"),
        (lambda lines: [*lines[:3], "20", *lines[4:]], "line 4: 20 joints, expected 25"),
        (lambda lines: [*lines[:9], "1 2 3", *lines[10:]], "line 10: 3 values of a joint"),
        (lambda lines: [*lines[:9], lines[9].replace("1036.6", "x"), *lines[10:]], "line 10: not a number .*'x'"),
        (lambda lines: [*lines[:9], lines[9][:-1] + "3", *lines[10:]], "line 10: tracking state 3"),
        (lambda lines: [*lines, "1"], "continues after the last of 2 frames"),
    ],
)
def test_errors_name_the_line(tmp_path, change, text):
    generator = np.random.default_rng(0)
    lines = skeleton_text([bodies(generator, 1), bodies(generator, 1)]).splitlines()
    path = write(tmp_path / NAME, "".join(f"{line}\n" for line in change(lines)))
    with pytest.raises(NtuError, match=text) as caught:
        list(NtuRecording(path, partial=True))
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_binary_files_are_refused_in_one_line(tmp_path):
    path = tmp_path / NAME
    path.write_bytes(bytes(range(256)))
    with pytest.raises(NtuError, match="not a text file"):
        list(NtuRecording(path))
    with pytest.raises(NtuError, match="No such file"):
        list(NtuRecording(tmp_path / "S001C001P001R001A001.skeleton"))
