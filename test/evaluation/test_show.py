"""The table of a recording agrees with the bag."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

from body_tracking.cli import main
from body_tracking.core.message_types import JOINT_STATE, POINT_CLOUD
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.evaluation import pictures
from body_tracking.evaluation.comparison import AngleComparison
from body_tracking.evaluation.metrics import angle_errors
from body_tracking.evaluation.pictures import _panels, _side
from body_tracking.evaluation.reading import AngleSeries, EvaluationError, Tracked, nearest, read
from body_tracking.evaluation.show import summarise, summary
from body_tracking.filters import make_filter
from body_tracking.kinect.simulated import KinectErrors
from body_tracking.kinematics.positional import ANGLE_NAMES, positional_angles
from body_tracking.messages.angles import angles_to_joint_states
from body_tracking.messages.skeletons import skeletons_to_cloud
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagError, BagWriter
from body_tracking.simulation.scene import Setup, simulate

BAGS = Path(__file__).resolve().parents[2] / "bags"
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def tracked_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wave tracked by one sensor with its true pose and white noise only, with the truth."""
    noisy = replace(KinectErrors.none(), white=0.001)
    recording = simulate(Setup("two_handed_wave", seconds=9.0, standard=True, errors=noisy))
    sensor = recording.sensors[0]
    tracker = make_filter("lkf_constant_velocity")
    folder = tmp_path_factory.mktemp("evaluation") / "wave"
    topics = ("/humans/bodies/ann/joint_states", "/humans/bodies/ann/joint_states_stddev", graph.TRUE_ANGLES)
    with BagWriter(folder) as bag:
        for topic in (graph.FILTERED, graph.TRUE_SKELETON):
            bag.add_topic(topic, POINT_CLOUD)
        for topic in topics:
            bag.add_topic(topic, JOINT_STATE)
        for k in range(len(recording.truths[0].stamps_ns)):
            truth = recording.truths[0].skeleton(k)
            states, _ = angles_to_joint_states(positional_angles(truth), "ann", "world", BAG_MESSAGES)
            bag.write_message(topics[2], states, truth.stamp_ns)
            bag.write_message(graph.TRUE_SKELETON, skeletons_to_cloud((truth,), BAG_MESSAGES), truth.stamp_ns)
        for frame in recording.frames:
            seen = frame.skeletons[0]
            if frame.sensor != sensor.pose.sensor:
                continue
            world = Skeleton(seen.stamp_ns, "world", sensor.pose.apply(seen.positions), seen.states)
            result = tracker.update(world)
            assert result is not None
            bag.write_message(graph.FILTERED, skeletons_to_cloud((result,), BAG_MESSAGES), seen.stamp_ns)
            states, deviations = angles_to_joint_states(positional_angles(result), "ann", "world", BAG_MESSAGES)
            bag.write_message(topics[0], states, seen.stamp_ns)
            bag.write_message(topics[1], deviations, seen.stamp_ns)
    return folder


def series(values: list[float], stddev: list[float], name: str = "knee") -> AngleSeries:
    stamps = np.arange(len(values), dtype=np.int64) * 33_333_333
    return AngleSeries(stamps, (name,), np.radians(values)[:, None], np.radians(stddev)[:, None])


def bare(folder: Path) -> Path:
    """A bag of angles without deviations, skeletons or truth."""
    topic = "/humans/bodies/body1/joint_states"
    rng = np.random.default_rng(0)
    with BagWriter(folder) as bag:
        bag.add_topic(topic, JOINT_STATE)
        for k in range(5):
            states = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
            angles = positional_angles(Skeleton(1 + k, "world", rng.normal(size=(N_JOINTS, 3)), states))
            bag.write_message(topic, angles_to_joint_states(angles, "body1", "world", BAG_MESSAGES)[0], 1 + k)
    return folder


def test_a_summary_ignores_unknown_angles() -> None:
    row = summary(series([10.0, 170.0, 30.0, 20.0], [1.0, np.inf, 2.0, 3.0])).row("knee")
    assert row == pytest.approx({"min": 10.0, "max": 30.0, "final": 20.0, "stddev": 2.5, "known": 75.0})


def test_errors_pass_over_the_cut_at_180_degrees() -> None:
    row = summary(series([179.0, -179.0], [1.0, 0.5]), series([-179.0, 179.0], [0.0, 0.0])).row("knee")
    assert row["rms_error"] == pytest.approx(2.0)
    assert row["within_2_stddev"] == 50.0


def test_the_note_explains_the_columns_that_are_there() -> None:
    angles = series([10.0, 20.0], [1.0, 40.0])
    assert "finite:" in summary(angles).note and "in 2 sd:" not in summary(angles).note
    assert "in 2 sd:" in summary(angles, series([11.0, 20.0], [0.0, 0.0])).note


def test_an_angle_known_in_single_frames_has_no_statistics() -> None:
    estimates = np.full(200, np.nan)
    estimates[:2] = 90.0
    rare = summary(series(list(estimates), [1.0] * 200), series([0.0] * 200, [0.0] * 200)).row("knee")
    assert rare["known"] == 1.0
    assert np.isnan([rare[name] for name in ("min", "max", "final")]).all() and "rms_error" not in rare


def test_the_trunk_has_no_side_although_its_names_end_with_directions() -> None:
    names = ("thorax_lateral_right", "thorax_axial_left", "elbow_flexion_left", "elbow_flexion_right")
    assert _panels(names) == {"thorax lateral right": [0], "thorax axial left": [1], "elbow flexion": [2, 3]}
    assert [_side(name) for name in names] == ["", "", "left", "right"]


def test_the_note_says_what_an_infinite_deviation_means() -> None:
    assert "inf if unknown in most frames" in summary(series([10.0, 20.0], [np.inf, np.inf])).note
    assert "inf" not in summary(series([10.0, 20.0], [1.0, 40.0])).note.replace("finite", "")


def test_titles_stand_above_their_columns() -> None:
    fine = summary(series([-123.4, -120.0], [0.001, 0.001]), series([-123.4, -120.0], [0.0, 0.0]))
    titles, units, _, row = fine.text().splitlines()
    ends = [match.end() for match in re.finditer(r"\S+", units)]
    assert ends == [match.end() for match in re.finditer(r"\S+", row)][1:]
    assert all(titles[:end].endswith(column.title) for column, end in zip(fine.columns, ends, strict=True))


@pytest.mark.parametrize("width", [80, 120])
def test_columns_are_apart_and_those_beyond_the_width_follow_below(width: int) -> None:
    angles, truth = (series([10.0, -123.4], [s, s], "shoulder_plane_of_elevation_right") for s in (1.0, 0.0))
    table = summary(angles, truth)
    text = table.text(width)
    assert max(map(len, text.splitlines())) <= width
    assert text.count(angles.names[0]) == (2 if width == 80 else 1)
    titles = [match for line in text.splitlines() for match in re.split(" {2,}", line)]
    assert all(column.title in titles for column in table.columns)


def test_a_picture_says_its_unit_and_names_sides_only_where_there_are_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    made = pictures.figure_of

    def remembered(height: float) -> Figure:
        drawn.append(made(height))
        return drawn[-1]

    monkeypatch.setattr(pictures, "figure_of", remembered)
    for name, sides in (("knee", False), ("elbow_flexion_left", True)):
        angles = series([10.0, 20.0, 30.0], [1.0, 1.0, 1.0], name)
        pictures.draw(Tracked(Path("bag"), "body1", angles, (), None, ()), tmp_path / f"{name}.png")
        assert ("left blue" in drawn[-1].get_suptitle()) == sides
        assert drawn[-1].axes[0].get_ylabel() == "deg" and drawn[-1].axes[0].get_xlabel() == "s"


def test_an_angle_known_for_one_frame_is_a_dot(tmp_path: Path) -> None:
    """Without it an axis would reach to a value that is not drawn."""
    lone, figure = series([np.nan, 90.0, np.nan, 10.0, 11.0], [1.0] * 5), Figure()
    nothing = np.full((5, 1), np.nan)
    errors = angle_errors(lone.known, nothing, lone.stddev)
    pictures._draw_angles(figure, AngleComparison(("knee",), np.arange(5.0), lone.known, nothing, lone.stddev, errors))
    (dots,) = (line for line in figure.axes[0].lines if line.get_marker() == ".")
    assert dots.get_xydata().tolist() == [[1.0, pytest.approx(90.0)]]


def test_no_line_is_drawn_over_a_gap_and_no_frame_is_lost() -> None:
    times = np.concatenate([np.arange(30) / 30.0, 5.0 + np.arange(30) / 30.0, [9.0]])
    angles, figure = series([20.0] * 61, [1.0] * 61), Figure()
    nothing = np.full((61, 1), np.nan)
    errors = angle_errors(angles.known, nothing, angles.stddev)
    pictures._draw_angles(figure, AngleComparison(("knee",), times, angles.known, nothing, angles.stddev, errors))
    curve, dots = figure.axes[0].lines[:2]
    known = np.isfinite(curve.get_ydata())
    assert_array_equal(curve.get_xdata()[known], times)
    assert_allclose(curve.get_xdata()[~known], [29 / 30 + 0.05, 4.95, 5 + 29 / 30 + 0.05, 8.95])
    assert dots.get_xdata().tolist() == [9.0]


def test_a_truth_in_another_world_is_drawn_onto_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    states = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
    positions = rng.normal(size=(N_JOINTS, 3))
    turned = positions @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + [0.5, 0.0, -1.0]
    here, there = (Skeleton(1, "world", each, states) for each in (positions, turned))
    drawn: list[FloatArray] = []
    monkeypatch.setattr(pictures, "_draw_bones", lambda axis, points, **style: drawn.append(points))
    angles = series([10.0, 20.0], [1.0, 1.0])
    pictures._draw_person(Figure(), Tracked(Path(), "body1", angles, (here,), None, (there,)), 0)
    true, estimated = drawn
    assert_allclose(true, estimated, atol=1e-12)


def test_an_angle_never_known_is_dashes_and_infinity() -> None:
    line = summary(series([np.nan, 5.0], [np.inf, np.inf])).text().splitlines()[-1].split()
    assert line == ["knee", "-", "-", "-", "inf", "0"]


def test_the_nearest_stamp_is_the_nearest_or_none() -> None:
    stamps = np.array([0, 100, 200], dtype=np.int64)
    assert_array_equal(nearest(stamps, np.array([-5, 49, 51, 149, 260, 205]), 20), [0, -1, -1, -1, -1, 2])
    assert_array_equal(nearest(stamps, np.array([40, 60]), 50), [0, 1])
    assert_array_equal(nearest(stamps[:1], np.array([3, 400]), 50), [0, -1])


def test_a_bag_becomes_a_table_and_a_picture(
    tracked_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "new" / "wave.png"
    assert main(["show", str(tracked_bag), "-o", str(picture)]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in ANGLE_NAMES) and "wave.png" in shown and "rms err" in shown
    assert picture.read_bytes().startswith(PNG) and picture.stat().st_size > 50_000
    table = summarise(tracked_bag)
    assert table.names == ANGLE_NAMES
    elbow = table.row("elbow_flexion_left")
    assert elbow["min"] < 30.0 and 80.0 < elbow["max"] < 130.0 and elbow["known"] > 95.0
    assert elbow["rms_error"] < 1.2 * elbow["stddev"] and elbow["within_2_stddev"] > 90.0
    # straight in the T-pose, bent while waving
    assert 10.0 < table.row("humeral_rotation_left")["known"] < 80.0


def test_the_angles_are_written_as_numbers(tracked_bag: Path, tmp_path: Path) -> None:
    file, angles = tmp_path / "new" / "angles.csv", read(tracked_bag).angles
    assert main(["show", str(tracked_bag), "--csv", str(file)]) == 0
    with file.open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert len(rows) == len(angles.stamps_ns)
    for number in (0, len(rows) // 2):
        seconds, _, rest = rows[number]["time"].partition(".")
        assert int(seconds) * NANOSECONDS + int(rest) == angles.stamps_ns[number]
        for name, found, stddev in zip(angles.names, angles.known[number], angles.stddev[number], strict=True):
            cells = rows[number][name], rows[number][f"{name}_stddev"]
            if np.isnan(found):
                assert cells == ("", "")
            else:
                assert [float(cell) for cell in cells] == pytest.approx(np.degrees([found, stddev]), abs=1e-3)
    assert any(row["humeral_rotation_left"] == "" for row in rows)


def test_a_bag_without_truth_or_skeletons_is_shown_all_the_same(tmp_path: Path) -> None:
    table = summarise(bare(tmp_path / "bare"), tmp_path / "bare.png")
    assert all(table.row(name)["known"] == 0.0 and np.isinf(table.row(name)["stddev"]) for name in table.names)
    assert (tmp_path / "bare.png").read_bytes().startswith(PNG)


def test_a_truth_that_does_not_hold_these_angles_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(bare(tmp_path / "bare")), "--truth", str(BAGS / "tpose_wave")]) == 0
    shown = capsys.readouterr().out
    assert "rms err" not in shown and "tpose_wave holds no truth of these angles at these times" in shown


def test_bags_without_angles_are_reported_in_one_line(tmp_path: Path) -> None:
    angles = bare(tmp_path / "bare")
    with pytest.raises(EvaluationError, match="holds no joint angles"):
        read(BAGS / "tpose_wave")
    with pytest.raises(EvaluationError, match="no joint angles of 'bob'"):
        read(angles, "bob")
    with pytest.raises(BagError):
        read(tmp_path / "nothing")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(EvaluationError, match="file"):
        summarise(angles, tmp_path / "file" / "wave.png")


def test_the_truth_may_be_in_the_bag_that_was_played(replayed_wave: Path, wave: Path, tmp_path: Path) -> None:
    """Recordings of the live graph hold angles without ground truth."""
    table = summarise(replayed_wave, truth=wave)
    assert table.text() == summarise(replayed_wave).text()  # replay takes the truth along
    elbow = table.row("elbow_flexion_left")
    assert elbow["rms_error"] < elbow["max_error"] and elbow["true_min"] < 30.0 and elbow["true_max"] > 80.0
    with pytest.raises(EvaluationError, match="holds no truth"):
        summarise(replayed_wave, truth=bare(tmp_path / "bare"))
    other = Path(__file__).parents[2] / "bags" / "tpose_slow_down"  # simulated at the same time
    with pytest.raises(EvaluationError, match="tpose_slow_down: is another recording than"):
        summarise(replayed_wave, truth=other)
