"""Points of other motion capture systems: C3D files and exports of Motive, read and imported."""

from __future__ import annotations

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from body_tracking import cli
from body_tracking.core import so3
from body_tracking.core.c3d import MarkerError
from body_tracking.core.csv_file import CsvError
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.evaluation.reading import read
from body_tracking.markers import setup
from body_tracking.markers.codecs import SpacePoints
from body_tracking.markers.observations import Points
from body_tracking.markers.trajectories import FRAME, TrajectoryError, TrajectoryRecording, read_trajectories
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader

RATE = 100.0
UNITS = {"Meters": 1.0, "Centimeters": 1e2, "Millimeters": 1e3}


def moving(frames: int = 5) -> FloatArray:
    """(n, 3, 3) metres of three points, z up; the second is hidden in the third frame."""
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (frames, 3, 3))
    points[2, 1] = np.nan
    return points


def write_c3d(path: Path, points: FloatArray, labels: list[str]) -> Path:
    file = ezc3d.c3d()
    data = np.ones((4, points.shape[1], len(points)))
    data[:3] = 1e3 * points.transpose(2, 1, 0)
    file["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    file["data"]["points"] = data
    file.write(str(path))
    return path


def motive(points: FloatArray, unit: str = "Meters", measured: bool = True, parents: bool = False) -> str:
    """An export with a rigid body, where it expects its markers, and the measured ones."""
    solved = [f"{kind},{name}" for kind, name in (("Rigid Body", "Hand"),) for _ in range(7)]
    blocks = [*solved, *("Rigid Body Marker,Hand:Marker1" for _ in range(3))]
    if measured:
        blocks += [f'Marker,"Hand:Marker{k + 1}"' for k in range(points.shape[1]) for _ in range(3)]
    kinds, names = zip(*(block.split(",") for block in blocks), strict=True)
    quantities = ["Rotation"] * 4 + ["Position"] * (len(blocks) - 4)
    axes = ["X", "Y", "Z", "W", *"XYZ", *["X", "Y", "Z"] * ((len(blocks) - 7) // 3)]
    lines = [
        f"Format Version,1.23,Take Name,take,Export Frame Rate,{RATE:f},Length Units,{unit},Coordinate Space,Global",
        "",
        f",Type,{','.join(kinds)}",
        f",Name,{','.join(names)}",
        f",ID,{','.join('1' for _ in blocks)}",
        *([f",Parent,{','.join('' for _ in blocks)}"] if parents else []),
        f",,{','.join(quantities)}",
        f"Frame,Time (Seconds),{','.join(axes)}",
    ]
    for frame, row in enumerate(points):
        expected = np.concatenate([[0.0, 0.0, 0.0, 1.0, 9.0, 9.0, 9.0], 0.1 * np.arange(3)])
        seen = row[:, [1, 2, 0]].ravel() * UNITS[unit] if measured else []  # Motive's y points up
        cells = ["" if np.isnan(value) else f"{value:.7f}" for value in [*expected, *seen]]
        lines.append(f"{frame},{frame / RATE:.6f},{','.join(cells)}")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("unit", "parents"), [("Meters", False), ("Centimeters", True), ("Millimeters", False)])
def test_an_export_of_motive_gives_the_measured_markers_with_z_up(tmp_path: Path, unit: str, parents: bool) -> None:
    path = tmp_path / "take.csv"
    path.write_text(motive(moving(), unit, parents=parents))
    found = read_trajectories(path)
    np.testing.assert_allclose(found.positions, moving(), atol=1e-6)
    assert found.labels == ("Hand:Marker1", "Hand:Marker2", "Hand:Marker3") and not found.warnings
    assert found.stamps_ns == tuple(round(k / RATE * NANOSECONDS) for k in range(5))


def test_expected_markers_stand_in_for_measured_ones_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    path.write_text(motive(moving(), measured=False))
    found = read_trajectories(path)
    np.testing.assert_allclose(found.positions[:, 0], np.tile([0.2, 0.0, 0.1], (5, 1)))
    assert "no column of type Marker" in found.warnings[0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Length Units,Meters", "Length Units,Inches", "line 1: Length Units is 'Inches'"),
        ("Frame,Time", "Row,Time", "no line Frame,Time"),
        (",Type,", ",Kind,", None),
        ("Marker", "Bone", "no column of type Marker"),
        ("Position", "Rotation", "no column of a Position"),
        ("2,0.020000,", "2,soon,", "line 10: Time (Seconds): 'soon' is not a number"),
        ("3,0.030000,0", "3,0.030000,x", None),
        ("4,0.040000,", "4,0.040000,1,", "line 12: 22 cells, expected 21"),
    ],
)
def test_a_damaged_export_is_refused_by_its_line(tmp_path: Path, old: str, new: str, said: str | None) -> None:
    """It is read if the damaged part is not needed (None): the word Type, a rotation."""
    path = tmp_path / "take.csv"
    assert old in motive(moving())
    path.write_text(motive(moving()).replace(old, new))
    if said is None:
        np.testing.assert_allclose(read_trajectories(path).positions, moving(), atol=1e-6)
        return
    with pytest.raises(CsvError) as caught:
        read_trajectories(path)
    assert said in str(caught.value) and str(path) in str(caught.value)


def test_a_truncated_export_is_read_only_with_partial(tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    path.write_text(motive(moving())[:-60])
    with pytest.raises(CsvError, match="line 12 is cut off; 4 row"):
        read_trajectories(path)
    assert len(read_trajectories(path, partial=True).positions) == 4


def test_a_truncated_c3d_file_is_read_only_with_partial(tmp_path: Path) -> None:
    path = write_c3d(tmp_path / "take.c3d", moving(), ["a", "b", "c"])
    whole = read_trajectories(path).positions
    path.write_bytes(path.read_bytes()[: 3 * 48 - 512])  # of the last block, 3 frames of 3 points of 4 numbers
    with pytest.raises(TrajectoryError, match=r"take\.c3d: cut off after 3 of 5 frames \(--partial reads these\)"):
        read_trajectories(path)
    found = read_trajectories(path, partial=True)
    np.testing.assert_array_equal(found.positions, whole[:3])
    assert any("cut off after 3 of 5 frames" in line for line in found.warnings)


def test_points_without_labels_and_chosen_labels(tmp_path: Path) -> None:
    unlabelled = write_c3d(tmp_path / "a.c3d", moving(), ["", "", ""])
    found = [frame.points for frame in TrajectoryRecording(unlabelled)]
    assert [len(points.positions) for points in found] == [3, 3, 2, 3, 3]
    labelled = write_c3d(tmp_path / "b.c3d", moving(), ["a", "b", "c"])
    chosen = [frame.points for frame in TrajectoryRecording(labelled, ["c", "a"])]
    np.testing.assert_allclose([points.positions for points in chosen], moving()[:, [2, 0]], atol=1e-6)
    for wrong, said in (("d", "no points with the label 'd'; the labels are a, b, c"), ("a", "2 points with")):
        path = write_c3d(tmp_path / "c.c3d", moving(), ["a", "a", "c"]) if wrong == "a" else labelled
        with pytest.raises(TrajectoryError, match=said):
            list(TrajectoryRecording(path, [wrong]))
    with pytest.raises(MarkerError, match="not a C3D file"):
        (tmp_path / "d.c3d").write_text("x" * 1000)
        list(TrajectoryRecording(tmp_path / "d.c3d"))


def test_angles_among_the_points_are_no_points(tmp_path: Path) -> None:
    path = write_c3d(tmp_path / "a.c3d", moving(), ["a", "b", "Knee"])
    file = ezc3d.c3d(str(path))
    file.add_parameter("POINT", "ANGLES", ["Knee"])
    file.write(str(path))
    assert read_trajectories(path).labels == ("a", "b")


def test_what_cannot_be_a_point_is_counted(tmp_path: Path) -> None:
    points = moving()
    points[3, 0] = 1e3
    points[4] = np.nan
    path = tmp_path / "take.csv"
    path.write_text(motive(points).replace("\n1,0.010000", "\n1,0.000000"))
    recording = TrajectoryRecording(path)
    assert [len(frame.points.positions) for frame in recording] == [3, 2, 2, 0]
    assert recording.problems == {
        "frames whose time does not advance": 1,
        "points farther away than 100 m: is the unit of length right?": 1,
        "frames without a point": 1,
    }


def imported(bag: Path) -> list[Points]:
    with BagReader(bag) as reader:
        return [SpacePoints().decode(raw.cdr, BAG_WIRE) for raw in reader.messages([setup.POINTS])]


def test_files_are_imported_as_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, bag = write_c3d(tmp_path / "a.c3d", moving(), ["a", "b", "c"]), tmp_path / "bag"
    assert cli.main(["import", str(path), "-o", str(bag), "--labels", "a,b", "--noise", "0.001"]) == 0
    first, found = ezc3d.c3d(str(path))["header"]["points"]["first_frame"], imported(bag)
    assert [points.stamp_ns for points in found] == [round((first + k) / RATE * NANOSECONDS) for k in range(5)]
    for points, true in zip(found, moving()[:, :2], strict=True):
        seen = np.isfinite(true).all(axis=1)
        np.testing.assert_allclose(points.positions, true[seen], atol=1e-6)
        np.testing.assert_allclose(points.covariance, np.tile(1e-6 * np.eye(3), (seen.sum(), 1, 1)), rtol=1e-6)
        assert points.frame_id == FRAME
    capsys.readouterr()
    for words, said in (
        (["--labels", "d"], "no points with the label 'd'"),
        (["--noise", "0"], "noise of points 0 m"),
        (["--sensor", "left"], "its points are of no sensor"),
    ):
        assert cli.main(["import", str(path), "-o", str(tmp_path / "other"), *words]) == 2
        out = capsys.readouterr().err
        assert said in out and out.count("\n") == 1
        assert not (tmp_path / "other").exists()


def test_points_without_a_setup_are_refused_with_the_option_and_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, bag, out = write_c3d(tmp_path / "a.c3d", moving(), ["a", "b", "c"]), tmp_path / "bag", tmp_path / "out"
    assert cli.main(["import", str(path), "-o", str(bag)]) == 0
    capsys.readouterr()
    for words in (["replay", str(bag), "-o", str(out)], ["up", "--bag", str(bag)]):
        assert cli.main(words) == 2
        said = capsys.readouterr().err
        assert "--marker-setup" in said and "docs/markers.md" in said and said.count("\n") == 1
    assert cli.main(["replay", str(bag), "-o", str(out), "--sensors", "none"]) == 2
    assert "--marker-setup" in capsys.readouterr().err
    assert not out.exists()


def test_a_real_recording_is_imported_whole(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "marker_unlabelled" / "racing_full.c3d"
    if not path.exists():
        pytest.skip(f"{path.name} is absent")
    assert cli.main(["import", str(path), "-o", str(tmp_path / "bag")]) == 0
    data = ezc3d.c3d(str(path))["data"]["points"][:3]
    found = imported(tmp_path / "bag")
    seen = np.isfinite(data).all(axis=0).sum(axis=0)
    assert [len(points.positions) for points in found] == seen.tolist()


def test_a_c3d_file_becomes_angles_without_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two targets on a hinge: measured by their labels, tracked without them; the angle is as exact as stated."""
    rng, noise = np.random.default_rng(0), 3e-4
    angles = np.radians(40.0) * np.sin(np.linspace(0.0, 6.0, 60))
    turns = np.array([so3.quat_to_matrix(so3.exp(np.array([0.0, angle, 0.0]))) for angle in angles])
    upper = np.array([[0.0, 0.0, 0.1], [0.07, 0.0, 0.16], [-0.05, 0.03, 0.2], [0.01, -0.06, 0.25]])
    lower = np.array([[0.03, 0.02, -0.08], [-0.06, 0.0, -0.11], [0.02, -0.07, -0.2], [-0.01, 0.05, -0.27]])
    sway = 0.1 * np.sin(np.linspace(0.0, 3.0, len(angles)))[:, None, None]
    points = np.concatenate([np.broadcast_to(upper, (len(angles), 4, 3)), lower @ turns.transpose(0, 2, 1)], axis=1)
    points = points + sway + rng.normal(0.0, noise, points.shape)
    path = write_c3d(tmp_path / "knee.c3d", points, [*"abcd", *"efgh"])
    lab, bag, out = tmp_path / "lab", tmp_path / "bag", tmp_path / "angles"
    for words in (
        ["markers", "target", str(path), "--name", "thigh", "--labels", "a,b,c,d", "--setup", str(lab)],
        ["markers", "target", str(path), "--name", "shank", "--labels", "e,f,g,h", "--setup", str(lab)],
        ["import", str(path), "-o", str(bag), "--noise", str(noise)],
        ["markers", "fit", str(bag), "--joint", "knee:hinge:thigh:shank", "--setup", str(lab)],
        ["markers", "angles", str(bag), "-o", str(out), "--setup", str(lab)],
        ["replay", str(bag), "-o", str(tmp_path / "replayed"), "--marker-setup", str(lab)],
    ):
        assert cli.main(words) == 0, words
    capsys.readouterr()
    assert cli.main(["markers", "check", "--setup", str(lab)]) == 0
    whole = f"whole: body_tracking up --sensors none --marker-setup {lab} --marker-points TOPIC\n"
    assert f"joints: knee (hinge)\n{whole}" in capsys.readouterr().out
    (lab / "chain.yaml").unlink()
    assert cli.main(["markers", "check", "--setup", str(lab)]) == 0
    assert "joints: none" in capsys.readouterr().out
    tracked, replayed = read(out).angles, read(tmp_path / "replayed").angles
    np.testing.assert_array_equal(replayed.known, tracked.known)
    assert len(tracked.known) >= 0.98 * len(angles)
    found, rows = tracked.known[:, 0], np.arange(len(angles))[-len(tracked.known) :]
    # the zero and the sense of a hinge are the fit's choice
    away = min((sign * (found - found.mean()) - (angles[rows] - angles[rows].mean()) for sign in (1, -1)), key=np.std)
    # 4 balls of a target at 6 cm from the axes' centroid: some 0.3 degrees
    assert np.degrees(np.std(away)) < 0.6
    assert (np.abs(away) < 1.96 * tracked.stddev[:, 0]).mean() >= 0.9
